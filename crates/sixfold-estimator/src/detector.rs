//! The interface of a detector, which finds the regions of objects.

use sixfold_geometry::RgbImage;

use crate::error::EstimatorError;
use crate::region::Region;

/// A detected object.
#[derive(Debug, Clone)]
pub struct DetectedObject {
    /// Its number among the detector's objects.
    pub object_id: u32,
    /// Its region, with the confidence.
    pub region: Region,
}

/// Finds the regions of known objects in colour images.
pub trait ObjectDetector: Send + Sync {
    /// An error unless the detector was trained on the object.
    ///
    /// # Errors
    /// [`EstimatorError::Method`].
    fn check_object(&self, object_id: u32) -> Result<(), EstimatorError>;

    /// The detections in an image, the most confident first.
    ///
    /// # Errors
    /// [`EstimatorError::Method`].
    fn detect(&self, image: &RgbImage) -> Result<Vec<DetectedObject>, EstimatorError>;
}
