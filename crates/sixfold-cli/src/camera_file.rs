//! Camera files: BOP's `camera.json` (fx fy cx cy), `cam_K` files, and `scene_camera.json` with one image.

use std::path::Path;

use anyhow::{Context, Result, anyhow, bail};
use serde_json::Value;
use sixfold_geometry::{BrownConrady, Camera};

/// A camera and what its depth files mean.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CameraFile {
    pub camera: Camera,
    /// Whether the file stated the image size (otherwise the image decides).
    pub sized: bool,
    /// Millimetres per unit of the depth image.
    pub depth_scale: Option<f64>,
}

impl CameraFile {
    /// The camera for an image of this size.
    pub fn for_image(&self, width: usize, height: usize, file: &Path) -> Result<Camera> {
        let mut camera = self.camera;
        if !self.sized {
            (camera.width, camera.height) = (width, height);
        }
        camera.check_image(width, height).with_context(|| file.display().to_string())?;
        let (cx, cy) = (camera.cx / width as f64, camera.cy / height as f64);
        if !(0.1..=0.9).contains(&cx) || !(0.1..=0.9).contains(&cy) {
            bail!(
                "{}: fields cx, cy: found {}, {}, expected near the middle of the {width}x{height} image: \
                 intrinsics of another resolution? Scale them, or give the right image",
                file.display(),
                camera.cx,
                camera.cy
            );
        }
        Ok(camera)
    }
}

pub(crate) fn read(path: &Path) -> Result<CameraFile> {
    let text = std::fs::read_to_string(path).with_context(|| format!("camera file {}", path.display()))?;
    let value: Value =
        serde_json::from_str(&text).with_context(|| format!("{}: not JSON", path.display()))?;
    parse(&value).with_context(|| path.display().to_string())
}

fn parse(value: &Value) -> Result<CameraFile> {
    let object = value.as_object().ok_or_else(|| anyhow!("expected a JSON object"))?;
    // scene_camera.json: one entry per image.
    if !object.is_empty() && object.keys().all(|k| k.parse::<u32>().is_ok()) {
        if object.len() > 1 {
            bail!(
                "holds the cameras of {} images: give a file for one image, or use --dataset",
                object.len()
            );
        }
        if let Some(inner) = object.values().next() {
            return parse(inner);
        }
    }
    let number = |field: &str| -> Result<Option<f64>> {
        match object.get(field) {
            None | Some(Value::Null) => Ok(None),
            Some(v) => match v.as_f64() {
                Some(x) if x.is_finite() => Ok(Some(x)),
                _ => bail!("field {field}: found {v}, expected a number"),
            },
        }
    };
    let (fx, fy, cx, cy) = if let Some(k) = object.get("cam_K") {
        let k: Vec<f64> = k
            .as_array()
            .and_then(|a| a.iter().map(Value::as_f64).collect())
            .ok_or_else(|| anyhow!("field cam_K: found {k}, expected nine numbers"))?;
        if k.len() != 9 {
            bail!("field cam_K: found {} numbers, expected nine", k.len());
        }
        if k[1].abs() > 1e-6 {
            bail!("field cam_K: found a skew of {}, expected 0", k[1]);
        }
        (k[0], k[4], k[2], k[5])
    } else {
        let need = |field: &str| {
            number(field)?
                .ok_or_else(|| anyhow!("field {field} is missing: expected fx, fy, cx, cy or cam_K"))
        };
        (need("fx")?, need("fy")?, need("cx")?, need("cy")?)
    };
    let size = |field: &str| -> Result<Option<usize>> {
        match object.get(field) {
            None => Ok(None),
            Some(v) => match v.as_u64() {
                Some(n) if n > 0 => Ok(Some(n as usize)),
                _ => bail!("field {field}: found {v}, expected a whole number above 0"),
            },
        }
    };
    let (width, height) = (size("width")?, size("height")?);
    let sized = width.is_some() && height.is_some();
    let distortion = match object.get("distortion") {
        None | Some(Value::Null) => None,
        Some(v) => Some(serde_json::from_value::<BrownConrady>(v.clone()).context("field distortion")?),
    };
    let camera =
        Camera { fx, fy, cx, cy, width: width.unwrap_or(1), height: height.unwrap_or(1), distortion };
    camera.check()?;
    let depth_scale = number("depth_scale")?;
    if depth_scale.is_some_and(|s| s <= 0.0) {
        bail!("field depth_scale: found {}, expected above 0", depth_scale.unwrap_or_default());
    }
    Ok(CameraFile { camera, sized, depth_scale })
}
