//! The interface of a refiner, which improves poses that a method found.

use std::sync::Arc;

use sixfold_geometry::{Camera, Pose, RgbImage};
use sixfold_mesh::Mesh;

use crate::error::EstimatorError;

/// A refined pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefinedPose {
    /// From the object's frame to the camera's.
    pub camera_from_object: Pose,
    /// Agreement of the image with the object at this pose, 0 to 1.
    pub agreement: f64,
}

/// Refines poses of any object with a mesh in colour images.
pub trait PoseRefiner: Send + Sync {
    /// The object, prepared once for all images.
    fn object(&self, mesh: &Mesh) -> Arc<dyn RefinedObject>;
}

/// An object whose poses are refined.
pub trait RefinedObject: Send + Sync {
    /// The pose that fits the pinhole image best near `camera_from_object`; `None` if the image does not show the object there.
    ///
    /// # Errors
    /// [`EstimatorError::Method`].
    fn refine(
        &self,
        image: &RgbImage,
        camera: &Camera,
        camera_from_object: &Pose,
    ) -> Result<Option<RefinedPose>, EstimatorError>;
}
