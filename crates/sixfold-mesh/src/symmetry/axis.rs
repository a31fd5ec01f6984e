//! Rotation axes, and their refinement: an axis is moved until rotations about it minimise the distance between an object and
//! itself.
//!
//! As in iterative closest points (Chen and Medioni 1992), a residual is the distance of a rotated point to the surface, along
//! the normal there. The unknowns are the four degrees of freedom of an axis: two rotations and two shifts perpendicular to it.

use std::f64::consts::TAU;

use nalgebra::{Matrix4, Unit as UnitVector, UnitQuaternion, Vector4};
use sixfold_geometry::{Pose, Vec3};

/// An axis of rotation in the object's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Axis {
    /// Unit vector.
    pub direction: Vec3,
    pub point: Vec3,
}

impl Axis {
    pub fn rotation(&self, angle: f64) -> Pose {
        let rotation = UnitQuaternion::from_axis_angle(&UnitVector::new_unchecked(self.direction), angle);
        Pose::new(rotation, self.point - rotation * self.point)
    }

    /// The angle between two axes regardless of their signs, radians.
    pub fn angle_to(&self, other: &Axis) -> f64 {
        let cross = self.direction.cross(&other.direction).norm();
        cross.atan2(self.direction.dot(&other.direction).abs())
    }

    /// The same line, with the point nearest to `centre` and the sign of the direction such that its largest component is
    /// positive.
    pub fn tidy(&self, centre: &Vec3) -> Axis {
        let direction = self.direction.normalize();
        let largest = direction[direction.iamax()];
        let offset = centre - self.point;
        let point = self.point + direction * offset.dot(&direction);
        Axis { direction: if largest < 0.0 { -direction } else { direction }, point }
    }
}

/// The angles of all rotations of an axis of this order except the identity.
pub(super) fn angles_of_order(order: u32) -> Vec<f64> {
    (1..order).map(|k| f64::from(k) * TAU / f64::from(order)).collect()
}

/// Moves an axis so that the rotated `points` come as close to the surface as possible. `residual` returns the distance to the
/// surface at a point, and its gradient. Distances much larger than `scale` (metres) count less (Geman and McClure 1985).
pub(super) fn refine(
    axis: &Axis,
    angles: &[f64],
    points: &[Vec3],
    scale: f64,
    steps: usize,
    residual: impl Fn(&Vec3) -> (f64, Vec3),
) -> Axis {
    let mut best = (*axis, f64::INFINITY);
    let mut axis = *axis;
    for _ in 0..=steps {
        let u = axis.direction.cross(&Vec3::ith(axis.direction.iamin(), 1.0)).normalize();
        let v = axis.direction.cross(&u);
        let (mut h, mut g, mut cost) = (Matrix4::zeros(), Vector4::zeros(), 0.0);
        for rotation in angles.iter().map(|angle| axis.rotation(*angle)) {
            // Moving the axis' point by `d` moves every rotated point by d - R d.
            let shifts = [u, v].map(|d| d - rotation.transform_direction(&d));
            for p in points {
                let arm = p - axis.point;
                let moved = rotation.transform_point(p);
                let (r, gradient) = residual(&moved);
                let ratio = r * r / (scale * scale);
                let weight = 1.0 / (1.0 + ratio).powi(2);
                cost += ratio / (1.0 + ratio);
                let tilt =
                    |w: &Vec3| w.cross(&(moved - axis.point)) - rotation.transform_direction(&w.cross(&arm));
                let j = Vector4::new(
                    gradient.dot(&tilt(&u)),
                    gradient.dot(&tilt(&v)),
                    gradient.dot(&shifts[0]),
                    gradient.dot(&shifts[1]),
                );
                h += weight * j * j.transpose();
                g += weight * r * j;
            }
        }
        if cost < best.1 {
            best = (axis, cost);
        }
        let damping = Matrix4::from_diagonal(&h.diagonal().map(|d| 1e-3 * d + 1e-12));
        let Some(step) = (h + damping).cholesky().map(|c| -c.solve(&g)) else { break };
        if !step.iter().all(|s| s.is_finite()) {
            break;
        }
        let tilt = UnitQuaternion::from_scaled_axis(u * step[0] + v * step[1]);
        axis.direction = (tilt * axis.direction).normalize();
        axis.point += u * step[2] + v * step[3];
    }
    best.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of a cone with its axis elsewhere; the residual is the exact distance to the cone's surface of revolution.
    #[test]
    fn finds_the_axis_of_a_cone() {
        let truth = Axis { direction: Vec3::new(1.0, 2.0, 2.0) / 3.0, point: Vec3::new(0.01, -0.02, 0.005) };
        let to = UnitQuaternion::rotation_between(&Vec3::z(), &truth.direction).unwrap();
        let points: Vec<Vec3> = (0..400)
            .map(|i| {
                let (height, angle) = (0.001 * f64::from(i % 40), f64::from(i) * 2.4);
                let radius = 0.05 - height;
                truth.point + to * Vec3::new(radius * angle.cos(), radius * angle.sin(), height)
            })
            .collect();
        let residual = |p: &Vec3| {
            let local = to.inverse() * (p - truth.point);
            let radius = local.xy().norm();
            let normal = Vec3::new(local.x / radius, local.y / radius, 1.0) / 2f64.sqrt();
            ((radius + local.z - 0.05) / 2f64.sqrt(), to * normal)
        };
        let start = Axis {
            direction: (truth.direction + Vec3::new(0.05, -0.04, 0.03)).normalize(),
            point: truth.point + Vec3::new(0.002, 0.003, -0.002),
        };
        let found = refine(&start, &[1.0, 2.0, 3.0], &points, 0.01, 12, residual);
        assert!(found.angle_to(&truth) < 1e-6, "{}", found.angle_to(&truth));
        let off = (found.point - truth.point).cross(&truth.direction).norm();
        assert!(off < 1e-8, "{off}");
    }

    #[test]
    fn rotations_keep_the_axis() {
        let axis = Axis { direction: Vec3::new(0.0, 0.6, 0.8), point: Vec3::new(1.0, 2.0, 3.0) };
        for angle in angles_of_order(5) {
            let on = axis.point + 7.0 * axis.direction;
            assert!((axis.rotation(angle).transform_point(&on) - on).norm() < 1e-12);
        }
        let tidy = Axis { direction: -axis.direction, ..axis }.tidy(&Vec3::zeros());
        assert!(tidy.direction == axis.direction && tidy.point.dot(&tidy.direction).abs() < 1e-12);
    }
}
