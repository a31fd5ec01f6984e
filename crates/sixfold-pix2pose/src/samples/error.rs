//! Errors of training data.

use sixfold_data::PosedImageError;
use sixfold_synth::augment::AugmentError;
use thiserror::Error;

/// Why samples cannot be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SampleError {
    /// An option is out of its range.
    #[error("sample option {field}: found {found}, expected {expected}")]
    Option {
        /// Name of the option.
        field: &'static str,
        /// Its value.
        found: String,
        /// The values allowed.
        expected: &'static str,
    },
    /// Error in the options of the augmentation, or in backgrounds.
    #[error(transparent)]
    Augment(#[from] AugmentError),
    /// An image does not show enough of its object.
    #[error(transparent)]
    Image(#[from] PosedImageError),
    /// No object was given.
    #[error("no training object was given; give at least one mesh with its description")]
    NoObjects,
    /// A mesh cannot be rendered.
    #[error(
        "object {id}: its mesh has {vertices} vertices and no faces; training needs a surface, not a point cloud"
    )]
    NoFaces {
        /// The object.
        id: u32,
        /// Its vertices.
        vertices: usize,
    },
    /// The size of a mesh, or its scale, is zero or not finite.
    #[error("object {id}, {field}: found {found}, expected finite numbers above zero (metres)")]
    Extent {
        /// The object.
        id: u32,
        /// Name of the field.
        field: &'static str,
        /// Its value.
        found: String,
    },
    /// There is no image of an object.
    #[error(
        "object {id}: no photograph shows it and its mesh has neither colours nor texture; give posed images, a \
         coloured mesh, or set random_color_probability above zero to train on random colours"
    )]
    NoPictures {
        /// The object.
        id: u32,
    },
    /// An image shows an object that is not trained.
    #[error(
        "a photograph shows object {id}, which is not among the training objects ({known}); give its mesh as well"
    )]
    UnknownObject {
        /// The object.
        id: u32,
        /// The objects of the training.
        known: String,
    },
}
