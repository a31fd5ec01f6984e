//! Runs any [`PoseEstimator`](sixfold_estimator::PoseEstimator) on one image ([`ImageRun`]) or on all targets of a BOP
//! dataset ([`DatasetRun`]), with regions from the ground truth, a file of detections or a detector ([`RegionSource`]).
//! Also runs a detector alone on all images of a dataset ([`DetectionRun`]).

#![warn(unreachable_pub, unnameable_types)]

mod dataset;
mod detection;
mod error;
mod image;
mod inputs;
mod overruled;
mod record;
mod regions;
mod table;

pub use dataset::{DatasetEvent, DatasetRun, DatasetSummary, ImageResult, PosedObject, dataset_object};
pub use detection::{DetectionEvent, DetectionRun, DetectionSummary, FoundDetection, detections};
pub use error::{OtherInput, OtherOptions, RunError, describe};
pub use image::{FoundObject, FoundPose, ImageReport, ImageRun, depth_notes, without_overruled};
pub use overruled::left_standing;
pub use record::RunOptions;
pub use regions::RegionSource;
pub use table::pose_table;
