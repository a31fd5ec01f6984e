//! A query to a method: an image and the region to search.

use std::any::{Any, TypeId};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use sixfold_align::{DepthRegion, PreparedDepth, PreparedDepthError};
use sixfold_geometry::{Camera, OptionError, RgbImage};

use crate::error::EstimatorError;
use crate::region::Region;

/// Data that methods compute once per query, or once per image, and use for every object that is searched in it, by type. A clone
/// shares the same memo.
#[derive(Default, Clone)]
pub struct Memo(Arc<Mutex<Kept>>);

type Kept = HashMap<TypeId, Arc<dyn Any + Send + Sync>>;

impl Memo {
    /// The value of this type, made at the first request.
    pub fn get_or_default<T: Default + Send + Sync + 'static>(&self) -> Arc<T> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let any = kept.entry(TypeId::of::<T>()).or_insert_with(|| Arc::new(T::default())).clone();
        drop(kept);
        // The entry under this type's id always holds this type.
        any.downcast().unwrap_or_default()
    }
}

/// Whether a number can be the confidence below which estimates are left out: 0 or more, not NaN.
///
/// # Errors
/// [`OptionError`].
pub fn check_min_confidence(value: f64) -> Result<(), OptionError> {
    OptionError::unless_within("min_confidence", value, 0.0.., "a number, 0 to 1")
}

/// An image of a pinhole camera and the region to search. One query can be used for any number of objects: data that depends
/// only on the image is computed once.
pub struct Query<'a> {
    /// The camera, without lens distortion.
    pub camera: &'a Camera,
    /// The colour image.
    pub rgb: Option<&'a RgbImage>,
    /// The depth image, prepared with the method's own [`depth_options`](crate::PoseEstimator::depth_options).
    pub depth: Option<&'a Arc<PreparedDepth>>,
    /// The region to search; `None` for the whole image.
    pub region: Option<&'a Region>,
    /// Maximum number of instances of an object, 1 or more.
    pub max_instances: usize,
    /// How many of these are wanted only to see how certain the others are: a method need not spend time on finding them.
    pub runners_up: usize,
    /// Estimates with a lower confidence (or, with probabilities, [`probability_with_alternatives`]) are left out; 0 or more. Confidences are
    /// 0 to 1, so a value above 1 leaves out all.
    ///
    /// [`probability_with_alternatives`]: crate::PoseEstimate::probability_with_alternatives
    pub min_confidence: f64,
    /// Whether images for people are wanted.
    pub diagnostics: bool,
    /// Data of the image and the region that methods share between objects.
    pub memo: Memo,
    /// Data of the image and its camera alone: queries of other regions of the same image can share it.
    pub image_memo: Memo,
    /// What [`Query::depth_region`] returns.
    #[doc(hidden)]
    pub depth_region: Arc<OnceLock<Result<DepthRegion, PreparedDepthError>>>,
}

impl<'a> Query<'a> {
    /// The same query with other limits, for a method that calls other methods: data that depends on the image and the region is
    /// computed once for all of them.
    #[must_use]
    pub fn passed_on(&self, max_instances: usize, min_confidence: f64) -> Query<'a> {
        Query {
            camera: self.camera,
            rgb: self.rgb,
            depth: self.depth,
            region: self.region,
            max_instances,
            runners_up: 0,
            min_confidence,
            diagnostics: self.diagnostics,
            memo: self.memo.clone(),
            image_memo: self.image_memo.clone(),
            depth_region: self.depth_region.clone(),
        }
    }

    /// A query for one instance anywhere in this camera's image, with any confidence; set images and limits through the fields.
    pub fn new(camera: &'a Camera) -> Query<'a> {
        Query {
            camera,
            rgb: None,
            depth: None,
            region: None,
            max_instances: 1,
            runners_up: 0,
            min_confidence: 0.0,
            diagnostics: false,
            memo: Memo::default(),
            image_memo: Memo::default(),
            depth_region: Arc::default(),
        }
    }

    /// Checks the limits. Runners call it before they call a method.
    ///
    /// # Errors
    /// [`OptionError`] with the first limit that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_some("max_instances", self.max_instances)?;
        check_min_confidence(self.min_confidence)
    }

    /// The part of the depth image to search.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_out_of_range_are_named() {
        let camera = Camera::new(300.0, 300.0, 159.5, 119.5, 320, 240).unwrap();
        let named = |query: Query<'_>| query.check().map_err(|error| error.option);
        assert_eq!(named(Query::new(&camera)), Ok(()));
        for value in [0.0, 1.0, 1.1, f64::INFINITY] {
            assert_eq!(named(Query { min_confidence: value, ..Query::new(&camera) }), Ok(()), "{value}");
        }
        for value in [-0.1, f64::NAN] {
            let query = Query { min_confidence: value, ..Query::new(&camera) };
            assert_eq!(named(query), Err("min_confidence"), "{value}");
        }
        assert_eq!(named(Query { max_instances: 0, ..Query::new(&camera) }), Err("max_instances"));
    }
}
