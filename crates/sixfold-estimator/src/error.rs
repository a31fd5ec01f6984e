//! Why a method cannot prepare an object or answer a query.

use sixfold_align::PreparedDepthError;
use thiserror::Error;

/// The error of a method, boxed.
pub(crate) type Source = Box<dyn std::error::Error + Send + Sync>;

/// Why a method cannot prepare an object or answer a query.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EstimatorError {
    /// The object lacks data that the method needs.
    #[error("object {object}: has no {what}, which --method {method} needs; {advice}")]
    Lacks {
        /// The object.
        object: String,
        /// What it lacks.
        what: &'static str,
        /// The method.
        method: &'static str,
        /// Advice.
        advice: &'static str,
    },
    /// The object cannot be prepared.
    #[error("object {object}")]
    Object {
        /// The object.
        object: String,
        /// Why.
        source: Source,
    },
    /// The query lacks an input that the method needs.
    #[error("has no {what}, which --method {method} needs; {advice}")]
    Input {
        /// What it lacks.
        what: &'static str,
        /// The method.
        method: &'static str,
        /// Advice.
        advice: &'static str,
    },
    /// The region cannot be searched; other regions of the image can.
    #[error("region")]
    Region {
        /// Why.
        source: Source,
    },
    /// The depth image cannot be used.
    #[error("depth image")]
    Depth(#[from] PreparedDepthError),
    /// An object that another method prepared.
    #[error("the object was not prepared by --method {method}")]
    Foreign {
        /// The method.
        method: &'static str,
    },
    /// The method itself failed.
    #[error(transparent)]
    Method(Source),
}

impl EstimatorError {
    /// Wraps a method's own error.
    pub fn method(error: impl Into<Source>) -> EstimatorError {
        EstimatorError::Method(error.into())
    }
}
