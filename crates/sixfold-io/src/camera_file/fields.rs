//! Conversion of the keys and values of a camera file to a camera, whatever program wrote it.
//!
//! Keys are compared in lower case and without underscores, so that `camera_matrix`, `Camera_Matrix` and `cameraMatrix` are the
//! same. A key that is neither used nor known to be irrelevant is refused, since it may be important.

use std::collections::BTreeMap;

use serde_json::{Map, Value};
use sixfold_geometry::{BrownConrady, Camera};

use super::CameraFile;

/// Keys of the intrinsic matrix: BOP; ROS and ROS 2; OpenCV and ROS's calibration files.
const MATRIX: [&str; 3] = ["camk", "k", "cameramatrix"];
/// Keys of the distortion: ours; OpenCV and ROS's calibration files; ROS and ROS 2.
const DISTORTION: [&str; 5] = ["distortion", "distcoeffs", "distortioncoefficients", "distortioncoeffs", "d"];
const WIDTH: [&str; 2] = ["width", "imagewidth"];
const HEIGHT: [&str; 2] = ["height", "imageheight"];
/// Other keys that are read.
const SINGLE: [&str; 6] = ["fx", "fy", "cx", "cy", "depthscale", "distortionmodel"];
/// Keys without influence on the projection.
const WITHOUT_INFLUENCE: [&str; 35] = [
    // The camera's pose, and BOP's notes on how an image was taken.
    "camrw2c",
    "camtw2c",
    "mode",
    "elev",
    "viewlevel",
    // Names and notes.
    "name",
    "cameraname",
    "label",
    "comment",
    "comments",
    "description",
    "note",
    "notes",
    "date",
    "time",
    "serial",
    "serialnumber",
    // ROS: the time stamp, and the rectified image, which differs from the raw image that K and D describe.
    "header",
    "r",
    "p",
    "rectificationmatrix",
    "projectionmatrix",
    // OpenCV's calibration: its inputs and its error.
    "calibrationtime",
    "nframes",
    "nrofframes",
    "boardwidth",
    "boardheight",
    "squaresize",
    "aspectratio",
    "flags",
    "avgreprojectionerror",
    "perviewreprojectionerrors",
    "extrinsicparameters",
    "imagepoints",
    "gridpoints",
];
const KNOWN: &str = "fx, fy, cx, cy or a matrix (cam_K, K, camera_matrix); width, height; distortion (distortion, dist_coeffs, \
                     distortion_coefficients, D), distortion_model; depth_scale; a comment begins with _";
/// Advice for a lens that the model does not cover.
const RECTIFY: &str = "undistort the images first (OpenCV, ROS image_proc) and give the camera of the undistorted images, without \
                       distortion";

/// The fields of a file, by their keys in lower case without underscores.
struct Fields<'a>(BTreeMap<String, (&'a str, &'a Value)>);

fn found(value: &Value) -> String {
    match value {
        Value::Array(items) => format!("a list of {}", items.len()),
        Value::Object(_) => "an object".to_owned(),
        other => other.to_string().chars().take(60).collect(),
    }
}

