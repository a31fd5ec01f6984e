//! The images of a request with their camera: checked when they arrive, then read and checked again by the worker.

use std::io::Cursor;
use std::path::Path;

use sixfold_geometry::{Camera, DepthImage, Mask, RgbImage, undistort_depth, undistort_rgb};
use sixfold_io::{CameraFile, ImageFile, limits, read_regular};

use crate::error::{Answer, ApiError};
use crate::form::Form;

/// Largest camera file, as for the command line.
const MAX_CAMERA: usize = 16 << 20;

/// The files of a request by the names that they have in a job's folder.
pub(crate) const FILES: [&str; 4] = ["rgb", "depth", "camera", "mask"];

/// The bytes of a request's files.
#[derive(Debug, Default, Clone)]
pub(crate) struct ImageBytes {
    rgb: Option<Vec<u8>>,
    depth: Option<Vec<u8>>,
    camera: Option<Vec<u8>>,
    mask: Option<Vec<u8>>,
}

impl ImageBytes {
    /// The files of a form. Camera parameters given as numbers are converted to a camera file.
    pub fn of_form(form: &Form) -> Answer<ImageBytes> {
        let bytes = |name: &str| form.file(name).map(|f| f.bytes.to_vec());
        let mut camera = bytes("camera");
        if let Some(numbers) = intrinsics(form)? {
            if camera.is_some() {
                return Err(ApiError::field(
                    "camera",
                    "a file, and fx, fy, cx, cy",
                    "one of them",
                    "leave out the numbers or the file",
                ));
            }
            camera = Some(numbers.into_bytes());
        }
        if camera.as_ref().is_some_and(|bytes| bytes.len() > MAX_CAMERA) {
            return Err(ApiError::field(
                "camera",
                "a file of more than 16 MB",
                "a camera file",
                "give the camera file",
            ));
        }
        Ok(ImageBytes { rgb: bytes("rgb"), depth: bytes("depth"), camera, mask: bytes("mask") })
    }

    /// The files in a job's folder.
    pub fn of_folder(folder: &Path) -> Answer<ImageBytes> {
        let read = |name: &str| {
            let path = folder.join(name);
            if !path.exists() {
                return Ok(None);
            }
            read_regular(&path, limits::IMAGE)
                .map(Some)
                .map_err(|e| ApiError::system(&format!("the job's file {name}"), e))
        };
        Ok(ImageBytes {
            rgb: read("rgb")?,
            depth: read("depth")?,
            camera: read("camera")?,
            mask: read("mask")?,
        })
    }

    /// The files with their names in a job's folder.
    pub fn files(&self) -> Vec<(&'static str, &[u8])> {
        let all = [&self.rgb, &self.depth, &self.camera, &self.mask];
        FILES.into_iter().zip(all).filter_map(|(name, bytes)| Some((name, bytes.as_deref()?))).collect()
    }

    pub fn has_rgb(&self) -> bool {
        self.rgb.is_some()
    }

    pub fn has_depth(&self) -> bool {
        self.depth.is_some()
    }

    pub fn has_mask(&self) -> bool {
        self.mask.is_some()
    }
}

/// `fx`, `fy`, `cx`, `cy` as a camera file; `None` where none of them is given.
fn intrinsics(form: &Form) -> Answer<Option<String>> {
    let expected = "a number of pixels";
    let [fx, fy, cx, cy] = ["fx", "fy", "cx", "cy"].map(|name| form.number(name, expected, f64::is_finite));
    let numbers = [fx?, fy?, cx?, cy?];
    let names = ["fx", "fy", "cx", "cy"];
    if numbers.iter().all(Option::is_none) {
        return Ok(None);
    }
    match numbers.iter().position(Option::is_none) {
        Some(missing) => Err(ApiError::field(
            names[missing],
            "nothing",
            expected,
            "give all of fx, fy, cx, cy, or a camera file",
        )),
        None => {
            let pairs = names.iter().zip(numbers);
            let text: Vec<String> =
                pairs.map(|(name, value)| format!("\"{name}\": {}", value.unwrap_or_default())).collect();
            Ok(Some(format!("{{{}}}", text.join(", "))))
        }
    }
}

/// The decoded images of a request, without lens distortion.
pub(crate) struct Images {
    /// The camera with its distortion.
    pub lens: Camera,
    pub camera: Camera,
    pub rgb: Option<RgbImage>,
    /// Depth, metres.
    pub depth: Option<DepthImage>,
    /// Mask in the raw image.
    pub mask: Option<Mask>,
}

