//! A grasp: the pose of the gripper, its opening, and the quality of its contacts.

use serde::{Deserialize, Serialize};
use sixfold_geometry::{Mat3, Pose, Vec3};

/// The quality of a two-finger grasp from the geometry of its contacts alone. Every part is between 0 and 1. The robot's reach,
/// forces and the object's weight are not considered.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct AntipodalQuality {
    /// How far the closing axis is inside both friction cones: 1 along both contact normals, 0 on the edge of a cone (two contacts
    /// hold against any disturbance when the axis is inside both cones: Nguyen 1988).
    pub alignment: f64,
    /// Surface area that each pad touches: 1 from half a pad's width times 15 mm on.
    pub support: f64,
    /// Closeness of the closing axis to the object's centre: `exp(-distance / 5 cm)`, with the horizontal distance, which is the
    /// lever of gravity.
    pub centring: f64,
    /// Fraction of the contact points that were seen; the rest was assumed (see `complete_by_mirrors`).
    pub observed: f64,
}

impl AntipodalQuality {
    /// The four parts as one number, 0 to 1.
    pub fn total(&self) -> f64 {
        (0.3 + 0.7 * self.alignment)
            * (0.3 + 0.7 * self.support)
            * self.centring
            * (0.6 + 0.4 * self.observed)
    }
}

/// One grasp of a parallel-jaw gripper.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grasp {
    /// Pose of the gripper when it closes; its frame is defined in the crate documentation.
    pub camera_from_gripper: Pose,
    /// Distance of the pads before closing, metres.
    pub opening: f64,
    /// Distance of the two contacts, as far as known, metres.
    pub width: f64,
    /// The quality of its contacts.
    pub quality: AntipodalQuality,
}

impl Grasp {
    /// The approach direction in the camera's frame.
    pub fn approach(&self) -> Vec3 {
        self.camera_from_gripper.transform_direction(&Vec3::z())
    }

    /// The closing direction in the camera's frame.
    pub fn closing(&self) -> Vec3 {
        self.camera_from_gripper.transform_direction(&Vec3::x())
    }

    /// Distance in metres and angle in radians to another grasp, where a half turn of the gripper about its approach direction
    /// counts as no difference.
    pub fn difference(&self, other: &Grasp) -> (f64, f64) {
        let flipped = other.camera_from_gripper * half_turn();
        let angle = self.camera_from_gripper.rotation_angle_to(&other.camera_from_gripper);
        let flipped_angle = self.camera_from_gripper.rotation_angle_to(&flipped);
        (self.camera_from_gripper.distance_to(&other.camera_from_gripper), angle.min(flipped_angle))
    }
}

/// Half a turn about the approach direction.
pub(crate) fn half_turn() -> Pose {
    Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::PI].into())
}

/// The point at which a gripper at this pose holds: a centimetre behind the tips, midway between the pads.
pub fn centre_between_pads(camera_from_gripper: &Pose) -> Vec3 {
    camera_from_gripper.transform_point(&(Vec3::z() * -0.01))
}

/// The pose of a gripper with the centre between its tips at `tip_centre` (metres), from approach and closing direction. They need
/// not be unit vectors nor exactly perpendicular: the approach keeps its direction. `None` when they are parallel or zero.
pub fn gripper_pose(tip_centre: &Vec3, approach: &Vec3, closing: &Vec3) -> Option<Pose> {
    let z = approach.try_normalize(1e-9)?;
    let x = (closing - z * closing.dot(&z)).try_normalize(1e-9)?;
    let y = z.cross(&x);
    Pose::from_parts(&Mat3::from_columns(&[x, y, z]), *tip_centre).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_frame_is_right_handed_and_keeps_the_approach() {
        let pose = gripper_pose(&Vec3::x(), &(Vec3::z() * -2.0), &Vec3::new(1.0, 0.0, 0.3)).unwrap();
        assert!((pose.transform_direction(&Vec3::z()) + Vec3::z()).norm() < 1e-12);
        assert!((pose.transform_direction(&Vec3::x()) - Vec3::x()).norm() < 1e-12);
        assert!((pose.transform_direction(&Vec3::y()) + Vec3::y()).norm() < 1e-12);
        assert!(gripper_pose(&Vec3::x(), &Vec3::z(), &Vec3::z()).is_none());
    }

    #[test]
    fn a_rotation_by_180_degrees_is_the_same_grasp() {
        let quality = AntipodalQuality { alignment: 1.0, support: 1.0, centring: 1.0, observed: 1.0 };
        let a = Grasp {
            camera_from_gripper: Pose::exp(&[0.1, 0.2, 0.6, 0.3, 2.0, 0.1].into()),
            opening: 0.05,
            width: 0.03,
            quality,
        };
        let b = Grasp { camera_from_gripper: a.camera_from_gripper * half_turn(), ..a };
        let (distance, angle) = a.difference(&b);
        assert!(distance < 1e-12 && angle < 1e-6, "{distance} {angle}");
        assert_eq!(quality.total(), 1.0);
    }
}
