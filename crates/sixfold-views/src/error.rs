//! Errors of this crate.

use std::path::PathBuf;

use sixfold_nn::weights::WeightsError;
use thiserror::Error;

/// Why poses could not be estimated from views.
#[derive(Debug, Error)]
pub enum ViewsError {
    /// The shipped weights cannot be used.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// A file could not be read.
    #[error("{}: expected a readable file, found: {source}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The network's output could not be read.
    #[error("features: expected numbers, found {reason}")]
    Network {
        /// The framework's error.
        reason: String,
    },
    /// The object is not visible from any side.
    #[error("object {object}: expected a mesh with faces that a camera sees, found none; give another mesh")]
    Invisible {
        /// Name of the object.
        object: String,
    },
}
