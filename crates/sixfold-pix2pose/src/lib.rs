//! Pix2Pose (Park, Patten, Vincze 2019; dissertation chapter 3): per-pixel object coordinates and their expected error
//! from an RGB crop, and poses from them.

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

pub mod adversarial;
pub mod aligned;
pub mod depth;
pub mod estimate;
pub mod estimator;
mod loss;
pub mod loss_curve;
pub mod model;
pub mod networks;
pub mod object;
mod outlier_threshold;
pub mod own_weights;
pub mod preset;
pub mod recipe;
pub mod refine;
pub mod samples;
pub mod training;
