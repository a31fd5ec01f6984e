//! Depth, masks and colour of image files, decoded without trusting their headers.

use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use sixfold_geometry::{DepthImage, Image, Mask, RgbImage};

use crate::error::ImageFileError;
use crate::files::write_atomically;

/// Neither PNG nor JPEG packs more than about this many bytes of pixels into one byte of file.
const LARGEST_EXPANSION: u64 = 2048;
const LARGEST_SIDE: u32 = 1 << 15;

/// An image file (PNG or JPEG) that is still to be read.
#[derive(Debug, Clone)]
pub struct ImageFile<'a> {
    path: &'a Path,
    /// Size the image must have and what says so.
    expected: Option<((usize, usize), String)>,
}

impl<'a> ImageFile<'a> {
    /// A file of any size.
    pub fn new(path: &'a Path) -> Self {
        ImageFile { path, expected: None }
    }

    /// A file that must be of this width and height; `size_from` is for the message: who says so.
    pub fn of_size(path: &'a Path, expected: (usize, usize), size_from: impl Into<String>) -> Self {
        ImageFile { path, expected: Some((expected, size_from.into())) }
    }

    fn error(&self, reason: impl Into<String>) -> ImageFileError {
        ImageFileError::Content { path: self.path.to_owned(), reason: reason.into() }
    }

    fn bytes(&self) -> Result<Vec<u8>, ImageFileError> {
        crate::read_regular(self.path, crate::limits::IMAGE)
            .map_err(|source| ImageFileError::Read { path: self.path.to_owned(), source })
    }

    fn decode(&self) -> Result<DynamicImage, ImageFileError> {
        let bytes = self.bytes()?;
        let format = image::guess_format(&bytes).map_err(|_| self.error("neither PNG nor JPEG"))?;
        if !matches!(format, ImageFormat::Png | ImageFormat::Jpeg) {
            return Err(self.error(format!("{format:?} is not supported, expected PNG or JPEG")));
        }
        let mut reader = ImageReader::with_format(Cursor::new(&bytes), format);
        let mut limits = Limits::default();
        limits.max_image_width = Some(LARGEST_SIDE);
        limits.max_image_height = Some(LARGEST_SIDE);
        reader.limits(limits);
        let decoder = reader.into_decoder().map_err(|e| self.error(e.to_string()))?;
        let (width, height) = decoder.dimensions();
        if let Some((expected, size_from)) = &self.expected
            && *expected != (width as usize, height as usize)
        {
            return Err(ImageFileError::Size {
                path: self.path.to_owned(),
                expected: *expected,
                found: (width as usize, height as usize),
                size_from: size_from.clone(),
            });
        }
        let length = bytes.len() as u64;
        if decoder.total_bytes() > length.saturating_mul(LARGEST_EXPANSION) {
            return Err(self.error(format!(
                "the header says {width}x{height}, far more than a file of {length} bytes can hold: cut off"
            )));
        }
        DynamicImage::from_decoder(decoder).map_err(|e| self.error(format!("{e} (cut off or damaged)")))
    }

    /// Depth in metres, of one channel of 16 bits; zero where nothing was measured.
    ///
    /// # Errors
    /// [`ImageFileError`] naming the file.
    pub fn depth(&self, metres_per_unit: f64) -> Result<DepthImage, ImageFileError> {
        let DynamicImage::ImageLuma16(pixels) = self.decode()? else {
            return Err(self.error("a depth image has one channel of 16 bits; this is an image of depth"));
        };
        let (width, height) = (pixels.width() as usize, pixels.height() as usize);
        let data = pixels.as_raw().iter().map(|&v| (f64::from(v) * metres_per_unit) as f32).collect();
        Image::from_vec(width, height, data).map_err(|e| self.error(e.to_string()))
    }

    /// A mask: every pixel above zero belongs to it.
    ///
    /// # Errors
    /// [`ImageFileError`] naming the file.
    pub fn mask(&self) -> Result<Mask, ImageFileError> {
        let pixels = self.decode()?.into_luma8();
        let (width, height) = (pixels.width() as usize, pixels.height() as usize);
        let data = pixels.as_raw().iter().map(|&v| v > 0).collect();
        Image::from_vec(width, height, data).map_err(|e| self.error(e.to_string()))
    }

    /// A colour image; grey becomes colour, alpha is dropped.
    ///
    /// # Errors
    /// [`ImageFileError`] naming the file.
    pub fn rgb(&self) -> Result<RgbImage, ImageFileError> {
        let pixels = match self.decode()? {
            // Sixteen bits of grey (some industrial cameras) keep their upper eight.
            DynamicImage::ImageLuma16(p) => DynamicImage::ImageLuma16(p).into_rgb8(),
            other => other.into_rgb8(),
        };
        let (width, height) = (pixels.width() as usize, pixels.height() as usize);
        let data = pixels.as_raw().as_chunks::<3>().0.to_vec();
        Image::from_vec(width, height, data).map_err(|e| self.error(e.to_string()))
    }

