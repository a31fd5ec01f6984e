//! A trained detector as an [`ObjectDetector`].

use std::path::Path;

use sixfold_estimator::{DetectedObject, EstimatorError, ObjectDetector, Region};
use sixfold_geometry::RgbImage;

use crate::detect::DetectOptions;
use crate::model::{DetectorModel, ModelError};

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

    /// Detections of a score below `threshold` are left out.
    pub fn with_threshold(self, threshold: f32) -> TrainedDetector {
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
