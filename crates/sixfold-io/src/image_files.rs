//! Depth, masks and colour from image files. Images are decoded only here, without trusting their headers.
//!
//! The size is read first and checked against the limit in pixels; only then are the pixels decoded. Other data in the file (text,
//! colour profiles) may take [`BESIDE_PIXELS`] in all, which also limits its decompressed size.

use std::borrow::Cow;
use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use sixfold_geometry::{DepthImage, Image, Mask, RgbImage};

use crate::error::ImageFileError;
use crate::files::write_atomically;
use crate::limit::{check_pixels, max_pixels};
use crate::mask_pixels;

/// Neither PNG nor JPEG stores more bytes of pixels than this in one byte of the file. PNG's deflate packs 1032 bytes of equal
/// values into one (zlib, "Maximum Compression Factor"), and a bit of a palette becomes up to four bytes.
const LARGEST_EXPANSION: u64 = 1032 * 32;
const LARGEST_SIDE: u32 = 1 << 15;
/// Maximum bytes of data other than pixels: colour profiles take up to 4 MB.
const BESIDE_PIXELS: u64 = 32 << 20;
/// Maximum bytes of a decoded pixel: four channels of 16 bits. A file with more bytes per pixel is not accepted as an image.
const BYTES_A_PIXEL: u64 = 8;

/// Diagonal of 35 mm film (36 x 24 mm), millimetres.
const FILM_DIAGONAL: f64 = 43.266_615_305_567_87;

/// An image (PNG or JPEG) to be read: a file, or the bytes of one.
#[derive(Debug, Clone)]
pub struct ImageFile<'a> {
    path: &'a Path,
    /// Its bytes, if they are in memory already.
    bytes: Option<&'a [u8]>,
    /// The required size of the image and the source of the requirement.
    expected: Option<((usize, usize), String)>,
    limit: u64,
}

impl<'a> ImageFile<'a> {
    /// A file of any size up to [`max_pixels`].
    pub fn new(path: &'a Path) -> Self {
        ImageFile { path, bytes: None, expected: None, limit: max_pixels() }
    }

    /// A file that must have this width and height; `size_from` names the source of the requirement in messages.
    pub fn of_size(path: &'a Path, expected: (usize, usize), size_from: impl Into<String>) -> Self {
        ImageFile { expected: Some((expected, size_from.into())), ..ImageFile::new(path) }
    }

    /// The bytes of a file, for example embedded in another one; `name` is for messages.
    pub fn of_bytes(name: &'a Path, bytes: &'a [u8]) -> Self {
        ImageFile { bytes: Some(bytes), ..ImageFile::new(name) }
    }

    /// The same with its own limit in pixels instead of [`max_pixels`].
    pub fn with_limit(self, pixels: u64) -> Self {
        ImageFile { limit: pixels, ..self }
    }

    fn error(&self, reason: impl Into<String>) -> ImageFileError {
        ImageFileError::Content { path: self.path.to_owned(), reason: reason.into() }
    }

