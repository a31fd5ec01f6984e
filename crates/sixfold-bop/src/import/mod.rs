//! Conversion of other datasets to BOP datasets, so that every method and every score works with them.
//!
//! The formats are documented only by the authors' scripts that read them; each file names its script. The source is
//! not changed.

mod hdf5;
mod ho3d;
mod nol;
mod numpy;
mod pickle;
mod smot;
mod view_range;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde_json::{Map, Value, json};
use sixfold_geometry::{Camera, DepthImage, Mask, Pose, Progress, RgbImage};
use sixfold_io::write_atomically;
use sixfold_mesh::{Mesh, ModelInfo, ModelsInfo, PlyFormat, Unit, write_ply};

use crate::dataset_error::DatasetError;
use crate::json::At;
use crate::scene_files::{GroundTruth, GroundTruthInfo};
use crate::visibility::{VISIBILITY_DELTA, bounding_box, ground_truth_visibility};
use crate::write::{NewImage, SceneWriter, write_camera};

pub use ho3d::{Ho3dOptions, import_ho3d};
pub use nol::{NolOptions, import_nol};
pub use smot::{SmotOptions, import_smot};
pub use view_range::ViewRange;

/// Summary of a conversion.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct ImportSummary {
    /// Scenes, one for each sequence.
    pub scenes: usize,
    /// Images with at least one pose.
    pub images: usize,
    /// Ids of the objects.
    pub objects: BTreeSet<u32>,
    /// From which sides the images show each object.
    pub views: BTreeMap<u32, ViewRange>,
    /// Images that were left out because they have no annotated pose.
    pub without_poses: usize,
}

/// One image to be converted.
struct NewFrame<'a> {
    im_id: u32,
    camera: &'a Camera,
    /// A colour file, which is copied byte for byte.
    rgb_file: Option<&'a Path>,
    rgb: Option<&'a RgbImage>,
    depth: Option<&'a DepthImage>,
    /// The mask of the visible part, for images with one object; without it, visibility is computed from depth and
    /// models.
    mask: Option<&'a Mask>,
    ground_truth: &'a [GroundTruth],
}

/// A sequence of the source, which becomes a scene.
struct Sequence {
    scene_id: u32,
    name: String,
    folder: PathBuf,
    /// Ids and colour files of its images.
    images: Vec<(u32, PathBuf)>,
}

/// Writes the new dataset.
struct Importer {
    out: PathBuf,
    split: String,
    /// Metres per unit.
    depth_scale: f64,
    writer: SceneWriter,
    meshes: BTreeMap<u32, Mesh>,
    infos: ModelsInfo,
    /// Names of the sequences by scene.
    names: BTreeMap<String, String>,
    /// Cameras of all sizes there are, by size.
    cameras: BTreeMap<(usize, usize), Camera>,
    /// The poses of each object, camera_from_object.
    poses: BTreeMap<u32, Vec<Pose>>,
    summary: ImportSummary,
}

impl Importer {
    fn new(out: &Path, split: &str, depth_scale: f64) -> Importer {
        Importer {
            out: out.to_owned(),
            split: split.to_owned(),
            depth_scale,
            writer: SceneWriter::new(out, split, 0),
            meshes: BTreeMap::new(),
            infos: ModelsInfo::default(),
            names: BTreeMap::new(),
            cameras: BTreeMap::new(),
            poses: BTreeMap::new(),
            summary: ImportSummary::default(),
        }
    }

    fn begin_scene(&mut self, scene_id: u32, name: &str) {
        self.writer = SceneWriter::new(&self.out, &self.split, scene_id);
        self.names.insert(scene_id.to_string(), name.to_owned());
    }

    fn finish_scene(&mut self) -> Result<(), DatasetError> {
        self.summary.scenes += 1;
        self.writer.finish()
    }

    /// Writes a scene for each sequence: `common` reads what its images have in common, `add_image` adds one of them.
    fn add_sequences<C>(
        &mut self,
        sequences: &[Sequence],
        progress: &dyn Progress,
        common: impl Fn(&Sequence) -> Result<C, DatasetError>,
        mut add_image: impl FnMut(&mut Importer, &Sequence, &C, (u32, &Path)) -> Result<(), DatasetError>,
    ) -> Result<(), DatasetError> {
        let (mut done, total) = (0, sequences.iter().map(|s| s.images.len()).sum());
        for sequence in sequences {
            self.begin_scene(sequence.scene_id, &sequence.name);
            let common = common(sequence)?;
            for (im_id, rgb) in &sequence.images {
                add_image(self, sequence, &common, (*im_id, rgb))?;
                done += 1;
                if !progress.report(done, total) {
                    return Err(DatasetError::Stopped);
                }
            }
            self.finish_scene()?;
        }
        Ok(())
    }

