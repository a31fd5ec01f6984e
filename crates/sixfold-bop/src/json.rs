//! Typed access to JSON values, with errors that state the place in the file.

use std::path::Path;

use serde_json::{Map, Value};
use sixfold_geometry::{Mat3, Pose, Vec3};

use crate::dataset_error::{DatasetError, Place};

/// A value and its place in the file.
#[derive(Clone, Copy)]
pub(crate) struct At<'a> {
    pub path: &'a Path,
    pub place: Place,
}

/// A description of a value, short enough for a message.
pub(crate) fn describe(value: &Value) -> String {
    let text = match value {
        Value::Array(items) => return format!("a list of {}", items.len()),
        Value::Object(_) => return "an object".to_owned(),
        other => other.to_string(),
    };
    if text.chars().count() <= 60 { text } else { text.chars().take(57).chain("...".chars()).collect() }
}

pub(crate) fn parse(text: &[u8], path: &Path) -> Result<Value, DatasetError> {
    serde_json::from_slice(text).map_err(|source| DatasetError::Json { path: path.to_owned(), source })
}

impl<'a> At<'a> {
    pub(crate) fn file(path: &'a Path) -> Self {
        At { path, place: Place::default() }
    }

    pub(crate) fn image(path: &'a Path, im_id: u32) -> Self {
        At { path, place: Place { im_id: Some(im_id), index: None } }
    }

    pub(crate) fn entry(mut self, index: usize) -> Self {
        self.place.index = Some(index);
        self
    }

    pub(crate) fn error(
        &self,
        field: impl Into<String>,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> DatasetError {
        DatasetError::Field {
            path: self.path.to_owned(),
            place: self.place,
            field: field.into(),
            found: found.into(),
            expected: expected.into(),
        }
    }

    pub(crate) fn object<'v>(&self, value: &'v Value) -> Result<&'v Map<String, Value>, DatasetError> {
        value.as_object().ok_or_else(|| self.error("(whole)", describe(value), "an object { ... }"))
    }

    pub(crate) fn list<'v>(&self, value: &'v Value) -> Result<&'v Vec<Value>, DatasetError> {
        value.as_array().ok_or_else(|| self.error("(whole)", describe(value), "a list [ ... ]"))
    }

    pub(crate) fn get<'v>(
        &self,
        map: &'v Map<String, Value>,
        field: &str,
        expected: &str,
    ) -> Result<&'v Value, DatasetError> {
        map.get(field).ok_or_else(|| self.error(field, "nothing", expected))
    }

    pub(crate) fn number(&self, field: &str, value: &Value) -> Result<f64, DatasetError> {
        value
            .as_f64()
            .filter(|v| v.is_finite())
            .ok_or_else(|| self.error(field, describe(value), "a finite number"))
    }

    pub(crate) fn id(&self, field: &str, value: &Value) -> Result<u32, DatasetError> {
        value
            .as_u64()
            .and_then(|v| u32::try_from(v).ok())
            .ok_or_else(|| self.error(field, describe(value), "a whole number from 0 to 4294967295"))
    }

    pub(crate) fn numbers<const N: usize>(
        &self,
        field: &str,
        value: &Value,
    ) -> Result<[f64; N], DatasetError> {
        let expected = || format!("a list of {N} numbers");
        let items = value.as_array().ok_or_else(|| self.error(field, describe(value), expected()))?;
        if items.len() != N {
            return Err(self.error(field, describe(value), expected()));
        }
        let mut out = [0.0; N];
        for (i, item) in items.iter().enumerate() {
            out[i] = self.number(&format!("{field}[{i}]"), item)?;
        }
        Ok(out)
    }

    /// A pose from a row-major rotation and a translation in millimetres, both in `map`; and the rotation as it is
    /// written there.
    pub(crate) fn pose_mm(
        &self,
        map: &Map<String, Value>,
        rotation: &str,
        translation: &str,
    ) -> Result<(Pose, Mat3), DatasetError> {
        let r: [f64; 9] =
            self.numbers(rotation, self.get(map, rotation, "a rotation, 9 numbers row by row")?)?;
        let t: [f64; 3] =
            self.numbers(translation, self.get(map, translation, "a translation, 3 numbers in mm")?)?;
        let written = Mat3::from_row_slice(&r);
        let pose = Pose::from_parts(&written, Vec3::from(t) / 1000.0).map_err(|reason| {
            self.error(rotation, format!("{r:?} ({reason})"), "a rotation: orthonormal, determinant 1")
        })?;
        Ok((pose, written))
    }
}

/// The keys of an object as image ids, in ascending order.
pub(crate) fn by_image<'v>(
    value: &'v Value,
    path: &Path,
) -> Result<std::collections::BTreeMap<u32, &'v Value>, DatasetError> {
    let at = At::file(path);
    let mut images = std::collections::BTreeMap::new();
    for (key, entry) in at.object(value)? {
        let im_id: u32 = key
            .trim()
            .parse()
            .map_err(|_| at.error("(key)", format!("{key:?}"), "an image id, a whole number in quotes"))?;
        images.insert(im_id, entry);
    }
    Ok(images)
}
