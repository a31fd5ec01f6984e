//! Camera files: BOP's `camera.json` (fx fy cx cy), `cam_K` files, and `scene_camera.json` with one image.

use std::path::{Path, PathBuf};

use serde_json::Value;
use sixfold_geometry::{BrownConrady, Camera};
use thiserror::Error;

/// A camera file that cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CameraFileError {
    /// The system could not read it.
    #[error("camera file {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// It is not JSON.
    #[error("{}: not JSON: {source}", path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// What and where.
        source: serde_json::Error,
    },
    /// What it says is no camera, or none of the image.
    #[error("{}: {message}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// The field, what was found and expected, and what to do.
        message: String,
    },
}

/// A camera and what its depth files mean.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraFile {
    /// The camera; its size is 1 x 1 where the file does not say it.
    pub camera: Camera,
    /// Whether the file stated the image size (otherwise the image decides).
    pub sized: bool,
    /// Millimetres per unit of the depth image.
    pub depth_scale: Option<f64>,
}

impl CameraFile {
    /// Reads a file with `fx fy cx cy` or `cam_K`, and perhaps `width`, `height`, `distortion` and `depth_scale`; or a
    /// `scene_camera.json` of one image.
    ///
    /// # Errors
    /// [`CameraFileError`].
    pub fn read(path: &Path) -> Result<CameraFile, CameraFileError> {
        let text = crate::read_regular_text(path, crate::limits::SMALL_TEXT)
            .map_err(|source| CameraFileError::Read { path: path.into(), source })?;
        let value: Value = serde_json::from_str(&text)
            .map_err(|source| CameraFileError::Json { path: path.into(), source })?;
        parse(&value).map_err(|message| CameraFileError::Content { path: path.into(), message })
    }

    /// The camera for an image of this size; `file` is for the message.
    ///
    /// # Errors
    /// [`CameraFileError::Content`] where the file states another size, or where the optical axis would lie far from the
    /// image's centre: intrinsics of another resolution.
    pub fn for_image(&self, width: usize, height: usize, file: &Path) -> Result<Camera, CameraFileError> {
        let mut camera = self.camera;
        if !self.sized {
            (camera.width, camera.height) = (width, height);
        }
        let wrong = |message: String| CameraFileError::Content { path: file.into(), message };
        camera.check_image(width, height).map_err(|error| wrong(error.to_string()))?;
        let (cx, cy) = (camera.cx / width as f64, camera.cy / height as f64);
        if !(0.1..=0.9).contains(&cx) || !(0.1..=0.9).contains(&cy) {
            return Err(wrong(format!(
                "fields cx, cy: found {}, {}, expected near the middle of the {width}x{height} image: intrinsics of another \
                 resolution? Scale them, or give the right image",
                camera.cx, camera.cy
            )));
        }
        Ok(camera)
    }
}

fn parse(value: &Value) -> Result<CameraFile, String> {
    let object = value.as_object().ok_or("expected a JSON object")?;
    // scene_camera.json: one entry per image.
    if !object.is_empty() && object.keys().all(|k| k.parse::<u32>().is_ok()) {
        if object.len() > 1 {
            return Err(format!(
                "holds the cameras of {} images: give a file for one image, or use the dataset it belongs to",
                object.len()
            ));
        }
        if let Some(inner) = object.values().next() {
            return parse(inner);
        }
    }
    let number = |field: &str| -> Result<Option<f64>, String> {
        match object.get(field) {
            None | Some(Value::Null) => Ok(None),
            Some(v) => match v.as_f64() {
                Some(x) if x.is_finite() => Ok(Some(x)),
                _ => Err(format!("field {field}: found {v}, expected a number")),
            },
        }
    };
    let (fx, fy, cx, cy) = if let Some(k) = object.get("cam_K") {
        let k: Vec<f64> = k
            .as_array()
            .and_then(|a| a.iter().map(Value::as_f64).collect())
            .ok_or_else(|| format!("field cam_K: found {k}, expected nine numbers"))?;
        if k.len() != 9 {
            return Err(format!("field cam_K: found {} numbers, expected nine", k.len()));
        }
        if k[1].abs() > 1e-6 {
            return Err(format!("field cam_K: found a skew of {}, expected 0", k[1]));
        }
        (k[0], k[4], k[2], k[5])
    } else {
        let need = |field: &str| {
            number(field)?
                .ok_or_else(|| format!("field {field} is missing: expected fx, fy, cx, cy or cam_K"))
        };
        (need("fx")?, need("fy")?, need("cx")?, need("cy")?)
    };
    let size = |field: &str| -> Result<Option<usize>, String> {
        match object.get(field) {
            None => Ok(None),
            Some(v) => match v.as_u64() {
                Some(n) if n > 0 => Ok(Some(n as usize)),
                _ => Err(format!("field {field}: found {v}, expected a whole number above 0")),
            },
        }
    };
    let (width, height) = (size("width")?, size("height")?);
    let sized = width.is_some() && height.is_some();
    let distortion = match object.get("distortion") {
        None | Some(Value::Null) => None,
        Some(v) => Some(
            serde_json::from_value::<BrownConrady>(v.clone())
                .map_err(|error| format!("field distortion: {error}"))?,
        ),
    };
    let camera =
        Camera { fx, fy, cx, cy, width: width.unwrap_or(1), height: height.unwrap_or(1), distortion };
    camera.check().map_err(|error| error.to_string())?;
    let depth_scale = number("depth_scale")?;
    if depth_scale.is_some_and(|s| s <= 0.0) {
        return Err(format!(
            "field depth_scale: found {}, expected above 0",
            depth_scale.unwrap_or_default()
        ));
    }
    Ok(CameraFile { camera, sized, depth_scale })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<CameraFile, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("camera.json");
        std::fs::write(&path, text).unwrap();
        CameraFile::read(&path).map_err(|error| error.to_string())
    }

    #[test]
    fn all_kinds_of_camera_files() {
        let plain = read(r#"{"fx": 300, "fy": 310, "cx": 159.5, "cy": 119.5, "depth_scale": 0.1}"#).unwrap();
        assert_eq!((plain.camera.fx, plain.sized, plain.depth_scale), (300.0, false, Some(0.1)));
        let camera = plain.for_image(320, 240, Path::new("c")).unwrap();
        assert_eq!((camera.width, camera.height), (320, 240));
        let error = plain.for_image(64, 48, Path::new("c.json")).unwrap_err().to_string();
        assert!(error.contains("c.json") && error.contains("another resolution"), "{error}");
        let matrix = r#"{"cam_K": [300, 0, 159.5, 0, 310, 119.5, 0, 0, 1], "width": 320, "height": 240}"#;
        let sized = read(matrix).unwrap();
        assert_eq!(sized.for_image(320, 240, Path::new("c")).unwrap(), camera);
        assert!(sized.for_image(640, 480, Path::new("c")).is_err());
        let one = read(&format!("{{\"7\": {matrix}}}")).unwrap();
        assert_eq!(one, sized);
        let two = read(&format!("{{\"7\": {matrix}, \"8\": {matrix}}}")).unwrap_err();
        assert!(two.contains("camera.json") && two.contains("2 images"), "{two}");
        let lens = r#"{"fx": 300, "fy": 310, "cx": 159.5, "cy": 119.5, "distortion": {"k1": true}}"#;
        assert!(read(lens).unwrap_err().contains("field distortion"));
    }
}
