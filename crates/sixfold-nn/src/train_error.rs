//! Errors of trainings.

use std::error::Error;
use std::path::PathBuf;

use sixfold_io::LockError;

use crate::checkpoint::CheckpointError;
use crate::files::explain;
use crate::options::OptionError;
use crate::training_log::TrainingLogError;
use crate::weights::WeightsError;

/// Why a training could not start or continue. The state of the last checkpoint is kept.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// An option is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// Error in reading or writing a checkpoint.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// Error in reading or writing the log.
    #[error(transparent)]
    Log(#[from] TrainingLogError),
    /// Error in the initial weights or in saving the trained ones.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// Another training runs in the folder, or the folder cannot be locked.
    #[error(transparent)]
    Lock(#[from] LockError),
    /// An input cannot be read.
    #[error("{name}: {}: cannot be read: {}", file.display(), explain(source))]
    Input {
        /// Name of the input.
        name: String,
        /// The file.
        file: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The folder contains a training with other options or inputs.
    #[error(
        "{}: holds a training with other options or on other inputs ({difference}); continue with the same ones, or start again in \
         another folder",
        folder.display()
    )]
    OtherTraining {
        /// The folder.
        folder: PathBuf,
        /// Which option or input differs, and how.
        difference: String,
    },
    /// The loss is not finite.
    #[error(
        "step {step}: the loss is not a number; start again from the last checkpoint with a lower learning rate (now {rate})"
    )]
    NotFinite {
        /// The step.
        step: u64,
        /// The learning rate.
        rate: f64,
    },
    /// There is no checkpoint to export.
    #[error("{}: holds no checkpoint; train first", folder.display())]
    NoCheckpoint {
        /// The training's folder.
        folder: PathBuf,
    },
    /// Error of the method itself: in its samples, its model or its evaluation.
    #[error(transparent)]
    Method(Box<dyn Error + Send + Sync>),
    /// The same, with the part it concerns.
    #[error("{part}: {source}")]
    Part {
        /// The part it concerns.
        part: String,
        /// The cause.
        source: Box<dyn Error + Send + Sync>,
    },
}

impl TrainError {
    /// An error of the method.
    pub fn method(error: impl Error + Send + Sync + 'static) -> Self {
        TrainError::Method(Box::new(error))
    }

    /// An error of the method, with the part it concerns.
    pub fn about<E: Error + Send + Sync + 'static>(part: impl Into<String>) -> impl FnOnce(E) -> Self {
        let part = part.into();
        move |error| TrainError::Part { part, source: Box::new(error) }
    }
}
