//! DGCM-Net: transfers successful grasps to other objects of similar shape.
//!
//! An object's depth image is encoded into a feature; the nearest stored experiences are retrieved; for each, a network predicts
//! the counterpart of every pixel of the object on the experience; the region around the stored grasp is located on the object and
//! aligned, and the grasp is transferred with this alignment. After Park, *6D Pose Estimation of Objects Using Limited Training
//! Data* (2020), chapter 6.
//!
//! Metres and radians, in the camera's frame unless a name says otherwise.

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

mod alignment_loss;
pub mod learner;
mod loss;
pub mod model;
mod networks;
pub mod outcome;
pub mod quality;
pub mod recipe;
mod samples;
mod training;
pub mod transfer;

pub use networks::{Alignment, Compact, Encoded, Network, Paper};
pub use samples::{GraspPoolOptions, Pair, PairOptions, Pool, View};
pub use training::{Batch, DgcmTraining, DgcmTrainingOptions};
