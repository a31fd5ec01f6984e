//! A file that names a mesh and photographs of it: JSON, poses as BOP has them, paths relative to the file.

use std::path::Path;
use std::sync::Arc;

use serde::Deserialize;
use sixfold_bop::{VISIBILITY_DELTA, ground_truth_visibility};
use sixfold_geometry::{Camera, Mask, Mat3, Pose, RgbImage, Vec3, undistort_rgb};
use sixfold_io::{CameraFile, read_mask, read_rgb};
use sixfold_mesh::{Mesh, ModelInfo, Unit, read_mesh};

use crate::error::TrainingSetError;
use crate::posed_image::PosedImage;
use crate::rough_images::{
    Disturber, RoughImage, RoughImageOptions, RoughImages, RoughObject, detected_mask, detections,
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    mesh: String,
    unit: String,
    photographs: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(non_snake_case)]
struct Entry {
    image: String,
    camera: String,
    cam_R_m2c: [f64; 9],
    cam_t_m2c: [f64; 3],
    mask: Option<String>,
}

impl RoughImages {
    /// The mesh and the photographs that a file names; the object gets the id 1. `detected` is its id for the detector.
    ///
    /// # Errors
    /// [`TrainingSetError`].
    pub fn of_file(
        path: &Path,
        detected: u32,
        options: &RoughImageOptions<'_>,
    ) -> Result<RoughImages, TrainingSetError> {
        let wrong = |reason: String| TrainingSetError::Photographs { path: path.to_owned(), reason };
        let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
        let file: File = serde_json::from_str(&text).map_err(|error| {
            wrong(format!(
                "{error}; expected {{\"mesh\", \"unit\", \"photographs\": [{{\"image\", \"camera\", \"cam_R_m2c\", \"cam_t_m2c\", \"mask\"}}]}}"
            ))
        })?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let unit: Unit = file.unit.parse().map_err(|error| wrong(format!("field unit: {error}")))?;
        let mesh = read_mesh(folder.join(&file.mesh), unit)?;
        if file.photographs.is_empty() {
            return Err(wrong("field photographs: found none, expected at least one".into()));
        }
        let mut disturber = Disturber::new(options);
        let mut images = vec![];
        for (number, entry) in file.photographs.iter().enumerate() {
            let (image, camera) = pinhole_image(folder, entry)?;
            let rotation = Mat3::from_row_slice(&entry.cam_R_m2c);
            let given = Pose::from_parts(&rotation, Vec3::from(entry.cam_t_m2c) * 1e-3)
                .map_err(|error| wrong(format!("field photographs[{number}].cam_R_m2c: {error}")))?;
            let pose = disturber.disturb(&given);
            let mask = match &entry.mask {
                Some(mask) => Some(read_mask(&folder.join(mask))?),
                None => mask_of_detector(options, &image, detected, (&mesh, pose), &camera)?,
            };
            let posed = PosedImage::new(&entry.image, detected, Arc::new(image), camera, pose)?;
            let posed = match &mask {
                Some(mask) => posed.with_mask(mask)?,
                None => posed,
            };
            images.push(RoughImage { number, posed, given });
        }
        let info = ModelInfo::of_mesh(&mesh);
        Ok(RoughImages::of_object(RoughObject { id: 1, mesh, info, images }))
    }
}

/// The mask that a detector sees where the pose puts the object.
fn mask_of_detector(
    options: &RoughImageOptions<'_>,
    image: &RgbImage,
    id: u32,
    posed: (&Mesh, Pose),
    camera: &Camera,
) -> Result<Option<Mask>, TrainingSetError> {
    if options.detect.is_none() {
        return Ok(None);
    }
    let visible = ground_truth_visibility(&[posed], camera, None, VISIBILITY_DELTA);
    let seen = detections(options, image)?;
    Ok(visible.first().and_then(|v| detected_mask(&seen, id, &v.mask_visible)))
}

/// An image without distortion, and its camera.
fn pinhole_image(folder: &Path, entry: &Entry) -> Result<(RgbImage, Camera), TrainingSetError> {
    let image = read_rgb(&folder.join(&entry.image))?;
    let file = folder.join(&entry.camera);
    let (width, height) = image.size();
    let camera = CameraFile::read(&file)?.for_image(width, height, &file)?;
    let image = if camera.distortion.is_some() { undistort_rgb(&image, &camera)? } else { image };
    Ok((image, camera.without_distortion()))
}
