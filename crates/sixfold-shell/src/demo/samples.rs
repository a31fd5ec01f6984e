//! The objects of the samples.

use std::path::Path;

use anyhow::{Result, anyhow};
use sixfold_bop::{BopDataset, GroundTruth, ModelPoints, Models};
use sixfold_geometry::Pose;
use sixfold_mesh::{Mesh, ModelInfo, ModelsInfo};

use sixfold_estimator::{Object, PoseEstimator, downcast};
use sixfold_ppf::{ObjectModel, PpfEstimator, PpfObject};

/// An object of the samples, prepared for point pair features.
pub(super) struct Known {
    pub object: Object,
    pub info: ModelInfo,
    pub model: ObjectModel,
    points: ModelPoints,
}

impl Known {
    /// Object `id`, and notes for the user; its prepared data is kept in `folder`.
    pub(super) fn new(
        dataset: &BopDataset,
        infos: &ModelsInfo,
        id: u32,
        folder: &Path,
    ) -> Result<(Known, Vec<String>)> {
        let mesh = dataset.model(id, Models::Rendering)?;
        let points = ModelPoints::new(mesh.vertices())
            .ok_or_else(|| anyhow!("object {id}: the model has no vertices"))?;
        let info = infos.0.get(&id).cloned();
        let info = info.unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
        let folder = folder.join(format!("{id:06}"));
        let object = Object::of_mesh(format!("object {id}"), mesh, info.clone());
        let object = Object { id: Some(id), folder: Some(folder), ..object };
        let prepared = PpfEstimator::default().prepare(&object)?;
        let notes = prepared.notes().to_vec();
        let model = downcast::<PpfObject>(prepared.as_ref(), "ppf")?.model().clone();
        Ok((Known { object, info, model, points }, notes))
    }

    /// Its surface.
    pub(super) fn mesh(&self) -> Option<&Mesh> {
        self.object.mesh.as_deref()
    }
}

/// ADD, or ADI for symmetric objects, in metres.
pub(super) fn add_s(known: &Known, camera_from_object: Pose, truth: &GroundTruth) -> f64 {
    sixfold_bop::add_s(&known.points, known.info.is_symmetric(), camera_from_object, truth.placement())
}
