//! Collision test: boxes of the gripper against the points of a cloud and the table's plane.
//!
//! A cloud contains only measured (and assumed) points: a gripper that passes this test may still collide with something that was
//! not seen.

use sixfold_geometry::{Plane, PointCloud, Pose, Vec3};

use crate::{Gripper, GripperBox};

/// What a gripper would collide with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Hit {
    /// A finger meets a point of the cloud.
    Finger,
    /// The palm meets a point of the cloud.
    Palm,
    /// A part of the gripper is below the table or too near to it.
    Table,
}

/// Everything that a gripper can collide with, in the camera's frame.
#[derive(Debug, Clone, Default)]
pub struct CollisionScene {
    points: Vec<Vec3>,
    /// Points close behind visible ones, where the palm must not be.
    behind: Vec<Vec3>,
    table: Option<Plane>,
    /// Points closer to a part of the gripper than this collide with it, metres.
    pub margin: f64,
    /// Smallest distance of the gripper from the table, metres.
    pub table_clearance: f64,
}

impl CollisionScene {
    /// Points closer together than this are merged, metres.
    const STEP: f64 = 0.004;

    /// A scene of clouds (thinned to 4 mm) and a table whose normal points up, with margins of 2 mm to points and 3 mm to the
    /// table.
    pub fn new(clouds: &[&PointCloud], table: Option<Plane>) -> CollisionScene {
        let points = clouds.iter().flat_map(|cloud| cloud.points.iter().copied()).collect();
        let all = PointCloud { points, normals: vec![] }.voxel_downsample(Self::STEP, 1.0);
        CollisionScene { points: all.points, behind: vec![], table, margin: 0.002, table_clearance: 0.003 }
    }

    /// Assumes that the object is this thick behind every visible point, metres, in the test of the palm. The fingers are exempt,
    /// because they must reach around the object.
    pub(crate) fn with_thickness(mut self, seen: &[Vec3], thickness: f64) -> CollisionScene {
        let steps = (thickness / Self::STEP).floor() as usize;
        let behind = |p: &Vec3, k: usize| p + p.normalize() * (k as f64 * Self::STEP);
        let points =
            seen.iter().filter(|p| p.z > 0.0).flat_map(|p| (1..=steps).map(move |k| behind(p, k))).collect();
        self.behind = PointCloud { points, normals: vec![] }.voxel_downsample(Self::STEP, 1.0).points;
        self
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

    /// What the gripper would collide with at a pose, with its pads `opening` metres apart; `None` when it is free.
    pub fn hit(&self, gripper: &Gripper, camera_from_gripper: &Pose, opening: f64) -> Option<Hit> {
        let boxes = gripper.boxes(opening);
        if self.above_table(&boxes, camera_from_gripper).is_some_and(|room| room < self.table_clearance) {
            return Some(Hit::Table);
        }
        // A bounding box around all parts rejects most points.
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
        let palm = |p: &Vec3| boxes[2].contains(&(rotation * (p - origin)), self.margin);
        let hit = self.points.iter().find_map(|p| inside(rotation * (p - origin)));
        hit.or_else(|| self.behind.iter().any(palm).then_some(Hit::Palm))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gripper_pose;

    #[test]
    fn the_palm_avoids_unobserved_space_behind_a_surface() {
        let gripper = Gripper::built_in("jaws-85").unwrap();
        // The camera views a plate half a metre away along z, with nothing behind it.
        let mut plate = vec![];
        for i in -20..=20 {
            for j in -20..=20 {
                plate.push(Vec3::new(0.003 * f64::from(i), 0.003 * f64::from(j), 0.5));
            }
        }
        let free = |behind: f64, thickness: f64| {
            // Approaching from behind the plate towards the camera, with the palm's front at this distance behind it.
            let tip = Vec3::new(0.0, 0.0, 0.5 + behind - gripper.finger_length);
            let pose = gripper_pose(&tip, &-Vec3::z(), &Vec3::x()).unwrap();
            let scene = CollisionScene::new(&[], None).with_thickness(&plate, thickness);
            scene.hit(&gripper, &pose, 0.06)
        };
        assert_eq!(free(0.01, 0.0), None);
        assert_eq!(free(0.01, 0.02), Some(Hit::Palm));
        assert_eq!(free(0.03, 0.02), None);
        // Fingers are permitted: only their tips are behind the plate, the palm is in front of it.
        let tip = Vec3::new(0.0, 0.0, 0.515);
        let pose = gripper_pose(&tip, &Vec3::z(), &Vec3::x()).unwrap();
        let scene = CollisionScene::new(&[], None).with_thickness(&plate, 0.02);
        assert_eq!(scene.hit(&gripper, &pose, 0.06), None);
    }

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
