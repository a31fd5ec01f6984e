//! One method that asks the others, holds their poses against the image together, and says how probable each is.
//!
//! [`AutoEstimator`] is given other methods behind [`PoseEstimator`](sixfold_estimator::PoseEstimator). Their poses compete in one
//! pool: each is rendered and held against depth, normals, outline, edges and colours ([`sixfold_align::evidence`]), and a
//! [`Calibration`] turns these numbers into a probability. What is asked, and in which order, is the caller's choice; [`AutoMembers`] puts together
//! all that there is.

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
