//! The record of a taught object in the object's folder: its mesh with symmetries, and its photographs with poses and masks.
//!
//! `photographs/photographs.json` has the form that `sixfold synthesize --photographs` takes: mesh, unit, and for each photograph its
//! image, camera, pose (BOP's, millimetres) and mask.

use std::path::{Path, PathBuf};

use serde_json::json;
use sixfold_bop::{GroundTruth, NewImage, SceneWriter, write_camera};
use sixfold_data::{PhotographEntry, PhotographFile};
use sixfold_estimator::{NewObject, Object, ObjectRecord, ObjectStore};
use sixfold_geometry::{Camera, Pose, RgbImage, undistort_rgb};
use sixfold_io::{limits, read_mask, read_regular_text, read_rgb, write_atomically, write_mask, write_rgb};
use sixfold_mesh::{
    FoundSymmetry, Mesh, ModelInfo, ModelsInfo, PlyFormat, SymmetryOptions, Unit, Verdict, find_symmetries,
    ply_files, sure_symmetries,
};

use crate::error::TeachError;
use crate::snapshot::Snapshot;

/// Folder of the photographs in an object's folder.
const PHOTOGRAPHS: &str = "photographs";
/// The mesh in the folder of a teaching.
const MESH: &str = "mesh.ply";
/// Noise of a surface from photographs alone, and of one from measured depth or a given mesh, as a fraction of the diameter: the mean
/// distance of taught to true meshes, 0.0074 and 0.0047 for twelve objects (results/teach.json at commit 715b9c8a).
const NOISE: f64 = 0.0075;
const NOISE_WITH_DEPTH: f64 = 0.0045;

/// A stored object.
#[derive(Debug, Clone)]
pub struct Stored {
    /// Its record.
    pub record: ObjectRecord,
    /// Symmetries that were examined, with evidence; the sure ones are stored.
    pub symmetries: Vec<FoundSymmetry>,
    /// How many photographs are kept.
    pub photographs: usize,
}

type Failure = Box<dyn std::error::Error + Send + Sync>;

impl Snapshot {
    /// Symmetries of the mesh with evidence; those that are sure by shape and colours are stored later.
    ///
    /// # Errors
    /// [`TeachError::Order`] before the mesh is made.
    pub fn symmetries(&self) -> Result<Vec<FoundSymmetry>, TeachError> {
        let mesh = self.mesh()?;
        Ok(self.symmetries_of(&mesh, ModelInfo::of_mesh(&mesh).diameter))
    }

    /// The object of this name, if it was stored from this folder as it is now, by [`Snapshot::store`].
    ///
    /// # Errors
    /// [`TeachError::Order`] before the mesh is made, [`TeachError::Store`].
    pub fn stored(&self, store: &ObjectStore, name: &str) -> Result<Option<Stored>, TeachError> {
        let (record, object, mesh) = (store.record(name)?, store.load(name)?, self.mesh()?);
        let same = object.mesh.is_some_and(|there| there.contents_hash() == mesh.contents_hash());
        if !same || record.source != self.folder().join(MESH).display().to_string() {
            return Ok(None);
        }
        Ok(Some(Stored { record, symmetries: self.symmetries()?, photographs: self.posed()?.len() }))
    }

    /// Stores the object under a name. `derive` computes the data that methods derive from it, as in [`ObjectStore::add`].
    ///
    /// # Errors
    /// [`TeachError::Order`] before the mesh is made, [`TeachError::Store`].
    pub fn store(
        &self,
        store: &ObjectStore,
        name: &str,
        replace: bool,
        derive: impl FnOnce(&Object) -> Result<(), Failure>,
    ) -> Result<Stored, TeachError> {
        let mesh = self.mesh()?;
        let mut info = ModelInfo::of_mesh(&mesh);
        let symmetries = self.symmetries_of(&mesh, info.diameter);
        (info.symmetries_discrete, info.symmetries_continuous) = sure_symmetries(&symmetries, true);
        let source = self.folder().join(MESH);
        let record = ObjectRecord::of_mesh(&source, Unit::Metre, &mesh, &info);
        let posed = self.posed()?;
        let new = NewObject { mesh: Some(&mesh), record: &record, replace };
        store.add(name, new, |object| {
            if let Some(folder) = object.file(PHOTOGRAPHS) {
                write_photographs(&folder, &posed)?;
            }
            derive(object)
        })?;
        Ok(Stored { record, symmetries, photographs: posed.len() })
    }

    /// The noise of the surface as a fraction of the diameter.
    fn noise(&self) -> f64 {
        let mut used = self.photographs().iter().filter(|p| p.left_out.is_none() && !p.left_out_by_person);
        let is_measured = self.has_given_mesh() || used.all(|p| p.depth.is_some());
        if is_measured { NOISE_WITH_DEPTH } else { NOISE }
    }

