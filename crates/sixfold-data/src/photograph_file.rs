//! A file that lists a mesh and photographs of it: JSON, poses in BOP's form, paths relative to the file.

use std::path::Path;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use sixfold_bop::{VISIBILITY_DELTA, ground_truth_visibility};
use sixfold_geometry::{Camera, Mask, Mat3, Plane, Pose, PoseError, RgbImage, Vec3, undistort_rgb};
use sixfold_io::{CameraFile, limits, read_mask, read_regular_text, read_rgb};
use sixfold_mesh::{Mesh, ModelInfo, Unit, read_mesh};

use crate::error::TrainingSetError;
use crate::posed_image::PosedImage;
use crate::rough_images::{
    Disturber, RoughImage, RoughImageOptions, RoughImages, RoughObject, detected_mask, detections,
};

/// A file that lists photographs of one object with its pose in each, and its mesh, if there is one. Paths are relative to the
/// file.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PhotographFile {
    /// The mesh.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mesh: Option<String>,
    /// Unit of the mesh file: m, cm, mm, in.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// The plane on which the object stands, in the object's frame: nothing of the object is below it. Without a point, the highest
    /// plane that the masks allow is used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub floor: Option<FloorEntry>,
    /// The photographs.
    pub photographs: Vec<PhotographEntry>,
}

/// A plane in a [`PhotographFile`].
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FloorEntry {
    /// Its normal, upwards; of any length but 0.
    pub normal: [f64; 3],
    /// A point on it, millimetres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub point: Option<[f64; 3]>,
}

impl FloorEntry {
    /// The normal, of length 1; `None` if its length is 0 or a number is not finite.
    pub fn up(&self) -> Option<Vec3> {
        let normal = Vec3::from(self.normal).try_normalize(1e-12)?;
        normal.iter().all(|v| v.is_finite()).then_some(normal)
    }

    /// The plane, metres; `None` without a point.
    pub fn plane(&self) -> Option<Plane> {
        let (normal, point) = (self.up()?, Vec3::from(self.point?) * 1e-3);
        Some(Plane { normal, offset: normal.dot(&point) }).filter(|plane| plane.offset.is_finite())
    }
}

/// A photograph in a [`PhotographFile`].
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(non_snake_case)]
pub struct PhotographEntry {
    /// Its image: PNG or JPEG.
    pub image: String,
    /// Its camera: a file of BOP, OpenCV or ROS.
    pub camera: String,
    /// Rotation from the object's frame to the camera's, by rows.
    pub cam_R_m2c: [f64; 9],
    /// Translation of the same, millimetres.
    pub cam_t_m2c: [f64; 3],
    /// Mask of the object in the image without lens distortion: PNG, 0 outside; 128 where something may occlude the object.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<String>,
    /// Measured depth from the same pixels: PNG of 16 bits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth: Option<String>,
    /// Millimetres per unit of the depth image.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth_scale: Option<f64>,
}

impl PhotographFile {
    /// Reads a file; its images are not read.
    ///
    /// # Errors
    /// [`TrainingSetError::Photographs`], which names the file and the field.
    pub fn read(path: &Path) -> Result<PhotographFile, TrainingSetError> {
        let wrong = |reason: String| TrainingSetError::Photographs { path: path.to_owned(), reason };
        let text = read_regular_text(path, limits::SMALL_TEXT).map_err(|error| wrong(error.to_string()))?;
        let file: PhotographFile = serde_json::from_str(&text).map_err(|error| {
            wrong(format!(
                "{error}; expected {{\"mesh\", \"unit\", \"floor\", \"photographs\": [{{\"image\", \"camera\", \"cam_R_m2c\", \"cam_t_m2c\", \"mask\", \"depth\", \"depth_scale\"}}]}}"
            ))
        })?;
        if file.photographs.is_empty() {
            return Err(wrong("field photographs: found none, expected at least one".into()));
        }
        if file.floor.is_some_and(|f| f.up().is_none() || (f.point.is_some() && f.plane().is_none())) {
            return Err(wrong(
                "field floor.normal: expected a direction, three numbers that are not all 0".into(),
            ));
        }
        for (number, entry) in file.photographs.iter().enumerate() {
            entry.pose().map_err(|error| wrong(format!("field photographs[{number}].cam_R_m2c: {error}")))?;
            if entry.depth.is_some()
                && !entry.depth_scale.is_some_and(|scale| scale > 0.0 && scale.is_finite())
            {
                return Err(wrong(format!(
                    "field photographs[{number}].depth_scale: expected millimetres per unit of the depth image, above 0"
                )));
            }
        }
        Ok(file)
    }

    /// The mesh, metres; `None` if the file names none.
    ///
    /// # Errors
    /// [`TrainingSetError`].
    pub fn read_mesh(&self, path: &Path) -> Result<Option<Mesh>, TrainingSetError> {
        let wrong = |reason: String| TrainingSetError::Photographs { path: path.to_owned(), reason };
        let Some(mesh) = &self.mesh else { return Ok(None) };
        let unit =
            self.unit.as_deref().ok_or_else(|| wrong("field unit: expected m, cm, mm or in".into()))?;
        let unit: Unit = unit.parse().map_err(|error| wrong(format!("field unit: {error}")))?;
        Ok(Some(read_mesh(path.parent().unwrap_or(Path::new("")).join(mesh), unit)?))
    }
}

impl PhotographEntry {
    /// Takes points of the object's frame to the camera's.
    ///
    /// # Errors
    /// [`PoseError`] if the matrix is not a rotation.
    pub fn pose(&self) -> Result<Pose, PoseError> {
        Pose::from_parts(&Mat3::from_row_slice(&self.cam_R_m2c), Vec3::from(self.cam_t_m2c) * 1e-3)
    }
}

impl RoughImages {
    /// The mesh and the photographs that a file lists; the object gets the id 1. `detected` is its id for the detector.
    ///
    /// # Errors
    /// [`TrainingSetError`].
    pub fn of_file(
        path: &Path,
        detected: u32,
        options: &RoughImageOptions<'_>,
    ) -> Result<RoughImages, TrainingSetError> {
        let wrong = |reason: String| TrainingSetError::Photographs { path: path.to_owned(), reason };
        let file = PhotographFile::read(path)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let mesh = file.read_mesh(path)?;
        let mesh = mesh.ok_or_else(|| wrong("field mesh: found none, expected the object's mesh".into()))?;
        let mut disturber = Disturber::new(options);
        let mut images = vec![];
        for (number, entry) in file.photographs.iter().enumerate() {
            let (image, camera) = pinhole_image(folder, entry)?;
            let given = entry
                .pose()
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

/// The detector's mask at the position of the object according to its pose.
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
fn pinhole_image(folder: &Path, entry: &PhotographEntry) -> Result<(RgbImage, Camera), TrainingSetError> {
    let image = read_rgb(&folder.join(&entry.image))?;
    let file = folder.join(&entry.camera);
    let (width, height) = image.size();
    let camera = CameraFile::read(&file)?.for_image(width, height, &file)?;
    let image = if camera.distortion.is_some() { undistort_rgb(&image, &camera)? } else { image };
    Ok((image, camera.without_distortion()))
}
