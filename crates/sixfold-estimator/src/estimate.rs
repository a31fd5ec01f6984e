//! An estimated pose with its evidence.

use serde::Serialize;
use serde_json::{Map, Value};
use sixfold_align::VerificationScore;
use sixfold_geometry::{Pose, RgbImage};

/// An image that shows how a method found a pose.
#[derive(Debug, Clone)]
pub struct Diagnostic {
    /// Its name, a file name without extension.
    pub name: &'static str,
    /// The image.
    pub image: RgbImage,
}

/// Another pose of an instance, as programs print it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AlternativePose {
    /// The pose by rows, metres.
    pub camera_from_object: [[f64; 4]; 4],
    /// Its confidence as a fraction of the sum over all poses of the instance, 0 to 1.
    pub weight: f64,
}

/// An estimated pose with its evidence.
#[derive(Debug, Clone)]
pub struct PoseEstimate {
    /// From the object's frame to the camera's, metres.
    pub camera_from_object: Pose,
    /// Confidence, 0 to 1; comparable only between estimates of one method.
    pub confidence: f64,
    /// The probability that the pose is right, if the method computes it: that no point of the object is further than a tenth of
    /// the diameter from its true position (MSSD).
    pub probability: Option<f64>,
    /// The score of verification by rendering, if there is depth.
    pub verification: Option<VerificationScore>,
    /// The object's visible pixels as indices `y * width + x`, if the method segments.
    pub mask: Option<Vec<u32>>,
    /// Other poses of the same instance with which the image agrees about equally: the object has at most one of them.
    pub alternatives: Vec<PoseEstimate>,
    /// Additional data of the method under its own keys; part of the JSON that programs print.
    pub details: Map<String, Value>,
    /// Images for people, if the query asks for them.
    pub diagnostics: Vec<Diagnostic>,
    /// Notes for the user about this pose, one sentence each.
    pub notes: Vec<String>,
}

impl PoseEstimate {
    /// An estimate with only a pose and its confidence.
    pub fn new(camera_from_object: Pose, confidence: f64) -> PoseEstimate {
        PoseEstimate {
            camera_from_object,
            confidence,
            probability: None,
            verification: None,
            mask: None,
            alternatives: vec![],
            details: Map::new(),
            diagnostics: vec![],
            notes: vec![],
        }
    }

    /// The alternatives as programs print them, each with its confidence relative to the sum over all poses of the instance.
    pub fn weighted_alternatives(&self) -> Vec<AlternativePose> {
        let sum = self.confidence + self.alternatives.iter().map(|other| other.confidence).sum::<f64>();
        let weighted = |other: &PoseEstimate| AlternativePose {
            camera_from_object: other.camera_from_object.rows(),
            weight: if sum > 0.0 { other.confidence / sum } else { 0.0 },
        };
        self.alternatives.iter().map(weighted).collect()
    }

    /// The probability that the pose or one of its alternatives is right, if the method computes it. At most one of them is, so that
    /// it is their sum.
    pub fn probability_with_alternatives(&self) -> Option<f64> {
        let others = self.alternatives.iter().filter_map(|other| other.probability);
        Some(self.probability? + others.sum::<f64>())
    }

    /// The visible fraction of the object, if verification has computed it.
    pub fn visibility(&self) -> Option<f64> {
        self.verification.map(|v| v.visible_fraction())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_and_its_alternatives_have_weights_and_a_probability() {
        let one = |p: f64| PoseEstimate { probability: Some(p), ..PoseEstimate::new(Pose::identity(), p) };
        let estimate = PoseEstimate { alternatives: vec![one(0.25), one(0.125)], ..one(0.5) };
        assert_eq!(estimate.probability_with_alternatives(), Some(0.875));
        let weights: Vec<f64> = estimate.weighted_alternatives().iter().map(|a| a.weight).collect();
        assert_eq!(weights, [0.25 / 0.875, 0.125 / 0.875]);
        assert_eq!(one(0.5).probability_with_alternatives(), Some(0.5));
        assert_eq!(PoseEstimate::new(Pose::identity(), 0.5).probability_with_alternatives(), None);
    }
}
