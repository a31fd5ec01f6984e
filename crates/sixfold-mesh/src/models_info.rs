//! BOP's `models_info.json`: diameter, bounding box and symmetries of every object model.
//!
//! The file is in millimetres, everything here in metres. Format and the meaning of the symmetries after
//! Hodan et al., BOP (2018, 2020); a symmetry is a transformation of the object onto itself.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Matrix4, Unit as UnitVector, UnitQuaternion};
use serde_json::{Map, Value, json};
use sixfold_geometry::{Pose, Vec3};

use crate::file::write_atomically;
use crate::{Mesh, MeshFileError};

const MILLIMETRE: f64 = 1e-3;
/// Largest number accepted in the file: a kilometre. Larger numbers lose digits, or overflow when squared.
const LARGEST: f64 = 1e6;
/// Largest number of discrete symmetries of an object: nuts have 12, a dodecahedron 60.
const MAX_DISCRETE: usize = 512;
/// Largest number of symmetries of an object with continuous ones in BOP's steps: 12 discrete ones about four axes.
const MAX_SYMMETRIES: usize = 16_384;

/// A symmetry under every rotation about an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContinuousSymmetry {
    /// The unit direction of the axis in the object's frame.
    pub axis: Vec3,
    /// A point on the axis, in metres.
    pub offset: Vec3,
}

impl ContinuousSymmetry {
    /// The rotation by an angle about the axis, radians.
    pub fn rotation(&self, angle: f64) -> Pose {
        let rotation = UnitQuaternion::from_axis_angle(&UnitVector::new_normalize(self.axis), angle);
        Pose::new(rotation, self.offset - rotation * self.offset)
    }
}

/// BOP's data of one object model; lengths in metres.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelInfo {
    /// Largest distance between two vertices.
    pub diameter: f64,
    /// Smallest corner of the bounding box.
    pub min: Vec3,
    /// Size of the bounding box.
    pub size: Vec3,
    /// Rigid transformations that map the object onto itself, besides the identity.
    pub symmetries_discrete: Vec<Pose>,
    /// Axes about which the object may rotate freely.
    pub symmetries_continuous: Vec<ContinuousSymmetry>,
}

impl ModelInfo {
    /// The step that BOP's evaluation uses in [`ModelInfo::symmetry_poses`].
    pub const BOP_MAX_STEP: f64 = 0.01;

    /// Diameter and bounding box of a mesh, without symmetries ([`crate::find_symmetries`] proposes them).
    pub fn of_mesh(mesh: &Mesh) -> Self {
        let (low, high) = mesh.bounding_box();
        ModelInfo {
            diameter: mesh.diameter(),
            min: low,
            size: high - low,
            symmetries_discrete: Vec::new(),
            symmetries_continuous: Vec::new(),
        }
    }

    /// Adds a symmetry: the object may rotate freely about this axis of its frame, through the centre of its box (a file's origin
    /// may be anywhere).
    pub fn rotates_freely_about(&mut self, axis: Vec3) {
        let offset = self.min + self.size * 0.5;
        self.symmetries_continuous.push(ContinuousSymmetry { axis, offset });
    }

    /// Whether there is any symmetry.
    pub fn is_symmetric(&self) -> bool {
        !self.symmetries_discrete.is_empty() || !self.symmetries_continuous.is_empty()
    }

    /// All transformations under which the object looks the same, the identity first: each discrete one
    /// (with the identity) followed by each step of every continuous one, in the order of BOP's evaluation.
    ///
    /// `max_step` is the largest distance that the vertex farthest from a continuous axis moves in one step, as a fraction of the
    /// diameter: `ceil(pi / max_step)` steps make a full turn (Hodan et al. 2020, section 2.2). [`ModelInfo::BOP_MAX_STEP`] gives
    /// 315 steps.
    ///
    /// # Panics
    /// When `max_step` is less than 1e-6, which is a programming error.
    pub fn symmetry_poses(&self, max_step: f64) -> Vec<Pose> {
        assert!(max_step >= 1e-6, "max_step {max_step} is not at least 1e-6");
        let steps = (std::f64::consts::PI / max_step).ceil().max(1.0) as usize;
        let mut turns = Vec::with_capacity(steps * self.symmetries_continuous.len());
        for symmetry in &self.symmetries_continuous {
            for step in 0..steps {
                turns.push(symmetry.rotation(step as f64 * (std::f64::consts::TAU / steps as f64)));
            }
        }
        if turns.is_empty() {
            turns.push(Pose::identity());
        }
        std::iter::once(Pose::identity())
            .chain(self.symmetries_discrete.iter().copied())
            .flat_map(|discrete| turns.iter().map(move |turn| *turn * discrete))
            .collect()
    }
}

