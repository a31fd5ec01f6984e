//! A trained detector as an [`ObjectDetector`].

use std::path::Path;

use sixfold_estimator::{DetectedObject, EstimatorError, ObjectDetector, Region};
use sixfold_geometry::RgbImage;

use crate::detect::DetectOptions;
use crate::model::{DetectorModel, ModelError};

/// Threshold for a requested object, if the detector's own is higher: it is more likely to be present than an arbitrary one of the
/// detector's objects.
const MIN_SCORE: f32 = 0.4;
/// Minimum score of detections in datasets: the poses' own confidences rank them further.
const MIN_DETECTION: f32 = 0.1;

/// Options of the proposals. Recall of the 694 objects that 100 LM-O development frames show to at least 40 %: 0.865 with 100 boxes of
/// one scale, 0.934 and 0.950 with 200 and 300 of three; with an overlap of at least 0.75 0.507 with 200 (0.447 without voting and with
/// a suppression at each scale).
const PROPOSAL_SCALES: usize = 3;
/// See [`PROPOSAL_SCALES`].
const PROPOSAL_OVERLAP: f32 = 0.6;
/// See [`PROPOSAL_SCALES`].
const MAX_PROPOSALS: usize = 300;

/// A trained detector with its options.
pub struct TrainedDetector {
    model: DetectorModel,
    options: DetectOptions,
}

impl TrainedDetector {
    /// The detector of a weight file with its own threshold.
    ///
    /// # Errors
    /// [`ModelError`] if the file is not a detector.
    pub fn load(weights: &Path) -> Result<TrainedDetector, ModelError> {
        let model = DetectorModel::load(weights)?;
        let options = model.options();
        Ok(TrainedDetector { model, options })
    }

    /// The shipped detector of any object: proposals for objects that no detector was trained on.
    ///
    /// # Errors
    /// [`ModelError`] if the shipped weights have another version than the program.
    pub fn proposals() -> Result<TrainedDetector, ModelError> {
        let model = DetectorModel::proposals()?;
        let options = model.options();
        Ok(TrainedDetector { model, options }.for_proposals())
    }

    /// The detector with the options for proposals: many boxes at several scales, without masks.
    #[must_use]
    pub fn for_proposals(self) -> TrainedDetector {
        let options = DetectOptions {
            masks: false,
            scales: if self.model.has_scales() { PROPOSAL_SCALES } else { 1 },
            overlap: PROPOSAL_OVERLAP,
            voting: true,
            per_class: MAX_PROPOSALS,
            max_detections: MAX_PROPOSALS,
            ..self.options
        };
        self.with_options(options)
    }

    /// A detector with other options.
    pub fn new(model: DetectorModel, options: DetectOptions) -> TrainedDetector {
        TrainedDetector { model, options }
    }

    /// The same detector with other options.
    #[must_use]
    pub fn with_options(self, options: DetectOptions) -> TrainedDetector {
        TrainedDetector { options, ..self }
    }

    /// The same detector, with or without masks.
    #[must_use]
    pub fn with_masks(self, masks: bool) -> TrainedDetector {
        TrainedDetector { options: DetectOptions { masks, ..self.options }, ..self }
    }

    /// The network.
    pub fn model(&self) -> &DetectorModel {
        &self.model
    }

    /// The options.
    pub fn options(&self) -> &DetectOptions {
        &self.options
    }

    /// The detector with the options for a method's regions in the images of a dataset.
    pub fn for_dataset(self) -> TrainedDetector {
        self.with_threshold(MIN_DETECTION)
    }

    /// The region of the best detection of the requested object, if there is one.
    ///
    /// # Errors
    /// If the network fails on the image.
    pub fn best(self, image: &RgbImage, object_id: u32) -> Result<Option<Region>, EstimatorError> {
        let threshold = self.options.threshold.min(MIN_SCORE);
        let found = self.with_threshold(threshold).detect(image)?;
        let found = found.into_iter().filter(|d| d.object_id == object_id);
        let best = found.max_by(|a, b| a.region.score.total_cmp(&b.region.score));
        Ok(best.map(|d| d.region))
    }

    /// Detections with a score below `threshold` are left out.
    pub(crate) fn with_threshold(self, threshold: f32) -> TrainedDetector {
        TrainedDetector { options: DetectOptions { threshold, ..self.options }, ..self }
    }
}

impl ObjectDetector for TrainedDetector {
    fn check_object(&self, object_id: u32) -> Result<(), EstimatorError> {
        self.model.check_object(object_id).map(|_| ()).map_err(EstimatorError::method)
    }

    fn detect(&self, image: &RgbImage) -> Result<Vec<DetectedObject>, EstimatorError> {
        let found = self.model.detect(image, &self.options).map_err(EstimatorError::method)?;
        let object = |d: crate::detect::Detected| DetectedObject {
            object_id: self.model.id_of(d.class),
            region: Region { score: f64::from(d.score), mask: d.mask, ..Region::of_box(d.bbox) },
        };
        Ok(found.into_iter().map(object).collect())
    }
}
