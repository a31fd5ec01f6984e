//! The interface of a method.

use std::any::Any;

use sixfold_align::DepthOptions;
use sixfold_mesh::Mesh;

use crate::error::EstimatorError;
use crate::estimate::PoseEstimate;
use crate::object::Object;
use crate::query::Query;

/// How much a method depends on an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Need {
    /// The input is not used.
    #[default]
    Unused,
    /// The method works without it, and uses it if given.
    Optional,
    /// The method needs it.
    Required,
}

/// The inputs that a method needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Needs {
    /// A depth image.
    pub depth: Need,
    /// A colour image.
    pub rgb: Need,
    /// A region of the image that contains the object.
    pub region: Need,
    /// A mesh or another model of the object; [`Need::Optional`] if the method's weights contain the object.
    pub object: Need,
}

/// The confidence below which estimates are left out, unless the caller sets another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MinConfidence {
    /// For a single image, where a person wants no guesses.
    pub image: f64,
    /// For a dataset, whose scores take low confidences into account.
    pub dataset: f64,
}

/// An object prepared for a method.
pub trait PreparedObject: Any + Send + Sync {
    /// Its name for people.
    fn name(&self) -> &str;

    /// The mesh that overlays render, if there is one.
    fn mesh(&self) -> Option<&Mesh>;

    /// Notes for the user about the preparation, one sentence each, such as an unusable cached file.
    fn notes(&self) -> &[String] {
        &[]
    }
}

/// A method that finds objects in images. The same query gives the same answer for any number of threads.
pub trait PoseEstimator: Send + Sync {
    /// Its name on the command line and in records, such as `ppf`.
    fn name(&self) -> &'static str;

    /// Its required and optional inputs.
    fn needs(&self) -> Needs;

    /// The options with which depth images are prepared for it.
    fn depth_options(&self) -> DepthOptions {
        DepthOptions::default()
    }

    /// The default thresholds of its confidence.
    fn min_confidence(&self) -> MinConfidence {
        MinConfidence { image: 0.0, dataset: 0.0 }
    }

    /// Whether the object has what the method needs of it, as far as this can be said without reading a file. A caller that asks
    /// several methods leaves this one out where it has not; [`PoseEstimator::prepare`] states what is missing.
    fn knows(&self, _object: &Object) -> bool {
        true
    }

    /// What the method holds of the object with this id that is neither in the object's files nor among the method's options, such
    /// as templates from other images: its name, and a hash that a resumed run compares. `None`: nothing.
    fn held(&self, _id: u32) -> Option<(&'static str, u64)> {
        None
    }

    /// Computes once from an object the data that every query needs; slow results are stored in the object's
    /// folder ([`Object::file`]).
    ///
    /// # Errors
    /// [`EstimatorError::Lacks`] and [`EstimatorError::Object`].
    fn prepare(&self, object: &Object) -> Result<Box<dyn PreparedObject>, EstimatorError>;

    /// Finds the object; returns estimates, the best first, or none if it is not found.
    ///
    /// # Errors
    /// [`EstimatorError`]; [`EstimatorError::Region`] concerns this region alone.
    fn estimate(
        &self,
        object: &dyn PreparedObject,
        query: &Query<'_>,
    ) -> Result<Vec<PoseEstimate>, EstimatorError>;
}

/// The method's own type behind an object that it prepared.
///
/// # Errors
/// [`EstimatorError::Foreign`] for an object of another method.
pub fn downcast<'a, T: PreparedObject>(
    object: &'a dyn PreparedObject,
    method: &'static str,
) -> Result<&'a T, EstimatorError> {
    (object as &dyn Any).downcast_ref::<T>().ok_or(EstimatorError::Foreign { method })
}
