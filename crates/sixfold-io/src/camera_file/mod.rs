//! Camera files: BOP's `camera.json` (fx fy cx cy), `cam_K` files and `scene_camera.json` with one image; OpenCV's `FileStorage` as
//! YAML, XML or JSON; ROS's `CameraInfo` and calibration files as YAML or JSON. The forms are in `docs/cameras.md`.

mod fields;
mod json;
mod xml;
mod yaml;

use std::path::{Path, PathBuf};

use serde_json::Value;
use sixfold_geometry::Camera;
use thiserror::Error;

use crate::limit::{check_pixels, max_pixels};

/// A camera file that cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CameraFileError {
    /// The system could not read it.
    #[error("camera file {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
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
    /// The content is not a valid camera, or not the image's.
    #[error("{}: {message}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// The field, what was found and expected, and what to do.
        message: String,
    },
}

/// A camera and the unit of its depth files.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraFile {
    /// The camera; its size is 1 x 1 if the file does not state it.
    pub camera: Camera,
    /// Whether the file stated the image size (otherwise the image decides).
    pub sized: bool,
    /// Millimetres per unit of the depth image.
    pub depth_scale: Option<f64>,
}

impl CameraFile {
    /// Reads a file with `fx fy cx cy` or a matrix (`cam_K`, `K`, `camera_matrix`), and perhaps image size, distortion and
    /// `depth_scale`; or a `scene_camera.json` of one image. JSON, YAML or XML, whatever the file's extension.
    ///
    /// # Errors
    /// [`CameraFileError`], also for an unknown key, and for a camera that no real lens has ([`Camera::check_whole_image`], if the
    /// file states the image's size).
    pub fn read(path: &Path) -> Result<CameraFile, CameraFileError> {
        let read = |source| CameraFileError::Read { path: path.into(), source };
        CameraFile::parse(&crate::read_regular(path, MAX_BYTES).map_err(read)?, path)
    }

    /// The same for a file's bytes; `path` is for messages.
    ///
    /// # Errors
    /// As [`CameraFile::read`].
    pub fn parse(bytes: &[u8], path: &Path) -> Result<CameraFile, CameraFileError> {
        let wrong = |message: String| CameraFileError::Content { path: path.into(), message };
        let text = str::from_utf8(bytes)
            .map_err(|_| wrong("found no text, expected JSON, YAML or XML".to_owned()))?;
        let file = fields::camera(&content(text, path)?).map_err(wrong)?;
        if file.sized {
            let (width, height) = (file.camera.width, file.camera.height);
            check_pixels(width, height, max_pixels())
                .map_err(|e| wrong(format!("fields width, height: {e}")))?;
            file.camera.check_whole_image().map_err(|error| wrong(error.to_string()))?;
        }
        Ok(file)
    }

    /// The camera for an image of this size; `file` is for the message.
    ///
    /// # Errors
    /// [`CameraFileError::Content`] if the file states another size, or if the intrinsics cannot belong to a whole image of this
    /// size ([`Camera::check_whole_image`]), for example in a wrong unit or for another resolution.
    pub fn for_image(&self, width: usize, height: usize, file: &Path) -> Result<Camera, CameraFileError> {
        let mut camera = self.camera;
        if !self.sized {
            (camera.width, camera.height) = (width, height);
        }
        let wrong = |message: String| CameraFileError::Content { path: file.into(), message };
        camera.check_image(width, height).map_err(|error| wrong(error.to_string()))?;
        camera.check_whole_image().map_err(|error| wrong(error.to_string()))?;
        Ok(camera)
    }
}

/// Largest camera file: calibrations that include their corners take a few MB.
const MAX_BYTES: u64 = 16 << 20;

