//! Poses from colour alone, beside those from depth; `colour_poses.rs` finds them.

use std::path::PathBuf;

use serde::Serialize;

use super::SamplePose;

/// Poses from colour, or why there are none.
#[derive(Serialize)]
pub struct Colour {
    /// Weights of Pix2Pose.
    pub weights: Option<PathBuf>,
    /// Weights of the detector; without them the boxes come from the ground truth.
    pub detector: Option<PathBuf>,
    /// The poses found.
    pub poses: Vec<SamplePose>,
    /// How many of the poses are within 10 % of the diameter.
    pub correct: usize,
    /// Targets that were searched for in colour images.
    pub targets: usize,
    /// Images that were written.
    pub pictures: Vec<PathBuf>,
    /// Why there are no poses.
    pub reason: Option<String>,
}

impl Colour {
    /// No poses.
    pub(super) fn none(weights: Option<PathBuf>, reason: String) -> Colour {
        Colour {
            weights,
            detector: None,
            poses: vec![],
            correct: 0,
            targets: 0,
            pictures: vec![],
            reason: Some(reason),
        }
    }
}
