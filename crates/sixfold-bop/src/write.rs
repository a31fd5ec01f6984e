//! Writing BOP datasets: a scene image by image, camera and targets. Every file appears whole or not at all.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value, json};
use sixfold_geometry::{Camera, DepthImage, Mask, Mat3, Pose, Rect, RgbImage};
use sixfold_io::{write_atomically, write_depth, write_mask, write_rgb};

use crate::dataset_error::DatasetError;
use crate::scene_files::{GroundTruth, GroundTruthInfo, Target};

/// One image to be written; what is `None` or empty is left out.
#[derive(Debug, Clone, Copy)]
pub struct NewImage<'a> {
    /// Its id.
    pub im_id: u32,
    /// Intrinsics.
    pub camera: &'a Camera,
    /// Metres per unit of the depth file: 1e-3 stores whole millimetres, 1e-4 tenths up to 6.5 m.
    pub depth_scale: f64,
    /// Pose of the world in the camera frame.
    pub camera_from_world: Option<Pose>,
    /// Colour.
    pub rgb: Option<&'a RgbImage>,
    /// Depth in metres; values that do not fit 16 bits are stored as missing.
    pub depth: Option<&'a DepthImage>,
    /// The objects.
    pub ground_truth: &'a [GroundTruth],
    /// Visibility and boxes, one per object.
    pub info: Option<&'a [GroundTruthInfo]>,
    /// Whole silhouettes, one per object.
    pub masks: Option<&'a [Mask]>,
    /// Visible parts, one per object.
    pub masks_visible: Option<&'a [Mask]>,
}

impl<'a> NewImage<'a> {
    /// An image with only its camera, depth in whole millimetres.
    pub fn new(im_id: u32, camera: &'a Camera) -> Self {
        NewImage {
            im_id,
            camera,
            depth_scale: 1e-3,
            camera_from_world: None,
            rgb: None,
            depth: None,
            ground_truth: &[],
            info: None,
            masks: None,
            masks_visible: None,
        }
    }
}

/// Writes a scene folder. Images are written by [`SceneWriter::add`], the text files by [`SceneWriter::finish`].
#[derive(Debug)]
pub struct SceneWriter {
    dir: PathBuf,
    cameras: BTreeMap<u32, Value>,
    ground_truth: BTreeMap<u32, Value>,
    infos: BTreeMap<u32, Value>,
}

impl SceneWriter {
    /// For the scene `dir/split/000002` and the like; folders are made as needed.
    pub fn new(dataset: &Path, split: &str, scene_id: u32) -> Self {
        SceneWriter {
            dir: dataset.join(split).join(format!("{scene_id:06}")),
            cameras: BTreeMap::new(),
            ground_truth: BTreeMap::new(),
            infos: BTreeMap::new(),
        }
    }

    /// The scene's folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Writes the image files and keeps the text for [`SceneWriter::finish`].
    ///
    /// # Errors
    /// [`DatasetError::Field`] when an image has another size than the camera or a list another length than the
    /// ground truth, [`DatasetError::Write`].
    pub fn add(&mut self, image: &NewImage<'_>) -> Result<(), DatasetError> {
        let im_id = image.im_id;
        let name = format!("{im_id:06}.png");
        let at = crate::json::At::image(&self.dir, im_id);
        let of_image = |error| DatasetError::of_image(im_id, error);
        let size = (image.camera.width, image.camera.height);
        let same_size = |field: &str, found: (usize, usize)| {
            if found == size {
                return Ok(());
            }
            Err(at.error(field, format!("{}x{}", found.0, found.1), format!("{}x{}", size.0, size.1)))
        };
        let same_length = |field: &str, found: Option<usize>| match found {
            Some(n) if n != image.ground_truth.len() => {
                Err(at.error(field, format!("{n} entries"), format!("{}", image.ground_truth.len())))
            }
            _ => Ok(()),
        };
        same_length("info", image.info.map(<[_]>::len))?;
        same_length("masks", image.masks.map(<[_]>::len))?;
        same_length("masks_visible", image.masks_visible.map(<[_]>::len))?;
        if let Some(rgb) = image.rgb {
            same_size("rgb", rgb.size())?;
            write_rgb(&self.dir.join("rgb").join(&name), rgb).map_err(of_image)?;
        }
        if let Some(depth) = image.depth {
            same_size("depth", depth.size())?;
            if !(image.depth_scale.is_finite() && image.depth_scale > 0.0) {
                return Err(at.error(
                    "depth_scale",
                    image.depth_scale.to_string(),
                    "metres per unit, above 0",
                ));
            }
            write_depth(&self.dir.join("depth").join(&name), depth, image.depth_scale).map_err(of_image)?;
        }
        for (folder, masks) in [("mask", image.masks), ("mask_visib", image.masks_visible)] {
            for (index, mask) in masks.into_iter().flatten().enumerate() {
                same_size(folder, mask.size())?;
                let path = self.dir.join(folder).join(format!("{im_id:06}_{index:06}.png"));
                write_mask(&path, mask).map_err(of_image)?;
            }
        }
        let c = image.camera;
        let mut camera = Map::new();
        camera.insert("cam_K".into(), json!([c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0]));
        camera.insert("depth_scale".into(), json!(tidy(image.depth_scale * 1000.0)));
        if let Some(pose) = &image.camera_from_world {
            camera.insert("cam_R_w2c".into(), json!(rotation_rows(&pose.rotation_matrix())));
            camera.insert("cam_t_w2c".into(), json!(translation_mm(pose)));
        }
        self.cameras.insert(im_id, Value::Object(camera));
        let poses = image.ground_truth.iter().map(|gt| {
            json!({
                "cam_R_m2c": rotation_rows(&gt.placement().rotation),
                "cam_t_m2c": translation_mm(&gt.camera_from_object),
                "obj_id": gt.obj_id,
            })
        });
        self.ground_truth.insert(im_id, poses.collect());
        if let Some(infos) = image.info {
            self.infos.insert(im_id, infos.iter().map(info_json).collect());
        }
        Ok(())
    }

