//! Errors of posed images and options.

use sixfold_data::PosedImageError;

/// Errors of posed images and options.
#[derive(Debug, thiserror::Error)]
pub enum NolError {
    /// An image does not fit its camera, mask or pose.
    #[error(transparent)]
    Image(#[from] PosedImageError),
    /// The mask is empty, or does not show the object.
    #[error(
        "photograph {name}: the mask covers {percent:.0} % of the object's outline at the given pose, \
         expected at least {minimum:.0} %; check that the mask belongs to this object and image"
    )]
    Mask {
        /// Name of the photograph.
        name: String,
        /// Part of the outline that the mask covers, per cent.
        percent: f64,
        /// Smallest value accepted, per cent.
        minimum: f64,
    },
    /// An option is out of range.
    #[error("{field}: expected {expected}, found {found}")]
    Option {
        /// Name of the option.
        field: &'static str,
        /// The values allowed.
        expected: &'static str,
        /// The value found.
        found: String,
    },
}
