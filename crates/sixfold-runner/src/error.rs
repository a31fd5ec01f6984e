//! Why a run cannot continue.

use std::path::{Path, PathBuf};

use sixfold_bop::{DatasetError, ResultsError, RleError};
use sixfold_estimator::{CacheError, EstimatorError};
use sixfold_geometry::CameraError;
use sixfold_io::LockError;
use thiserror::Error;

/// Why a run cannot continue.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunError {
    /// The dataset cannot be read.
    #[error(transparent)]
    Dataset(Box<DatasetError>),
    /// The result file cannot be read or written.
    #[error(transparent)]
    Results(#[from] ResultsError),
    /// The method failed.
    #[error(transparent)]
    Estimator(#[from] EstimatorError),
    /// The cache cannot be used.
    #[error(transparent)]
    Cache(#[from] CacheError),
    /// The mask of a detection has another size than the image.
    #[error("segmentation of object {object_id} in image {scene_id}/{image_id}")]
    Segmentation {
        /// The object.
        object_id: u32,
        /// The scene.
        scene_id: u32,
        /// The image.
        image_id: u32,
        /// Why.
        source: CameraError,
    },
    /// An image lacks what the run needs.
    #[error("has no {what}, which {user} needs")]
    Lacks {
        /// What it lacks.
        what: &'static str,
        /// The part that needs it.
        user: &'static str,
    },
    /// The method needs regions.
    #[error(
        "--method {method} needs boxes: give --detector FILE.safetensors, --boxes gt or a file of COCO detections"
    )]
    NoRegions {
        /// The method.
        method: &'static str,
    },
    /// The result file exists without a record of its options.
    #[error(
        "{} exists, but {} does not say what it was made with: remove it or choose another --out",
        results.display(), record.display()
    )]
    NoRecord {
        /// The result file.
        results: PathBuf,
        /// The record beside it.
        record: PathBuf,
    },
    /// The result file was made with other options.
    #[error(transparent)]
    OtherOptions(Box<OtherOptions>),
    /// The result file was made with other contents of an input.
    #[error(transparent)]
    OtherInput(Box<OtherInput>),
    /// Another process writes the result file.
    #[error(transparent)]
    Locked(#[from] LockError),
    /// A mask cannot be written as run lengths.
    #[error(transparent)]
    Mask(#[from] RleError),
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The caller asked to stop.
    #[error("interrupted; run the same command again to resume")]
    Interrupted,
    /// The caller's own work on a result failed.
    #[error(transparent)]
    Caller(Box<dyn std::error::Error + Send + Sync>),
}

impl From<DatasetError> for RunError {
    fn from(error: DatasetError) -> RunError {
        RunError::Dataset(Box::new(error))
    }
}

/// A result file that was made with other options.
#[derive(Debug, Error)]
#[error(
    "{} was made with other options ({option}: {before}, now {now}; see {}): remove both or choose another --out",
    results.display(), record.display()
)]
pub struct OtherOptions {
    /// The result file.
    pub results: PathBuf,
    /// The record beside it.
    pub record: PathBuf,
    /// The option that differs.
    pub option: String,
    /// Its earlier value.
    pub before: String,
    /// Its current value.
    pub now: String,
}

/// A result file whose rows were computed from an input file that has changed since.
#[derive(Debug, Error)]
#[error(
    "{} was made with another {input} ({}; see {}): remove both or choose another --out",
    results.display(), changed(file), record.display()
)]
pub struct OtherInput {
    /// The result file.
    pub results: PathBuf,
    /// The record beside it.
    pub record: PathBuf,
    /// The input that changed, with its image or object.
    pub input: String,
    /// The file of this input; empty if it no longer exists.
    pub file: PathBuf,
}

fn changed(file: &Path) -> String {
    let gone = file.as_os_str().is_empty();
    if gone { "the file is gone".into() } else { format!("{} has changed since", file.display()) }
}

/// The whole chain of causes in one line, without repeating a cause that its parent already prints.
pub fn describe(error: &(dyn std::error::Error + 'static)) -> String {
    let mut text = String::new();
    let mut cause = Some(error);
    while let Some(error) = cause {
        let part = error.to_string();
        if !text.contains(&part) {
            if !text.is_empty() {
                text.push_str(": ");
            }
            text.push_str(&part);
        }
        cause = error.source();
    }
    text
}