    /// No symmetry of an object seen from one side is sure: its other side was made from the seen one.
    fn symmetries_of(&self, mesh: &Mesh, diameter: f64) -> Vec<FoundSymmetry> {
        let options = SymmetryOptions { noise: self.noise() * diameter, ..SymmetryOptions::default() };
        let found = find_symmetries(mesh, &options).unwrap_or_default();
        if self.shape().is_some_and(|shape| shape.one_side) { at_most_likely(found) } else { found }
    }
}

fn at_most_likely(mut found: Vec<FoundSymmetry>) -> Vec<FoundSymmetry> {
    for symmetry in &mut found {
        symmetry.by_shape = symmetry.by_shape.min(Verdict::Likely);
        symmetry.by_shape_and_color = symmetry.by_shape_and_color.min(Verdict::Likely);
    }
    found
}

pub(crate) type Posed = (String, RgbImage, Camera, Pose, sixfold_geometry::Mask);

fn write_photographs(folder: &Path, posed: &[Posed]) -> Result<(), Failure> {
    std::fs::create_dir_all(folder)?;
    let mut photographs = vec![];
    for (number, (_, image, camera, pose, mask)) in posed.iter().enumerate() {
        let file = format!("{number:06}.png");
        let mask_file = format!("{number:06}_mask.png");
        write_rgb(&folder.join(&file), image)?;
        write_mask(&folder.join(&mask_file), mask)?;
        let (rotation, t) = (pose.rotation_matrix(), pose.translation() * 1000.0);
        photographs.push(PhotographEntry {
            image: file,
            camera: "camera.json".to_owned(),
            cam_R_m2c: std::array::from_fn(|i| rotation[(i / 3, i % 3)]),
            cam_t_m2c: [t.x, t.y, t.z],
            mask: Some(mask_file),
            depth: None,
            depth_scale: None,
        });
        if number == 0 {
            write_atomically(&folder.join("camera.json"), serde_json::to_string_pretty(camera)?.as_bytes())?;
        }
    }
    let file = PhotographFile {
        mesh: Some("../mesh.ply".to_owned()),
        unit: Some("m".to_owned()),
        floor: None,
        photographs,
    };
    let text = serde_json::to_string_pretty(&file)?;
    Ok(write_atomically(&folder.join("photographs.json"), text.as_bytes())?)
}

/// The file that lists a stored object's photographs; `None` if it has none.
pub fn photographs_of(object: &Object) -> Option<PathBuf> {
    object.file(PHOTOGRAPHS).map(|folder| folder.join("photographs.json")).filter(|file| file.is_file())
}

/// Writes a stored object as a BOP dataset: its model with `models_info.json` as object `id`, and, where it has photographs, these
/// with poses and masks as scene 1 of split `train_real`. Returns the number of images.
///
/// # Errors
/// [`TeachError::File`] if a file of the object is invalid or the dataset cannot be written.
pub fn export_bop(object: &Object, id: u32, dataset: &Path) -> Result<usize, TeachError> {
    let failed = |what: String| TeachError::File { path: dataset.to_owned(), what };
    let mesh = object.needed_mesh("ppf").map_err(|e| failed(e.to_string()))?;
    let info = object.info.clone().unwrap_or_else(|| ModelInfo::of_mesh(mesh));
    write_model(mesh, info, id, dataset).map_err(|e| failed(e.to_string()))?;
    let Some(file) = photographs_of(object) else { return Ok(0) };
    let wrong = |what: String| TeachError::File { path: file.clone(), what };
    let list = PhotographFile::read(&file).map_err(|e| wrong(e.to_string()))?;
    let folder = file.parent().unwrap_or(Path::new(""));
    let mut scene = SceneWriter::new(dataset, "train_real", 1);
    for (number, entry) in list.photographs.iter().enumerate() {
        let raw = read_rgb(&folder.join(&entry.image))?;
        let path = folder.join(&entry.camera);
        let text = read_regular_text(&path, limits::SMALL_TEXT).map_err(|e| wrong(e.to_string()))?;
        let camera: Camera =
            serde_json::from_str(&text).map_err(|e| TeachError::File { path, what: e.to_string() })?;
        let rgb = undistort_rgb(&raw, &camera).map_err(|e| wrong(e.to_string()))?;
        let camera = camera.without_distortion();
        let mask = match &entry.mask {
            Some(mask) => Some(read_mask(&folder.join(mask))?),
            None => None,
        };
        let pose = entry.pose().map_err(|e| wrong(e.to_string()))?;
        let truth = [GroundTruth::new(id, pose)];
        let masks = mask.map(|m| vec![m]);
        let image = NewImage {
            rgb: Some(&rgb),
            ground_truth: &truth,
            masks: masks.as_deref(),
            masks_visible: masks.as_deref(),
            ..NewImage::new(number as u32, &camera)
        };
        scene.add(&image).map_err(|e| failed(e.to_string()))?;
        if number == 0 {
            write_camera(dataset, &camera, 1e-3).map_err(|e| failed(e.to_string()))?;
        }
    }
    scene.finish().map_err(|e| failed(e.to_string()))?;
    Ok(list.photographs.len())
}

