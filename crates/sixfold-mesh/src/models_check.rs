//! Whether a `models_info.json` describes the meshes beside it. Thresholds of pose errors depend on the diameter, and symmetries
//! accept rotated poses: with a file for other meshes, in another unit or with a wrong axis, wrong poses would count as right.
//!
//! The tolerances allow for simplified meshes and for symmetries that hold except for a detail. LM-O's file matches its meshes,
//! and the symmetries preserve the bounding boxes; in HOPE, the differences reach 0.5 mm, 0.5 % of a diameter
//! (`tests/real_data.rs`).

use sixfold_geometry::{Pose, Vec3};

use crate::models_info::{ModelInfo, ModelsInfo};
use crate::{Mesh, MeshFileError};

/// Tolerance of the diameter and of the box's corners, as a fraction of the mesh's diameter.
const SIZE_TOLERANCE: f64 = 0.05;
/// How far a symmetry may move the sides of the mesh's box, as a fraction of the diameter, where poses are scored with it.
const SYMMETRY_TOLERANCE: f64 = 0.2;
/// The same tolerance whenever a mesh is opened. Trainings report a symmetry that the mesh does not have and use it nevertheless,
/// but a symmetry that moves the mesh away is always refused.
const PLACE_TOLERANCE: f64 = 1.0;
/// Rotations at which a continuous symmetry is tested, including a full turn.
const ROTATIONS: usize = 8;

/// A mismatch with a mesh: field, found value, expected value.
type Mismatch = (String, String, String);

impl ModelsInfo {
    /// Compares diameter and box of object `id` with its mesh, and whether its symmetries leave the mesh where it is; `file` is
    /// the name in messages. An object without an entry passes.
    ///
    /// # Errors
    /// [`MeshFileError::Info`] naming object and field.
    pub fn check_mesh(&self, id: u32, mesh: &Mesh, file: &str) -> Result<(), MeshFileError> {
        let diameter = mesh.diameter();
        self.check(id, file, |info| {
            info.check_size(mesh, diameter)?;
            info.check_symmetries(mesh, diameter, PLACE_TOLERANCE)
        })
    }

    /// Checks that the symmetries of object `id` map its mesh onto itself, as far as the bounding box shows.
    ///
    /// # Errors
    /// As [`ModelsInfo::check_mesh`].
    pub fn check_symmetries(&self, id: u32, mesh: &Mesh, file: &str) -> Result<(), MeshFileError> {
        self.check(id, file, |info| info.check_symmetries(mesh, mesh.diameter(), SYMMETRY_TOLERANCE))
    }

    fn check(
        &self,
        object: u32,
        file: &str,
        check: impl FnOnce(&ModelInfo) -> Result<(), Mismatch>,
    ) -> Result<(), MeshFileError> {
        let Some(info) = self.0.get(&object) else { return Ok(()) };
        check(info).map_err(|(field, found, expected)| MeshFileError::Info {
            file: file.to_owned(),
            object,
            field,
            found,
            expected,
        })
    }
}

impl ModelInfo {
    fn check_size(&self, mesh: &Mesh, diameter: f64) -> Result<(), Mismatch> {
        let tolerance = SIZE_TOLERANCE * diameter;
        let test = |field: String, found: f64, expected: f64| {
            if (found - expected).abs() <= tolerance {
                return Ok(());
            }
            let expected =
                format!("{:.3} mm, as the mesh has it, up to {:.3} mm off", 1e3 * expected, 1e3 * tolerance);
            Err((field, format!("{:.3} mm", 1e3 * found), expected))
        };
        test("diameter".into(), self.diameter, diameter)?;
        let (low, high) = mesh.bounding_box();
        for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
            test(format!("min_{name}"), self.min[axis], low[axis])?;
            test(format!("size_{name}"), self.size[axis], high[axis] - self.min[axis])?;
        }
        Ok(())
    }

    /// Checks that every symmetry leaves the mesh's bounding box in place, as a motion of the mesh onto itself does.
    fn check_symmetries(&self, mesh: &Mesh, diameter: f64, tolerance: f64) -> Result<(), Mismatch> {
        let tolerance = tolerance * diameter;
        let test = |field: String, motion: &Pose| {
            let moved = box_motion(mesh, motion);
            if moved <= tolerance {
                return Ok(());
            }
            let found = format!("a motion that moves the sides of the mesh's box by {:.1} mm", 1e3 * moved);
            Err((
                field,
                found,
                format!("one that maps the mesh onto itself, up to {:.1} mm", 1e3 * tolerance),
            ))
        };
        for (index, motion) in self.symmetries_discrete.iter().enumerate() {
            test(format!("symmetries_discrete[{index}]"), motion)?;
        }
        for (index, symmetry) in self.symmetries_continuous.iter().enumerate() {
            for k in 1..ROTATIONS {
                let angle = k as f64 / ROTATIONS as f64 * std::f64::consts::TAU;
                test(format!("symmetries_continuous[{index}]"), &symmetry.rotation(angle))?;
            }
        }
        Ok(())
    }
}

