//! What can be wrong with training data.

use sixfold_data::PosedImageError;
use sixfold_synth::augment::AugmentError;
use thiserror::Error;

/// Why no samples can be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SampleError {
    /// An option is out of its range.
    #[error("sample option {field}: found {found}, expected {expected}")]
    Option {
        /// Name of the option.
        field: &'static str,
        /// What it held.
        found: String,
        /// What it should hold.
        expected: &'static str,
    },
    /// Options of the augmentation, or backgrounds.
    #[error(transparent)]
    Augment(#[from] AugmentError),
    /// An image does not show enough of its object.
    #[error(transparent)]
    Image(#[from] PosedImageError),
    /// There is nothing to learn.
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
    /// A mesh is flat to a point, or its scale is.
    #[error("object {id}, {field}: found {found}, expected finite numbers above zero (metres)")]
    Extent {
        /// The object.
        id: u32,
        /// Which field.
        field: &'static str,
        /// What it held.
        found: String,
    },
    /// No image can be had of an object.
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
        /// Those that are known.
        known: String,
    },
}