fn write_model(mesh: &Mesh, info: ModelInfo, id: u32, dataset: &Path) -> Result<(), Failure> {
    let folder = dataset.join("models");
    std::fs::create_dir_all(&folder)?;
    for (file, bytes) in ply_files(
        folder.join(format!("obj_{id:06}.ply")),
        mesh,
        Unit::Millimetre,
        PlyFormat::BinaryLittleEndian,
    )? {
        write_atomically(&file, &bytes)?;
    }
    ModelsInfo([(id, info)].into_iter().collect()).write(folder.join("models_info.json"))?;
    let targets = json!([]);
    write_atomically(&dataset.join("test_targets_bop19.json"), targets.to_string().as_bytes())?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::Vec3;

    use super::*;

    /// A teaching with photographs of these files of depth.
    fn snapshot(depths: &[Option<&str>], given_mesh: Option<u64>) -> Snapshot {
        let photograph = |depth: &Option<&str>| json!({"name": "a.jpg", "file": "000000.jpg", "depth": depth.map(|file| json!([file, 0.001]))});
        let photographs: Vec<_> = depths.iter().map(photograph).collect();
        let state = json!({
            "version": 1, "ruler": null, "given_camera": null, "photographs": photographs, "located": null, "volume": null,
            "shape": null, "given_mesh": given_mesh,
        });
        Snapshot { folder: PathBuf::from("teaching"), state: serde_json::from_value(state).unwrap() }
    }

    #[test]
    fn less_noise_is_expected_of_measured_depth_and_of_a_given_mesh() {
        let (plain, measured) = (None, Some("000000.png"));
        assert_eq!(snapshot(&[plain, plain], None).noise(), NOISE);
        assert_eq!(snapshot(&[plain, measured], None).noise(), NOISE);
        assert_eq!(snapshot(&[measured, measured], None).noise(), NOISE_WITH_DEPTH);
        assert_eq!(snapshot(&[plain, plain], Some(1)).noise(), NOISE_WITH_DEPTH);
        let mut one_left_out = snapshot(&[plain, measured], None);
        one_left_out.state.photographs[0].left_out = Some("blurred".to_owned());
        assert_eq!(one_left_out.noise(), NOISE_WITH_DEPTH);
    }

    #[test]
    fn a_ragged_cylinder_is_round_with_the_noise_of_photographs_only() {
        // 48 sides, every second edge of which is pushed inwards by 2 % of the diameter.
        let corner = |i: u32| {
            let (side, level) = (i % 48, i / 48);
            let radius = if side.is_multiple_of(2) { 0.035 } else { 0.0334 };
            let angle = f64::from(side) / 48.0 * std::f64::consts::TAU;
            Vec3::new(radius * angle.cos(), radius * angle.sin(), 0.0)
                + Vec3::z() * if level == 0 { -0.02 } else { 0.02 }
        };
        let sides = (0..48).flat_map(|i| {
            let (a, b) = (i, (i + 1) % 48);
            [[a, b, b + 48], [a, b + 48, a + 48]]
        });
        let caps = (1..47).flat_map(|i| [[0, i + 1, i], [48, 48 + i, 48 + i + 1]]);
        let mesh = Mesh::new((0..96).map(corner).collect(), sides.chain(caps).collect()).unwrap();
        let round = |depth| {
            let found = snapshot(&[depth], None).symmetries_of(&mesh, mesh.diameter());
            let (_, continuous) = sure_symmetries(&found, true);
            continuous.len()
        };
        assert_eq!([round(None), round(Some("000000.png"))], [1, 0]);
    }

    #[test]
    fn symmetries_of_an_assumed_side_are_never_sure() {
        let corner = |i: u32| Vec3::from([0, 1, 2].map(|k| if (i >> k) & 1 == 0 { -0.03 } else { 0.03 }));
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let faces = quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        let cube = Mesh::new((0..8).map(corner).collect(), faces).unwrap();
        let found = find_symmetries(&cube, &SymmetryOptions::default()).unwrap();
        assert!(!sure_symmetries(&found, true).0.is_empty() && !sure_symmetries(&found, false).0.is_empty());
        let unsure = at_most_likely(found.clone());
        assert_eq!(unsure.len(), found.len());
        for with_color in [false, true] {
            assert!(sure_symmetries(&unsure, with_color).0.is_empty());
            assert!(unsure.iter().any(|s| s.verdict(with_color) == Verdict::Likely));
        }
    }
}
