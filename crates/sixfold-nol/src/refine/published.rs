//! The dissertation's refinement (section 4.2.3, equation 4.3), for comparison: gradient descent on the mean absolute difference
//! between the first rendering and one photograph's projection, in one target view.
//!
//! Details that the dissertation leaves open are taken from the author's code: step 0.0001, times 0.99 after a step that lowered
//! the error; otherwise the step is undone and reduced by the factor 0.9; translations move at most 5 mm per step; it stops after
//! 50 steps or at a change of the error below a millionth. The gradient with respect to the rotation is taken in Euler angles, as
//! the dissertation states (the author's code takes the angles of the matrix of gradients, which is not a rotation matrix).

use sixfold_align::outline::motion;
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::VisibilityBuffer;

use crate::maps::Maps;
use crate::projection::TargetSurface;
use crate::source::SourceView;

/// The parameters of the published rule.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PublishedRuleOptions {
    /// First step.
    pub step: f64,
    /// Maximum number of steps.
    pub iterations: usize,
    /// Largest translation in a step, metres.
    pub longest: f64,
    /// The descent stops when the error changes by less.
    pub min_change: f64,
}

impl Default for PublishedRuleOptions {
    fn default() -> Self {
        PublishedRuleOptions { step: 1e-4, iterations: 50, longest: 0.005, min_change: 1e-6 }
    }
}

/// Moves one photograph's pose by the published rule. `target` is the view of the first rendering, `rendered` its channels at the
/// target's pixels (`pixels x channels`), `known` which of them are valid; `maps` has the same channels of the photograph. Returns
/// the pose and the errors before and after.
pub(crate) fn published_rule(
    view: &mut SourceView,
    maps: &Maps,
    mesh: &Mesh,
    target: &TargetSurface,
    rendered: &[f32],
    known: &[bool],
    options: &PublishedRuleOptions,
) -> (Pose, [f64; 2]) {
    let mut frame = VisibilityBuffer::new(&view.camera);
    let mut pose = *view.camera_from_object();
    let (first, mut gradient) = error(view, maps, target, rendered, known);
    let (mut best, mut step) = (first, options.step);
    for _ in 0..options.iterations {
        let shift = Vec3::new(gradient[0], gradient[1], gradient[2]) * step;
        let shift = shift.map(|v| v.clamp(-options.longest, options.longest));
        let [roll, pitch, yaw] = [3, 4, 5].map(|k| -gradient[k] * step);
        let turn = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        let next = Pose::new(turn * pose.rotation(), pose.translation() - shift);
        view.set_pose(mesh, next, &mut frame);
        let (after, next_gradient) = error(view, maps, target, rendered, known);
        if after.is_finite() && after < best {
            let change = best - after;
            (pose, best, gradient) = (next, after, next_gradient);
            step *= 0.99;
            if change < options.min_change {
                break;
            }
        } else {
            view.set_pose(mesh, pose, &mut frame);
            step *= 0.9;
        }
    }
    view.set_pose(mesh, pose, &mut frame);
    (pose, [first, best])
}

/// Mean absolute difference over pixels and channels, and its gradient with respect to translation (per metre) and small rotations
/// about the camera's axes through the object's origin (per radian).
fn error(
    view: &SourceView,
    maps: &Maps,
    target: &TargetSurface,
    rendered: &[f32],
    known: &[bool],
) -> (f64, [f64; 6]) {
    let channels = maps.channels();
    let pose = view.camera_from_object();
    let origin = pose.translation();
    let (mut value, mut dx, mut dy) = (vec![0.0; channels], vec![0.0; channels], vec![0.0; channels]);
    let (mut sum, mut gradient, mut count) = (0.0, [0.0; 6], 0usize);
    for (i, (point, normal)) in target.points.iter().zip(&target.normals).enumerate() {
        if !known[i] {
            continue;
        }
        let Some(([x, y], _)) = view.see(point, normal) else { continue };
        maps.sample_with_gradient(x, y, &mut value, &mut dx, &mut dy);
        let [along_x, along_y] = motion(&view.camera, &pose.transform_point(point), &origin);
        count += channels;
        for c in 0..channels {
            let residual = f64::from(value[c] - rendered[i * channels + c]);
            sum += residual.abs();
            let (gx, gy) = (residual.signum() * f64::from(dx[c]), residual.signum() * f64::from(dy[c]));
            for (k, g) in gradient.iter_mut().enumerate() {
                *g += gx * along_x[k] + gy * along_y[k];
            }
        }
    }
    if count == 0 {
        return (f64::INFINITY, gradient);
    }
    (sum / count as f64, gradient.map(|g| g / count as f64))
}
