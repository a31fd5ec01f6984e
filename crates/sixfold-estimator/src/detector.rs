//! Who says where objects are: the interface of a detector.

use sixfold_geometry::RgbImage;

use crate::error::EstimatorError;
use crate::region::Region;

/// An object that a detector sees.
#[derive(Debug, Clone)]
pub struct DetectedObject {
    /// Its number among the detector's objects.
    pub object_id: u32,
    /// Where it is, and how sure that is.
    pub region: Region,
}

/// Finds the regions of known objects in colour images.
pub trait ObjectDetector: Send + Sync {
    /// An error unless the detector knows the object.
    ///
    /// # Errors
    /// [`EstimatorError::Method`].
    fn check_object(&self, object_id: u32) -> Result<(), EstimatorError>;

    /// What it sees in an image, the most confident first.
    ///
    /// # Errors
    /// [`EstimatorError::Method`].
    fn detect(&self, image: &RgbImage) -> Result<Vec<DetectedObject>, EstimatorError>;
}
