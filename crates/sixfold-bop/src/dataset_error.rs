//! Errors of datasets on disk: every message names the file, the place in it, the values expected and found, and
//! what to do.

use std::path::PathBuf;

use sixfold_io::ImageFileError;
use thiserror::Error;

/// A place in a scene file: the image, then the index in that image's list.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Place {
    /// The image.
    pub im_id: Option<u32>,
    /// Index of the entry, from zero.
    pub index: Option<usize>,
}

impl std::fmt::Display for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if let Some(im_id) = self.im_id {
            write!(f, "im_id {im_id}, ")?;
        }
        if let Some(index) = self.index {
            write!(f, "entry {index}, ")?;
        }
        Ok(())
    }
}

/// Why a dataset cannot be read or written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// A required file or folder is missing.
    #[error("{}: {what} is missing; {advice}", path.display())]
    Missing {
        /// The expected path.
        path: PathBuf,
        /// Its description.
        what: &'static str,
        /// Advice.
        advice: &'static str,
    },
    /// The system could not read a file or folder.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The system could not write a file.
    #[error("{}: cannot be written: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file is not JSON.
    #[error(
        "{}: not valid JSON: {source}; the file may be cut off, and NaN or Infinity are not allowed",
        path.display()
    )]
    Json {
        /// The file.
        path: PathBuf,
        /// What and where.
        source: serde_json::Error,
    },
    /// A field holds an invalid value.
    #[error("{}: {place}field {field}: found {found}, expected {expected}", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// Image and entry.
        place: Place,
        /// Name of the field.
        field: String,
        /// Its value.
        found: String,
        /// The expected value.
        expected: String,
    },
    /// An image file cannot be decoded.
    #[error("{}: im_id {im_id}: not a readable image: {reason}; get the file again or remove it", path.display())]
    Image {
        /// The file.
        path: PathBuf,
        /// The image.
        im_id: u32,
        /// What is wrong.
        reason: String,
    },
    /// It is not clear which pixels of an image file belong to the mask.
    #[error("{}: im_id {im_id}: mask: {reason}", path.display())]
    Mask {
        /// The file.
        path: PathBuf,
        /// The image.
        im_id: u32,
        /// What was found and expected, and what to do.
        reason: String,
    },
    /// An image has another size than the camera.
    #[error(
        "{}: im_id {im_id}: the image is {}x{}, expected {}x{} from {size_from}; the intrinsics belong to \
         another resolution: give the camera file of these images or resize them",
        path.display(), found.0, found.1, expected.0, expected.1
    )]
    ImageSize {
        /// The file.
        path: PathBuf,
        /// The image.
        im_id: u32,
        /// Width and height expected.
        expected: (usize, usize),
        /// Width and height found.
        found: (usize, usize),
        /// The file that states the expected size.
        size_from: String,
    },
    /// The requested scene does not exist.
    #[error("{}: scene {scene_id} is not there; the split has scenes {known}", path.display())]
    NoScene {
        /// Folder of the split.
        path: PathBuf,
        /// The requested scene.
        scene_id: u32,
        /// The existing scenes.
        known: String,
    },
    /// The scene does not have the requested image.
    #[error("{}: im_id {im_id} is not there; was the right split given?", path.display())]
    NoImage {
        /// The file that should have it.
        path: PathBuf,
        /// The requested image.
        im_id: u32,
    },
    /// The size of the images is stated nowhere.
    #[error(
        "{}: im_id {im_id}: the image size is unknown; camera.json has no width and height and there is no rgb, \
         gray or depth image",
        path.display()
    )]
    UnknownSize {
        /// Folder of the scene.
        path: PathBuf,
        /// The image.
        im_id: u32,
    },
    /// An object has no model file.
    #[error("{}: no model of object {obj_id}; expected obj_{obj_id:06}.ply there", path.display())]
    NoModel {
        /// Folder of the models.
        path: PathBuf,
        /// The object.
        obj_id: u32,
    },
    /// The receiver of the progress reports asked to stop.
    #[error("stopped")]
    Stopped,
    /// A model or `models_info.json` is broken.
    #[error(transparent)]
    Model(Box<dyn std::error::Error + Send + Sync>),
}

impl DatasetError {
    /// What is wrong with a file of image `im_id`.
    pub(crate) fn of_image(im_id: u32, error: ImageFileError) -> Self {
        match error {
            ImageFileError::Read { path, source } => DatasetError::Read { path, source },
            ImageFileError::Write { path, source } => DatasetError::Write { path, source },
            ImageFileError::Content { path, reason } => DatasetError::Image { path, im_id, reason },
            ImageFileError::Mask { path, reason } => DatasetError::Mask { path, im_id, reason },
            ImageFileError::Size { path, expected, found, size_from } => {
                DatasetError::ImageSize { path, im_id, expected, found, size_from }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_images_name_file_and_image() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("000007.png");
        std::fs::write(&path, b"not an image").unwrap();
        let error = sixfold_io::read_rgb(&path).unwrap_err();
        let message = DatasetError::of_image(7, error).to_string();
        assert!(
            message.contains("000007.png: im_id 7: not a readable image: neither PNG nor JPEG"),
            "{message}"
        );
    }
}
