//! Runs a method on one image.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

use serde::Serialize;
use serde_json::{Map, Value};
use sixfold_align::{PreparedDepth, VerificationScore};
use sixfold_estimator::{
    AlternativePose, EstimatorError, Object, PoseEstimate, PoseEstimator, PreparedObject, Query,
};

use crate::overruled::left_standing;

/// A method and an image.
pub struct ImageRun<'a> {
    /// The method.
    pub estimator: &'a dyn PoseEstimator,
    /// The image and the region to search.
    pub query: Query<'a>,
}

/// An object that was searched, with its estimates.
pub struct FoundObject {
    /// The object, prepared for the method.
    pub object: Box<dyn PreparedObject>,
    /// Its poses, best first.
    pub estimates: Vec<PoseEstimate>,
    /// Seconds for preparing and searching it.
    pub seconds: f64,
}

impl ImageRun<'_> {
    /// Searches one object. Data that depends only on the image is computed for the first object only.
    ///
    /// # Errors
    /// [`EstimatorError`], also for a query whose limits are out of their range.
    pub fn find(&self, object: &Object) -> Result<FoundObject, EstimatorError> {
        self.query.check().map_err(EstimatorError::method)?;
        let start = Instant::now();
        let object = self.estimator.prepare(object)?;
        let estimates = self.estimator.estimate(object.as_ref(), &self.query)?;
        Ok(FoundObject { object, estimates, seconds: start.elapsed().as_secs_f64() })
    }

    /// The results in the form of a report for programs and people.
    pub fn report(&self, found: &[FoundObject]) -> ImageReport {
        let of = |f: &FoundObject| {
            f.estimates.iter().map(|e| FoundPose::new(f.object.name(), f.seconds, e)).collect::<Vec<_>>()
        };
        let poses = found.iter().flat_map(of).collect();
        let missing = found.iter().filter(|f| f.estimates.is_empty());
        let not_found = missing.map(|f| f.object.name().to_owned()).collect();
        ImageReport { poses, not_found, overlay: None, diagnostics: BTreeMap::new() }
    }
}

/// Removes poses most of whose pixels belong to more probable poses, of the same object or of another. Only for methods that
/// report probabilities. Returns how many were removed.
pub fn without_overruled(found: &mut [FoundObject]) -> usize {
    let all: Vec<&PoseEstimate> = found.iter().flat_map(|f| &f.estimates).collect();
    let standing = left_standing(&all);
    let mut stands = standing.iter();
    for object in found {
        object.estimates.retain(|_| stands.next().copied().unwrap_or(true));
    }
    standing.iter().filter(|stands| !**stands).count()
}

/// Properties of a depth image that make a search slow or unlikely to succeed, one sentence each.
pub fn depth_notes(depth: &PreparedDepth, estimator: &dyn PoseEstimator) -> Vec<String> {
    let mut notes = vec![];
    let pixels = depth.depth().as_slice();
    let measured = pixels.iter().filter(|&&z| z > 0.0).count();
    if 10 * measured < pixels.len() {
        let percent = (100.0 * measured as f64 / pixels.len() as f64).round();
        notes.push(format!("only {percent} % of the depth image is measured"));
    }
    if estimator.depth_options().remove_plane && depth.plane().is_none() {
        notes.push("no table plane was found; all of the image is searched".to_owned());
    }
    notes
}

/// A pose as JSON.
#[derive(Debug, Serialize)]
pub struct FoundPose {
    /// The object's name.
    pub object: String,
    /// The pose by rows, metres.
    pub camera_from_object: [[f64; 4]; 4],
    /// Confidence, 0 to 1.
    pub confidence: f64,
    /// Probability that the pose is right, if the method computes it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub probability: Option<f64>,
    /// Probability that the pose or one of its alternatives is right, if the method computes probabilities.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub probability_with_alternatives: Option<f64>,
    /// Score of verification by rendering.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub verification: Option<VerificationScore>,
    /// Other poses of the same instance that are about as good; the object has at most one of them.
    pub alternatives: Vec<AlternativePose>,
    /// The method's own keys, and `seconds`.
    #[serde(flatten)]
    pub details: Map<String, Value>,
    /// Seconds for preparing and searching the object.
    #[serde(skip)]
    pub elapsed: f64,
}

impl FoundPose {
    /// `seconds` are those of the whole search for the object.
    pub(crate) fn new(object: &str, seconds: f64, estimate: &PoseEstimate) -> FoundPose {
        let mut details = estimate.details.clone();
        if !details.contains_key("seconds") {
            details.insert("seconds".to_owned(), seconds.into());
        }
        FoundPose {
            object: object.to_owned(),
            camera_from_object: estimate.camera_from_object.rows(),
            confidence: estimate.confidence,
            alternatives: estimate.weighted_alternatives(),
            probability: estimate.probability,
            probability_with_alternatives: estimate.probability_with_alternatives(),
            verification: estimate.verification,
            details,
            elapsed: seconds,
        }
    }

    /// The visible fraction of the object, if verification has computed it.
    pub fn visibility(&self) -> Option<f64> {
        self.verification.map(|v| v.visible_fraction())
    }
}

/// The results of one image, as JSON.
#[derive(Debug, Serialize)]
pub struct ImageReport {
    /// All poses, object by object.
    pub poses: Vec<FoundPose>,
    /// Names of the objects that were not found.
    pub not_found: Vec<String>,
    /// The overlay, if one was rendered.
    pub overlay: Option<PathBuf>,
    /// The method's own images, by name.
    #[serde(flatten)]
    pub diagnostics: BTreeMap<String, PathBuf>,
}
