//! An experience as a row of a table, for all databases.

use sixfold_geometry::{Camera, Vec3};
use sixfold_grasp::{Gripper, parse_gripper};

use super::StoreError;
use super::encode::{self, Images};
use super::experience::{Copy, Experience};
use crate::Extent;

/// Tests an experience before it is stored; returns its images and a key that is equal for equal experiences.
///
/// # Errors
/// [`StoreError::Field`].
pub(super) fn prepare(e: &Experience) -> Result<(Images, [u8; 16]), StoreError> {
    e.check()?;
    let images = encode::images(&e.crop).ok_or_else(|| StoreError::Field {
        id: 0,
        field: "crop",
        expected: "images that can be written as PNG",
        found: format!("{} pixels a side", e.crop.side),
    })?;
    // Without the time, so that an experience stored again after an interruption is recognised as the same.
    let key = encode::key(&[
        &images.depth,
        &images.vd_noc,
        &encode::rounded(&e.camera_from_gripper),
        &e.opening.to_le_bytes(),
        e.object.as_bytes(),
        e.part.as_deref().unwrap_or_default().as_bytes(),
        e.gripper.name.as_bytes(),
        e.network.as_bytes(),
        e.provenance.as_bytes(),
    ]);
    Ok((images, key))
}

/// A gripper as the text of a gripper file, including its kind.
pub(super) fn gripper_text(gripper: &Gripper) -> String {
    let mut value = serde_json::to_value(gripper).unwrap_or_default();
    value["kind"] = "parallel-jaws".into();
    value.to_string()
}

/// The gripper's name in such a text.
pub(super) fn gripper_name(text: &str) -> String {
    let value = serde_json::from_str::<serde_json::Value>(text).unwrap_or_default();
    value["name"].as_str().unwrap_or_default().to_owned()
}

/// The columns of an experience before decoding.
pub(super) struct Raw {
    pub time: i64,
    pub object: String,
    pub part: Option<String>,
    pub gripper: String,
    pub opening: f64,
    pub width: f64,
    pub pose: Vec<u8>,
    pub camera: Vec<u8>,
    pub side: i64,
    pub extent: Vec<u8>,
    pub images: Images,
    pub region: Vec<u8>,
    pub network: String,
    pub provenance: String,
    pub table_plane: Option<Vec<u8>>,
}

impl Raw {
    /// Decodes the experience and tests every column.
    ///
    /// # Errors
    /// [`StoreError::Field`].
    pub(crate) fn understand(self, id: i64, copies: Vec<Copy>) -> Result<Experience, StoreError> {
        let wrong = |field, expected, found: String| StoreError::Field { id, field, expected, found };
        let side = usize::try_from(self.side)
            .ok()
            .filter(|s| (8..=1024).contains(s))
            .ok_or_else(|| wrong("side", "8 to 1024 pixels", self.side.to_string()))?;
        let numbers = encode::doubles(&self.camera);
        let &[fx, fy, cx, cy] = numbers.as_slice() else {
            return Err(wrong("camera", "four numbers", numbers.len().to_string()));
        };
        let camera = Camera::new(fx, fy, cx, cy, side, side)
            .map_err(|e| wrong("camera", "a camera", e.to_string()))?;
        let extent = encode::doubles(&self.extent);
        if extent.len() != 6 || !extent.iter().all(|v| v.is_finite()) {
            return Err(wrong("extent", "six finite numbers", format!("{extent:?}")));
        }
        let extent = Extent {
            centre: Vec3::from_column_slice(&extent[..3]),
            half: Vec3::from_column_slice(&extent[3..]),
        };
        let table = match &self.table_plane {
            Some(bytes) => Some(encode::from_plane(bytes).ok_or_else(|| {
                wrong("table_plane", "a unit normal and an offset", bytes.len().to_string())
            })?),
            None => None,
        };
        let crop = encode::crop(&self.images, &camera, extent, table)
            .map_err(|(field, found)| wrong(field, "a PNG image of the crop's size", found))?;
        let pose = encode::from_pose(&self.pose).ok_or_else(|| {
            wrong("camera_from_gripper", "a pose of 16 numbers", self.pose.len().to_string())
        })?;
        let region = encode::from_bits(&self.region, side * side)
            .ok_or_else(|| wrong("region", "one bit a pixel", self.region.len().to_string()))?;
        let gripper = parse_gripper(&self.gripper, "gripper")
            .map_err(|e| wrong("gripper", "a gripper", e.to_string()))?;
        let experience = Experience {
            crop,
            camera_from_gripper: pose,
            opening: self.opening,
            width: self.width,
            region,
            copies,
            network: self.network,
            gripper,
            object: self.object,
            part: self.part,
            time: self.time,
            provenance: self.provenance,
        };
        // The checks made before storing are repeated after reading: a file may have been changed by other programs.
        experience.check().map_err(|error| match error {
            StoreError::Field { field, expected, found, .. } => {
                StoreError::Field { id, field, expected, found }
            }
            other => other,
        })?;
        Ok(experience)
    }
}
