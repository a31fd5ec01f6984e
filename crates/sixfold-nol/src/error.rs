//! What is wrong with posed images or options.

use sixfold_data::PosedImageError;

/// What is wrong with posed images or options.
#[derive(Debug, thiserror::Error)]
pub enum NolError {
    /// An image does not fit its camera, mask or pose.
    #[error(transparent)]
    Image(#[from] PosedImageError),
    /// The mask is empty, or shows something else.
    #[error(
        "photograph {name}: the mask covers {share:.0} % of the object's outline at the given pose, expected at least {least:.0} %; check that the mask belongs to this object and image"
    )]
    Mask {
        /// The photograph.
        name: String,
        /// Covered part of the outline, per cent.
        share: f64,
        /// What it should be at least.
        least: f64,
    },
    /// An option is out of range.
    #[error("{field}: expected {expected}, found {found}")]
    Option {
        /// Which.
        field: &'static str,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
}
