//! The JSON files of a BOP scene and of the targets: text to checked values.
//!
//! Format: "BOP dataset format", github.com/thodan/bop_toolkit, docs/bop_datasets_format.md. Lengths there are in
//! millimetres; here they are in metres.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::{Map, Value};
use sixfold_geometry::{Mat3, Pose, Rect};

use crate::dataset_error::DatasetError;
use crate::errors::Placement;
use crate::json::{At, by_image, describe, parse};

/// Largest number of instances of an object in one image that targets may request: all of them are searched for and scored.
const MAX_INSTANCES: usize = 1000;

/// Intrinsics of one image without its size, and the unit of its depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImageCamera {
    /// Focal length in x, pixels.
    pub fx: f64,
    /// Focal length in y, pixels.
    pub fy: f64,
    /// Principal point x, pixels.
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
    /// Metres per unit of the depth image (BOP's `depth_scale` is millimetres per unit). `None` in scenes without it.
    pub depth_scale: Option<f64>,
    /// Pose of the world in the camera frame, where the scene has one.
    pub camera_from_world: Option<Pose>,
}

/// One object in one image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundTruth {
    /// Id of the object.
    pub obj_id: u32,
    /// Its pose.
    pub camera_from_object: Pose,
    /// The rotation as written in the file, if it came from one (in LM-O `R^T R` deviates from the identity by up to 0.009); the
    /// pose holds the nearest true rotation. An evaluation computes errors with these numbers, as the official one does.
    pub rotation_as_written: Option<Mat3>,
}

impl GroundTruth {
    /// An object at a pose.
    pub fn new(obj_id: u32, camera_from_object: Pose) -> Self {
        GroundTruth { obj_id, camera_from_object, rotation_as_written: None }
    }

    /// The pose as the evaluation uses it.
    pub fn placement(&self) -> Placement {
        let rotation = self.rotation_as_written.unwrap_or_else(|| self.camera_from_object.rotation_matrix());
        Placement { rotation, translation: self.camera_from_object.translation() }
    }
}

/// The entry of one ground-truth pose in `scene_gt_info.json`. Boxes are as BOP writes them: first pixel, then last minus
/// first pixel; `None` where BOP writes -1 because nothing is visible.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundTruthInfo {
    /// Box of the whole silhouette, parts outside the image and behind others included.
    pub bbox_obj: Option<Rect>,
    /// Box of what is visible.
    pub bbox_visib: Option<Rect>,
    /// Pixels of the whole silhouette, parts outside the image included.
    pub px_count_all: Option<u64>,
    /// Pixels of the silhouette with measured depth.
    pub px_count_valid: Option<u64>,
    /// Visible pixels.
    pub px_count_visib: Option<u64>,
    /// Visible fraction of the whole silhouette.
    pub visib_fract: f64,
}

/// A target: one object in one image, or (BOP'24) all objects in one image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Target {
    /// The scene.
    pub scene_id: u32,
    /// The image.
    pub im_id: u32,
    /// The object and the number of its instances to find; `None` in the BOP'24 format.
    pub object: Option<TargetObject>,
}

/// The object of a [`Target`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TargetObject {
    /// Id of the object.
    pub obj_id: u32,
    /// Number of instances to find.
    pub inst_count: usize,
}

