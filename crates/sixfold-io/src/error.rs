//! Errors of image files: every message names the file, the values found and expected, and what to do.

use std::path::PathBuf;

use thiserror::Error;

/// Why an image file cannot be read or written.
#[derive(Debug, Error)]
pub enum ImageFileError {
    /// The system could not read it.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The system could not write it.
    #[error("{}: cannot be written: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// It cannot be decoded, or has another kind of pixels.
    #[error("{}: not a readable image: {reason}; get the file again or remove it", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// It is an image but not a mask, or it is not clear which pixels belong to the mask.
    #[error("{}: mask: {reason}", path.display())]
    Mask {
        /// The file.
        path: PathBuf,
        /// What was found and expected, and what to do.
        reason: String,
    },
    /// It has another size than the camera.
    #[error(
        "{}: the image is {}x{}, expected {}x{} from {size_from}; the intrinsics belong to another resolution: give the \
         camera file of these images or resize them",
        path.display(), found.0, found.1, expected.0, expected.1
    )]
    Size {
        /// The file.
        path: PathBuf,
        /// Width and height expected.
        expected: (usize, usize),
        /// Width and height found.
        found: (usize, usize),
        /// The source of the expected size.
        size_from: String,
    },
}

/// The system's error, for callers that name the file in their own error.
impl From<ImageFileError> for std::io::Error {
    fn from(error: ImageFileError) -> Self {
        match error {
            ImageFileError::Read { source, .. } | ImageFileError::Write { source, .. } => source,
            other => std::io::Error::other(other),
        }
    }
}
