//! Fits a grasp from another source (transferred from experience, or given by a person) to the view: centred so that the object is
//! midway between the pads, tested for collision, and with the same contact quality as the planner's grasps.

use sixfold_geometry::Pose;

use crate::antipodal::Planner;
use crate::{
    AntipodalOptions, AntipodalQuality, CompletedObject, Grasp, GraspView, Gripper, OptionsError,
    complete_by_mirrors,
};

/// Fits grasps to the object of a view.
pub struct GraspFitter<'a> {
    view: &'a GraspView,
    planner: Planner<'a>,
}

impl<'a> GraspFitter<'a> {
    /// The view.
    pub fn view(&self) -> &'a GraspView {
        self.view
    }

    /// The gripper.
    pub fn gripper(&self) -> &'a Gripper {
        self.planner.gripper
    }

    /// The options that a grasp must satisfy.
    pub fn options(&self) -> &'a AntipodalOptions {
        self.planner.options
    }

    pub(crate) fn planner(&self) -> &Planner<'a> {
        &self.planner
    }

    /// A fitter for a view and a gripper. The object's far side is completed according to the options.
    ///
    /// # Errors
    /// [`OptionsError`].
    pub fn new(
        view: &'a GraspView,
        gripper: &'a Gripper,
        options: &'a AntipodalOptions,
    ) -> Result<GraspFitter<'a>, OptionsError> {
        options.check()?;
        let object = match &options.completion {
            Some(completion) => complete_by_mirrors(view, completion),
            None => {
                CompletedObject { cloud: view.object.clone(), observed: view.object.len(), planes: vec![] }
            }
        };
        Ok(GraspFitter { view, planner: Planner::new(view, gripper, object, options) })
    }

    /// The grasp at about this pose, moved along the closing direction so that the object is midway between the pads; `None` when
    /// the gripper would collide or a contact is outside its friction cone.
    pub fn fit(&self, camera_from_gripper: &Pose, opening: f64) -> Option<Grasp> {
        if self.planner.object.cloud.normals.len() != self.planner.object.cloud.len() {
            return None;
        }
        self.planner.grasp(camera_from_gripper, opening)
    }

    /// The grasp at exactly this pose if the gripper is free of collisions and something is between its pads, regardless of its
    /// contacts: they may be on sides that the camera does not see. The alignment of its quality is 0.
    pub fn accept(&self, camera_from_gripper: &Pose, opening: f64) -> Option<Grasp> {
        let planner = &self.planner;
        if !(opening > 0.0 && opening <= planner.gripper.max_opening)
            || planner.scene.hit(planner.gripper, camera_from_gripper, opening).is_some()
        {
            return None;
        }
        let (low, high) = planner.extent(&planner.between(camera_from_gripper, opening))?;
        let quality = AntipodalQuality { alignment: 0.0, support: 0.0, centring: 0.5, observed: 0.0 };
        Some(Grasp { camera_from_gripper: *camera_from_gripper, opening, width: high - low, quality })
    }

    /// The distance from the finger tips along the approach to the first point of the object, metres (negative: the tips reach over
    /// it); `None` when nothing is between the pads' planes.
    pub fn reach(&self, camera_from_gripper: &Pose, opening: f64) -> Option<f64> {
        let gripper_from_camera = camera_from_gripper.inverse();
        let half = (0.5 * opening, 0.5 * self.planner.gripper.finger_width);
        let depths = self.planner.object.cloud.points[..self.planner.object.observed]
            .iter()
            .map(|p| gripper_from_camera.transform_point(p))
            .filter(|p| p.x.abs() < half.0 && p.y.abs() < half.1 && p.z.abs() < 0.2)
            .map(|p| p.z);
        depths.min_by(f64::total_cmp)
    }
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::{PointCloud, Vec3};

    use super::*;
    use crate::gripper_pose;

    /// A wall of 2 cm on a table seen from above, of which the camera saw only the side at y = 1 cm if `half`.
    fn wall(half: bool) -> GraspView {
        let mut object = PointCloud::default();
        for side in [1.0, -1.0] {
            for i in 0..=60 {
                for k in 0..=20 {
                    let (x, z) = (0.0025 * f64::from(i) - 0.075, 0.6 - 0.0025 * f64::from(k));
                    if side > 0.0 || !half {
                        object.points.push(Vec3::new(x, 0.01 * side, z));
                        object.normals.push(Vec3::y() * side);
                    }
                }
            }
        }
        GraspView::from_above(object, 0.6, 0.0025)
    }

    #[test]
    fn assumed_surface_gets_more_clearance_where_possible() {
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let options = AntipodalOptions::default();
        let tip = Vec3::new(0.0, 0.0, 0.58);
        let pose = gripper_pose(&tip, &Vec3::z(), &Vec3::y()).unwrap();
        let opening = |view: &GraspView, seen: usize| {
            let object = CompletedObject { cloud: wall(false).object, observed: seen, planes: vec![] };
            let fitter = GraspFitter { view, planner: Planner::new(view, &gripper, object, &options) };
            fitter.fit(&pose, 0.05).map(|g| g.opening)
        };
        let (both, half) = (wall(false), wall(true));
        let all = both.object.len();
        let seen = opening(&both, all).unwrap();
        assert!((seen - 0.02 - 2.0 * options.clearance).abs() < 1e-6, "{seen}");
        let assumed = opening(&half, half.object.len()).unwrap();
        assert!((assumed - seen - 2.0 * options.contact_clearance).abs() < 1e-6, "{assumed} {seen}");
        // An obstacle where the finger would be then, or even with half of that clearance.
        for (place, more) in [(-0.044, options.contact_clearance), (-0.0385, 0.0)] {
            let mut narrow = wall(true);
            for k in 0..=10 {
                narrow.obstacles.points.push(Vec3::new(0.0, place, 0.6 - 0.004 * f64::from(k)));
                narrow.obstacles.normals.push(Vec3::y());
            }
            let beside = opening(&narrow, half.object.len()).unwrap();
            assert!((beside - seen - more).abs() < 1e-6, "{place}: {beside} {seen}");
        }
    }
}
