//! A pose with what speaks for it.

use serde_json::{Map, Value};
use sixfold_align::VerificationScore;
use sixfold_geometry::{Pose, RgbImage};

/// An image that shows how a method came to a pose.
#[derive(Debug, Clone)]
pub struct Diagnostic {
    /// Its name, a file name without ending.
    pub name: &'static str,
    /// The image.
    pub image: RgbImage,
}

/// A pose with what speaks for it.
#[derive(Debug, Clone)]
pub struct PoseEstimate {
    /// From the object's frame to the camera's, metres.
    pub camera_from_object: Pose,
    /// What decides between estimates of one method, 0 to 1.
    pub confidence: f64,
    /// The probability that the pose is right, where the method knows it: that no point of the object lies further than a tenth of
    /// the diameter from where it is (MSSD).
    pub probability: Option<f64>,
    /// What verification by rendering says, where there is depth.
    pub verification: Option<VerificationScore>,
    /// The object's visible pixels as numbers `y * width + x`, where the method segments.
    pub mask: Option<Vec<u32>>,
    /// What the method says besides, under its own keys; part of the JSON that programs print.
    pub details: Map<String, Value>,
    /// Images for people, where the query asks for them.
    pub diagnostics: Vec<Diagnostic>,
    /// What a user should know of this pose, a sentence each.
    pub notes: Vec<String>,
}

impl PoseEstimate {
    /// A pose and its confidence alone.
    pub fn new(camera_from_object: Pose, confidence: f64) -> PoseEstimate {
        PoseEstimate {
            camera_from_object,
            confidence,
            probability: None,
            verification: None,
            mask: None,
            details: Map::new(),
            diagnostics: vec![],
            notes: vec![],
        }
    }

    /// The fraction of the object that is seen, where verification says it.
    pub fn visibility(&self) -> Option<f64> {
        self.verification.map(|v| v.visible_fraction())
    }
}