/// The content of a `models_info.json`: the data of each object, by its id.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ModelsInfo(pub BTreeMap<u32, ModelInfo>);

impl ModelsInfo {
    /// Reads a `models_info.json`.
    ///
    /// # Errors
    /// [`MeshFileError`] naming the file, the object's id and the field.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, MeshFileError> {
        let path = path.as_ref();
        let file = path.display().to_string();
        let bytes = sixfold_io::read_regular(path, sixfold_io::limits::SMALL_TEXT)
            .map_err(|source| MeshFileError::Io { file: file.clone(), source })?;
        Self::parse(&bytes, &file)
    }

    /// Reads the bytes of a `models_info.json`; `file` is the name in messages.
    ///
    /// # Errors
    /// As [`ModelsInfo::read`].
    pub fn parse(bytes: &[u8], file: &str) -> Result<Self, MeshFileError> {
        let value: Value = serde_json::from_slice(bytes)
            .map_err(|error| MeshFileError::field(file, "document", "JSON", error.to_string()))?;
        let objects = value.as_object().ok_or_else(|| {
            MeshFileError::field(file, "document", "an object with object ids as keys", kind(&value))
        })?;
        let mut infos = BTreeMap::new();
        for (key, value) in objects {
            let id = key.parse().map_err(|_| {
                MeshFileError::field(file, "object id", "a whole number", format!("\"{key}\""))
            })?;
            infos.insert(id, Fields { file, id, value }.info()?);
        }
        Ok(ModelsInfo(infos))
    }

    /// Writes a `models_info.json` in millimetres, rounded to a picometre so that a number that was read is written unchanged.
    /// The file is written atomically.
    ///
    /// # Errors
    /// [`MeshFileError::Io`].
    pub fn write(&self, path: impl AsRef<Path>) -> Result<(), MeshFileError> {
        write_atomically(path.as_ref(), self.to_text().as_bytes())
    }

    /// The text that [`ModelsInfo::write`] writes.
    pub fn to_text(&self) -> String {
        let objects: Vec<String> =
            self.0.iter().map(|(id, info)| format!(" \"{id}\": {}", to_json(info))).collect();
        format!("{{\n{}\n}}\n", objects.join(",\n"))
    }
}

fn to_json(info: &ModelInfo) -> Value {
    let mm = |metres: f64| {
        let value = metres / MILLIMETRE;
        // Undoes the last-digit noise of the division.
        let rounded = (value * 1e9).round() / 1e9;
        json!(if rounded.is_finite() { rounded } else { value })
    };
    let mut object = Map::new();
    object.insert("diameter".into(), mm(info.diameter));
    for (axis, name) in ["x", "y", "z"].iter().enumerate() {
        object.insert(format!("min_{name}"), mm(info.min[axis]));
        object.insert(format!("size_{name}"), mm(info.size[axis]));
    }
    if !info.symmetries_discrete.is_empty() {
        let list = info.symmetries_discrete.iter().map(|pose| {
            let m = pose.to_matrix();
            let entry = |i: usize| {
                let (row, column) = (i / 4, i % 4);
                if column == 3 && row < 3 { mm(m[(row, 3)]) } else { json!(m[(row, column)]) }
            };
            Value::Array((0..16).map(entry).collect())
        });
        object.insert("symmetries_discrete".into(), Value::Array(list.collect()));
    }
    if !info.symmetries_continuous.is_empty() {
        let list = info.symmetries_continuous.iter().map(|symmetry| {
            json!({
                "axis": symmetry.axis.as_slice(),
                "offset": symmetry.offset.iter().map(|v| mm(*v)).collect::<Vec<_>>(),
            })
        });
        object.insert("symmetries_continuous".into(), Value::Array(list.collect()));
    }
    Value::Object(object)
}

/// The kind of a value, for messages.
fn kind(value: &Value) -> String {
    match value {
        Value::Array(items) => format!("an array of {}", items.len()),
        Value::Object(_) => "an object".to_owned(),
        Value::String(text) => format!("\"{}\"", crate::ply::excerpt(text)),
        other => other.to_string(),
    }
}

/// One object's entry in the file.
struct Fields<'a> {
    file: &'a str,
    id: u32,
    value: &'a Value,
}