    fn leave_out(&mut self) {
        self.summary.without_poses += 1;
    }

    fn has_model(&self, obj_id: u32) -> bool {
        self.meshes.contains_key(&obj_id)
    }

    /// Writes a model. Symmetries are not known: the sources have none.
    fn add_model(&mut self, obj_id: u32, mesh: Mesh) -> Result<(), DatasetError> {
        let path = self.out.join("models").join(format!("obj_{obj_id:06}.ply"));
        sixfold_io::make_folder_of(&path)
            .map_err(|source| DatasetError::Write { path: path.clone(), source })?;
        write_ply(&path, &mesh, Unit::Millimetre, PlyFormat::BinaryLittleEndian)
            .map_err(|e| DatasetError::Model(Box::new(e)))?;
        self.infos.0.insert(obj_id, ModelInfo::of_mesh(&mesh));
        self.meshes.insert(obj_id, mesh);
        self.summary.objects.insert(obj_id);
        Ok(())
    }

    /// Writes an image with masks and visibility of its objects, whose models are known.
    fn add(&mut self, frame: &NewFrame<'_>) -> Result<(), DatasetError> {
        let placed: Vec<(&Mesh, Pose)> = frame
            .ground_truth
            .iter()
            .filter_map(|g| Some((self.meshes.get(&g.obj_id)?, g.camera_from_object)))
            .collect();
        let mut visible = ground_truth_visibility(&placed, frame.camera, frame.depth, VISIBILITY_DELTA);
        if let (Some(mask), [only]) = (frame.mask, &mut visible[..]) {
            only.info = of_mask(&only.info, mask);
            only.mask_visible = mask.clone();
        }
        let infos: Vec<GroundTruthInfo> = visible.iter().map(|v| v.info).collect();
        let masks: Vec<Mask> = visible.iter().map(|v| v.mask.clone()).collect();
        let masks_visible: Vec<Mask> = visible.into_iter().map(|v| v.mask_visible).collect();
        if let Some(file) = frame.rgb_file {
            self.copy_colour(file, frame.im_id)?;
        }
        self.writer.add(&NewImage {
            depth_scale: self.depth_scale,
            rgb: frame.rgb,
            depth: frame.depth,
            ground_truth: frame.ground_truth,
            info: Some(&infos),
            masks: Some(&masks),
            masks_visible: Some(&masks_visible),
            ..NewImage::new(frame.im_id, frame.camera)
        })?;
        self.cameras.entry((frame.camera.width, frame.camera.height)).or_insert(*frame.camera);
        for truth in frame.ground_truth {
            self.poses.entry(truth.obj_id).or_default().push(truth.camera_from_object);
        }
        self.summary.images += 1;
        Ok(())
    }

    fn copy_colour(&self, file: &Path, im_id: u32) -> Result<(), DatasetError> {
        let ending = file.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        let path = self.writer.dir().join("rgb").join(format!("{im_id:06}.{ending}"));
        let bytes = read_bytes(file, sixfold_io::limits::IMAGE)?;
        write_atomically(&path, &bytes).map_err(|source| DatasetError::Write { path, source })
    }

    /// Writes the files that belong to all scenes.
    fn finish(self) -> Result<ImportSummary, DatasetError> {
        let info = self.out.join("models").join("models_info.json");
        self.infos.write(&info).map_err(|e| DatasetError::Model(Box::new(e)))?;
        let path = self.out.join("scenes.json");
        let text = format!("{:#}\n", json!(self.names));
        write_atomically(&path, text.as_bytes()).map_err(|source| DatasetError::Write { path, source })?;
        // With images of several sizes, one camera file would be wrong for some.
        if self.cameras.len() == 1 {
            for camera in self.cameras.values() {
                write_camera(&self.out, camera, self.depth_scale)?;
            }
        }
        let views = self.poses.iter().filter_map(|(id, poses)| Some((*id, ViewRange::of(poses)?))).collect();
        Ok(ImportSummary { views, ..self.summary })
    }
}

