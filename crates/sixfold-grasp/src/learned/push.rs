//! Moves a hand forward until it touches something, as both planners do.

use sixfold_geometry::Vec3;

use crate::antipodal::THICKNESS;
use crate::{AntipodalQuality, CollisionScene, Grasp, GraspView, Gripper, gripper_pose};

/// Initial reach of the tips over the surface, metres.
const FIRST_BITE: f64 = 0.01;
/// Steps of the hand, metres.
const STEP: f64 = 0.005;
/// Minimum number of points between the pads: as in the antipodal planner.
const MIN_POINTS: usize = 8;

/// The obstacles of the hand: the object and its surroundings as measured. Nothing is assumed about the far side.
pub(super) struct Pusher<'a> {
    pub gripper: &'a Gripper,
    pub view: &'a GraspView,
    scene: CollisionScene,
}

impl<'a> Pusher<'a> {
    pub(super) fn new(view: &'a GraspView, gripper: &'a Gripper) -> Pusher<'a> {
        let scene = CollisionScene::new(&[&view.object, &view.obstacles], view.table)
            .with_thickness(&view.object.points, THICKNESS);
        Pusher { gripper, view, scene }
    }

    /// Moves the open hand along `approach`, starting with its tips 1 cm beyond `contact`, until it would collide, then along the
    /// closing direction so that the enclosed points are midway between the pads, if the hand is free there. `None` when it is not
    /// free at first, or encloses too few points. The grasp's quality does not describe its contacts.
    pub(super) fn push(
        &self,
        contact: &Vec3,
        approach: &Vec3,
        closing: &Vec3,
        opening: f64,
    ) -> Option<Grasp> {
        let pose_at = |depth: f64| gripper_pose(&(contact + approach * depth), approach, closing);
        let free =
            |depth: f64| pose_at(depth).filter(|pose| self.scene.hit(self.gripper, pose, opening).is_none());
        let mut pose = free(FIRST_BITE)?;
        let steps = ((self.gripper.finger_length - FIRST_BITE) / STEP) as usize;
        for k in 1..=steps {
            match free(FIRST_BITE + STEP * k as f64) {
                Some(next) => pose = next,
                None => break,
            }
        }
        let extent = |pose: &sixfold_geometry::Pose| {
            let gripper_from_camera = pose.inverse();
            let between = self.view.object.points.iter().filter_map(|p| {
                let q = gripper_from_camera.transform_point(p);
                self.gripper.is_between_pads(&q, opening).then_some(q.x)
            });
            let mut x: Vec<f64> = between.collect();
            x.sort_by(f64::total_cmp);
            (x.len() >= MIN_POINTS).then(|| (x[0], x[x.len() - 1]))
        };
        let (low, high) = extent(&pose)?;
        let centred = pose * sixfold_geometry::Pose::from_translation(Vec3::x() * (0.5 * (low + high)));
        if self.scene.hit(self.gripper, &centred, opening).is_none() && extent(&centred).is_some() {
            pose = centred;
        }
        let quality = AntipodalQuality { alignment: 0.0, support: 0.0, centring: 0.5, observed: 1.0 };
        Some(Grasp { camera_from_gripper: pose, opening, width: high - low, quality })
    }

    /// Straight down; along the viewing direction if the table is unknown.
    pub(super) fn down(&self) -> Vec3 {
        self.view.table.map_or_else(Vec3::z, |t| -t.normal)
    }
}
