//! Depth-only pose of known objects without training: point pair features, pose hypotheses and their
//! verification.
//!
//! The way of one image: a [`Scene`] is prepared once; for every object its [`ObjectModel`] votes for poses
//! ([`model`], [`voting`]), similar poses are joined ([`clustering`]), the best are refined by ICP and
//! judged by rendering ([`verification`]); [`estimate()`] puts it together.

#![deny(clippy::print_stdout, clippy::print_stderr)]

pub mod clustering;
pub mod estimate;
pub mod model;
mod model_file;
pub mod scene;
pub mod verification;
pub mod voting;

pub use estimate::{Estimate, EstimateOptions, estimate};
pub use model::{ModelError, ModelOptions, ObjectModel};
pub use model_file::ModelFileError;
pub use scene::{Scene, SceneError, SceneOptions};
pub use verification::{VerificationOptions, VerificationScore, Verifier};

/// A point or direction in single precision, for the hot loops.
pub(crate) type V3 = nalgebra::Vector3<f32>;