    fn bytes(&self) -> Result<Cow<'a, [u8]>, ImageFileError> {
        if let Some(bytes) = self.bytes {
            return Ok(bytes.into());
        }
        let most = self.limit.saturating_mul(BYTES_A_PIXEL).saturating_add(BESIDE_PIXELS);
        match crate::read_regular(self.path, most) {
            Ok(bytes) => Ok(bytes.into()),
            Err(error) if error.kind() == std::io::ErrorKind::FileTooLarge => Err(self.error(format!(
                "found more than {} MB, expected an image of at most {:.1} megapixels (--max-pixels, set_max_pixels)",
                most / 1_000_000,
                self.limit as f64 / 1e6
            ))),
            Err(source) => Err(ImageFileError::Read { path: self.path.to_owned(), source }),
        }
    }

    /// The decoder of these bytes after reading the header, if the size is as expected and within the limit; and the format.
    fn decoder<'b>(
        &self,
        bytes: &'b [u8],
    ) -> Result<(impl ImageDecoder + use<'b>, ImageFormat), ImageFileError> {
        let format = image::guess_format(bytes).map_err(|_| {
            self.error(if is_heif(bytes) {
                "a HEIF (HEIC) file, expected PNG or JPEG: export it as JPEG, or let the phone take JPEG (\"most compatible\")"
            } else {
                "neither PNG nor JPEG"
            })
        })?;
        if !matches!(format, ImageFormat::Png | ImageFormat::Jpeg) {
            return Err(self.error(format!("{format:?} is not supported, expected PNG or JPEG")));
        }
        let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
        let mut limits = Limits::default();
        limits.max_image_width = Some(LARGEST_SIDE);
        limits.max_image_height = Some(LARGEST_SIDE);
        limits.max_alloc = Some(BESIDE_PIXELS);
        reader.limits(limits);
        let decoder = reader.into_decoder().map_err(|e| self.error(e.to_string()))?;
        let (width, height) = decoder.dimensions();
        let size = (width as usize, height as usize);
        if let Some((expected, size_from)) = &self.expected
            && *expected != size
        {
            return Err(ImageFileError::Size {
                path: self.path.to_owned(),
                expected: *expected,
                found: size,
                size_from: size_from.clone(),
            });
        }
        check_pixels(size.0, size.1, self.limit).map_err(|reason| self.error(reason))?;
        let length = bytes.len() as u64;
        if decoder.total_bytes() > length.saturating_mul(LARGEST_EXPANSION) {
            return Err(self.error(format!(
                "the header says {width}x{height}, far more than a file of {length} bytes can hold: cut off"
            )));
        }
        Ok((decoder, format))
    }

    fn decode(&self) -> Result<(DynamicImage, ImageFormat), ImageFileError> {
        let bytes = self.bytes()?;
        let (decoder, format) = self.decoder(&bytes)?;
        let image = DynamicImage::from_decoder(decoder)
            .map_err(|e| self.error(format!("{e} (cut off or damaged)")))?;
        Ok((image, format))
    }

    fn image<T>(&self, width: u32, height: u32, data: Vec<T>) -> Result<Image<T>, ImageFileError> {
        Image::from_vec(width as usize, height as usize, data).map_err(|e| self.error(e.to_string()))
    }

    /// The values of one channel of 16 bits.
    ///
    /// # Errors
    /// [`ImageFileError`] naming the file.
    pub fn units(&self) -> Result<Image<u16>, ImageFileError> {
        let DynamicImage::ImageLuma16(pixels) = self.decode()?.0 else {
            return Err(self.error("a depth image has one channel of 16 bits; this is an image of depth"));
        };
        self.image(pixels.width(), pixels.height(), pixels.into_raw())
    }

    /// Depth in metres, from one channel of 16 bits; zero where nothing was measured.
    ///
    /// # Errors
    /// [`ImageFileError`] naming the file.
    pub fn depth(&self, metres_per_unit: f64) -> Result<DepthImage, ImageFileError> {
        Ok(self.units()?.map(|&v| (f64::from(v) * metres_per_unit) as f32))
    }

    /// A mask: every pixel that is not zero. Grey of 1, 2, 4, 8 or 16 bits, a palette, or RGB with one colour besides black. An
    /// alpha channel that is not opaque everywhere is the mask itself.
    ///
    /// # Errors
    /// [`ImageFileError`] naming the file: also for a JPEG, whose zeros are not exact, for several colours, and if alpha and colour
    /// contradict each other.
    pub fn mask(&self) -> Result<Mask, ImageFileError> {
        Ok(self.mask_and_hidden()?.0)
    }

    /// A mask as [`ImageFile::mask`] reads it, and the part of it where it is unknown whether the object is there, because
    /// something may occlude it: the value 128 in grey images of 8 bits; `None` if there is no such pixel.
    ///
    /// # Errors
    /// As [`ImageFile::mask`].
    pub fn mask_and_hidden(&self) -> Result<(Mask, Option<Mask>), ImageFileError> {
        let (image, format) = self.decode()?;
        if format == ImageFormat::Jpeg {
            return Err(ImageFileError::Mask {
                path: self.path.to_owned(),
                reason: "found a JPEG, whose zeros are not exact; write the mask as PNG".to_owned(),
            });
        }
        let data = mask_pixels::inside(&image)
            .map_err(|reason| ImageFileError::Mask { path: self.path.to_owned(), reason })?;
        let hidden = mask_pixels::hidden(&image);
        let hidden = hidden.map(|hidden| self.image(image.width(), image.height(), hidden)).transpose()?;
        Ok((self.image(image.width(), image.height(), data)?, hidden))
    }

    /// A colour image; grey is converted to colour, alpha is dropped, and of 16 bits the upper eight are kept.
    ///
    /// # Errors
    /// [`ImageFileError`] naming the file.
    pub fn rgb(&self) -> Result<RgbImage, ImageFileError> {
        let pixels = self.decode()?.0.into_rgb8();
        self.image(pixels.width(), pixels.height(), pixels.as_raw().as_chunks::<3>().0.to_vec())
    }

    /// The focal length in the file's EXIF data (`FocalLengthIn35mmFilm`, related to the diagonal of 43.27 mm of that film: CIPA
    /// DC-008), in pixels; `None` if there is none, or none that a camera can have. It is wrong for an image that was cropped or
    /// resized afterwards.
    ///
    /// # Errors
    /// [`ImageFileError`] naming the file, for a file that is not an image. Invalid EXIF data count as none.
    pub fn focal_length(&self) -> Result<Option<f64>, ImageFileError> {
        let bytes = self.bytes()?;
        let mut decoder = self.decoder(&bytes)?.0;
        let (width, height) = decoder.dimensions();
        let Ok(Some(raw)) = decoder.exif_metadata() else { return Ok(None) };
        let Ok(exif) = exif::Reader::new().read_raw(raw) else { return Ok(None) };
        let field = exif.get_field(exif::Tag::FocalLengthIn35mmFilm, exif::In::PRIMARY);
        let millimetres = field.and_then(|field| field.value.get_uint(0)).map(f64::from);
        // From a fisheye to a telescope; 0 means "unknown".
        let possible = millimetres.filter(|f| (5.0..=2000.0).contains(f));
        Ok(possible.map(|f| f / FILM_DIAGONAL * f64::from(width).hypot(f64::from(height))))
    }

    /// Width and height from the header alone.
    ///
    /// # Errors
    /// [`ImageFileError`] naming the file.
    pub fn size(&self) -> Result<(usize, usize), ImageFileError> {
        let bytes = self.bytes()?;
        let (width, height) = self.decoder(&bytes)?.0.dimensions();
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

/// A PNG with 255 inside, 0 outside, and 128 where the mask is inside and hidden.
pub(crate) fn png_of_mask(mask: &Mask, hidden: Option<&Mask>) -> Option<DynamicImage> {
    let is_hidden = |i: usize| hidden.is_some_and(|h| h.as_slice().get(i).copied().unwrap_or(false));
    let value = |(i, m): (usize, &bool)| match m {
        true if is_hidden(i) => mask_pixels::HIDDEN,
        true => 255,
        false => 0,
    };
    let data: Vec<u8> = mask.as_slice().iter().enumerate().map(value).collect();
    image::GrayImage::from_raw(mask.width() as u32, mask.height() as u32, data).map(DynamicImage::from)
}

/// Depth as 16 bit; missing values and values that do not fit become 0, a sensor's value for "nothing measured".
pub(crate) fn png_of_depth(depth: &DepthImage, metres_per_unit: f64) -> Option<DynamicImage> {
    let unit = |z: f32| {
        let value = (f64::from(z) / metres_per_unit).round();
        if value.is_finite() && value > 0.0 && value <= f64::from(u16::MAX) { value as u16 } else { 0 }
    };
    let data: Vec<u16> = depth.as_slice().iter().map(|&z| unit(z)).collect();
    image::ImageBuffer::<image::Luma<u16>, _>::from_raw(depth.width() as u32, depth.height() as u32, data)
        .map(DynamicImage::from)
}

/// Whether a file is HEIF, which phones write by default (ISO/IEC 23008-12).
fn is_heif(bytes: &[u8]) -> bool {
    let brand = bytes.get(8..12).filter(|_| bytes.get(4..8) == Some(b"ftyp".as_slice()));
    brand.is_some_and(|brand| {
        [b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1"].iter().any(|b| *b == brand)
    })
}

#[cfg(test)]
mod tests {
    use std::fs::File;

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

    /// A JPEG of 40 x 30 pixels whose EXIF data name a focal length of that many millimetres on 35 mm film.
    fn jpeg_with_exif(millimetres: u16) -> Vec<u8> {
        let mut jpeg = Cursor::new(Vec::new());
        DynamicImage::new_rgb8(40, 30).write_to(&mut jpeg, ImageFormat::Jpeg).unwrap();
        let jpeg = jpeg.into_inner();
        let entry = |tag: u16, kind: u16, value: u32| {
            [&tag.to_le_bytes()[..], &kind.to_le_bytes(), &1u32.to_le_bytes(), &value.to_le_bytes()].concat()
        };
        let directory = |entry: Vec<u8>| [&1u16.to_le_bytes()[..], &entry, &0u32.to_le_bytes()].concat();
        let tiff = [
            b"II*\0\x08\0\0\0".to_vec(),
            // The EXIF directory follows this one.
            directory(entry(0x8769, 4, 26)),
            directory(entry(0xa405, 3, u32::from(millimetres))),
        ];
        let exif = [b"Exif\0\0".to_vec(), tiff.concat()].concat();
        let length = u16::try_from(exif.len() + 2).unwrap().to_be_bytes();
        [&jpeg[..2], b"\xff\xe1", &length, &exif, &jpeg[2..]].concat()
    }

    #[test]
    fn the_focal_length_of_exif_data_is_read_in_pixels() {
        let of =
            |bytes: &[u8]| ImageFile::of_bytes(Path::new("photograph.jpg"), bytes).focal_length().unwrap();
        // 26 mm on film of 43.27 mm are .601 of the image's diagonal of 50 pixels.
        let f = of(&jpeg_with_exif(26)).unwrap();
        assert!((f - 50.0 * 26.0 / 43.2666).abs() < 1e-3, "{f}");
        // Unknown, or outside the range of cameras.
        assert_eq!([0, 4, 2001].map(|f| of(&jpeg_with_exif(f))), [None; 3]);
        assert_eq!(of(&depth_png()), None);
        // Truncated data count as none.
        let whole = jpeg_with_exif(26);
        let mut broken = whole.clone();
        broken[40..50].fill(0xff);
        assert_eq!(of(&broken), None);
        let error = ImageFile::of_bytes(Path::new("notes.jpg"), b"no image").focal_length().unwrap_err();
        assert!(error.to_string().contains("notes.jpg"), "{error}");
    }

    #[test]
    fn errors_name_truncated_inconsistent_and_foreign_files() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("000007.png");
        let png = depth_png();
        std::fs::write(&path, &png[..png.len() / 2]).unwrap();
        let message = file(&path).depth(1e-3).unwrap_err().to_string();
        assert!(message.contains("000007.png") && message.contains("not a readable image"), "{message}");

        // A header of 30000 x 30000 (with its own right checksum) before the same few bytes.
        let mut wrong_size = png.clone();
        wrong_size[16..20].copy_from_slice(&30000u32.to_be_bytes());
        wrong_size[20..24].copy_from_slice(&30000u32.to_be_bytes());
        let crc = crc32(&wrong_size[12..29]);
        wrong_size[29..33].copy_from_slice(&crc.to_be_bytes());
        std::fs::write(&path, &wrong_size).unwrap();
        let message = file(&path).depth(1e-3).unwrap_err().to_string();
        assert!(message.contains("30000x30000"), "{message}");
        let unlimited = ImageFile::new(&path).with_limit(u64::MAX);
        let message = unlimited.depth(1e-3).unwrap_err().to_string();
        assert!(message.contains("30000x30000") && message.contains("cut off"), "{message}");

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

    /// 778 kB of zeros as PNG took 4.6 GB.
    #[test]
    fn an_image_bomb_is_refused_by_its_header() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("bomb.png");
        let file = std::io::BufWriter::new(File::create(&path).unwrap());
        let (width, height) = (20_000u32, 6_000u32);
        let mut encoder = png::Encoder::new(file, width, height);
        encoder.set_color(png::ColorType::Rgba);
        encoder.set_depth(png::BitDepth::Eight);
        let mut header = encoder.write_header().unwrap();
        let mut stream = header.stream_writer().unwrap();
        let row = vec![0; 4 * width as usize];
        (0..height).for_each(|_| std::io::Write::write_all(&mut stream, &row).unwrap());
        stream.finish().unwrap();
        header.finish().unwrap();
        for message in [
            ImageFile::new(&path).rgb().unwrap_err().to_string(),
            ImageFile::new(&path).mask().unwrap_err().to_string(),
            ImageFile::new(&path).size().unwrap_err().to_string(),
        ] {
            assert!(message.contains("bomb.png") && message.contains("120.0 megapixels"), "{message}");
            assert!(message.contains("at most 100.0") && message.contains("--max-pixels"), "{message}");
        }
        assert_eq!(ImageFile::new(&path).with_limit(120_000_000).size().unwrap(), (20_000, 6_000));
        // An endless file.
        #[cfg(target_os = "linux")]
        {
            let endless = ImageFile::new(Path::new("/dev/zero")).with_limit(1000);
            assert!(endless.rgb().unwrap_err().to_string().contains("found a device"));
        }
    }

    /// Decompressed data other than pixels: a colour profile of 40 MB in 40 kB is left out.
    #[test]
    fn a_colour_profile_that_inflates_is_left_out() {
        let mut info = png::Info::with_size(8, 8);
        info.icc_profile = Some(vec![0u8; 40 << 20].into());
        let mut bytes = vec![];
        let encoder = png::Encoder::with_info(&mut bytes, info).unwrap();
        encoder.write_header().unwrap().write_image_data(&[7; 64]).unwrap();
        assert!(bytes.len() < 1 << 20);
        let file = ImageFile::of_bytes(Path::new("profile.png"), &bytes);
        assert_eq!(file.decoder(&bytes).unwrap().0.icc_profile().unwrap(), None);
        assert_eq!(file.rgb().unwrap().size(), (8, 8));
    }

    fn mask_of(image: DynamicImage) -> Result<Vec<bool>, String> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("mask.png");
        write_png(&path, image).unwrap();
        file(&path).mask().map(|m| m.as_slice().to_vec()).map_err(|e| e.to_string())
    }

    #[test]
    fn the_hidden_part_of_a_mask_comes_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("mask.png");
        let mask = Image::from_vec(4, 1, vec![false, true, true, false]).unwrap();
        let hidden = Image::from_vec(4, 1, vec![false, false, true, false]).unwrap();
        crate::write_mask_and_hidden(&path, &mask, Some(&hidden)).unwrap();
        assert_eq!(crate::read_mask_and_hidden(&path).unwrap(), (mask.clone(), Some(hidden)));
        assert_eq!(file(&path).mask().unwrap(), mask);
        crate::write_mask(&path, &mask).unwrap();
        assert_eq!(crate::read_mask_and_hidden(&path).unwrap(), (mask, None));
        // In colour, 128 is a colour.
        let grey = image::RgbImage::from_vec(2, 1, vec![0, 0, 0, 128, 128, 128]).unwrap();
        write_png(&path, grey.into()).unwrap();
        assert_eq!(file(&path).mask_and_hidden().unwrap().1, None);
    }

    /// A 16-bit mask once lost its values below 129, a coloured one its dark pixels.
    #[test]
    fn every_pixel_that_is_not_zero_is_in_the_mask() {
        let line = [false, true, true, true];
        let grey8 = image::GrayImage::from_vec(4, 1, vec![0, 1, 128, 255]).unwrap();
        let grey16 =
            image::ImageBuffer::<image::Luma<u16>, _>::from_vec(4, 1, vec![0, 1, 128, 65535]).unwrap();
        let blue = image::RgbImage::from_vec(4, 1, vec![0, 0, 0, 0, 0, 1, 0, 0, 1, 0, 0, 1]).unwrap();
        let grey = image::RgbImage::from_vec(4, 1, vec![0, 0, 0, 1, 1, 1, 9, 9, 9, 255, 255, 255]).unwrap();
        let dark = image::ImageBuffer::<image::Rgb<u16>, _>::from_vec(
            4,
            1,
            vec![0, 0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0],
        );
        let rgba = |values: [[u8; 4]; 4]| image::RgbaImage::from_vec(4, 1, values.concat()).unwrap();
        let opaque = rgba([[0, 0, 0, 255], [3, 0, 0, 255], [3, 0, 0, 255], [3, 0, 0, 255]]);
        let cut_out = rgba([[9, 9, 9, 0], [200, 3, 0, 255], [3, 0, 70, 255], [3, 0, 0, 1]]);
        let shape = rgba([[0, 0, 0, 0], [0, 0, 0, 255], [0, 0, 0, 255], [0, 0, 0, 9]]);
        let grey_alpha = image::GrayAlphaImage::from_vec(4, 1, vec![0, 255, 1, 255, 2, 255, 3, 255]).unwrap();
        let accepted: [DynamicImage; 9] = [
            grey8.into(),
            grey16.into(),
            blue.into(),
            grey.into(),
            dark.unwrap().into(),
            opaque.into(),
            cut_out.into(),
            shape.into(),
            grey_alpha.into(),
        ];
        for image in accepted {
            assert_eq!(mask_of(image.clone()).as_deref(), Ok(&line[..]), "{image:?}");
        }
        let labels = image::RgbImage::from_vec(4, 1, vec![0, 0, 0, 255, 0, 0, 0, 255, 0, 0, 255, 0]).unwrap();
        let both = rgba([[0, 0, 0, 0], [0, 0, 0, 255], [255, 255, 255, 255], [0, 0, 0, 255]]);
        for (image, words) in [(labels.into(), "several colours"), (both.into(), "in alpha")] {
            let error = mask_of(image).unwrap_err();
            assert!(error.contains("mask.png") && error.contains(words), "{error}");
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("mask.jpg");
        image::GrayImage::new(8, 8).save(&path).unwrap();
        assert!(file(&path).mask().unwrap_err().to_string().contains("PNG"));
    }

    /// Palettes and single bits, as drawing programs write masks.
    #[test]
    fn masks_of_palettes_and_of_single_bits() {
        let dir = tempfile::tempdir().unwrap();
        for (name, color, bytes) in [
            ("bits.png", png::ColorType::Grayscale, [0b0110_0000]),
            ("palette.png", png::ColorType::Indexed, [0b0110_0000]),
        ] {
            let path = dir.path().join(name);
            let mut encoder = png::Encoder::new(File::create(&path).unwrap(), 4, 1);
            encoder.set_color(color);
            encoder.set_depth(png::BitDepth::One);
            if color == png::ColorType::Indexed {
                encoder.set_palette(vec![0, 0, 0, 1, 0, 0]);
            }
            encoder.write_header().unwrap().write_image_data(&bytes).unwrap();
            assert_eq!(file(&path).mask().unwrap().as_slice(), [false, true, true, false], "{name}");
        }
    }

    /// One object in a large image takes very few bytes: the file was once taken for a truncated one.
    #[test]
    fn masks_of_single_bits_that_compress_well() {
        let dir = tempfile::tempdir().unwrap();
        for (name, color) in
            [("bits.png", png::ColorType::Grayscale), ("palette.png", png::ColorType::Indexed)]
        {
            let path = dir.path().join(name);
            let mut encoder = png::Encoder::new(File::create(&path).unwrap(), 1920, 1200);
            encoder.set_color(color);
            encoder.set_depth(png::BitDepth::One);
            encoder.set_compression(png::Compression::High);
            encoder.set_filter(png::Filter::NoFilter);
            if color == png::ColorType::Indexed {
                encoder.set_palette(vec![0, 0, 0, 1, 0, 0]);
            }
            let mut bytes = vec![0u8; 1920 / 8 * 1200];
            (100..140).for_each(|y| bytes[y * 240 + 20..y * 240 + 25].fill(255));
            encoder.write_header().unwrap().write_image_data(&bytes).unwrap();
            assert!(std::fs::metadata(&path).unwrap().len() < 1000);
            let mask = file(&path).mask().unwrap();
            assert_eq!(mask.as_slice().iter().filter(|m| **m).count(), 40 * 40, "{name}");
        }
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
