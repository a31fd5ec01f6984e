//! Poses from colour alone, beside those from depth; `colour_poses.rs` finds them.

use std::path::PathBuf;

use serde::Serialize;

/// A pose from colour, beside the ground truth.
#[derive(Serialize)]
pub struct ColourPose {
    /// Scene and image.
    pub image: String,
    /// Object id.
    pub object: u32,
    /// Mean distance of the model's points (nearest points for symmetric objects), millimetres.
    pub add_s_mm: f64,
    /// The same as a fraction of the diameter.
    pub add_s_of_diameter: f64,
    /// The method's confidence.
    pub confidence: f64,
    /// Time it took.
    pub seconds: f64,
}

/// Poses from colour, or why there are none.
#[derive(Serialize)]
pub struct Colour {
    /// Weights of Pix2Pose.
    pub weights: Option<PathBuf>,
    /// Weights of the detector; without them boxes are the ground truth's.
    pub detector: Option<PathBuf>,
    /// What was found.
    pub poses: Vec<ColourPose>,
    /// How many of the poses are within 10 % of the diameter.
    pub correct: usize,
    /// Targets in colour images that were looked for.
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
