//! Why nothing could be trained, whatever it was.

use std::error::Error;
use std::path::PathBuf;

use sixfold_io::LockError;

use crate::checkpoint::CheckpointError;
use crate::files::explain;
use crate::options::OptionError;
use crate::training_log::TrainingLogError;
use crate::weights::WeightsError;

/// Why a training could not begin or be continued. What was trained until the last checkpoint is kept.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// An option is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// Reading or writing a checkpoint.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// Reading or writing the log.
    #[error(transparent)]
    Log(#[from] TrainingLogError),
    /// Weights to begin with, or those that came out.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// Another training runs in the folder, or the folder cannot be locked.
    #[error(transparent)]
    Lock(#[from] LockError),
    /// An input cannot be read.
    #[error("{name}: {}: cannot be read: {}", file.display(), explain(source))]
    Input {
        /// What it is for.
        name: String,
        /// The file.
        file: PathBuf,
        /// What the file system said.
        source: std::io::Error,
    },
    /// The folder holds a training with other options, or on other inputs.
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
    /// The loss is no number any more.
    #[error(
        "step {step}: the loss is not a number; start again from the last checkpoint with a lower learning rate (now {rate})"
    )]
    NotFinite {
        /// The step.
        step: u64,
        /// The learning rate.
        rate: f64,
    },
    /// There is nothing to export.
    #[error("{}: holds no checkpoint; train first", folder.display())]
    NoCheckpoint {
        /// The training's folder.
        folder: PathBuf,
    },
    /// What the method itself could not do: its samples, its model, its evaluation.
    #[error(transparent)]
    Method(Box<dyn Error + Send + Sync>),
    /// The same where the reason does not say what it is about.
    #[error("{part}: {source}")]
    Part {
        /// What it is about.
        part: String,
        /// Why.
        source: Box<dyn Error + Send + Sync>,
    },
}

impl TrainError {
    /// An error of the method's own.
    pub fn method(error: impl Error + Send + Sync + 'static) -> Self {
        TrainError::Method(Box::new(error))
    }

    /// An error of the method's own with what it is about before it.
    pub fn about<E: Error + Send + Sync + 'static>(part: impl Into<String>) -> impl FnOnce(E) -> Self {
        let part = part.into();
        move |error| TrainError::Part { part, source: Box::new(error) }
    }
}
