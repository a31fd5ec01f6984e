//! The data of trainings on objects: images and models of a dataset, or meshes alone.

use std::path::{Path, PathBuf};

use sixfold_bop::{BopDataset, DatasetError, Models};
use sixfold_geometry::FrameId;
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_render::BoundingBoxScale;

use crate::error::TrainingSetError;
use crate::posed_image::PosedImage;
use crate::reading::read_posed_images;

/// An object of a training.
#[derive(Debug, Clone)]
pub struct TrainingObject {
    /// Its id in the dataset.
    pub id: u32,
    /// Its surface in metres, with colours or texture if it is to be rendered in its own colours.
    pub mesh: Mesh,
    /// Diameter and symmetries.
    pub info: ModelInfo,
    /// The normalisation of its coordinates.
    pub scale: BoundingBoxScale,
}

impl TrainingObject {
    /// An object whose coordinates are normalised by the box of its mesh.
    pub fn new(id: u32, mesh: Mesh, info: ModelInfo) -> Self {
        let (low, high) = mesh.bounding_box();
        TrainingObject { id, scale: BoundingBoxScale::of_corners(&low, &high), mesh, info }
    }
}

/// Objects, their posed images, and where they came from.
#[derive(Debug, Clone, Default)]
pub struct TrainingSet {
    /// The objects.
    pub objects: Vec<TrainingObject>,
    /// Images that show them, one entry for each instance.
    pub images: Vec<PosedImage>,
    /// The frames of a dataset that were chosen, in order; these must not be used for tests.
    pub frames: Vec<FrameId>,
    /// The source of objects and images, for people.
    pub description: String,
}

/// Which frames of a dataset's split are used as training images.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum FrameSelection {
    /// All frames with a colour image.
    #[default]
    All,
    /// None: no image is opened.
    RendersOnly,
    /// The frames that a file lists: JSON, `[{"scene_id": 2, "im_id": 36}, ...]`.
    File(PathBuf),
    /// These.
    Listed(Vec<FrameId>),
}

impl TrainingSet {
    /// Objects of a BOP dataset (all that its models_info.json names if `ids` is empty), and the instances in its
    /// images whose visible fraction is at least `min_visibility`.
    ///
    /// # Errors
    /// [`TrainingSetError`].
    pub fn of_dataset(
        root: &Path,
        split: &str,
        ids: &[u32],
        frames: &FrameSelection,
        min_visibility: f64,
    ) -> Result<TrainingSet, TrainingSetError> {
        TrainingSet::of_opened(&BopDataset::open(root, split)?, ids, frames, min_visibility)
    }

    /// The same for an opened dataset, with its chosen models.
    ///
    /// # Errors
    /// [`TrainingSetError`].
    pub fn of_opened(
        dataset: &BopDataset,
        ids: &[u32],
        frames: &FrameSelection,
        min_visibility: f64,
    ) -> Result<TrainingSet, TrainingSetError> {
        let (root, split) = (dataset.root(), dataset.split());
        if let Some(id) = ids.iter().enumerate().find(|(i, id)| ids[..*i].contains(id)).map(|(_, id)| *id) {
            return Err(TrainingSetError::NamedTwice { id });
        }
        let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
        let ids: Vec<u32> = if ids.is_empty() { infos.0.keys().copied().collect() } else { ids.to_vec() };
        if ids.is_empty() {
            return Err(TrainingSetError::NoObjects { root: root.to_owned() });
        }
        let mut objects = vec![];
        for &id in &ids {
            let mesh = dataset.model(id, Models::Rendering)?;
            let info = infos.0.get(&id).cloned().unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
            objects.push(TrainingObject::new(id, mesh, info));
        }
        let renders_only = *frames == FrameSelection::RendersOnly;
        let mut frames: Vec<FrameId> = match frames {
            FrameSelection::File(file) => {
                dataset.targets(Some(file))?.iter().map(|t| FrameId::new(t.scene_id, t.im_id)).collect()
            }
            FrameSelection::Listed(frames) => frames.clone(),
            FrameSelection::RendersOnly => vec![],
            FrameSelection::All => {
                let all = frames_with_colour(dataset)?;
                if all.is_empty() {
                    return Err(TrainingSetError::NoImages { root: root.to_owned(), split });
                }
                all
            }
        };
        frames.sort_unstable();
        frames.dedup();
        let images = read_posed_images(dataset, &frames, &ids, min_visibility)?;
        if images.is_empty() && !renders_only {
            let (root, percent) = (root.to_owned(), 100.0 * min_visibility);
            return Err(TrainingSetError::NothingVisible { root, frames: frames.len(), percent });
        }
        let name = root.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let description = format!(
            "dataset {name}, split {split}: {} real frames with {} instances, and renders of its models",
            frames.len(),
            images.len()
        );
        Ok(TrainingSet { objects, images, frames, description })
    }

    /// Meshes by their ids, to be learnt from renders; `names` describes them in the description.
    pub fn of_meshes(meshes: Vec<(u32, Mesh, ModelInfo)>, names: &str) -> TrainingSet {
        TrainingSet {
            objects: meshes.into_iter().map(|(id, mesh, info)| TrainingObject::new(id, mesh, info)).collect(),
            images: vec![],
            frames: vec![],
            description: format!("renders of {names}"),
        }
    }
}

/// All frames with a colour image.
pub(crate) fn frames_with_colour(dataset: &BopDataset) -> Result<Vec<FrameId>, DatasetError> {
    let mut all = vec![];
    for scene_id in dataset.scene_ids() {
        let scene = dataset.scene(scene_id)?;
        let shown = scene.image_ids().into_iter().filter(|id| scene.rgb_path(*id).is_some());
        all.extend(shown.map(|im_id| FrameId { scene_id, im_id }));
    }
    Ok(all)
}
