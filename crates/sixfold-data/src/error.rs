//! Errors of posed images and training sets.

use std::path::PathBuf;

use sixfold_bop::DatasetError;
use sixfold_geometry::{CameraError, FrameId};
use sixfold_io::{CameraFileError, ImageFileError};
use sixfold_mesh::MeshFileError;
use sixfold_synth::augment::AugmentError;
use thiserror::Error;

/// An error of one posed image.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PosedImageError {
    /// The camera cannot be used.
    #[error("photograph {name}: {source}")]
    Camera {
        /// The image.
        name: String,
        /// What is wrong.
        source: CameraError,
    },
    /// Image, mask and camera are not of one size.
    #[error(
        "photograph {name}: the {what} is {width}x{height}, the camera is for \
         {camera_width}x{camera_height}; give the camera of this image"
    )]
    Size {
        /// The image.
        name: String,
        /// "image" or "mask".
        what: &'static str,
        /// Its columns.
        width: usize,
        /// Its rows.
        height: usize,
        /// The camera's columns.
        camera_width: usize,
        /// The camera's rows.
        camera_height: usize,
    },
    /// The pose puts the object behind the camera or outside the image.
    #[error(
        "photograph {name}: its pose puts the object outside the image (translation {translation:.3?} m); poses are object to camera, in metres here and in millimetres in BOP files"
    )]
    OutsideImage {
        /// The image.
        name: String,
        /// Translation of the pose, metres.
        translation: [f64; 3],
    },
    /// Too little of the object is visible to learn from.
    #[error(
        "photograph {name}: its mask holds {pixels} pixels of the object, expected at least {minimum}; \
         leave this image out or check its pose"
    )]
    NotVisible {
        /// The image.
        name: String,
        /// Visible pixels.
        pixels: usize,
        /// The minimum number.
        minimum: usize,
    },
    /// It is unknown where the object is visible.
    #[error("photograph {name}: no mask of the visible part of the object; give one")]
    NoMask {
        /// The image.
        name: String,
    },
}

/// Why there is nothing to learn from.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TrainingSetError {
    /// The dataset cannot be read.
    #[error(transparent)]
    Dataset(Box<DatasetError>),
    /// An image of the dataset cannot be used.
    #[error(transparent)]
    Image(#[from] PosedImageError),
    /// A mesh cannot be read.
    #[error(transparent)]
    Mesh(#[from] MeshFileError),
    /// An image file cannot be read.
    #[error(transparent)]
    ImageFile(#[from] ImageFileError),
    /// A camera file cannot be read, or does not belong to the image.
    #[error(transparent)]
    CameraFile(#[from] CameraFileError),
    /// An image does not belong to its camera.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The detector cannot search an image.
    #[error("detector: {0}")]
    Detector(Box<dyn std::error::Error + Send + Sync>),
    /// A file that lists photographs is invalid.
    #[error("{}: {reason}", path.display())]
    Photographs {
        /// The file.
        path: PathBuf,
        /// Field, found and expected.
        reason: String,
    },
    /// A frame of the dataset has no colour image.
    #[error("scene {}, image {}: there is no colour image; leave this frame out", frame.scene_id, frame.im_id)]
    NoColorImage {
        /// The frame.
        frame: FrameId,
    },
    /// The backgrounds cannot be read.
    #[error(transparent)]
    Backgrounds(#[from] AugmentError),
    /// The dataset does not list its objects.
    #[error("{}: no objects: its models have no models_info.json; name their ids", root.display())]
    NoObjects {
        /// The dataset.
        root: PathBuf,
    },
    /// An object is named twice, so a model would contain it twice.
    #[error("ids: object {id} is named more than once; name every object once")]
    NamedTwice {
        /// The object.
        id: u32,
    },
    /// There is no colour image.
    #[error("{}: split {split} has no colour images to learn from", root.display())]
    NoImages {
        /// The dataset.
        root: PathBuf,
        /// Its split.
        split: String,
    },
    /// No frame shows enough of an object.
    #[error(
        "{}: none of the {frames} frames shows an object at least {percent:.0} % visible; choose other frames",
        root.display()
    )]
    NothingVisible {
        /// The dataset.
        root: PathBuf,
        /// How many there are.
        frames: usize,
        /// The minimum visible part.
        percent: f64,
    },
}

impl From<DatasetError> for TrainingSetError {
    fn from(error: DatasetError) -> Self {
        TrainingSetError::Dataset(Box::new(error))
    }
}
