//! The interface of pose estimation methods. A method implements [`PoseEstimator`]: it prepares an [`Object`] once and answers
//! a [`Query`] (an image and a region of it) with [`PoseEstimate`]s. Runners, programs and other languages use methods through
//! this trait only; this crate depends on no method.
//!
//! Objects come from mesh files or from an [`ObjectStore`], a folder of named objects. Data that methods derive from an object
//! (descriptions, templates) is stored in its folder there, or for a mesh file in a [`Cache`].

#![warn(unreachable_pub, unnameable_types)]

mod cache;
mod detector;
mod error;
mod estimate;
mod method;
mod object;
mod query;
mod refiner;
mod region;
mod store;

pub use cache::{Cache, CacheError};
pub use detector::{DetectedObject, ObjectDetector};
pub use error::EstimatorError;
pub use estimate::{AlternativePose, Diagnostic, PoseEstimate};
pub use method::{MinConfidence, Need, Needs, PoseEstimator, PreparedObject, downcast};
pub use object::Object;
pub use query::{Memo, Query, check_min_confidence};
pub use refiner::{PoseRefiner, RefinedObject, RefinedPose};
pub use region::Region;
pub use store::{FreeAxis, NewObject, ObjectRecord, ObjectStore, StoreError};
