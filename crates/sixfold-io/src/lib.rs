//! Files outside datasets: colour, depth and mask images, camera files, and atomic writes.
//!
//! Images are decoded without trusting their headers; depth is returned in metres. Crates above this one handle
//! datasets.

#![warn(unreachable_pub, unnameable_types)]

mod camera_file;
mod error;
mod files;
mod hash;
mod image_files;
mod images;
mod limit;
mod lock;
mod mask_pixels;
mod regular;

pub use camera_file::{CameraFile, CameraFileError};
pub use error::ImageFileError;
pub use files::{make_folder_of, sync_folder_of, write_atomically, write_atomically_with};
pub use hash::{Fnv1a, fnv1a, fnv1a_of_file};
pub use image_files::ImageFile;
pub use images::{
    read_depth, read_mask, read_mask_and_hidden, read_rgb, write_depth, write_mask, write_mask_and_hidden,
    write_rgb,
};
pub use limit::{DEFAULT_MAX_PIXELS, check_pixels, max_pixels, set_max_pixels};
pub use lock::{LockError, WriteLock};
pub use regular::{limits, open_regular, read_regular, read_regular_text};
