//! What trainings on objects learn from: photographs and models of a dataset, or meshes alone; and their backgrounds.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use sixfold_bop::{BopDataset, DatasetError, Models};
use sixfold_geometry::{Rect, Vec3};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_render::BoundingBoxScale;
use sixfold_synth::augment::{AugmentError, Backgrounds, PhotographOptions};
use thiserror::Error;

use crate::samples::{RealCrop, SampleError, TrainingObject, read_real_crops};

/// Objects, their photographs, and where they came from in words.
pub struct Material {
    /// The objects.
    pub objects: Vec<TrainingObject>,
    /// Their photographed instances.
    pub real: Vec<RealCrop>,
    /// Where they came from.
    pub description: String,
    /// The dataset and its frames, if it is one.
    pub frames: Option<(BopDataset, Vec<(u32, u32)>)>,
}

/// Which frames of a dataset's split are photographs to learn from, as scene and image.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Frames {
    /// All that have a colour image.
    #[default]
    All,
    /// None: no photograph is opened.
    RendersOnly,
    /// Those that a file names: JSON, `[{"scene_id": 2, "im_id": 36}, ...]`.
    File(PathBuf),
    /// These.
    Listed(Vec<(u32, u32)>),
}

/// Why there is nothing to learn from.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum MaterialError {
    /// The dataset cannot be read.
    #[error(transparent)]
    Dataset(Box<DatasetError>),
    /// The photographs cannot be read.
    #[error(transparent)]
    Samples(Box<SampleError>),
    /// The backgrounds cannot be read.
    #[error(transparent)]
    Backgrounds(#[from] AugmentError),
    /// The dataset does not say which objects it has.
    #[error("{}: no objects: its models have no models_info.json; name their ids", root.display())]
    NoObjects {
        /// The dataset.
        root: PathBuf,
    },
    /// There is no colour image.
    #[error("{}: split {split} has no colour images to learn from", root.display())]
    NoImages {
        /// The dataset.
        root: PathBuf,
        /// Its split.
        split: String,
    },
    /// No frame shows enough of an object.
    #[error(
        "{}: none of the {frames} frames shows an object at least {percent:.0} % visible; choose other frames",
        root.display()
    )]
    NothingVisible {
        /// The dataset.
        root: PathBuf,
        /// How many there are.
        frames: usize,
        /// How much should be seen.
        percent: f64,
    },
}

impl From<DatasetError> for MaterialError {
    fn from(error: DatasetError) -> Self {
        MaterialError::Dataset(Box::new(error))
    }
}

impl From<SampleError> for MaterialError {
    fn from(error: SampleError) -> Self {
        MaterialError::Samples(Box::new(error))
    }
}

impl Material {
    /// Objects of a BOP dataset (all that its models_info.json names if `ids` is empty), and their photographed instances of
    /// which at least the share `least_visible` is seen.
    ///
    /// # Errors
    /// [`MaterialError`].
    pub fn of_dataset(
        root: &Path,
        split: &str,
        ids: &[u32],
        frames: &Frames,
        least_visible: f64,
    ) -> Result<Material, MaterialError> {
        let dataset = BopDataset::open(root, split)?;
        let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
        let ids: Vec<u32> = if ids.is_empty() { infos.0.keys().copied().collect() } else { ids.to_vec() };
        if ids.is_empty() {
            return Err(MaterialError::NoObjects { root: root.to_owned() });
        }
        let mut objects = vec![];
        for &id in &ids {
            let mesh = dataset.model(id, Models::Rendering)?;
            let info = infos.0.get(&id).cloned().unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
            objects.push(object(id, mesh, info));
        }
        let renders_only = *frames == Frames::RendersOnly;
        let mut frames: Vec<(u32, u32)> = match frames {
            Frames::File(file) => {
                dataset.targets(Some(file))?.iter().map(|t| (t.scene_id, t.im_id)).collect()
            }
            Frames::Listed(frames) => frames.clone(),
            Frames::RendersOnly => vec![],
            Frames::All => {
                let mut all = vec![];
                for scene_id in dataset.scene_ids() {
                    let scene = dataset.scene(scene_id)?;
                    let shown = scene.image_ids().into_iter().filter(|id| scene.rgb_path(*id).is_some());
                    all.extend(shown.map(|im_id| (scene_id, im_id)));
                }
                if all.is_empty() {
                    return Err(MaterialError::NoImages { root: root.to_owned(), split: split.to_owned() });
                }
                all
            }
        };
        frames.sort_unstable();
        frames.dedup();
        let real = read_real_crops(&dataset, &frames, &ids, least_visible)?;
        if real.is_empty() && !renders_only {
            let (root, percent) = (root.to_owned(), 100.0 * least_visible);
            return Err(MaterialError::NothingVisible { root, frames: frames.len(), percent });
        }
        let name = root.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let images =
            frames.iter().map(|(scene, image)| format!("{scene}/{image}")).collect::<Vec<_>>().join(" ");
        let description = format!(
            "dataset {name}, split {split}: {} real frames ({images}) with {} instances, and renders of its models",
            frames.len(),
            real.len()
        );
        Ok(Material { objects, real, description, frames: Some((dataset, frames)) })
    }

