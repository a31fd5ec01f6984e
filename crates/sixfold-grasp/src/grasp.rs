//! A grasp: where the gripper goes, how far it opens, and how good the contacts look.

use serde::{Deserialize, Serialize};
use sixfold_geometry::{Mat3, Pose, Vec3};

/// How good a two-finger grasp looks from its contacts alone. Every part lies in 0 to 1. Nothing here knows of the robot's
/// reach, of forces or of the object's weight: it is the geometry of the contacts.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct AntipodalQuality {
    /// How far the closing axis lies inside both friction cones: 1 along both contact normals, 0 on the edge of a cone
    /// (two contacts hold against any disturbance when the axis lies inside both cones: Nguyen 1988).
    pub alignment: f64,
    /// How much surface each pad meets: 1 from half a pad's width times 15 mm.
    pub support: f64,
    /// How near the closing axis passes to the object's centre: `exp(-distance / 5 cm)`, the distance measured
    /// horizontally, as gravity's lever is.
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
    /// Where the gripper is when it closes: the gripper's frame is described on the crate's first page.
    pub camera_from_gripper: Pose,
    /// Distance of the pads before closing, metres.
    pub opening: f64,
    /// Distance of the two contacts, as far as it is known, metres.
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

    /// Distance in metres and angle in radians to another grasp, with the gripper's half turn about its approach direction
    /// counted as no difference.
    pub fn difference(&self, other: &Grasp) -> (f64, f64) {
        let flipped = other.camera_from_gripper * half_turn();
        let angle = self.camera_from_gripper.rotation_angle_to(&other.camera_from_gripper);
        let turned = self.camera_from_gripper.rotation_angle_to(&flipped);
        (self.camera_from_gripper.distance_to(&other.camera_from_gripper), angle.min(turned))
    }
}

/// Half a turn about the approach direction.
pub(crate) fn half_turn() -> Pose {
    Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::PI].into())
}

/// The point that a gripper at this pose holds: a centimetre behind the tips, midway between the pads.
pub fn centre_between_pads(camera_from_gripper: &Pose) -> Vec3 {
    camera_from_gripper.transform_point(&(Vec3::z() * -0.01))
}

/// The pose of a gripper whose tips' middle is at `tip_centre` (metres), from approach and closing direction, which need
/// not be unit nor exactly perpendicular: the approach keeps its direction. `None` when they are parallel or zero.
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
    fn half_a_turn_is_the_same_gripper() {
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
