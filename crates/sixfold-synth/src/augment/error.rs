//! Errors in a user's input: folders, images, options.

use std::path::PathBuf;

use thiserror::Error;

/// Why backgrounds or options cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum AugmentError {
    /// The folder of photographs cannot be listed.
    #[error("{}: cannot be listed as a folder of photographs ({source}); give a folder with PNG or JPEG files", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// There is no usable photograph.
    #[error("{}: found {found} image files that can be read, expected at least one PNG or JPEG; without photographs use procedural backgrounds", path.display())]
    NoPhotographs {
        /// The folder.
        path: PathBuf,
        /// How many were readable.
        found: usize,
    },
    /// An image given in memory is too small.
    #[error("background image {index}: found {width}x{height} pixels, expected at least 8x8")]
    SmallImage {
        /// Its index in the list.
        index: usize,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// An option is out of its range.
    #[error("option {field}: found {found}, expected {expected}")]
    Option {
        /// Name of the option.
        field: &'static str,
        /// Its value.
        found: String,
        /// The expected value.
        expected: &'static str,
    },
}

impl AugmentError {
    /// Tests that `range` is finite, in order and within `low..=high`.
    ///
    /// # Errors
    /// [`AugmentError::Option`].
    pub(crate) fn check_range(
        field: &'static str,
        range: [f32; 2],
        low: f32,
        high: f32,
        expected: &'static str,
    ) -> Result<(), AugmentError> {
        if range[0] >= low && range[0] <= range[1] && range[1] <= high {
            return Ok(());
        }
        Err(AugmentError::Option { field, found: format!("{range:?}"), expected })
    }

    /// Tests that a probability lies in `0..=1`.
    ///
    /// # Errors
    /// [`AugmentError::Option`].
    pub(crate) fn check_probability(field: &'static str, found: f32) -> Result<(), AugmentError> {
        AugmentError::check_range(field, [found, found], 0.0, 1.0, "a probability between 0 and 1")
    }
}
