//! Single image files outside datasets: read into checked types, written atomically.

use std::path::Path;

use sixfold_geometry::{DepthImage, Mask, RgbImage};

use crate::error::ImageFileError;
use crate::image_files::{ImageFile, png_of_depth, png_of_mask, png_of_rgb, write_png};

/// Reads a colour image (PNG or JPEG; grey becomes colour, alpha is dropped).
///
/// # Errors
/// [`ImageFileError`] naming the file.
pub fn read_rgb(path: &Path) -> Result<RgbImage, ImageFileError> {
    ImageFile::new(path).rgb()
}

/// Reads a depth image (PNG, one channel of 16 bits) into metres.
///
/// # Errors
/// [`ImageFileError`] naming the file.
pub fn read_depth(path: &Path, metres_per_unit: f64) -> Result<DepthImage, ImageFileError> {
    ImageFile::new(path).depth(metres_per_unit)
}

/// Reads a mask: every pixel that is not zero belongs to it ([`ImageFile::mask`]).
///
/// # Errors
/// [`ImageFileError`] naming the file.
pub fn read_mask(path: &Path) -> Result<Mask, ImageFileError> {
    ImageFile::new(path).mask()
}

fn write(path: &Path, image: Option<image::DynamicImage>) -> Result<(), ImageFileError> {
    let image = image.ok_or_else(|| ImageFileError::Write {
        path: path.to_owned(),
        source: std::io::Error::other("the image is too large for a PNG"),
    })?;
    write_png(path, image)
}

/// Writes a colour image as PNG.
///
/// # Errors
/// [`ImageFileError`] naming the file.
pub fn write_rgb(path: &Path, image: &RgbImage) -> Result<(), ImageFileError> {
    write(path, png_of_rgb(image))
}

/// Writes depth in metres as a 16-bit PNG; values that do not fit are stored as missing.
///
/// # Errors
/// [`ImageFileError`] naming the file.
pub fn write_depth(path: &Path, depth: &DepthImage, metres_per_unit: f64) -> Result<(), ImageFileError> {
    write(path, png_of_depth(depth, metres_per_unit))
}

/// Writes a mask as PNG, 255 inside.
///
/// # Errors
/// [`ImageFileError`] naming the file.
pub fn write_mask(path: &Path, mask: &Mask) -> Result<(), ImageFileError> {
    write(path, png_of_mask(mask, None))
}

/// Reads a mask with the part of it where it is unknown whether the object is there:
/// [`ImageFile::mask_and_hidden`].
///
/// # Errors
/// [`ImageFileError`] naming the file.
pub fn read_mask_and_hidden(path: &Path) -> Result<(Mask, Option<Mask>), ImageFileError> {
    ImageFile::new(path).mask_and_hidden()
}

/// Writes a mask as PNG: 255 inside, 0 outside, 128 where the mask is inside and hidden.
///
/// # Errors
/// [`ImageFileError`] naming the file.
pub fn write_mask_and_hidden(path: &Path, mask: &Mask, hidden: Option<&Mask>) -> Result<(), ImageFileError> {
    write(path, png_of_mask(mask, hidden))
}
