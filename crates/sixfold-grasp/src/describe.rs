//! The description of a grasp before it is tried: numbers from which its outcome can be predicted.

use serde::{Deserialize, Serialize};
use sixfold_geometry::Vec3;

use crate::{AntipodalQuality, Grasp, GraspFitter};

/// The description of a grasp before it is tried.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GraspDescription {
    /// The quality of its contacts.
    pub quality: AntipodalQuality,
    /// How far the pads reach over the object along the approach, metres.
    pub overlap: f64,
    /// Horizontal distance of the object's centre from the centre between the pads along the closing direction, metres: the
    /// lever that pulls the object out of one pad.
    pub lever: f64,
    /// Height of the points between the pads above the object's centre, metres.
    pub above_middle: f64,
    /// Distance of the gripper's lowest corner from the table, metres; `None` if the table is unknown.
    pub table_room: Option<f64>,
}

impl GraspFitter<'_> {
    /// Describes a grasp on the object of this view.
    pub fn describe(&self, grasp: &Grasp) -> GraspDescription {
        let planner = self.planner();
        let between = planner.between(&grasp.camera_from_gripper, grasp.opening);
        let count = between.len().max(1) as f64;
        let sum: Vec3 = between.iter().map(|(i, _)| planner.object.cloud.points[*i]).sum();
        let lever = planner.centre - sum / count;
        let up = -lever.dot(&planner.down);
        let level = lever + planner.down * up;
        GraspDescription {
            quality: grasp.quality,
            overlap: -between.iter().map(|(_, q)| q.z).fold(0.0, f64::min),
            lever: level.dot(&grasp.closing()).abs(),
            // `up` is the vertical offset of the object's centre from the centre of the points between the pads.
            above_middle: if between.is_empty() { 0.0 } else { -up },
            table_room: planner.scene.table_room(planner.gripper, &grasp.camera_from_gripper, grasp.opening),
        }
    }
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::PointCloud;

    use super::*;
    use crate::{AntipodalOptions, GraspView, Gripper, gripper_pose};

    #[test]
    fn a_bar_held_off_its_centre() {
        // A bar of 20 x 2 x 6 cm on a table, its long side along x, seen from above (the camera looks down the z axis).
        let mut object = PointCloud::default();
        for i in 0..=100 {
            for k in 0..=30 {
                for side in [-1.0, 1.0] {
                    let (x, z) = (0.002 * f64::from(i) - 0.1, 0.5 - 0.002 * f64::from(k));
                    object.points.push(Vec3::new(x, 0.01 * side, z));
                    object.normals.push(Vec3::y() * side);
                }
            }
        }
        let view = GraspView::from_above(object, 0.5, 0.002);
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let options = AntipodalOptions { completion: None, ..AntipodalOptions::default() };
        let fitter = GraspFitter::new(&view, &gripper, &options).unwrap();
        let at = |x: f64, closing: Vec3| {
            let pose = gripper_pose(&Vec3::new(x, 0.0, 0.47), &Vec3::z(), &closing).unwrap();
            let quality = AntipodalQuality { alignment: 1.0, support: 1.0, centring: 1.0, observed: 1.0 };
            fitter.describe(&Grasp { camera_from_gripper: pose, opening: 0.05, width: 0.02, quality })
        };
        // Across the bar, 5 cm from its centre: no lever along the closing direction.
        let d = at(0.05, Vec3::y());
        assert!(d.lever < 1e-3, "{d:?}");
        assert!((d.overlap - 0.03).abs() < 0.002, "{d:?}");
        assert!((d.table_room.unwrap() - 0.03).abs() < 1e-9, "{d:?}");
        // The pads reach over the upper half, whose centre is 15 mm above the bar's.
        assert!((d.above_middle - 0.015).abs() < 0.002, "{d:?}");
        // Along the bar (as if its end were held): the whole distance is a lever.
        assert!((at(0.05, Vec3::x()).lever - 0.05).abs() < 2e-3);
    }
}
