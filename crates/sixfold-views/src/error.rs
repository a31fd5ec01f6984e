//! What can go wrong.

use std::path::PathBuf;

use sixfold_nn::weights::WeightsError;
use thiserror::Error;

/// Why poses could not be estimated from views.
#[derive(Debug, Error)]
pub enum ViewsError {
    /// The program's weights are not its own.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// A file could not be read.
    #[error("{}: expected a readable file, found: {source}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// What the file system said.
        source: std::io::Error,
    },
    /// The network's output could not be read.
    #[error("features: expected numbers, found {reason}")]
    Network {
        /// What the framework said.
        reason: String,
    },
    /// The object cannot be seen from any side.
    #[error("object {object}: expected a mesh with faces that a camera sees, found none; give another mesh")]
    Invisible {
        /// What people call it.
        object: String,
    },
}