/// Parses `scene_camera.json`; `path` is for messages.
///
/// # Errors
/// [`DatasetError::Json`] or [`DatasetError::Field`] naming the image and field.
pub fn parse_scene_camera(text: &[u8], path: &Path) -> Result<BTreeMap<u32, ImageCamera>, DatasetError> {
    let json = parse(text, path)?;
    let mut cameras = BTreeMap::new();
    for (im_id, value) in by_image(&json, path)? {
        let at = At::image(path, im_id);
        let map = at.object(value)?;
        let k: [f64; 9] = at.numbers(
            "cam_K",
            at.get(map, "cam_K", "9 numbers, K row by row (only pinhole cameras are supported)")?,
        )?;
        for (i, field, found) in [(0, "cam_K[0] (fx)", k[0]), (4, "cam_K[4] (fy)", k[4])] {
            if found <= 0.0 {
                return Err(at.error(field, format!("{found}"), format!("K[{i}] above zero")));
            }
        }
        let ratio = k[0] / k[4];
        if !(0.5..=2.0).contains(&ratio) {
            let expected = "focal lengths in pixels within a factor of 2 of each other: is a digit lost?";
            return Err(at.error("cam_K (fx, fy)", format!("{} and {}", k[0], k[4]), expected));
        }
        check_lens_keys(&at, map)?;
        // In some files rounding leaves a tiny skew; anything above a thousandth of a pixel is a real one.
        for (i, expected) in [(1, 0.0), (3, 0.0), (6, 0.0), (7, 0.0), (8, 1.0)] {
            if (k[i] - expected).abs() > 1e-3 {
                return Err(at.error(
                    format!("cam_K[{i}]"),
                    format!("{}", k[i]),
                    format!("{expected}: K = fx 0 cx, 0 fy cy, 0 0 1; undo skew before"),
                ));
            }
        }
        let depth_scale = match map.get("depth_scale") {
            None | Some(Value::Null) => None,
            Some(value) => {
                let mm = at.number("depth_scale", value)?;
                if mm <= 0.0 {
                    return Err(at.error("depth_scale", format!("{mm}"), "millimetres per unit, above zero"));
                }
                if !(1e-4..=1e3).contains(&mm) {
                    return Err(at.error(
                        "depth_scale",
                        format!("{mm}"),
                        "millimetres per unit; this looks like metres or a wrong unit (1.0 is usual)",
                    ));
                }
                Some(mm / 1000.0)
            }
        };
        let camera_from_world = match (map.contains_key("cam_R_w2c"), map.contains_key("cam_t_w2c")) {
            (true, true) => Some(at.pose_mm(map, "cam_R_w2c", "cam_t_w2c")?.0),
            _ => None,
        };
        cameras.insert(
            im_id,
            ImageCamera { fx: k[0], fy: k[4], cx: k[2], cy: k[5], depth_scale, camera_from_world },
        );
    }
    Ok(cameras)
}

/// Refuses keys that would change the projection but are not supported: lens models other than the pinhole. Other keys are
/// notes on how an image was taken.
fn check_lens_keys(at: &At<'_>, map: &Map<String, Value>) -> Result<(), DatasetError> {
    let pinhole = |value: &Value| value.is_null() || value.as_str() == Some("pinhole");
    if let Some(model) = map.get("cam_model").filter(|value| !pinhole(value)) {
        let expected = "\"pinhole\": undistort the images before, as those of BOP are";
        return Err(at.error("cam_model", describe(model), expected));
    }
    for (key, value) in map {
        let plain = key.to_lowercase();
        let of_lens = plain.contains("dist") || plain.contains("coeff") || plain == "d";
        let zero = |v: &Value| v.is_null() || v.as_f64() == Some(0.0);
        let without = zero(value) || value.as_array().is_some_and(|list| list.iter().all(zero));
        if of_lens && !without {
            let expected =
                "images without lens distortion, as BOP's are: undistort them and remove the field";
            return Err(at.error(key.as_str(), describe(value), expected));
        }
    }
    Ok(())
}

/// Parses `scene_gt.json`; `path` is for messages.
///
/// # Errors
/// [`DatasetError::Json`] or [`DatasetError::Field`] naming image, entry and field.
pub fn parse_scene_gt(text: &[u8], path: &Path) -> Result<BTreeMap<u32, Vec<GroundTruth>>, DatasetError> {
    let json = parse(text, path)?;
    let mut images = BTreeMap::new();
    for (im_id, value) in by_image(&json, path)? {
        let at = At::image(path, im_id);
        let mut poses = Vec::new();
        for (index, value) in at.list(value)?.iter().enumerate() {
            let at = at.entry(index);
            let map = at.object(value)?;
            let obj_id = at.id("obj_id", at.get(map, "obj_id", "an object id")?)?;
            let (camera_from_object, written) = at.pose_mm(map, "cam_R_m2c", "cam_t_m2c")?;
            poses.push(GroundTruth { obj_id, camera_from_object, rotation_as_written: Some(written) });
        }
        images.insert(im_id, poses);
    }
    Ok(images)
}