    /// Meshes by their ids, to be learnt from renders; `names` stands for them in the description.
    pub fn of_meshes(meshes: Vec<(u32, Mesh, ModelInfo)>, names: &str) -> Material {
        Material {
            objects: meshes.into_iter().map(|(id, mesh, info)| object(id, mesh, info)).collect(),
            real: vec![],
            description: format!("renders of {names}"),
            frames: None,
        }
    }
}

fn object(id: u32, mesh: Mesh, info: ModelInfo) -> TrainingObject {
    let (low, high) = mesh.bounding_box();
    TrainingObject { id, scale: BoundingBoxScale::of_corners(&low, &high), mesh, info }
}

/// Photographs of a folder if there is one, else procedural textures; and the share of textures that goes well with them.
///
/// # Errors
/// [`AugmentError`] for a folder without photographs.
pub fn plain_backgrounds(folder: Option<&Path>) -> Result<(Backgrounds, f32), AugmentError> {
    Ok(match folder {
        Some(folder) => (Backgrounds::from_folder(folder, &PhotographOptions::default())?, 0.1),
        None => (Backgrounds::procedural(), 0.6),
    })
}

/// As [`plain_backgrounds`], and always the training frames themselves away from their objects.
///
/// # Errors
/// [`AugmentError`].
pub fn backgrounds(
    folder: Option<&Path>,
    real: &[RealCrop],
    objects: &[TrainingObject],
) -> Result<Backgrounds, AugmentError> {
    let (mut backgrounds, share) = plain_backgrounds(folder)?;
    let mut frames: Vec<(&Arc<_>, Vec<Rect>)> = vec![];
    for crop in real {
        let Some(object) = objects.iter().find(|o| o.id == crop.object_id()) else { continue };
        let (low, high) = object.mesh.bounding_box();
        let corners = (0..8).filter_map(|i| {
            let pick = |axis: usize| if i >> axis & 1 == 0 { low[axis] } else { high[axis] };
            let corner = Vec3::new(pick(0), pick(1), pick(2));
            crop.camera().project(&crop.camera_from_object().transform_point(&corner))
        });
        let (x, y): (Vec<f64>, Vec<f64>) = corners.map(|c| (c.x, c.y)).unzip();
        let least = |v: &[f64]| v.iter().copied().fold(f64::INFINITY, f64::min);
        let most = |v: &[f64]| v.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if x.is_empty() {
            continue;
        }
        let rect =
            Rect { x: least(&x), y: least(&y), width: most(&x) - least(&x), height: most(&y) - least(&y) };
        match frames.iter_mut().find(|(image, _)| Arc::ptr_eq(image, crop.image())) {
            Some((_, rects)) => rects.push(rect),
            None => frames.push((crop.image(), vec![rect])),
        }
    }
    for (image, rects) in frames {
        backgrounds = backgrounds.with_image(image.clone(), rects)?;
    }
    Ok(backgrounds.with_procedural_share(share))
}
