//! Depth-only pose of known objects without training: point pair features, pose hypotheses and their
//! verification.
//!
//! The steps for one image: a [`DepthRegion`](sixfold_align::DepthRegion) is prepared once; for every object its [`ObjectModel`]
//! votes for poses ([`voting`]), similar poses are clustered ([`clustering`]), and the best are refined by ICP and verified by
//! rendering ([`sixfold_align::verify()`]); [`estimate()`] runs all steps.

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

pub mod clustering;
pub mod estimate;
mod estimator;
mod model;
mod model_file;
pub mod voting;

pub use estimate::{PpfEstimate, PpfOptions, estimate};
pub use estimator::{PpfEstimator, PpfObject};
pub use model::{ModelError, ModelOptions, ObjectModel};
pub use model_file::ModelFileError;

/// A point or direction in single precision, for the hot loops.
pub(crate) type V3 = nalgebra::Vector3<f32>;
