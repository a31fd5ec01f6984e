//! One pose for all that look alike: an object with a continuous symmetry is turned about its axis until the camera
//! lies in a fixed direction, so that equal pictures have equal targets.
//!
//! The author sets the Euler angle about the axis to zero, which still depends on the view; turning towards the camera
//! does not, and has no jump except where the camera looks along the axis.

use sixfold_geometry::nalgebra::{Unit, UnitQuaternion};
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::{ContinuousSymmetry, ModelInfo};

/// The pose whose targets are trained.
pub(super) fn canonical(pose: &Pose, info: &ModelInfo) -> Pose {
    info.symmetries_continuous.iter().fold(*pose, |pose, symmetry| facing_camera(&pose, symmetry))
}

fn facing_camera(pose: &Pose, symmetry: &ContinuousSymmetry) -> Pose {
    let Some(axis) = Unit::try_new(symmetry.axis, 1e-9) else { return *pose };
    // Of the two directions across the axis, the fixed one is made from the coordinate axis least along it.
    let helper = if axis.x.abs() < 0.6 { Vec3::x() } else { Vec3::y() };
    let forward = (helper - axis.scale(axis.dot(&helper))).normalize();
    let side = axis.cross(&forward);
    let camera = pose.inverse().translation() - symmetry.offset;
    let (a, b) = (camera.dot(&forward), camera.dot(&side));
    if a.hypot(b) < 1e-9 {
        return *pose;
    }
    let turn = UnitQuaternion::from_axis_angle(&axis, b.atan2(a));
    *pose * Pose::new(turn, symmetry.offset - turn * symmetry.offset)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_that_look_alike_become_one() {
        let symmetry = ContinuousSymmetry {
            axis: Vec3::new(0.2, 0.5, 0.9).normalize(),
            offset: Vec3::new(0.01, 0.02, -0.03),
        };
        let info = ModelInfo {
            diameter: 0.1,
            min: Vec3::zeros(),
            size: Vec3::repeat(0.1),
            symmetries_discrete: vec![],
            symmetries_continuous: vec![symmetry],
        };
        let pose = Pose::exp(&[0.1, 0.2, 0.8, 0.4, 1.0, -0.6].into());
        let expected = canonical(&pose, &info);
        for turn in info.symmetry_poses(0.3) {
            let found = canonical(&(pose * turn), &info);
            assert!((found.inverse() * expected).log().amax() < 1e-9);
            // And it is one of those that look alike: points on the axis stay.
            let on_axis = symmetry.offset + symmetry.axis * 0.3;
            assert!((found.transform_point(&on_axis) - pose.transform_point(&on_axis)).norm() < 1e-9);
        }
    }
}