    /// Writes `scene_camera.json`, `scene_gt.json` and, where any image had it, `scene_gt_info.json`. May be called
    /// more than once, to save what there is so far.
    ///
    /// # Errors
    /// [`DatasetError::Write`].
    pub fn finish(&self) -> Result<(), DatasetError> {
        write_by_image(&self.dir.join("scene_camera.json"), &self.cameras)?;
        write_by_image(&self.dir.join("scene_gt.json"), &self.ground_truth)?;
        if !self.infos.is_empty() {
            write_by_image(&self.dir.join("scene_gt_info.json"), &self.infos)?;
        }
        Ok(())
    }
}

/// Writes `camera.json` of a dataset. `depth_scale` in metres per unit.
///
/// # Errors
/// [`DatasetError::Write`].
pub fn write_camera(dataset: &Path, camera: &Camera, depth_scale: f64) -> Result<(), DatasetError> {
    let json = json!({
        "width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
        "cx": camera.cx, "cy": camera.cy, "depth_scale": tidy(depth_scale * 1000.0),
    });
    write_text(&dataset.join("camera.json"), &format!("{json:#}\n"))
}

/// Writes a targets file.
///
/// # Errors
/// [`DatasetError::Write`].
pub fn write_targets(path: &Path, targets: &[Target]) -> Result<(), DatasetError> {
    let entry = |target: &Target| match &target.object {
        Some(o) => json!({
            "im_id": target.im_id, "inst_count": o.inst_count, "obj_id": o.obj_id, "scene_id": target.scene_id,
        }),
        None => json!({ "im_id": target.im_id, "scene_id": target.scene_id }),
    };
    let lines: Vec<String> = targets.iter().map(|t| entry(t).to_string()).collect();
    write_text(path, &format!("[\n{}\n]\n", lines.join(",\n")))
}

fn write_text(path: &Path, text: &str) -> Result<(), DatasetError> {
    write_atomically(path, text.as_bytes())
        .map_err(|source| DatasetError::Write { path: path.to_owned(), source })
}

/// One image a line, in ascending order of the number (not of its text).
fn write_by_image(path: &Path, images: &BTreeMap<u32, Value>) -> Result<(), DatasetError> {
    let lines: Vec<String> = images.iter().map(|(im_id, value)| format!("\"{im_id}\": {value}")).collect();
    write_text(path, &format!("{{\n{}\n}}\n", lines.join(",\n")))
}

/// Removes the rounding errors that a change of unit leaves (1e-4 m is 0.1 mm, not 0.10000000000000002).
fn tidy(value: f64) -> f64 {
    let rounded = (value * 1e9).round() / 1e9;
    if (rounded - value).abs() <= 1e-12 * value.abs() { rounded } else { value }
}

pub(crate) fn rotation_rows(r: &Mat3) -> [f64; 9] {
    std::array::from_fn(|i| r[(i / 3, i % 3)])
}

pub(crate) fn translation_mm(pose: &Pose) -> [f64; 3] {
    let t = pose.translation();
    [t.x * 1000.0, t.y * 1000.0, t.z * 1000.0]
}

fn info_json(info: &GroundTruthInfo) -> Value {
    let bbox = |rect: &Option<Rect>| match rect {
        Some(r) => json!([r.x as i64, r.y as i64, r.width as i64, r.height as i64]),
        None => json!([-1, -1, -1, -1]),
    };
    let mut map = Map::new();
    map.insert("bbox_obj".into(), bbox(&info.bbox_obj));
    map.insert("bbox_visib".into(), bbox(&info.bbox_visib));
    for (field, count) in [
        ("px_count_all", info.px_count_all),
        ("px_count_valid", info.px_count_valid),
        ("px_count_visib", info.px_count_visib),
    ] {
        if let Some(count) = count {
            map.insert(field.into(), json!(count));
        }
    }
    map.insert("visib_fract".into(), json!(info.visib_fract));
    Value::Object(map)
}
