//! One experience: the crop of the depth image, the grasp, and further data about both.

use std::f64::consts::FRAC_PI_4;

use sixfold_geometry::Pose;
use sixfold_grasp::{Grasp, Gripper};

use super::StoreError;
use crate::{Crop, CropOptions};

/// Rotations of the in-plane copies, radians: -90 to 90 degrees in steps of 45 (dissertation, section 6.3.1).
pub const COPIES: [f64; 5] = [0.0, -2.0 * FRAC_PI_4, -FRAC_PI_4, FRAC_PI_4, 2.0 * FRAC_PI_4];

/// Computes the feature of a crop: the only interface between a store and a network.
pub trait FeatureExtractor {
    /// A name that distinguishes its features from those of another network.
    fn fingerprint(&self) -> String;

    /// Options of its crops.
    fn crop_options(&self) -> &CropOptions;

    /// [`crate::FEATURE`] numbers for a crop of the size that [`FeatureExtractor::crop_options`] gives.
    fn feature(&self, crop: &Crop) -> Vec<f32>;
}

/// An in-plane copy: everything but its feature can be computed from the experience.
#[derive(Debug, Clone, PartialEq)]
pub struct Copy {
    /// Rotation about the optical axis, radians.
    pub angle: f64,
    /// 256 numbers.
    pub feature: Vec<f32>,
}

/// A successful grasp.
#[derive(Debug, Clone, PartialEq)]
pub struct Experience {
    /// The crop: depth, normals, VD-NOC and mask, in the camera's frame.
    pub crop: Crop,
    /// Pose of the gripper when it closed.
    pub camera_from_gripper: Pose,
    /// Distance of the pads before closing, metres.
    pub opening: f64,
    /// Distance of the contacts, metres.
    pub width: f64,
    /// Pixels of the crop near the gripper: the region of interest.
    pub region: Vec<bool>,
    /// The feature, and those of the in-plane copies; the first one's angle is 0.
    pub copies: Vec<Copy>,
    /// Fingerprint of the network that computed the features.
    pub network: String,
    /// The gripper.
    pub gripper: Gripper,
    /// The object's name.
    pub object: String,
    /// The part that was grasped, if known.
    pub part: Option<String>,
    /// Seconds since 1970.
    pub time: i64,
    /// Origin of the experience, as text.
    pub provenance: String,
}

/// A stored experience with its number.
#[derive(Debug, Clone, PartialEq)]
pub struct Stored {
    /// Its number in the store.
    pub id: i64,
    /// The experience.
    pub experience: Experience,
}

impl Experience {
    /// An experience from a successful grasp; region and features are computed.
    #[allow(clippy::too_many_arguments)]
    pub fn new(
        model: &dyn FeatureExtractor,
        crop: Crop,
        grasp: &Grasp,
        gripper: &Gripper,
        object: &str,
        part: Option<&str>,
        time: i64,
        provenance: &str,
    ) -> Experience {
        let copies = copies(model, &crop);
        Experience {
            region: region(&crop, &grasp.camera_from_gripper, grasp.opening, gripper),
            crop,
            camera_from_gripper: grasp.camera_from_gripper,
            opening: grasp.opening,
            width: grasp.width,
            copies,
            network: model.fingerprint(),
            gripper: gripper.clone(),
            object: object.to_owned(),
            part: part.map(str::to_owned),
            time,
            provenance: provenance.to_owned(),
        }
    }

    /// The same with the features of another network.
    ///
    /// # Errors
    /// [`StoreError::Field`] for a crop of another size than the network's.
    pub fn encoded(&self, model: &dyn FeatureExtractor) -> Result<Experience, StoreError> {
        if self.crop.side != model.crop_options().side {
            return Err(StoreError::Field {
                id: 0,
                field: "crop",
                expected: "as many pixels a side as the network wants; it has to be recorded again",
                found: format!("{}, the network wants {}", self.crop.side, model.crop_options().side),
            });
        }
        let copies = copies(model, &self.crop);
        Ok(Experience { copies, network: model.fingerprint(), ..self.clone() })
    }

    /// Tests the properties on which a store relies.
    ///
    /// # Errors
    /// [`StoreError::Field`].
    pub fn check(&self) -> Result<(), StoreError> {
        let wrong = |field, expected, found: String| Err(StoreError::Field { id: 0, field, expected, found });
        let total = self.crop.side * self.crop.side;
        if self.crop.mask.len() != total || self.region.len() != total || self.crop.points.len() != total {
            return wrong("crop", "side times side pixels everywhere", self.region.len().to_string());
        }
        if self.copies.first().is_none_or(|c| c.angle != 0.0) {
            return wrong("copies", "the experience itself first", self.copies.len().to_string());
        }
        if let Some(copy) = self.copies.iter().find(|c| !c.feature.iter().all(|v| v.is_finite())) {
            return wrong("feature", "finite numbers", format!("{:?}", copy.angle));
        }
        if !(self.opening > 0.0 && self.opening.is_finite() && self.width.is_finite()) {
            return wrong("opening", "a finite width above 0 m", self.opening.to_string());
        }
        if self.gripper.check("").is_err() {
            return wrong("gripper", "a gripper with possible sizes", self.gripper.name.clone());
        }
        Ok(())
    }
}

/// The features of a crop and of its in-plane copies.
fn copies(model: &dyn FeatureExtractor, crop: &Crop) -> Vec<Copy> {
    let trim = model.crop_options().trim;
    COPIES
        .iter()
        .map(|&angle| {
            let feature =
                if angle == 0.0 { model.feature(crop) } else { model.feature(&crop.rotated(angle, trim)) };
            Copy { angle, feature }
        })
        .collect()
}

/// Pixels whose points are between the fingers or within a centimetre of them: where gripper and object overlap (dissertation,
/// section 6.2.1).
pub fn region(crop: &Crop, camera_from_gripper: &Pose, opening: f64, gripper: &Gripper) -> Vec<bool> {
    const AROUND: f64 = 0.01;
    let gripper_from_camera = camera_from_gripper.inverse();
    let inside = |i: usize| {
        let p = gripper_from_camera.transform_point(&crop.point(i));
        p.x.abs() < 0.5 * opening + gripper.finger_thickness + AROUND
            && p.y.abs() < 0.5 * gripper.finger_width + AROUND
            && p.z < AROUND
            && p.z > -gripper.finger_length - AROUND
    };
    crop.mask.iter().enumerate().map(|(i, &seen)| seen && inside(i)).collect()
}
