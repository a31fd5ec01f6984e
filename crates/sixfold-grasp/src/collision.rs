//! May the gripper be there? Boxes of the gripper against the points of a cloud and the table's plane.
//!
//! A cloud is what was measured (and assumed), not what is there: a gripper that passes this test may still meet
//! something nobody saw.

use sixfold_geometry::{Plane, PointCloud, Pose, Vec3};

use crate::{Gripper, GripperBox};

/// What a gripper would hit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Hit {
    /// A finger meets a point of the cloud.
    Finger,
    /// The palm meets a point of the cloud.
    Palm,
    /// A part of the gripper is below the table or too near to it.
    Table,
}

/// Everything a gripper can hit, in the camera's frame.
#[derive(Debug, Clone, Default)]
pub struct CollisionScene {
    points: Vec<Vec3>,
    table: Option<Plane>,
    /// Points nearer to a part of the gripper than this are hit, metres.
    pub margin: f64,
    /// Least distance of the gripper from the table, metres.
    pub table_clearance: f64,
}

impl CollisionScene {
    /// Points closer together than this are one, metres.
    const STEP: f64 = 0.004;

    /// A scene of clouds (thinned to 4 mm) and a table whose normal points up, with margins of 2 mm to points and 3 mm to the
    /// table.
    pub fn new(clouds: &[&PointCloud], table: Option<Plane>) -> CollisionScene {
        let points = clouds.iter().flat_map(|cloud| cloud.points.iter().copied()).collect();
        let all = PointCloud { points, normals: vec![] }.voxel_downsample(Self::STEP, 1.0);
        CollisionScene { points: all.points, table, margin: 0.002, table_clearance: 0.003 }
    }

    /// The points.
    pub fn points(&self) -> &[Vec3] {
        &self.points
    }

    /// Distance of the gripper's lowest corner from the table, metres; `None` without a table.
    pub fn table_room(&self, gripper: &Gripper, camera_from_gripper: &Pose, opening: f64) -> Option<f64> {
        self.above_table(&gripper.boxes(opening), camera_from_gripper)
    }

    fn above_table(&self, boxes: &[GripperBox], camera_from_gripper: &Pose) -> Option<f64> {
        let table = self.table.as_ref()?;
        let corners = boxes.iter().flat_map(GripperBox::corners);
        corners.map(|c| table.distance(&camera_from_gripper.transform_point(&c))).min_by(f64::total_cmp)
    }

    /// What the gripper would hit at a pose, with its pads `opening` metres apart; `None` when it is free.
    pub fn hit(&self, gripper: &Gripper, camera_from_gripper: &Pose, opening: f64) -> Option<Hit> {
        let boxes = gripper.boxes(opening);
        if self.above_table(&boxes, camera_from_gripper).is_some_and(|room| room < self.table_clearance) {
            return Some(Hit::Table);
        }
        // All parts lie within the box around them: most points are sorted out by it.
        let around = boxes
            .iter()
            .skip(1)
            .fold(boxes[0], |a, b| GripperBox { low: a.low.inf(&b.low), high: a.high.sup(&b.high) });
        let rotation = camera_from_gripper.rotation_matrix().transpose();
        let origin = camera_from_gripper.translation();
        let inside = |p: Vec3| {
            if !around.contains(&p, self.margin) {
                return None;
            }
            if boxes[..2].iter().any(|finger| finger.contains(&p, self.margin)) {
                return Some(Hit::Finger);
            }
            boxes[2].contains(&p, self.margin).then_some(Hit::Palm)
        };
        self.points.iter().find_map(|p| inside(rotation * (p - origin)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gripper_pose;

    #[test]
    fn points_between_the_fingers_are_free_and_others_are_hit() {
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let pose = gripper_pose(&Vec3::new(0.0, 0.0, 0.5), &Vec3::z(), &Vec3::x()).unwrap();
        let at = |x: f64, z: f64| PointCloud { points: vec![Vec3::new(x, 0.0, z)], normals: vec![] };
        let hit = |x, z| CollisionScene::new(&[&at(x, z)], None).hit(&gripper, &pose, 0.06);
        assert_eq!(hit(0.0, 0.49), None);
        assert_eq!(hit(0.035, 0.49), Some(Hit::Finger));
        assert_eq!(hit(0.0, 0.44), Some(Hit::Palm));
        assert_eq!(hit(0.0, 0.51), None);
        assert_eq!(hit(0.2, 0.49), None);
        // The camera looks down on a table: its normal points to the camera.
        let table = |z: f64| Some(Plane { normal: -Vec3::z(), offset: -z });
        assert_eq!(CollisionScene::new(&[], table(0.51)).hit(&gripper, &pose, 0.06), None);
        assert_eq!(CollisionScene::new(&[], table(0.502)).hit(&gripper, &pose, 0.06), Some(Hit::Table));
        assert_eq!(CollisionScene::new(&[], table(0.3)).hit(&gripper, &pose, 0.06), Some(Hit::Table));
    }
}
