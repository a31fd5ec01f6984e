//! Triangulation of a point from several photographs: the point nearest to all rays, then least squares of reprojection errors.

use sixfold_geometry::nalgebra::Matrix3;
use sixfold_geometry::{Mat3, Pose, Vec2, Vec3};

/// Iterations of Gauss-Newton. Chosen by hand; not swept.
const ITERATIONS: usize = 8;

/// The point of the world on the rays through points on the planes `z = 1` of several cameras; `None` if rays are parallel or the
/// point is behind a camera. Poses take points of the world to the cameras.
pub fn triangulated(seen: &[(Pose, Vec2)]) -> Option<Vec3> {
    let (mut h, mut g) = (Matrix3::zeros(), Vec3::zeros());
    for (pose, point) in seen {
        let back = pose.inverse();
        let ray = back.transform_direction(&point.push(1.0)).normalize();
        let across = Mat3::identity() - ray * ray.transpose();
        h += across;
        g += across * back.translation();
    }
    let values = h.symmetric_eigenvalues();
    if seen.len() < 2 || !(values.min() > 1e-9 * values.max()) {
        return None;
    }
    let mut point = h.cholesky()?.solve(&g);
    for _ in 0..ITERATIONS {
        let (mut h, mut g) = (Matrix3::zeros(), Vec3::zeros());
        for (pose, seen) in seen {
            let p = pose.transform_point(&point);
            if !(p.z > 0.0) {
                return None;
            }
            let r = p.xy() / p.z - seen;
            let rotation = pose.rotation_matrix();
            for (axis, residual) in [(0, r.x), (1, r.y)] {
                let j = (rotation.row(axis) - rotation.row(2) * (p[axis] / p.z)) / p.z;
                h += j.transpose() * j;
                g += j.transpose() * residual;
            }
        }
        let step = h.cholesky()?.solve(&-g);
        point += step;
        if step.norm() < 1e-13 * point.norm() {
            break;
        }
    }
    let before = seen.iter().all(|(pose, _)| pose.transform_point(&point).z > 0.0);
    (before && point.iter().all(|v| v.is_finite())).then_some(point)
}

/// The largest angle between two of the rays to a point, radians.
pub(crate) fn widest(point: &Vec3, eyes: &[Vec3]) -> f64 {
    let rays: Vec<Vec3> = eyes.iter().filter_map(|e| (point - e).try_normalize(0.0)).collect();
    let angle = |a: &Vec3, b: &Vec3| a.cross(b).norm().atan2(a.dot(b));
    rays.iter().enumerate().flat_map(|(i, a)| rays[..i].iter().map(move |b| angle(a, b))).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_is_found_and_parallel_rays_give_none() {
        let truth = Vec3::new(0.1, -0.2, 3.0);
        let seen: Vec<(Pose, Vec2)> = (0..4)
            .map(|i| {
                let t = f64::from(i);
                let pose = Pose::exp(&[0.3 * t, 0.1, 0.05 * t, 0.0, 0.1 * t, 0.02].into());
                let p = pose.transform_point(&truth);
                (pose, (p / p.z).xy())
            })
            .collect();
        assert!((triangulated(&seen).unwrap() - truth).norm() < 1e-10);
        assert!(triangulated(&[seen[0], seen[0]]).is_none() && triangulated(&seen[..1]).is_none());
        let eyes: Vec<Vec3> = seen.iter().map(|s| s.0.inverse().translation()).collect();
        assert!(widest(&truth, &eyes) > 0.1 && widest(&truth, &eyes[..1]) == 0.0);
    }
}