impl Images {
    /// Decodes the images and checks that they fit each other. `depth_scale`: millimetres per unit of the depth image, instead of
    /// the camera file's.
    pub fn decode(bytes: &ImageBytes, depth_scale: Option<f64>) -> Answer<Images> {
        let camera_name = Path::new("camera");
        let camera = bytes.camera.as_deref().ok_or_else(|| {
            ApiError::field(
                "camera",
                "nothing",
                "a camera file, or fx, fy, cx, cy",
                "send the camera of these images; without it nothing has a size",
            )
        })?;
        let file = CameraFile::parse(camera, camera_name).map_err(|e| ApiError::of_camera(&e))?;
        // From the headers alone: an image of a wrong size is not decoded.
        let size_of = |field: &str, bytes: &Option<Vec<u8>>| {
            let size = |b: &[u8]| image(field, b).size().map_err(|e| ApiError::of_image(field, &e));
            bytes.as_deref().map(size).transpose()
        };
        let (of_depth, of_rgb) = (size_of("depth", &bytes.depth)?, size_of("rgb", &bytes.rgb)?);
        let Some(size) = of_depth.or(of_rgb) else {
            return Err(ApiError::field(
                "depth",
                "no image",
                "a depth image, a colour image or both",
                "send them as the file fields depth and rgb",
            ));
        };
        for (field, found) in [("rgb", of_rgb), ("mask", size_of("mask", &bytes.mask)?)] {
            same_size(field, found.unwrap_or(size), size)?;
        }
        let lens = file.for_image(size.0, size.1, camera_name).map_err(|e| ApiError::of_camera(&e))?;
        let depth = bytes.depth.as_deref().map(|b| depth(b, depth_scale.or(file.depth_scale))).transpose()?;
        let rgb = bytes.rgb.as_deref();
        let rgb = rgb.map(|b| image("rgb", b).rgb()).transpose();
        let rgb = rgb.map_err(|e| ApiError::of_image("rgb", &e))?;
        let mask = bytes.mask.as_deref();
        let mask = mask.map(|b| image("mask", b).mask()).transpose();
        let mask = mask.map_err(|e| ApiError::of_image("mask", &e))?;
        let lens_fault = |e: &dyn std::fmt::Display| {
            ApiError::about("camera", e, "a distortion that can be undone", "calibrate the camera again")
        };
        let depth = depth.map(|d| undistort_depth(&d, &lens)).transpose().map_err(|e| lens_fault(&e))?;
        let rgb = rgb.map(|c| undistort_rgb(&c, &lens)).transpose().map_err(|e| lens_fault(&e))?;
        Ok(Images { lens, camera: lens.without_distortion(), rgb, depth, mask })
    }
}

fn depth(bytes: &[u8], scale: Option<f64>) -> Answer<DepthImage> {
    let expected = "millimetres per unit of the depth image, above 0: 1 for most cameras";
    let scale = scale.ok_or_else(|| {
        ApiError::field("depth_scale", "nothing", expected, "give it, or a camera file that has it")
    })?;
    if !(scale > 0.0 && scale.is_finite()) {
        return Err(ApiError::field("depth_scale", scale.to_string(), expected, "correct the value"));
    }
    image("depth", bytes).depth(scale / 1000.0).map_err(|e| ApiError::of_image("depth", &e))
}

/// An image that messages name by its field.
fn image<'a>(field: &'a str, bytes: &'a [u8]) -> ImageFile<'a> {
    ImageFile::of_bytes(Path::new(field), bytes)
}

fn same_size(field: &str, found: (usize, usize), expected: (usize, usize)) -> Answer<()> {
    if found == expected {
        return Ok(());
    }
    Err(ApiError::field(
        field,
        format!("an image of {}x{}", found.0, found.1),
        format!("{}x{}, as the other image has", expected.0, expected.1),
        "send images of one camera that belong together",
    ))
}

/// An image as the bytes of a PNG.
pub(crate) fn png(image: &RgbImage) -> Answer<Vec<u8>> {
    let data: Vec<u8> = image.as_slice().iter().flatten().copied().collect();
    let buffer = ::image::RgbImage::from_raw(image.width() as u32, image.height() as u32, data);
    let buffer = buffer.ok_or_else(|| ApiError::system("an image", "too large for a PNG"))?;
    let mut bytes = Cursor::new(vec![]);
    let written = buffer.write_to(&mut bytes, ::image::ImageFormat::Png);
    written.map_err(|e| ApiError::system("an image", e))?;
    Ok(bytes.into_inner())
}
