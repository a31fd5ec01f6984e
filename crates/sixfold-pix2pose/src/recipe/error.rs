//! Why no model could be trained.

use sixfold_mesh::MeshError;
use sixfold_nn::pretrained::PretrainedError;
use sixfold_nn::recipe::NotReady;
use sixfold_nn::weights::WeightsError;
use sixfold_synth::augment::AugmentError;
use thiserror::Error;

use crate::estimate::EstimateError;
use crate::model::ModelError;
use crate::samples::SampleError;
use crate::training::TrainingError;

/// Why no model could be trained. What was trained until then is kept.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecipeError {
    /// An option out of its range, or nothing to export.
    #[error(transparent)]
    NotReady(#[from] NotReady),
    /// A mesh without a hull.
    #[error("object {id}: its vertices have no convex hull: {reason}")]
    Hull {
        /// The object.
        id: u32,
        /// Why.
        reason: MeshError,
    },
    /// Backgrounds.
    #[error(transparent)]
    Backgrounds(#[from] AugmentError),
    /// Samples.
    #[error(transparent)]
    Samples(Box<SampleError>),
    /// Weights to begin with.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// Weights in torchvision's layout.
    #[error(transparent)]
    Pretrained(#[from] PretrainedError),
    /// A model file.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The training itself.
    #[error(transparent)]
    Training(#[from] TrainingError),
    /// What is measured after it.
    #[error(transparent)]
    Estimate(#[from] EstimateError),
}

impl From<SampleError> for RecipeError {
    fn from(error: SampleError) -> Self {
        RecipeError::Samples(Box::new(error))
    }
}