    /// Width and height from the header alone.
    ///
    /// # Errors
    /// [`ImageFileError`] naming the file.
    pub fn size(&self) -> Result<(usize, usize), ImageFileError> {
        let read = |source| ImageFileError::Read { path: self.path.to_owned(), source };
        let reader = ImageReader::open(self.path).map_err(read)?.with_guessed_format().map_err(read)?;
        let (width, height) = reader.into_dimensions().map_err(|e| self.error(e.to_string()))?;
        Ok((width as usize, height as usize))
    }
}

pub(crate) fn write_png(path: &Path, image: DynamicImage) -> Result<(), ImageFileError> {
    let mut bytes = Cursor::new(Vec::new());
    let written = image.write_to(&mut bytes, ImageFormat::Png).map_err(std::io::Error::other);
    written
        .and_then(|()| write_atomically(path, bytes.get_ref()))
        .map_err(|source| ImageFileError::Write { path: path.to_owned(), source })
}

pub(crate) fn png_of_rgb(image: &RgbImage) -> Option<DynamicImage> {
    let data: Vec<u8> = image.as_slice().iter().flatten().copied().collect();
    image::RgbImage::from_raw(image.width() as u32, image.height() as u32, data).map(DynamicImage::from)
}

pub(crate) fn png_of_mask(mask: &Mask) -> Option<DynamicImage> {
    let data: Vec<u8> = mask.as_slice().iter().map(|&m| if m { 255 } else { 0 }).collect();
    image::GrayImage::from_raw(mask.width() as u32, mask.height() as u32, data).map(DynamicImage::from)
}

/// Depth to 16 bit; what is missing or does not fit becomes 0, as a sensor would say "nothing measured".
pub(crate) fn png_of_depth(depth: &DepthImage, metres_per_unit: f64) -> Option<DynamicImage> {
    let unit = |z: f32| {
        let value = (f64::from(z) / metres_per_unit).round();
        if value.is_finite() && value > 0.0 && value <= f64::from(u16::MAX) { value as u16 } else { 0 }
    };
    let data: Vec<u16> = depth.as_slice().iter().map(|&z| unit(z)).collect();
    image::ImageBuffer::<image::Luma<u16>, _>::from_raw(depth.width() as u32, depth.height() as u32, data)
        .map(DynamicImage::from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn file(path: &Path) -> ImageFile<'_> {
        ImageFile::new(path)
    }

    fn depth_png() -> Vec<u8> {
        let depth = Image::from_fn(20, 10, |x, y| 0.001 * (100 * y + x) as f32);
        let mut bytes = Cursor::new(Vec::new());
        png_of_depth(&depth, 1e-3).unwrap().write_to(&mut bytes, ImageFormat::Png).unwrap();
        bytes.into_inner()
    }

    #[test]
    fn depth_comes_back_in_metres() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("000007.png");
        std::fs::write(&path, depth_png()).unwrap();
        let depth = file(&path).depth(1e-4).unwrap();
        assert_eq!(depth.size(), (20, 10));
        assert!((depth[(3, 2)] - 0.0203).abs() < 1e-7);
        assert_eq!(file(&path).size().unwrap(), (20, 10));
    }

    #[test]
    fn truncated_lying_and_foreign_files_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("000007.png");
        let png = depth_png();
        std::fs::write(&path, &png[..png.len() / 2]).unwrap();
        let message = file(&path).depth(1e-3).unwrap_err().to_string();
        assert!(message.contains("000007.png") && message.contains("not a readable image"), "{message}");

        // A header of 30000 x 30000 (with its own right checksum) before the same few bytes.
        let mut lying = png.clone();
        lying[16..20].copy_from_slice(&30000u32.to_be_bytes());
        lying[20..24].copy_from_slice(&30000u32.to_be_bytes());
        let crc = crc32(&lying[12..29]);
        lying[29..33].copy_from_slice(&crc.to_be_bytes());
        std::fs::write(&path, &lying).unwrap();
        let message = file(&path).depth(1e-3).unwrap_err().to_string();
        assert!(message.contains("30000x30000"), "{message}");

        std::fs::write(&path, b"not an image").unwrap();
        assert!(file(&path).rgb().unwrap_err().to_string().contains("neither PNG nor JPEG"));
        let message = file(&dir.path().join("gone.png")).rgb().unwrap_err().to_string();
        assert!(message.contains("gone.png"), "{message}");

        let grey = DynamicImage::from(image::GrayImage::new(20, 10));
        write_png(&path, grey).unwrap();
        assert!(file(&path).depth(1e-3).unwrap_err().to_string().contains("16 bits"));
        let sized = ImageFile::of_size(&path, (640, 480), "camera.json");
        let message = sized.rgb().unwrap_err().to_string();
        assert!(message.contains("20x10") && message.contains("640x480"), "{message}");
    }

    fn crc32(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(!0u32, |crc, &b| {
            (0..8).fold(crc ^ u32::from(b), |c, _| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 })
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn mutated_images_never_panic(at in 0usize..200, byte: u8, cut in 0usize..300) {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("x.png");
            let mut png = depth_png();
            let at = at % png.len();
            png[at] = byte;
            png.truncate(cut.max(1));
            std::fs::write(&path, &png).unwrap();
            let _ = file(&path).depth(1e-3);
            let _ = file(&path).rgb();
            let _ = file(&path).mask();
            let _ = file(&path).size();
        }
    }
}