/// The content of a file in one of three formats, which its first character distinguishes.
fn content(text: &str, path: &Path) -> Result<Value, CameraFileError> {
    let wrong = |message: String| CameraFileError::Content { path: path.into(), message };
    match text.trim_start_matches('\u{feff}').trim_start().chars().next() {
        Some('{' | '[') => json::parse(text.trim_start_matches('\u{feff}'))
            .map_err(|source| CameraFileError::Json { path: path.into(), source }),
        Some('<') => xml::parse(text.trim_start_matches('\u{feff}')).map_err(wrong),
        _ => yaml::parse(text).map_err(|reason| wrong(format!("neither JSON nor YAML nor XML: {reason}"))),
    }
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
    const SIZE: &str = r#""width": 640, "height": 480"#;

    fn message(text: &str) -> String {
        match read(text)
            .and_then(|f| f.for_image(640, 480, Path::new("camera.json")).map_err(|e| e.to_string()))
        {
            Ok(camera) => panic!("{text} is {camera:?}"),
            Err(message) => message,
        }
    }

    /// A focal length of half a pixel once gave a pose 597 m behind the camera.
    #[test]
    fn an_impossible_camera_is_refused_with_advice() {
        for size in ["", &format!(", {SIZE}")] {
            for (numbers, words) in [
                (r#""fx": 0.5, "fy": 0.5, "cx": 319.5, "cy": 239.5"#, "millimetres"),
                (r#""fx": 1e-5, "fy": 1e-5, "cx": 319.5, "cy": 239.5"#, "millimetres"),
                (r#""fx": 0.89, "fy": 1.19, "cx": 0.5, "cy": 0.5"#, "normalised"),
                (r#""fx": 572.4, "fy": 57.24, "cx": 319.5, "cy": 239.5"#, "factor of 2"),
                (r#""fx": 900, "fy": 900, "cx": 959.5, "cy": 539.5"#, "another resolution"),
                (r#""fx": 160, "fy": 160, "cx": 159.5, "cy": 119.5"#, "another resolution"),
            ] {
                let message = message(&format!("{{{numbers}{size}}}"));
                assert!(message.contains("camera.json") && message.contains("field"), "{message}");
                assert!(message.contains(words) && message.contains("expected"), "{message}");
            }
        }
        let large = r#"{"fx": 5e5, "fy": 5e5, "cx": 2e4, "cy": 2e4, "width": 40000, "height": 40000}"#;
        let message = read(large).unwrap_err();
        assert!(message.contains("camera"), "{message}");
    }

    /// `dist_coeffs` and a width without a height were once ignored.
    #[test]
    fn nothing_in_a_camera_file_is_ignored_in_silence() {
        let k = r#""cam_K": [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1]"#;
        for (more, words) in [
            (r#""width": 640"#, "height is missing"),
            (r#""image_height": 480"#, "width is missing"),
            (r#""lens": 3"#, "field lens is unknown; known are fx"),
            (r#""fx": 500"#, "fields fx and cam_K differ"),
            (r#""K": [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1]"#, "say the same"),
            (r#""cam_K": [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1]"#, "stands twice"),
            (r#""dist_coeffs": [0.1, 0, 0]"#, "found 3 numbers"),
            (r#""dist_coeffs": [0.1, 0, 0, 0, 0, 0.2, 0, 0]"#, "rational"),
            (r#""dist_coeffs": [0.1, 0, 0, 0], "D": []"#, "say the same"),
            (r#""distortion": {"k1": 0, "k2": 0, "p1": 0, "p2": 0, "k4": 1}"#, "k4 is unknown"),
            (r#""distortion_model": "equidistant", "D": [0, 0, 0, 0]"#, "fisheye"),
            (r#""distortion_model": "ftheta", "D": [1, 0, 0, 0]"#, "ftheta"),
            (r#""cam_model": {"ProjectionModelType": "CameraModelType.FISHEYE624"}"#, "pinhole"),
            (r#""binning_x": 2"#, "binning_x"),
            (r#""roi": {"x_offset": 10}"#, "roi"),
            (r#""distortion": [-50, 0, 0, 0]"#, "k1, k2, p1, p2, k3"),
        ] {
            let message = message(&format!("{{{k}, {more}}}"));
            assert!(message.contains("camera.json") && message.contains(words), "{message} lacks {words}");
        }
        let zeros = format!(
            r#"{{{k}, "D": [0, 0, 0, 0, 0, 0, 0, 0], "distortion_model": "rational_polynomial", "_why": 1}}"#
        );
        assert_eq!(read(&zeros).unwrap().camera.distortion, None);
        let uncalibrated = read(r#"{"K": [0, 0, 0, 0, 0, 0, 0, 0, 0]}"#).unwrap_err();
        assert!(uncalibrated.contains("calibrate"), "{uncalibrated}");
        assert!(
            read(r#"{"cam_K": [572.4, 0, 0, 0, 573.6, 0, 325.3, 242.0, 1]}"#)
                .unwrap_err()
                .contains("row by row")
        );
    }

    const OPENCV_YAML: &str = "%YAML:1.0\n---\ncalibration_time: \"Mon 23 Nov 2026\"\nimage_width: 640\nimage_height: 480\nflags: 0\n\
        camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 5.7240000000000000e+02, 0., 3.253e+02, 0.,\n       \
        573.6, 242., 0., 0., 1. ]\ndistortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n   \
        data: [ 0.1, -0.2, 1.0e-03,\n       0., 0.05 ]\navg_reprojection_error: 2.1e-01\n";
    const OPENCV_XML: &str = "<?xml version=\"1.0\"?>\n<opencv_storage>\n<image_width>640</image_width>\n<image_height>480</image_height>\n\
        <camera_matrix type_id=\"opencv-matrix\">\n  <rows>3</rows>\n  <cols>3</cols>\n  <dt>d</dt>\n  <data>\n    5.724e+02 0. 325.3 0.\n    \
        573.6 242. 0. 0. 1.</data></camera_matrix>\n<dist_coeffs type_id=\"opencv-matrix\">\n  <rows>1</rows>\n  <cols>5</cols>\n  \
        <dt>d</dt>\n  <data>\n    0.1 -0.2 1.0e-03 0. 0.05</data></dist_coeffs>\n<!-- done --></opencv_storage>\n";
    const ROS_CALIBRATION: &str = "image_width: 640\nimage_height: 480\ncamera_name: head_camera\ncamera_matrix:\n  rows: 3\n  cols: 3\n  \
        data: [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1]\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  \
        data: [0.1, -0.2, 0.001, 0, 0.05]\nrectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n\
        projection_matrix:\n  rows: 3\n  cols: 4\n  data: [575, 0, 326, 0, 0, 576, 243, 0, 0, 0, 1, 0]\n";
    const ROS_INFO: &str = "header: \n  seq: 12\n  stamp: \n    secs: 1\n    nsecs: 2\n  frame_id: \"camera # optical\"  # a comment\n\
        height: 480\nwidth: 640\ndistortion_model: \"plumb_bob\"\nD: [0.1, -0.2, 0.001, 0.0, 0.05]\n\
        K: [572.4, 0.0, 325.3, 0.0, 573.6, 242.0, 0.0, 0.0, 1.0]\nR: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n\
        P: [575.0, 0.0, 326.0, 0.0, 0.0, 576.0, 243.0, 0.0, 0.0, 0.0, 1.0, 0.0]\nbinning_x: 0\nbinning_y: 0\nroi: \n  x_offset: 0\n  \
        y_offset: 0\n  height: 0\n  width: 0\n  do_rectify: False\n---\n";
    const ROS2_INFO: &str = "header:\n  stamp: {sec: 1, nanosec: 2}\n  frame_id: camera\nheight: 480\nwidth: 640\n\
        distortion_model: plumb_bob\nd:\n- 0.1\n- -0.2\n- 0.001\n- 0.0\n- 0.05\nk:\n  - 572.4\n  - 0.0\n  - 325.3\n  - 0.0\n  - 573.6\n  \
        - 242.0\n  - 0.0\n  - 0.0\n  - 1.0\nbinning_x: 0\nbinning_y: 0\nroi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}\n";
    const ROS_JSON: &str = r#"{"header": {"seq": 1, "frame_id": "camera"}, "height": 480, "width": 640, "distortion_model": "plumb_bob",
        "D": [0.1, -0.2, 0.001, 0, 0.05], "K": [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1], "R": [1, 0, 0, 0, 1, 0, 0, 0, 1],
        "P": [575, 0, 326, 0, 0, 576, 243, 0, 0, 0, 1, 0], "binning_x": 0, "binning_y": 0}"#;
    const NUMPY: &str = r#"{"camera_matrix": [[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]],
        "dist_coeffs": [[0.1, -0.2, 0.001, 0.0, 0.05]], "width": 640, "height": 480}"#;

    /// The forms in which OpenCV and ROS write cameras, with their distortion.
    #[test]
    fn camera_files_of_opencv_and_ros() {
        let plain = r#"{"fx": 572.4, "fy": 573.6, "cx": 325.3, "cy": 242.0, "width": 640, "height": 480,
            "distortion": {"k1": 0.1, "k2": -0.2, "p1": 0.001, "p2": 0, "k3": 0.05}}"#;
        let expected = read(plain).unwrap();
        assert_eq!(expected.camera.distortion.unwrap().k3, 0.05);
        for text in [OPENCV_YAML, OPENCV_XML, ROS_CALIBRATION, ROS_INFO, ROS2_INFO, ROS_JSON, NUMPY] {
            assert_eq!(read(text), Ok(expected), "{text}");
        }
        for (text, words) in [
            (ROS_INFO.to_owned() + "height: 480\n", "second document"),
            (ROS2_INFO.replace("camera\n", "*camera\n"), "anchor or alias"),
            (ROS2_INFO.replace("d:\n", "d: !!python/tuple\n"), "tag !!python/tuple"),
            (ROS_CALIBRATION.replace("  rows", "\trows"), "tab"),
            (ROS_CALIBRATION.replace("image_height", "image_width"), "stands twice"),
            (ROS_CALIBRATION.replace("plumb_bob", "equidistant"), "equidistant is a fisheye"),
            (OPENCV_XML.replace("</opencv_storage>", ""), "</opencv_storage>"),
            (OPENCV_XML.replace("<?xml version=\"1.0\"?>", "<!DOCTYPE x>"), "DOCTYPE"),
            (OPENCV_YAML.replace("rows: 5", "rows: 4"), "expected 4 x 1"),
            ("fx 500".to_owned(), "key: value"),
        ] {
            let message = read(&text).unwrap_err();
            assert!(message.contains("camera.json") && message.contains(words), "{message} lacks {words}");
        }
        for deep in [
            "[".repeat(5000),
            "a:\n".to_owned() + &(1..5000).map(|n| " ".repeat(n) + "a:\n").collect::<String>(),
        ] {
            assert!(read(&deep).is_err() && read(&format!("x: {deep}")).is_err());
        }
        assert!(read(&"<a>".repeat(100_000)).is_err());
    }
}
