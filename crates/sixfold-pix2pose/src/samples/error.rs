//! What can be wrong with training data.

use sixfold_bop::DatasetError;
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
    /// The dataset cannot be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// There is nothing to learn.
    #[error("no training object was given; give at least one mesh with its description")]
    NoObjects,
    /// A mesh cannot be drawn.
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
    /// No picture can be had of an object.
    #[error(
        "object {id}: no photograph shows it and its mesh has neither colours nor texture; give posed photographs, a \
         coloured mesh, or set random_color_chance above zero to train on random colours"
    )]
    NoPictures {
        /// The object.
        id: u32,
    },
    /// A photograph does not fit its camera or mask.
    #[error(
        "object {id}: the {what} has {width}x{height} pixels, the camera is for {camera_width}x{camera_height}"
    )]
    Size {
        /// The object.
        id: u32,
        /// "photograph" or "visible mask".
        what: &'static str,
        /// Its width.
        width: usize,
        /// Its height.
        height: usize,
        /// The camera's width.
        camera_width: usize,
        /// The camera's height.
        camera_height: usize,
    },
    /// Nothing of the object is seen in a photograph.
    #[error(
        "object {id}: its visible mask holds {pixels} pixels, expected at least {least}; leave this photograph out or \
         check its pose"
    )]
    NotVisible {
        /// The object.
        id: u32,
        /// Visible pixels.
        pixels: usize,
        /// How many there should be.
        least: usize,
    },
    /// The pose puts the object behind the camera or outside the image.
    #[error(
        "object {id}: its pose puts it at {translation:?} metres, outside the photograph; check pose, unit and camera"
    )]
    OutsideImage {
        /// The object.
        id: u32,
        /// Translation of the pose.
        translation: [f64; 3],
    },
    /// A photograph shows an object that is not trained.
    #[error(
        "a photograph shows object {id}, which is not among the training objects ({known}); give its mesh as well"
    )]
    UnknownObject {
        /// The object.
        id: u32,
        /// Those that are known.
        known: String,
    },
    /// A frame of the dataset has no colour image.
    #[error("scene {scene_id}, image {im_id}: there is no colour image; leave this frame out")]
    NoColorImage {
        /// The scene.
        scene_id: u32,
        /// The image.
        im_id: u32,
    },
    /// The camera is not usable.
    #[error("object {id}: {source}")]
    Camera {
        /// The object.
        id: u32,
        /// What is wrong.
        source: sixfold_geometry::CameraError,
    },
}
