//! A trained detector as an [`ObjectDetector`].

use std::path::Path;

use sixfold_estimator::{DetectedObject, EstimatorError, ObjectDetector, Region};
use sixfold_geometry::RgbImage;

use crate::detect::DetectOptions;
use crate::model::{DetectorModel, ModelError};

/// Least score of an object that was asked for: it is more likely there than any of the detector's objects.
const MIN_SCORE: f32 = 0.4;
/// In datasets, detections this sure are passed on: a pose's own confidence sorts them further.
const MIN_DETECTION: f32 = 0.1;

/// A trained detector with what is asked of it.
pub struct TrainedDetector {
    model: DetectorModel,
    options: DetectOptions,
}

impl TrainedDetector {
    /// The detector of a weight file with its own threshold.
    ///
    /// # Errors
    /// [`ModelError`] where the file is not that of a detector.
    pub fn load(weights: &Path) -> Result<TrainedDetector, ModelError> {
        let model = DetectorModel::load(weights)?;
        let options = model.options();
        Ok(TrainedDetector { model, options })
    }

    /// The detector of any object that is within the program: proposals for objects that no detector was trained on.
    ///
    /// # Errors
    /// [`ModelError`] if the program carries weights of another version than its own.
    pub fn proposals() -> Result<TrainedDetector, ModelError> {
        let model = DetectorModel::proposals()?;
        let options = DetectOptions { masks: false, ..model.options() };
        Ok(TrainedDetector { model, options })
    }

    /// A detector with options of one's own.
    pub fn new(model: DetectorModel, options: DetectOptions) -> TrainedDetector {
        TrainedDetector { model, options }
    }

    /// The network.
    pub fn model(&self) -> &DetectorModel {
        &self.model
    }

    /// What is asked of it.
    pub fn options(&self) -> &DetectOptions {
        &self.options
    }

    /// A detector that says where a method looks in the images of a dataset.
    pub fn for_dataset(self) -> TrainedDetector {
        self.with_threshold(MIN_DETECTION)
    }

    /// Where it sees the object that was asked for best, if at all.
    ///
    /// # Errors
    /// When the network fails on the image.
    pub fn best(self, image: &RgbImage, object_id: u32) -> Result<Option<Region>, EstimatorError> {
        let threshold = self.options.threshold.min(MIN_SCORE);
        let found = self.with_threshold(threshold).detect(image)?;
        let found = found.into_iter().filter(|d| d.object_id == object_id);
        let best = found.max_by(|a, b| a.region.score.total_cmp(&b.region.score));
        Ok(best.map(|d| d.region))
    }

    /// Detections of a score below `threshold` are left out.
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
