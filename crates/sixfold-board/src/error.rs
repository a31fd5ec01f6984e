//! Why a photograph, or a set of them, cannot be used.

use thiserror::Error;

/// Why a photograph, or a set of them, cannot be used.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum BoardError {
    /// Too little of the board is visible.
    #[error(
        "found {found} tags of the board, expected at least {minimum}: show more of the board, sharp and \
         well lit"
    )]
    TooFewTags {
        /// Tags found.
        found: usize,
        /// Tags needed.
        minimum: usize,
    },
    /// The image is mirrored.
    #[error(
        "the tags of the board are mirrored: give the photograph as the camera stores it, not as a selfie preview shows it"
    )]
    Mirrored,
    /// The image is blurred.
    #[error(
        "the photograph is blurred: edges of tags are {width:.1} pixels wide, expected at most \
         {maximum:.1}; hold the camera still, \
         or give it more light"
    )]
    Blurred {
        /// Width of the edges, pixels.
        width: f64,
        /// What is allowed for tags of this size.
        maximum: f64,
    },
    /// The corners fit no pose of the board.
    #[error(
        "corners deviate by {found:.1} pixels from the board's layout, expected at most {maximum:.1}: is the \
         board flat, and \
         the camera file that of this photograph?"
    )]
    DoesNotFit {
        /// Root mean square distance, pixels.
        found: f64,
        /// What is allowed.
        maximum: f64,
    },
    /// Too few photographs for a calibration.
    #[error(
        "found {found} photographs that show the board, expected at least {minimum}: take more, from \
         different sides"
    )]
    TooFewPhotographs {
        /// Photographs that show the board.
        found: usize,
        /// Photographs needed.
        minimum: usize,
    },
    /// The photographs do not determine the camera.
    #[error(
        "the photographs do not determine the camera (focal length {focal:.0} +- {deviation:.0} pixels): take some with the camera \
         tilted by 30 to 60 degrees against the board, in different directions"
    )]
    Undetermined {
        /// Focal length, pixels.
        focal: f64,
        /// Its standard deviation.
        deviation: f64,
    },
    /// The solver found no camera.
    #[error("no camera fits these photographs: are they all of one camera, with one zoom, and whole images?")]
    NoSolution,
}
