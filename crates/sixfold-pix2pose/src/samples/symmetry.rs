//! A canonical pose for all symmetric ones: an object with a continuous symmetry is rotated about its axis until the camera is in a
//! fixed direction, so that equal images have equal targets.
//!
//! The author sets the Euler angle about the axis to zero, which still depends on the view; a rotation towards the camera does not,
//! and is continuous except where the camera looks along the axis.

//!
//! For comparison, discrete symmetries can be treated in the same way ("view limits" in the dissertation's table 3.1): the pose
//! whose camera views one side of the object represents all. Targets then jump where two sides meet.

use sixfold_geometry::nalgebra::{Unit, UnitQuaternion};
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::{ContinuousSymmetry, ModelInfo};

/// The pose whose targets are used in the training; with `limits`, one of those that are equivalent under the discrete symmetries.
pub(crate) fn canonical(pose: &Pose, info: &ModelInfo, limits: bool) -> Pose {
    let pose = if limits { within_limits(pose, info) } else { *pose };
    info.symmetries_continuous.iter().fold(pose, |pose, symmetry| facing_camera(&pose, symmetry))
}

/// Of the symmetric poses, the one whose camera is furthest in a fixed direction of the object.
fn within_limits(pose: &Pose, info: &ModelInfo) -> Pose {
    // Not along an axis of symmetry that a person would choose.
    let side = Vec3::new(0.67, 0.74, 0.05);
    let reach = |pose: &Pose| pose.inverse().translation().dot(&side);
    let equal = info.symmetries_discrete.iter().map(|symmetry| *pose * *symmetry);
    equal.fold(*pose, |best, other| if reach(&other) > reach(&best) { other } else { best })
}

fn facing_camera(pose: &Pose, symmetry: &ContinuousSymmetry) -> Pose {
    let Some(axis) = Unit::try_new(symmetry.axis, 1e-9) else { return *pose };
    // Of the two directions perpendicular to the axis, the fixed one is computed from the coordinate axis least parallel to it.
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
        let expected = canonical(&pose, &info, false);
        for turn in info.symmetry_poses(0.3) {
            let found = canonical(&(pose * turn), &info, false);
            assert!((found.inverse() * expected).log().amax() < 1e-9);
            // It is also one of the symmetric poses: points on the axis are unchanged.
            let on_axis = symmetry.offset + symmetry.axis * 0.3;
            assert!((found.transform_point(&on_axis) - pose.transform_point(&on_axis)).norm() < 1e-9);
        }
    }

    #[test]
    fn view_limits_choose_one_of_the_poses_that_look_alike() {
        let quarter = |n: f64| Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, n * std::f64::consts::FRAC_PI_2].into());
        let info = ModelInfo {
            diameter: 0.1,
            min: Vec3::repeat(-0.05),
            size: Vec3::repeat(0.1),
            symmetries_discrete: vec![quarter(1.0), quarter(2.0), quarter(3.0)],
            symmetries_continuous: vec![],
        };
        let pose = Pose::exp(&[0.1, 0.2, 0.8, 0.4, 1.0, -0.6].into());
        let chosen = canonical(&pose, &info, true);
        for symmetry in &info.symmetries_discrete {
            assert!((canonical(&(pose * *symmetry), &info, true).inverse() * chosen).log().amax() < 1e-9);
        }
        let alike = std::iter::once(Pose::identity()).chain(info.symmetries_discrete.iter().copied());
        assert!(alike.into_iter().any(|s| ((pose * s).inverse() * chosen).log().amax() < 1e-9));
        assert!((canonical(&pose, &info, false).inverse() * pose).log().amax() < 1e-9);
    }
}