/// Parses `scene_gt_info.json`; `path` is for messages.
///
/// # Errors
/// [`DatasetError::Json`] or [`DatasetError::Field`] naming image, entry and field.
pub fn parse_scene_gt_info(
    text: &[u8],
    path: &Path,
) -> Result<BTreeMap<u32, Vec<GroundTruthInfo>>, DatasetError> {
    let json = parse(text, path)?;
    let mut images = BTreeMap::new();
    for (im_id, value) in by_image(&json, path)? {
        let at = At::image(path, im_id);
        let mut infos = Vec::new();
        for (index, value) in at.list(value)?.iter().enumerate() {
            let at = at.entry(index);
            let map = at.object(value)?;
            let bbox = |field: &str| -> Result<Option<Rect>, DatasetError> {
                let Some(value) = map.get(field).filter(|v| !v.is_null()) else { return Ok(None) };
                let [x, y, width, height] = at.numbers(field, value)?;
                Ok((width >= 0.0 && height >= 0.0).then_some(Rect { x, y, width, height }))
            };
            let count = |field: &str| -> Result<Option<u64>, DatasetError> {
                let Some(value) = map.get(field).filter(|v| !v.is_null()) else { return Ok(None) };
                let whole = value.as_u64();
                whole.map(Some).ok_or_else(|| at.error(field, describe(value), "a number of pixels"))
            };
            let visib_fract =
                at.number("visib_fract", at.get(map, "visib_fract", "the visible fraction, 0 to 1")?)?;
            if !(-1e-6..=1.0 + 1e-6).contains(&visib_fract) {
                return Err(at.error("visib_fract", format!("{visib_fract}"), "a fraction from 0 to 1"));
            }
            infos.push(GroundTruthInfo {
                bbox_obj: bbox("bbox_obj")?,
                bbox_visib: bbox("bbox_visib")?,
                px_count_all: count("px_count_all")?,
                px_count_valid: count("px_count_valid")?,
                px_count_visib: count("px_count_visib")?,
                visib_fract,
            });
        }
        images.insert(im_id, infos);
    }
    Ok(images)
}