impl Fields<'_> {
    fn error(&self, field: &str, expected: &str, found: impl Into<String>) -> MeshFileError {
        MeshFileError::field(self.file, format!("object {}, {field}", self.id), expected, found)
    }

    fn length(&self, field: &str, expected: &str, valid: impl Fn(f64) -> bool) -> Result<f64, MeshFileError> {
        let value = self.value.get(field).ok_or_else(|| self.error(field, expected, "no such field"))?;
        match value.as_f64() {
            Some(number) if valid(number) && number.abs() <= LARGEST => Ok(number * MILLIMETRE),
            _ => Err(self.error(field, expected, kind(value))),
        }
    }

    fn list(&self, field: &str) -> Result<&[Value], MeshFileError> {
        match self.value.get(field) {
            None | Some(Value::Null) => Ok(&[]),
            Some(Value::Array(items)) => Ok(items),
            Some(other) => Err(self.error(field, "a list", kind(other))),
        }
    }

    fn numbers<const N: usize>(&self, field: &str, value: Option<&Value>) -> Result<[f64; N], MeshFileError> {
        let expected = format!("{N} numbers of at most {LARGEST}");
        let Some(value) = value else { return Err(self.error(field, &expected, "no such field")) };
        value
            .as_array()
            .and_then(|items| items.iter().map(Value::as_f64).collect::<Option<Vec<f64>>>())
            .and_then(|numbers| <[f64; N]>::try_from(numbers).ok())
            .filter(|numbers| numbers.iter().all(|v| v.abs() <= LARGEST))
            .ok_or_else(|| self.error(field, &expected, kind(value)))
    }

    /// Every symmetry is evaluated for every pose, so their number is limited to keep the time reasonable.
    fn check_counts(&self) -> Result<(), MeshFileError> {
        let (discrete, continuous) =
            (self.list("symmetries_discrete")?.len(), self.list("symmetries_continuous")?.len());
        if discrete > MAX_DISCRETE {
            let expected = format!("at most {MAX_DISCRETE} symmetries");
            return Err(self.error("symmetries_discrete", &expected, discrete.to_string()));
        }
        let steps = (std::f64::consts::PI / ModelInfo::BOP_MAX_STEP).ceil() as usize;
        let all = (1 + discrete).saturating_mul(continuous.saturating_mul(steps).max(1));
        if all > MAX_SYMMETRIES {
            let expected = format!(
                "at most {MAX_SYMMETRIES} symmetries, with each discrete one at each step of each axis"
            );
            return Err(self.error("symmetries_continuous", &expected, all.to_string()));
        }
        Ok(())
    }

    fn info(&self) -> Result<ModelInfo, MeshFileError> {
        if !self.value.is_object() {
            return Err(self.error("entry", "an object with diameter, min_x ...", kind(self.value)));
        }
        let diameter = self.length("diameter", "a number above zero, in millimetres", |d| d > 0.0)?;
        let corner = |prefix: &str, expected: &str, valid: fn(f64) -> bool| {
            let axis = |name: &str| self.length(&format!("{prefix}_{name}"), expected, valid);
            Ok(Vec3::new(axis("x")?, axis("y")?, axis("z")?))
        };
        let min = corner("min", "a number, in millimetres", f64::is_finite)?;
        let size = corner("size", "a number of zero or more, in millimetres", |s| s >= 0.0)?;
        self.check_counts()?;
        let mut symmetries_discrete = Vec::new();
        for (index, entry) in self.list("symmetries_discrete")?.iter().enumerate() {
            let field = format!("symmetries_discrete[{index}]");
            let numbers: [f64; 16] = self.numbers(&field, Some(entry))?;
            let mut matrix = Matrix4::from_row_slice(&numbers);
            for row in 0..3 {
                matrix[(row, 3)] *= MILLIMETRE;
            }
            let pose = Pose::from_matrix(&matrix).map_err(|error| {
                self.error(&field, "a rigid transformation, row by row", error.to_string())
            })?;
            symmetries_discrete.push(pose);
        }
        let mut symmetries_continuous = Vec::new();
        for (index, entry) in self.list("symmetries_continuous")?.iter().enumerate() {
            let field = format!("symmetries_continuous[{index}].axis");
            let axis = Vec3::from(self.numbers::<3>(&field, entry.get("axis"))?);
            let axis = axis
                .try_normalize(1e-9)
                .ok_or_else(|| self.error(&field, "a direction", format!("{:?}", axis.as_slice())))?;
            let field = format!("symmetries_continuous[{index}].offset");
            let offset = Vec3::from(self.numbers::<3>(&field, entry.get("offset"))?) * MILLIMETRE;
            symmetries_continuous.push(ContinuousSymmetry { axis, offset });
        }
        Ok(ModelInfo { diameter, min, size, symmetries_discrete, symmetries_continuous })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const TEXT: &str = r#"{
        "10": {"diameter": 164.627, "min_x": -50.0, "min_y": -1, "min_z": 2.5,
               "size_x": 100, "size_y": 20, "size_z": 30, "extra": "kept out",
               "symmetries_discrete": [[-1,0,0,-7, 0,-1,0,3, 0,0,1,0, 0,0,0,1]]},
        "2": {"diameter": 10, "min_x": 0, "min_y": 0, "min_z": 0, "size_x": 1, "size_y": 1, "size_z": 1,
              "symmetries_continuous": [{"axis": [0, 0, 2], "offset": [5, 0, 0]}]}
    }"#;

    #[test]
    fn read_in_metres_and_written_back() {
        let infos = ModelsInfo::parse(TEXT.as_bytes(), "x.json").unwrap();
        assert_eq!(infos.0.keys().copied().collect::<Vec<_>>(), [2, 10]);
        let ten = &infos.0[&10];
        assert!((ten.diameter - 0.164627).abs() < 1e-15 && (ten.min.z - 0.0025).abs() < 1e-15);
        assert!((ten.symmetries_discrete[0].translation() - Vec3::new(-0.007, 0.003, 0.0)).norm() < 1e-12);
        assert_eq!(infos.0[&2].symmetries_continuous[0].axis, Vec3::z());
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("models_info.json");
        infos.write(&path).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains("\"diameter\":164.627,"), "{text}");
        assert_eq!(ModelsInfo::read(&path).unwrap(), infos);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "temporary files are left");
    }

    #[test]
    fn symmetries_as_in_bop() {
        let infos = ModelsInfo::parse(TEXT.as_bytes(), "x.json").unwrap();
        let discrete = infos.0[&10].symmetry_poses(ModelInfo::BOP_MAX_STEP);
        assert_eq!(discrete.len(), 2);
        assert_eq!(discrete[0], Pose::identity());
        // ceil(pi / 0.01) steps about an axis through (5 mm, 0, 0).
        let turns = infos.0[&2].symmetry_poses(ModelInfo::BOP_MAX_STEP);
        assert_eq!(turns.len(), 315);
        let on_axis = Vec3::new(0.005, 0.0, 0.7);
        for (i, turn) in turns.iter().enumerate() {
            assert!((turn.transform_point(&on_axis) - on_axis).norm() < 1e-12);
            let angle = i as f64 * std::f64::consts::TAU / 315.0;
            let moved = turn.transform_point(&Vec3::new(1.005, 0.0, 0.0));
            assert!((moved - Vec3::new(0.005 + angle.cos(), angle.sin(), 0.0)).norm() < 1e-12);
        }
        // Both kinds: each discrete symmetry with each rotation, the rotation applied last.
        let mut both = infos.0[&10].clone();
        both.symmetries_continuous = infos.0[&2].symmetries_continuous.clone();
        let poses = both.symmetry_poses(1.0);
        assert_eq!(poses.len(), 2 * 4);
        let expected = turns_of(&both, 1.0)[1] * both.symmetries_discrete[0];
        assert!((poses[5].inverse() * expected).log().amax() < 1e-12);
    }

    fn turns_of(info: &ModelInfo, step: f64) -> Vec<Pose> {
        ModelInfo { symmetries_discrete: vec![], ..info.clone() }.symmetry_poses(step)
    }

    #[test]
    fn errors_name_object_and_field() {
        for (from, to, names) in [
            ("164.627", "\"big\"", ["object 10, diameter", "above zero", "\"big\""]),
            ("164.627", "-1", ["object 10, diameter", "above zero", "-1"]),
            ("\"min_y\": -1,", "", ["object 10, min_y", "a number", "no such field"]),
            ("[[-1,0,0,-7", "[[-2,0,0,-7", ["object 10, symmetries_discrete[0]", "rigid", "not a rotation"]),
            ("[[-1,0,0,-7,", "[[0,-7,", ["object 10, symmetries_discrete[0]", "16 numbers", "array of 14"]),
            ("[0, 0, 2]", "[0, 0, 0]", ["object 2, symmetries_continuous[0].axis", "direction", "0.0"]),
            ("\"10\"", "\"ten\"", ["object id", "whole number", "ten"]),
            ("{\"diameter\": 10,", "{\"diameter\": 10", ["document", "JSON", "line 5"]),
        ] {
            assert!(TEXT.contains(from), "{from}");
            let error =
                ModelsInfo::parse(TEXT.replacen(from, to, 1).as_bytes(), "m.json").unwrap_err().to_string();
            for name in names.iter().chain(&["m.json"]) {
                assert!(error.contains(name), "{name} not in: {error}");
            }
        }
    }

    proptest! {
        #[test]
        fn bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), at in 0..TEXT.len(), to in any::<u8>()) {
            let _ = ModelsInfo::parse(&bytes, "x");
            let mut changed = TEXT.as_bytes().to_vec();
            changed[at] = to;
            let _ = ModelsInfo::parse(&changed, "x");
        }
    }
}
