//! Point pair features as a [`PoseEstimator`].

use sixfold_align::DepthOptions;
use sixfold_estimator::{
    EstimatorError, MinConfidence, Need, Needs, Object, PoseEstimate, PoseEstimator, PreparedObject, Query,
    downcast,
};
use sixfold_mesh::Mesh;
use std::sync::Arc;

use crate::estimate::{PpfOptions, estimate};
use crate::model::{ModelOptions, ObjectModel};

/// Step at which a continuous symmetry is sampled for the clustering, as a fraction of the diameter.
const SYMMETRY_STEP: f64 = 0.05;
/// File of an object's description in its folder.
const FILE: &str = "ppf.bin";
const METHOD: &str = "ppf";

/// Poses of known objects from depth by point pair features, without training (Drost et al. 2010).
#[derive(Debug, Clone, Default)]
pub struct PpfEstimator {
    /// How depth images are prepared.
    pub depth: DepthOptions,
    /// How objects are sampled.
    pub model: ModelOptions,
    /// How poses are estimated; the query sets the number of instances and the minimum confidence.
    pub options: PpfOptions,
}

/// An object prepared for point pair features.
pub struct PpfObject {
    name: String,
    mesh: Arc<Mesh>,
    model: ObjectModel,
    notes: Vec<String>,
}

impl PpfObject {
    /// The description.
    pub fn model(&self) -> &ObjectModel {
        &self.model
    }
}

impl PreparedObject for PpfObject {
    fn name(&self) -> &str {
        &self.name
    }

    fn mesh(&self) -> Option<&Mesh> {
        Some(&self.mesh)
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }
}

impl PoseEstimator for PpfEstimator {
    fn name(&self) -> &'static str {
        METHOD
    }

    fn needs(&self) -> Needs {
        Needs { depth: Need::Required, rgb: Need::Unused, region: Need::Optional, object: Need::Required }
    }

    fn depth_options(&self) -> DepthOptions {
        self.depth
    }

    /// On real frames most wrong poses have a confidence below 0.25, most right ones above (LM-O frame 3 and two YCB-V frames, by
    /// `cargo test --release -p sixfold-ppf --test real_frames -- --nocapture`).
    fn min_confidence(&self) -> MinConfidence {
        MinConfidence { image: 0.25, dataset: PpfOptions::default().min_score }
    }

    fn prepare(&self, object: &Object) -> Result<Box<dyn PreparedObject>, EstimatorError> {
        let mesh = object.needed_mesh(METHOD)?.clone();
        let symmetries = object.info.as_ref().map_or_else(Vec::new, |i| i.symmetry_poses(SYMMETRY_STEP));
        let described = match object.file(FILE) {
            Some(file) => ObjectModel::cached(&file, &mesh, &symmetries, &self.model),
            None => ObjectModel::new(&mesh, &symmetries, &self.model).map(|model| (model, None)),
        };
        let wrap = |e| EstimatorError::Object { object: object.name.clone(), source: Box::new(e) };
        let (model, note) = described.map_err(wrap)?;
        let say = |note| format!("description of {} not kept, or computed again: {note}", object.name);
        let notes = note.map(say).into_iter().collect();
        Ok(Box::new(PpfObject { name: object.name.clone(), mesh, model, notes }))
    }

    fn estimate(
        &self,
        object: &dyn PreparedObject,
        query: &Query<'_>,
    ) -> Result<Vec<PoseEstimate>, EstimatorError> {
        let object: &PpfObject = downcast(object, METHOD)?;
        let options = PpfOptions {
            max_instances: query.max_instances,
            min_score: query.min_confidence,
            ..self.options.clone()
        };
        options.check().map_err(EstimatorError::method)?;
        let found = estimate(query.depth_region(METHOD)?, &object.model, &options);
        let pose = |e: crate::PpfEstimate| PoseEstimate {
            verification: Some(e.score),
            ..PoseEstimate::new(e.camera_from_object, e.confidence)
        };
        Ok(found.into_iter().map(pose).collect())
    }
}