/// Parses a targets file, `test_targets_bop19.json` (with objects) or `test_targets_bop24.json` (images only).
///
/// # Errors
/// [`DatasetError::Json`] or [`DatasetError::Field`] naming entry and field.
pub fn parse_targets(text: &[u8], path: &Path) -> Result<Vec<Target>, DatasetError> {
    let json = parse(text, path)?;
    let at = At::file(path);
    let mut targets = Vec::new();
    for (index, value) in at.list(&json)?.iter().enumerate() {
        let at = at.entry(index);
        let map = at.object(value)?;
        let scene_id = at.id("scene_id", at.get(map, "scene_id", "a scene id")?)?;
        let im_id = at.id("im_id", at.get(map, "im_id", "an image id")?)?;
        let object = match map.get("obj_id") {
            None => None,
            Some(value) => Some(TargetObject {
                obj_id: at.id("obj_id", value)?,
                inst_count: match map.get("inst_count") {
                    None => 1,
                    Some(value) => match at.id("inst_count", value)? as usize {
                        count if count <= MAX_INSTANCES => count,
                        count => {
                            let expected =
                                format!("up to {MAX_INSTANCES} instances of an object in one image");
                            return Err(at.error("inst_count", count.to_string(), expected));
                        }
                    },
                },
            }),
        };
        targets.push(Target { scene_id, im_id, object });
    }
    Ok(targets)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const GT: &str = r#"{"3": [{"cam_R_m2c": [1,0,0,0,1,0,0,0,1], "cam_t_m2c": [10,-20,1000], "obj_id": 5},
        {"cam_R_m2c": [0,-1,0,1,0,0,0,0,1], "cam_t_m2c": [0,0,500], "obj_id": 9}]}"#;
    const CAMERA: &str = r#"{"3": {"cam_K": [572.4,0,325.2,0,573.5,242.0,0,0,1], "depth_scale": 0.1,
        "cam_R_w2c": [1,0,0,0,1,0,0,0,1], "cam_t_w2c": [0,0,2000]}}"#;
    const INFO: &str = r#"{"3": [{"bbox_obj": [1,2,3,4], "bbox_visib": [-1,-1,-1,-1], "px_count_all": 12,
        "px_count_valid": 10, "px_count_visib": 6, "visib_fract": 0.5}]}"#;

    fn path() -> &'static Path {
        Path::new("scene/file.json")
    }

    #[test]
    fn millimetres_become_metres() {
        let gt = parse_scene_gt(GT.as_bytes(), path()).unwrap();
        let t = gt[&3][0].camera_from_object.translation();
        assert!((t - sixfold_geometry::Vec3::new(0.01, -0.02, 1.0)).norm() < 1e-15);
        assert_eq!(gt[&3][1].obj_id, 9);
        let camera = parse_scene_camera(CAMERA.as_bytes(), path()).unwrap()[&3];
        assert!((camera.depth_scale.unwrap() - 1e-4).abs() < 1e-18);
        assert_eq!(camera.camera_from_world.unwrap().translation().z, 2.0);
        let info = parse_scene_gt_info(INFO.as_bytes(), path()).unwrap()[&3][0];
        assert_eq!(info.bbox_obj.unwrap().height, 4.0);
        assert_eq!((info.bbox_visib, info.px_count_visib), (None, Some(6)));
    }

    #[test]
    fn both_forms_of_targets() {
        let targets = parse_targets(
            br#"[{"im_id": 3, "inst_count": 2, "obj_id": 1, "scene_id": 2}, {"im_id": 4, "scene_id": 2}]"#,
            path(),
        )
        .unwrap();
        assert_eq!(targets[0].object, Some(TargetObject { obj_id: 1, inst_count: 2 }));
        assert_eq!(targets[1], Target { scene_id: 2, im_id: 4, object: None });
    }

    #[test]
    fn broken_fields_are_named_with_file_image_and_entry() {
        let cases = [
            (GT.replace("[0,-1,0,1,0,0,0,0,1]", "[0,-1,0,1,0,0,0,0,-1]"), "entry 1, field cam_R_m2c"),
            (GT.replace("[0,-1,0,1,0,0,0,0,1]", "[0,-1,0,1,0,0,0,0]"), "found a list of 8"),
            (GT.replace("[0,0,500]", "[0,null,500]"), "cam_t_m2c[1]: found null"),
            (GT.replace("\"obj_id\": 9", "\"obj_id\": -9"), "obj_id: found -9"),
            (GT.replace("\"obj_id\": 9", "\"obj\": 9"), "obj_id: found nothing"),
            (GT.replace("500", "NaN"), "not valid JSON"),
            (GT.replace("500", "1e999"), "not valid JSON"),
            (GT.replace("\"3\"", "\"three\""), "\"three\""),
            (GT[..80].to_owned(), "not valid JSON"),
        ];
        for (text, part) in cases {
            let message = parse_scene_gt(text.as_bytes(), path()).unwrap_err().to_string();
            assert!(message.contains(part), "{message} lacks {part}");
            assert!(message.contains("scene/file.json"), "{message}");
        }
        for (text, part) in [
            (CAMERA.replace("572.4", "0"), "im_id 3, field cam_K[0] (fx): found 0"),
            (CAMERA.replace("[572.4,0,", "[572.4,7,"), "cam_K[1]: found 7"),
            (CAMERA.replace("\"depth_scale\": 0.1", "\"depth_scale\": 0.0"), "depth_scale: found 0"),
            (CAMERA.replace("\"depth_scale\": 0.1", "\"depth_scale\": 1e-6"), "depth_scale"),
            (CAMERA.replace("cam_K", "cam_model"), "only pinhole"),
            (CAMERA.replace("572.4", "57.24"), "is a digit lost"),
            (
                CAMERA.replace("\"depth_scale\"", "\"dist_coeffs\": [0.1, 0, 0, 0], \"depth_scale\""),
                "dist_coeffs",
            ),
            (CAMERA.replace("\"depth_scale\"", "\"cam_model\": \"fisheye\", \"depth_scale\""), "pinhole"),
        ] {
            let message = parse_scene_camera(text.as_bytes(), path()).unwrap_err().to_string();
            assert!(message.contains(part), "{message} lacks {part}");
        }
        let message =
            parse_scene_gt_info(INFO.replace("0.5", "50").as_bytes(), path()).unwrap_err().to_string();
        assert!(message.contains("visib_fract: found 50"), "{message}");
        let message = parse_targets(br#"[{"im_id": 3}]"#, path()).unwrap_err().to_string();
        assert!(message.contains("entry 0, field scene_id: found nothing"), "{message}");
        assert!(parse_targets(b"{}", path()).is_err());
    }

    proptest! {
        #[test]
        fn mutated_files_never_panic(which in 0usize..3, at in 0usize..300, byte: u8, cut in 0usize..400) {
            let source = [GT, CAMERA, INFO][which].as_bytes();
            let mut text = source.to_vec();
            let at = at % text.len();
            text[at] = byte;
            text.truncate(cut.max(1));
            let _ = parse_scene_gt(&text, path());
            let _ = parse_scene_camera(&text, path());
            let _ = parse_scene_gt_info(&text, path());
            let _ = parse_targets(&text, path());
        }
    }
}