/// Visibility where the visible part is given.
fn of_mask(info: &GroundTruthInfo, mask: &Mask) -> GroundTruthInfo {
    let seen = mask.as_slice().iter().filter(|p| **p).count() as u64;
    let all = info.px_count_all.unwrap_or(seen).max(seen);
    let bbox_visib = bounding_box(mask, 0, 0);
    GroundTruthInfo {
        bbox_visib,
        bbox_obj: info.bbox_obj.or(bbox_visib),
        px_count_all: Some(all),
        px_count_visib: Some(seen),
        visib_fract: if all == 0 { 0.0 } else { seen as f64 / all as f64 },
        ..*info
    }
}

/// Reads a file of at most `limit` bytes.
fn read_bytes(path: &Path, limit: u64) -> Result<Vec<u8>, DatasetError> {
    sixfold_io::read_regular(path, limit)
        .map_err(|source| DatasetError::Read { path: path.to_owned(), source })
}

/// The entries of a folder, by name.
fn entries(dir: &Path, advice: &'static str) -> Result<Vec<(String, PathBuf)>, DatasetError> {
    let read = |source| DatasetError::Read { path: dir.to_owned(), source };
    if !dir.is_dir() {
        return Err(DatasetError::Missing { path: dir.to_owned(), what: "the folder", advice });
    }
    let mut all = vec![];
    for entry in std::fs::read_dir(dir).map_err(read)? {
        let path = entry.map_err(read)?.path();
        all.push((path.file_name().unwrap_or_default().to_string_lossy().into_owned(), path));
    }
    all.sort();
    Ok(all)
}

/// The folders in a folder, by name; at least one.
fn folders_in(dir: &Path, expected: &'static str) -> Result<Vec<(String, PathBuf)>, DatasetError> {
    let folders: Vec<_> = entries(dir, expected)?.into_iter().filter(|(_, path)| path.is_dir()).collect();
    if folders.is_empty() {
        return Err(DatasetError::Missing {
            path: dir.to_owned(),
            what: "what is to be converted",
            advice: expected,
        });
    }
    Ok(folders)
}

/// Every n-th image of a folder by its number.
fn images_in(dir: &Path, every: usize) -> Result<Vec<(u32, PathBuf)>, DatasetError> {
    let mut images = BTreeMap::new();
    for (name, path) in entries(dir, "a sequence has a folder of colour images")? {
        let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        if !matches!(ending.as_str(), "png" | "jpg" | "jpeg") {
            continue;
        }
        let number = path.file_stem().and_then(|stem| stem.to_str()).and_then(|stem| stem.parse().ok());
        let Some(number) = number else {
            return Err(At::file(dir).error("(file)", name, "a number and .png or .jpg, such as 000012.png"));
        };
        if images.insert(number, path).is_some() {
            return Err(At::file(dir).error("(file)", name, "one file for each number"));
        }
    }
    Ok(images.into_iter().step_by(every.max(1)).collect())
}

/// Width and height of a camera file.
fn image_size(at: &At<'_>, camera: &Map<String, Value>) -> Result<(usize, usize), DatasetError> {
    let side = |field: &str| -> Result<usize, DatasetError> {
        Ok(at.id(field, at.get(camera, field, "pixels")?)? as usize)
    };
    Ok((side("width")?, side("height")?))
}

/// An error for focal lengths that cannot be in pixels, or that a BOP dataset could not store.
fn of_pixels(at: &At<'_>, field: &str, (fx, fy): (f64, f64)) -> Result<(), DatasetError> {
    if fx > 0.0 && fy > 0.0 && (0.5..=2.0).contains(&(fx / fy)) {
        return Ok(());
    }
    let expected = "focal lengths in pixels, above zero and within a factor of 2 of each other";
    Err(at.error(field, format!("{fx} and {fy}"), expected))
}

/// Hostile input for the readers of this module.
#[doc(hidden)]
pub mod parsers {
    use super::{hdf5, pickle};

    /// Reads a pickle; returns whether it is a dictionary.
    pub fn pickle(bytes: &[u8]) -> bool {
        let keys = ["camMat", "objRot", "objTrans", "objName"];
        pickle::PickledDict::parse(bytes).is_ok_and(|dict| keys.iter().all(|key| dict.get(key).is_some()))
    }

    /// Reads an HDF5 file and the datasets of these names; returns how many numbers they hold.
    pub fn hdf5(bytes: &[u8], names: &[&str]) -> Option<usize> {
        let file = hdf5::Hdf5File::parse(bytes).ok()?;
        Some(names.iter().filter_map(|name| file.dataset(name).ok()).map(|d| d.values.len()).sum())
    }
}
