//! What a method is asked: an image and where to look in it.

use std::any::{Any, TypeId};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use sixfold_align::{DepthRegion, PreparedDepth, PreparedDepthError};
use sixfold_geometry::{Camera, RgbImage};

use crate::error::EstimatorError;
use crate::region::Region;

/// What methods derive from a query once and use for every object that is searched in it, by type.
#[derive(Default)]
pub struct Memo(Mutex<HashMap<TypeId, Arc<dyn Any + Send + Sync>>>);

impl Memo {
    /// The value of this type, made when first asked for.
    pub fn get_or_default<T: Default + Send + Sync + 'static>(&self) -> Arc<T> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let any = kept.entry(TypeId::of::<T>()).or_insert_with(|| Arc::new(T::default())).clone();
        drop(kept);
        // The entry of this type's id holds this type.
        any.downcast().unwrap_or_default()
    }
}

/// An image of a pinhole camera and where to look in it. One query serves any number of objects: what depends on the image alone
/// is computed once.
pub struct Query<'a> {
    /// The camera, without lens distortion.
    pub camera: &'a Camera,
    /// The colour image.
    pub rgb: Option<&'a RgbImage>,
    /// The depth image, prepared with the method's own [`depth_options`](crate::PoseEstimator::depth_options).
    pub depth: Option<&'a Arc<PreparedDepth>>,
    /// Where to look; `None` is everywhere.
    pub region: Option<&'a Region>,
    /// Most instances of an object.
    pub max_instances: usize,
    /// Estimates of lower confidence are left out.
    pub min_confidence: f64,
    /// Whether images for people are wanted.
    pub diagnostics: bool,
    /// What methods keep between objects.
    pub memo: Memo,
    /// What [`Query::depth_region`] returns.
    #[doc(hidden)]
    pub depth_region: OnceLock<Result<DepthRegion, PreparedDepthError>>,
}

impl<'a> Query<'a> {
    /// Everything in the image of this camera, one instance, any confidence; add images and limits by the fields.
    pub fn new(camera: &'a Camera) -> Query<'a> {
        Query {
            camera,
            rgb: None,
            depth: None,
            region: None,
            max_instances: 1,
            min_confidence: 0.0,
            diagnostics: false,
            memo: Memo::default(),
            depth_region: OnceLock::new(),
        }
    }

    /// The part of the depth image in which to look.
    ///
    /// # Errors
    /// [`EstimatorError::Input`] without a depth image (`method` is for the message), and [`EstimatorError::Depth`] where the
    /// region's mask does not belong to it.
    pub fn depth_region(&self, method: &'static str) -> Result<&DepthRegion, EstimatorError> {
        let depth = self.depth.ok_or(EstimatorError::Input {
            what: "depth image",
            method,
            advice: "give one, or simulate it with `sixfold simulate-depth`",
        })?;
        let make = || match self.region {
            None => Ok(DepthRegion::whole(depth)),
            Some(region) => DepthRegion::new(depth, &region.pixels(self.camera)),
        };
        self.depth_region.get_or_init(make).as_ref().map_err(|error| EstimatorError::Depth(error.clone()))
    }

    /// The colour image.
    ///
    /// # Errors
    /// [`EstimatorError::Input`] without one; `method` is for the message.
    pub fn rgb(&self, method: &'static str) -> Result<&'a RgbImage, EstimatorError> {
        let advice = "give one, or choose a method that works on depth";
        self.rgb.ok_or(EstimatorError::Input { what: "colour image", method, advice })
    }
}