/// How far a motion moves the sides of the mesh's axis-aligned box; infinite if it is not a rigid motion.
fn box_motion(mesh: &Mesh, motion: &Pose) -> f64 {
    let ((low, high), infinite) = (mesh.bounding_box(), Vec3::repeat(f64::INFINITY));
    let moved = mesh.vertices().iter().map(|v| motion.transform_point(v));
    let (moved_low, moved_high) =
        moved.fold((infinite, -infinite), |(low, high), p| (low.inf(&p), high.sup(&p)));
    let off = (moved_low - low).amax().max((moved_high - high).amax());
    let finite = motion.to_matrix().iter().all(|v| v.is_finite());
    if finite { off } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A box of 60 x 40 x 100 mm about (10, 0, 0) mm.
    fn block() -> Mesh {
        let corner = |k: usize| {
            let side = |axis: usize, half: f64| if k >> axis & 1 == 1 { half } else { -half };
            Vec3::new(0.01 + side(0, 0.03), side(1, 0.02), side(2, 0.05))
        };
        Mesh::new((0..8).map(corner).collect(), vec![[0, 1, 2]]).unwrap()
    }

    fn check(symmetries: &str, diameter: f64, min_x: f64) -> Result<(), String> {
        let text = format!(
            r#"{{"4": {{"diameter": {diameter}, "min_x": {min_x}, "min_y": -20, "min_z": -50,
                "size_x": 60, "size_y": 40, "size_z": 100 {symmetries}}}}}"#
        );
        let infos = ModelsInfo::parse(text.as_bytes(), "m.json").map_err(|e| e.to_string())?;
        infos.check_mesh(9, &block(), "m.json").unwrap();
        infos.check_mesh(4, &block(), "m.json").map_err(|e| e.to_string())?;
        infos.check_symmetries(4, &block(), "m.json").map_err(|e| e.to_string())
    }

    /// Seen: the diameter times 1000 gave a wrong pose recall 1.0.
    #[test]
    fn a_size_that_is_not_the_meshs_is_refused() {
        assert_eq!(check("", 123.288, -20.0), Ok(()));
        assert_eq!(check("", 128.0, -24.0), Ok(()));
        for (diameter, min_x, words) in [
            (123288.0, -20.0, ["object 4, diameter", "123288.000 mm", "123.288 mm"]),
            (0.123288, -20.0, ["object 4, diameter", "0.123 mm", "123.288 mm"]),
            (123.288, 20.0, ["object 4, min_x", "20.000 mm", "-20.000 mm"]),
        ] {
            let error = check("", diameter, min_x).unwrap_err();
            assert!(words.iter().chain(&["m.json"]).all(|w| error.contains(w)), "{error}");
        }
    }

    /// Seen: an axis of 1e308 became NaN and scored 1.0; 1000 discrete symmetries with 200 axes never ended.
    #[test]
    fn symmetries_that_are_none_are_refused() {
        let discrete = |matrix: &str| format!(r#", "symmetries_discrete": [[{matrix}]]"#);
        let about = |axis: &str, offset: &str| {
            format!(r#", "symmetries_continuous": [{{"axis": [{axis}], "offset": [{offset}]}}]"#)
        };
        // Half a turn about the vertical through the centre.
        assert_eq!(check(&discrete("-1,0,0,20, 0,-1,0,0, 0,0,1,0, 0,0,0,1"), 123.288, -20.0), Ok(()));
        // A quarter turn is not a symmetry of a box of 60 x 100 mm, nor is half a turn about another axis.
        let error = check(&discrete("0,0,1,0, 0,1,0,0, -1,0,0,0, 0,0,0,1"), 123.288, -20.0).unwrap_err();
        assert!(error.contains("symmetries_discrete[0]") && error.contains("onto itself"), "{error}");
        assert!(check(&discrete("-1,0,0,90, 0,-1,0,0, 0,0,1,0, 0,0,0,1"), 123.288, -20.0).is_err());
        // An axis far from the mesh is refused even where symmetries are not used for scores.
        let far = format!(
            r#"{{"4": {{"diameter": 123.288, "min_x": -20, "min_y": -20, "min_z": -50, "size_x": 60,
            "size_y": 40, "size_z": 100 {}}}}}"#,
            about("0,0,1", "900,0,0")
        );
        let far = ModelsInfo::parse(far.as_bytes(), "m.json").unwrap();
        assert!(far.check_mesh(4, &block(), "m.json").is_err());
        for (axis, offset, words) in [
            ("0,0,1", "900,0,0", "symmetries_continuous[0]"),
            ("1,0,0", "0,0,0", "symmetries_continuous[0]"),
            ("0,0,1e308", "10,0,0", "symmetries_continuous[0].axis"),
            ("0,0,1", "1e300,0,0", "symmetries_continuous[0].offset"),
        ] {
            let error = check(&about(axis, offset), 123.288, -20.0).unwrap_err();
            assert!(error.contains(words), "{error}");
        }
        let one = "[1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]";
        let axis = r#"{"axis": [0,0,1], "offset": [10,0,0]}"#;
        let many = format!(
            r#", "symmetries_discrete": [{}], "symmetries_continuous": [{}]"#,
            vec![one; 1000].join(","),
            vec![axis; 200].join(",")
        );
        let error = check(&many, 123.288, -20.0).unwrap_err();
        assert!(error.contains("symmetries_discrete") && error.contains("1000"), "{error}");
    }
}