impl<'a> Fields<'a> {
    fn of(object: &'a Map<String, Value>) -> Result<Fields<'a>, String> {
        let mut fields: BTreeMap<String, (&str, &Value)> = BTreeMap::new();
        for (key, value) in object {
            if key.starts_with('_') {
                continue;
            }
            let plain = key.to_lowercase().replace('_', "");
            check_key(key, &plain, value)?;
            if let Some((other, _)) = fields.insert(plain, (key, value)) {
                return Err(format!("fields {other} and {key} say the same; remove one of them"));
            }
        }
        Ok(Fields(fields))
    }

    /// The field under one of several keys; `None` if it is missing or null.
    fn one_of(&self, keys: &[&str]) -> Result<Option<(&'a str, &'a Value)>, String> {
        let mut present =
            keys.iter().filter_map(|key| self.0.get(*key)).filter(|(_, value)| !value.is_null());
        let first = present.next().copied();
        match (first, present.next()) {
            (Some((one, _)), Some((other, _))) => {
                Err(format!("fields {one} and {other} say the same; remove one of them"))
            }
            _ => Ok(first),
        }
    }

    fn number(&self, key: &str) -> Result<Option<f64>, String> {
        let Some((key, value)) = self.one_of(&[key])? else { return Ok(None) };
        match value.as_f64() {
            Some(number) if number.is_finite() => Ok(Some(number)),
            _ => Err(format!("field {key}: found {}, expected a number", found(value))),
        }
    }

    fn size(&self, keys: &[&str]) -> Result<Option<usize>, String> {
        let Some((key, value)) = self.one_of(keys)? else { return Ok(None) };
        match value.as_u64() {
            Some(n) if n > 0 && n <= 1 << 20 => Ok(Some(n as usize)),
            _ => Err(format!(
                "field {key}: found {}, expected a whole number of pixels from 1 to 1048576",
                found(value)
            )),
        }
    }
}

/// Refuses keys that are not read and may matter.
fn check_key(key: &str, plain: &str, value: &Value) -> Result<(), String> {
    let read = [&MATRIX[..], &DISTORTION, &WIDTH, &HEIGHT, &SINGLE, &WITHOUT_INFLUENCE];
    if read.iter().any(|keys| keys.contains(&plain)) {
        return Ok(());
    }
    let number = value.as_f64();
    match plain {
        "binningx" | "binningy" if number.is_some_and(|n| n == 0.0 || n == 1.0) => Ok(()),
        "roi" if window_is_whole(value) => Ok(()),
        "binningx" | "binningy" | "roi" => Err(format!(
            "field {key}: the image is a part of the sensor's or binned, and K counts the sensor's pixels; scale and shift K to \
             the image, and remove the field"
        )),
        "fisheyemodel" if number == Some(0.0) || value == &Value::Bool(false) => Ok(()),
        "fisheyemodel" => Err(format!("field {key}: a fisheye lens is not a pinhole camera; {RECTIFY}")),
        "cammodel" | "cameramodel" if value.as_str() == Some("pinhole") => Ok(()),
        "cammodel" | "cameramodel" => {
            Err(format!("field {key}: found {}, expected \"pinhole\"; {RECTIFY}", found(value)))
        }
        _ => Err(format!("field {key} is unknown; known are {KNOWN}")),
    }
}

/// Whether ROS's region of interest is the whole image: all of its numbers 0.
fn window_is_whole(value: &Value) -> bool {
    let zero = |v: &Value| v.as_f64() == Some(0.0) || v == &Value::Bool(false);
    value.as_object().is_some_and(|roi| roi.values().all(zero))
}

/// Numbers from a list, from rows, or from the `data` of OpenCV's and ROS's matrices.
fn numbers(key: &str, value: &Value) -> Result<Vec<f64>, String> {
    let wrong = || format!("field {key}: found {}, expected numbers", found(value));
    match value {
        Value::Array(items) => {
            let rows = items.iter().map(|item| match item {
                Value::Array(_) => numbers(key, item),
                _ => item
                    .as_f64()
                    .map(|n| vec![n])
                    .ok_or_else(|| format!("field {key}: found {}, expected a number", found(item))),
            });
            rows.collect::<Result<Vec<_>, _>>().map(|rows| rows.concat())
        }
        Value::Object(matrix) => {
            let data = numbers(key, matrix.get("data").ok_or_else(wrong)?)?;
            let side = |name: &str| matrix.get(name).map(|v| v.as_u64().ok_or_else(wrong)).transpose();
            if let (Some(rows), Some(columns)) = (side("rows")?, side("cols")?)
                && rows.checked_mul(columns) != Some(data.len() as u64)
            {
                return Err(format!(
                    "field {key}: found {} numbers, expected {rows} x {columns}",
                    data.len()
                ));
            }
            Ok(data)
        }
        // A matrix of one number, in XML.
        Value::Number(number) => Ok(number.as_f64().into_iter().collect()),
        _ => Err(wrong()),
    }
}

/// Focal lengths and principal point of a matrix.
fn of_matrix(key: &str, value: &Value) -> Result<[f64; 4], String> {
    let k: [f64; 9] = numbers(key, value).and_then(|k| {
        k.try_into().map_err(|k: Vec<f64>| format!("field {key}: found {} numbers, expected nine", k.len()))
    })?;
    if k[0] == 0.0 && k[4] == 0.0 {
        return Err(format!(
            "field {key}: found fx and fy of 0, as of a camera that was never calibrated; calibrate it"
        ));
    }
    if k[1].abs() > 1e-6 {
        return Err(format!("field {key}: found a skew of {}, expected 0", k[1]));
    }
    for (i, expected) in [(3, 0.0), (6, 0.0), (7, 0.0), (8, 1.0)] {
        if (k[i] - expected).abs() > 1e-6 {
            return Err(format!(
                "field {key}: found {} as number {}, expected {expected}: the matrix is fx 0 cx, 0 fy cy, 0 0 1, row by row",
                k[i],
                i + 1
            ));
        }
    }
    Ok([k[0], k[4], k[2], k[5]])
}

fn intrinsics(fields: &Fields<'_>) -> Result<[f64; 4], String> {
    let names = ["fx", "fy", "cx", "cy"];
    let Some((key, value)) = fields.one_of(&MATRIX)? else {
        let mut all = [0.0; 4];
        for (number, name) in all.iter_mut().zip(names) {
            *number = fields
                .number(name)?
                .ok_or_else(|| format!("field {name} is missing: expected fx, fy, cx, cy or cam_K"))?;
        }
        return Ok(all);
    };
    let all = of_matrix(key, value)?;
    for (number, name) in all.iter().zip(names) {
        if fields.number(name)?.is_some_and(|other| other != *number) {
            return Err(format!("fields {name} and {key} differ; remove one of them"));
        }
    }
    Ok(all)
}

/// The coefficients, in OpenCV's order or by name; `None` if there are none or all are zero.
fn distortion(fields: &Fields<'_>) -> Result<Option<BrownConrady>, String> {
    let model = match fields.one_of(&["distortionmodel"])? {
        None => String::new(),
        Some((_, Value::String(model))) => model.to_lowercase(),
        Some((key, other)) => return Err(format!("field {key}: found {}, expected plumb_bob", found(other))),
    };
    // Even with coefficients of zero this is not a pinhole camera.
    if matches!(model.as_str(), "equidistant" | "fisheye" | "kannala_brandt" | "kannala_brandt4" | "omni") {
        return Err(format!(
            "field distortion_model: {model} is a fisheye lens, expected plumb_bob; {RECTIFY}"
        ));
    }
    let Some((key, value)) = fields.one_of(&DISTORTION)? else { return Ok(None) };
    if let Value::Object(named) = value
        && !named.contains_key("data")
    {
        return by_name(key, named).map(non_zero);
    }
    let c = numbers(key, value)?;
    if let Some(bad) = c.iter().find(|c| !c.is_finite()) {
        return Err(format!("field {key}: found {bad}, expected finite numbers"));
    }
    if c.iter().all(|c| *c == 0.0) {
        return Ok(None);
    }
    match model.as_str() {
        "" | "plumb_bob" | "brown_conrady" | "radtan" | "rational_polynomial" => {}
        other => {
            return Err(format!("field distortion_model: found {other:?}, expected plumb_bob; {RECTIFY}"));
        }
    }
    if ![4, 5, 8, 12, 14].contains(&c.len()) {
        return Err(format!(
            "field {key}: found {} numbers, expected k1, k2, p1, p2 and perhaps k3",
            c.len()
        ));
    }
    if let Some(more) = c.get(5..).filter(|more| more.iter().any(|c| *c != 0.0)) {
        let name = match more.len() {
            3 => "rational (k4 to k6)",
            7 => "thin prism (s1 to s4)",
            _ => "tilted (s1 to s4, tau)",
        };
        return Err(format!(
            "field {key}: found a {name} lens model, expected k1, k2, p1, p2, k3; {RECTIFY}"
        ));
    }
    Ok(Some(BrownConrady { k1: c[0], k2: c[1], p1: c[2], p2: c[3], k3: c.get(4).copied().unwrap_or(0.0) }))
}

fn by_name(key: &str, named: &Map<String, Value>) -> Result<BrownConrady, String> {
    for name in named.keys() {
        if !["k1", "k2", "p1", "p2", "k3"].contains(&name.as_str()) {
            return Err(format!("field {key}: {name} is unknown; known are k1, k2, p1, p2, k3"));
        }
    }
    let number = |name: &str| match named.get(name) {
        None if name == "k3" => Ok(0.0),
        None => Err(format!("field {key}: {name} is missing; expected k1, k2, p1, p2 and perhaps k3")),
        Some(value) => value
            .as_f64()
            .ok_or_else(|| format!("field {key}: {name}: found {}, expected a number", found(value))),
    };
    Ok(BrownConrady {
        k1: number("k1")?,
        k2: number("k2")?,
        p1: number("p1")?,
        p2: number("p2")?,
        k3: number("k3")?,
    })
}

fn non_zero(d: BrownConrady) -> Option<BrownConrady> {
    (d != BrownConrady::default()).then_some(d)
}

/// The camera of a file's content.
///
/// # Errors
/// A message with the field, the values found and expected, and advice.
pub(super) fn camera(value: &Value) -> Result<CameraFile, String> {
    let object = value.as_object().ok_or("expected a JSON object, or the keys of a YAML or XML file")?;
    // scene_camera.json: one entry per image.
    if !object.is_empty() && object.keys().all(|k| k.parse::<u32>().is_ok()) {
        if object.len() > 1 {
            return Err(format!(
                "holds the cameras of {} images: give a file for one image, or use the dataset it belongs to",
                object.len()
            ));
        }
        if let Some(inner) = object.values().next() {
            return camera(inner);
        }
    }
    let fields = Fields::of(object)?;
    let [fx, fy, cx, cy] = intrinsics(&fields)?;
    let distortion = distortion(&fields)?;
    let (width, height) = match (fields.size(&WIDTH)?, fields.size(&HEIGHT)?) {
        (Some(_), None) => {
            return Err("field height is missing: expected both width and height, or neither".to_owned());
        }
        (None, Some(_)) => {
            return Err("field width is missing: expected both width and height, or neither".to_owned());
        }
        sides => sides,
    };
    let sized = width.is_some();
    let camera =
        Camera { fx, fy, cx, cy, width: width.unwrap_or(1), height: height.unwrap_or(1), distortion };
    camera.check().map_err(|error| error.to_string())?;
    let depth_scale = fields.number("depthscale")?;
    if let Some(scale) = depth_scale.filter(|s| *s <= 0.0) {
        return Err(format!("field depth_scale: found {scale}, expected above 0"));
    }
    Ok(CameraFile { camera, sized, depth_scale })
}
