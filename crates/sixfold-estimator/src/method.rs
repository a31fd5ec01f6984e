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
    /// It makes no use of it.
    #[default]
    Unused,
    /// It works without.
    Optional,
    /// It cannot do without.
    Required,
}

/// What a method needs of a query and of an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Needs {
    /// A depth image.
    pub depth: Need,
    /// A colour image.
    pub rgb: Need,
    /// A region that says where in the image the object is.
    pub region: Need,
    /// A mesh, or whatever else stands for the object; [`Need::Optional`] where the method's own weights know it.
    pub object: Need,
}

/// The confidence below which estimates are left out unless the caller says otherwise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MinConfidence {
    /// For a person who asks about one image and wants no guesses.
    pub image: f64,
    /// For a dataset, whose scores sort guesses out.
    pub dataset: f64,
}

/// An object as a method knows it.
pub trait PreparedObject: Any + Send + Sync {
    /// What people call it.
    fn name(&self) -> &str;

    /// What overlays render for it, where there is a mesh.
    fn mesh(&self) -> Option<&Mesh>;

    /// What happened on the way that a user should know, a sentence each: a cached file that was not usable, say.
    fn notes(&self) -> &[String] {
        &[]
    }
}

/// A method that finds objects in images. The same query gives the same answer at any number of threads.
pub trait PoseEstimator: Send + Sync {
    /// As it is called on the command line and in records: `ppf`.
    fn name(&self) -> &'static str;

    /// What it needs.
    fn needs(&self) -> Needs;

    /// How depth images are prepared for it.
    fn depth_options(&self) -> DepthOptions {
        DepthOptions::default()
    }

    /// The usual thresholds of its confidence.
    fn min_confidence(&self) -> MinConfidence {
        MinConfidence { image: 0.0, dataset: 0.0 }
    }

    /// Derives once from an object what every query needs; kept in the object's folder where it takes time
    /// ([`Object::file`]).
    ///
    /// # Errors
    /// [`EstimatorError::Lacks`] and [`EstimatorError::Object`].
    fn prepare(&self, object: &Object) -> Result<Box<dyn PreparedObject>, EstimatorError>;

    /// Finds the object, best first; empty where it is not found.
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
