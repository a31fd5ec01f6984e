//! A method that runs the others, compares all their poses with the image, and estimates the probability of each.
//!
//! [`AutoEstimator`] runs other methods through [`PoseEstimator`](sixfold_estimator::PoseEstimator). Their poses compete in one
//! pool: each is rendered and compared with depth, normals, outline, edges and colours ([`sixfold_align::evidence`]), and a
//! [`Calibration`] turns these numbers into a probability. The caller chooses the methods and their order; [`AutoMembers`] collects
//! all available ones.

#![warn(unreachable_pub, unnameable_types)]

mod calibration;
mod estimator;
mod hypotheses;
mod lookalikes;
mod members;
mod numbers;
mod prepared;
mod regression;

pub use calibration::{Calibration, CalibrationError};
pub use estimator::{AutoEstimator, AutoObject};
pub use hypotheses::Hypothesis;
pub use members::AutoMembers;
pub use numbers::{NAMES, Numbers};
pub use prepared::prepare_all;
pub use regression::{Fit, LogisticModel, fit};
