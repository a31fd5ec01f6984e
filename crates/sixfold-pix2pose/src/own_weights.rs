//! Pix2Pose with the weights that each object has of its own: `sixfold teach --train` keeps them in the object's folder.

use std::sync::Arc;

use sixfold_align::DepthOptions;
use sixfold_estimator::{
    EstimatorError, Need, Needs, Object, PoseEstimate, PoseEstimator, PoseRefiner, PreparedObject, Query,
    downcast,
};
use sixfold_mesh::Mesh;

use crate::aligned::AlignOptions;
use crate::estimator::{METHOD, Pix2PoseEstimator, Pix2PoseObject, depth_for_icp};
use crate::model::Pix2PoseModel;

/// File of an object's own weights in its folder ([`Object::file`]).
pub const WEIGHTS_FILE: &str = "pix2pose.safetensors";

/// Poses from colour of objects that have weights of their own, and of those that another model knows.
#[derive(Clone)]
pub struct OwnWeights {
    /// Both passes, PnP and the alignment of the outline.
    pub options: AlignOptions,
    /// Align the rendered outline with the image.
    pub refine: bool,
    /// Align poses with the depth image.
    pub icp: bool,
    /// Refines aligned poses, unless they are aligned with depth.
    pub refiner: Option<Arc<dyn PoseRefiner>>,
    /// The model for objects without weights of their own; `None`: only objects that have some can be found.
    pub others: Option<Pix2PoseModel>,
}

impl Default for OwnWeights {
    fn default() -> Self {
        OwnWeights { options: AlignOptions::default(), refine: true, icp: false, refiner: None, others: None }
    }
}

impl OwnWeights {
    /// The dissertation's form: its two stages with its parameters, one pass, no alignment of the outline.
    pub fn published() -> OwnWeights {
        OwnWeights { options: AlignOptions::published(), refine: false, ..OwnWeights::default() }
    }

    /// The same options with one model for all objects. `object_id` is the object's id in it, for objects that do not give one.
    pub fn with(self, model: Pix2PoseModel, object_id: Option<u32>) -> Pix2PoseEstimator {
        let OwnWeights { options, refine, icp, refiner, others: _ } = self;
        Pix2PoseEstimator { model, options, refine, icp, object_id, refiner }
    }
}

/// An object with the estimator of its own weights.
struct OwnObject {
    estimator: Pix2PoseEstimator,
    object: Pix2PoseObject,
}

impl PreparedObject for OwnObject {
    fn name(&self) -> &str {
        self.object.name()
    }

    fn mesh(&self) -> Option<&Mesh> {
        self.object.mesh()
    }

    fn notes(&self) -> &[String] {
        self.object.notes()
    }
}

impl PoseEstimator for OwnWeights {
    fn name(&self) -> &'static str {
        METHOD
    }

    fn needs(&self) -> Needs {
        let depth = if self.icp { Need::Required } else { Need::Unused };
        Needs { depth, rgb: Need::Required, region: Need::Required, object: Need::Required }
    }

    fn depth_options(&self) -> DepthOptions {
        depth_for_icp()
    }

    fn knows(&self, object: &Object) -> bool {
        self.others.is_some() || object.file(WEIGHTS_FILE).is_some_and(|file| file.is_file())
    }

    fn prepare(&self, object: &Object) -> Result<Box<dyn PreparedObject>, EstimatorError> {
        let Some(file) = object.file(WEIGHTS_FILE).filter(|file| file.is_file()) else {
            if let Some(model) = &self.others {
                let estimator = self.clone().with(model.clone(), None);
                let object = estimator.object(object)?;
                return Ok(Box::new(OwnObject { estimator, object }));
            }
            return Err(EstimatorError::Lacks {
                object: object.name.clone(),
                what: "weights of its own",
                method: METHOD,
                advice: "train them with `sixfold teach NAME --train`, or give --weights FILE.safetensors, which `sixfold train \
                         pix2pose` writes",
            });
        };
        let model = Pix2PoseModel::load(&file).map_err(EstimatorError::method)?;
        let estimator = self.clone().with(model, None);
        // The weights are those of this object alone, whatever its id is elsewhere.
        let object = estimator.object(&Object { id: None, ..object.clone() })?;
        Ok(Box::new(OwnObject { estimator, object }))
    }

    fn estimate(
        &self,
        object: &dyn PreparedObject,
        query: &Query<'_>,
    ) -> Result<Vec<PoseEstimate>, EstimatorError> {
        let OwnObject { estimator, object } = downcast(object, METHOD)?;
        estimator.estimate(object, query)
    }
}
