//! Distances between projections of model points at two poses: MSPD and the 2D projection error.

use sixfold_geometry::{Camera, Mat3, Pose, Vec3};

use super::Placement;
use crate::points::{ModelPoints, Node, stretch};

/// The rows of `[R | t]`, the first two times the focal lengths: `u / w` is in pixels without principal point.
struct Projector {
    u: [f64; 4],
    v: [f64; 4],
    w: [f64; 4],
}

impl Projector {
    fn new(camera: &Camera, pose: &Placement) -> Self {
        let (r, t) = (&pose.rotation, &pose.translation);
        let row = |i: usize, f: f64| [f * r[(i, 0)], f * r[(i, 1)], f * r[(i, 2)], f * t[i]];
        Projector { u: row(0, camera.fx), v: row(1, camera.fy), w: row(2, 1.0) }
    }
}

#[inline(always)]
fn dot(row: &[f64; 4], x: f64, y: f64, z: f64) -> f64 {
    row[0] * x + row[1] * y + row[2] * z + row[3]
}

/// Squared distance in pixels between the projections of a point, and the smaller of the two depths.
#[inline(always)]
fn squared_shift(e: &Projector, g: &Projector, x: f64, y: f64, z: f64) -> (f64, f64) {
    let (depth_e, depth_g) = (dot(&e.w, x, y, z), dot(&g.w, x, y, z));
    // One division for four quotients.
    let inverse = 1.0 / (depth_e * depth_g);
    let du = (dot(&e.u, x, y, z) * depth_g - dot(&g.u, x, y, z) * depth_e) * inverse;
    let dv = (dot(&e.v, x, y, z) * depth_g - dot(&g.v, x, y, z) * depth_e) * inverse;
    (du * du + dv * dv, if depth_e < depth_g { depth_e } else { depth_g })
}

/// Maximum Symmetry-Aware Projection Distance in pixels (BOP Challenge 2019; Hodan et al. 2020, section 2.2): the
/// largest distance between the projections of corresponding vertices, under the symmetry for which it is
/// smallest. Infinite when a vertex lies at or behind the camera; `symmetries` must hold the identity.
pub fn mspd(
    points: &ModelPoints,
    estimate: impl Into<Placement>,
    ground_truth: impl Into<Placement>,
    camera: &Camera,
    symmetries: &[Pose],
) -> f64 {
    let (estimate, ground_truth) = (estimate.into(), ground_truth.into());
    let e = Projector::new(camera, &estimate);
    let mut best = f64::INFINITY;
    for symmetry in symmetries {
        let equivalent = ground_truth.after(&symmetry.into());
        let g = Projector::new(camera, &equivalent);
        let bound = NodeBound {
            difference: estimate.rotation - equivalent.rotation,
            offset: estimate.translation - equivalent.translation,
            stretch: stretch(&(estimate.rotation - equivalent.rotation)),
            estimate: &estimate,
            ground_truth: &equivalent,
            focal: camera.fx.max(camera.fy),
        };
        best = best.min(points.largest(
            best,
            |node| bound.of(node),
            |leaf| largest_in_leaf(points, leaf, &e, &g),
        ));
    }
    best.sqrt()
}

/// An upper bound on the shift of all points in a node of the tree.
///
/// With `d = p_e - p_g` and `q = (x_g, y_g) / z_g` the shift is `f ((d_x, d_y) / z_e - q d_z / z_e)`. In a ball of radius
/// `r` the points move with `d` by at most `|R_e - R_g| r` and with `p` by at most `r` (a little more for numbers that are
/// not quite a rotation), which bounds how far the shift can be from that of the ball's centre.
struct NodeBound<'a> {
    difference: Mat3,
    offset: Vec3,
    stretch: f64,
    estimate: &'a Placement,
    ground_truth: &'a Placement,
    focal: f64,
}

impl NodeBound<'_> {
    fn of(&self, node: &Node) -> f64 {
        let e = self.estimate.rotation * node.center + self.estimate.translation;
        let g = self.ground_truth.rotation * node.center + self.ground_truth.translation;
        let d = self.difference * node.center + self.offset;
        let r = 1.01 * node.radius;
        let (nearest_e, nearest_g) = (e.z - r, g.z - r);
        if !(nearest_e > 0.0 && nearest_g > 0.0) {
            return f64::INFINITY;
        }
        let (inverse_e, inverse_near, inverse_g) = (1.0 / e.z, 1.0 / nearest_e, 1.0 / g.z);
        let near_g = r / nearest_g;
        let moved = self.stretch * node.radius * inverse_near;
        let by_depth = r * inverse_near * inverse_e;
        let (qx, qy, dz) = (g.x * inverse_g, g.y * inverse_g, d.z * inverse_e);
        let (u, v) = (d.x * inverse_e - qx * dz, d.y * inverse_e - qy * dz);
        let (center, sideways) = ((u * u + v * v).sqrt(), (d.x * d.x + d.y * d.y).sqrt());
        let q = (qx * qx + qy * qy).sqrt();
        let q_moves = (1.0 + q) * near_g;
        let first = moved + sideways * by_depth;
        let second = (q + q_moves) * (moved + d.z.abs() * by_depth) + q_moves * dz.abs();
        self.focal * (center + first + second)
    }
}

/// Infinite when a point of the leaf is at or behind the camera.
fn largest_in_leaf(points: &ModelPoints, leaf: &Node, e: &Projector, g: &Projector) -> f64 {
    let range = leaf.start..leaf.end;
    let (xs, ys, zs) = (&points.x[range.clone()], &points.y[range.clone()], &points.z[range]);
    let mut largest = [0.0f64; 4];
    let mut nearest = [f64::INFINITY; 4];
    let mut take = |lane: usize, (shift, depth): (f64, f64)| {
        largest[lane] = if shift > largest[lane] { shift } else { largest[lane] };
        nearest[lane] = if depth < nearest[lane] { depth } else { nearest[lane] };
    };
    let (x4, x_rest) = xs.as_chunks::<4>();
    let (y4, y_rest) = ys.as_chunks::<4>();
    let (z4, z_rest) = zs.as_chunks::<4>();
    for ((x, y), z) in x4.iter().zip(y4).zip(z4) {
        for lane in 0..4 {
            take(lane, squared_shift(e, g, x[lane], y[lane], z[lane]));
        }
    }
    for ((&x, &y), &z) in x_rest.iter().zip(y_rest).zip(z_rest) {
        take(0, squared_shift(e, g, x, y, z));
    }
    if nearest.iter().any(|&depth| depth <= 0.0) {
        return f64::INFINITY;
    }
    largest.iter().fold(0.0f64, |a, &b| a.max(b))
}

/// The mean distance in pixels between the projections of corresponding points (Brachmann et al. 2016).
/// Infinite when a point lies at or behind the camera.
pub fn projection_error(
    points: &ModelPoints,
    estimate: impl Into<Placement>,
    ground_truth: impl Into<Placement>,
    camera: &Camera,
) -> f64 {
    let (e, g) = (Projector::new(camera, &estimate.into()), Projector::new(camera, &ground_truth.into()));
    let mut total = 0.0;
    for i in 0..points.len() {
        let (shift, depth) = squared_shift(&e, &g, points.x[i], points.y[i], points.z[i]);
        if depth <= 0.0 {
            return f64::INFINITY;
        }
        total += shift.sqrt();
    }
    total / points.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use sixfold_geometry::nalgebra::Vector6;

    fn camera() -> Camera {
        Camera::new(500.0, 400.0, 320.0, 240.0, 640, 480).unwrap()
    }

    #[test]
    fn a_shifted_point_by_hand() {
        // At 1 m, 3 cm in x are 15 px; the second point at 2 m moves by half of that.
        let points = ModelPoints::new(&[Vec3::zeros(), Vec3::new(0.0, 0.0, 1.0)]).unwrap();
        let g = Pose::from_translation(Vec3::new(0.0, 0.0, 1.0));
        let e = Pose::from_translation(Vec3::new(0.03, 0.0, 1.0));
        let identity = [Pose::identity()];
        assert!((mspd(&points, e, g, &camera(), &identity) - 15.0).abs() < 1e-9);
        assert!((projection_error(&points, e, g, &camera()) - 11.25).abs() < 1e-9);
        let down = Pose::from_translation(Vec3::new(0.0, 0.03, 1.0));
        assert!((mspd(&points, down, g, &camera(), &identity) - 12.0).abs() < 1e-9);
    }

    #[test]
    fn an_estimate_behind_the_camera_is_infinitely_wrong() {
        let points = ModelPoints::new(&[Vec3::zeros()]).unwrap();
        let g = Pose::from_translation(Vec3::new(0.0, 0.0, 1.0));
        let e = Pose::from_translation(Vec3::new(0.0, 0.0, -1.0));
        assert_eq!(mspd(&points, e, g, &camera(), &[Pose::identity()]), f64::INFINITY);
        assert_eq!(projection_error(&points, e, g, &camera()), f64::INFINITY);
    }

    proptest! {
        #[test]
        fn agrees_with_projecting_point_by_point(
            points in prop::collection::vec(prop::array::uniform3(-0.1..0.1f64).prop_map(Vec3::from), 1..700),
            e in prop::array::uniform6(-0.3..0.3f64), g in prop::array::uniform6(-0.3..0.3f64),
        ) {
            let ahead = Pose::from_translation(Vec3::new(0.0, 0.0, 1.5));
            let (e, g) = (ahead * Pose::exp(&Vector6::from(e)), ahead * Pose::exp(&Vector6::from(g)));
            let flip = Pose::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 3.0));
            let model = ModelPoints::new(&points).unwrap();
            let c = camera();
            let under = |s: &Pose| points.iter().map(|p| {
                let a = c.project(&e.transform_point(p)).unwrap();
                let b = c.project(&g.transform_point(&s.transform_point(p))).unwrap();
                (a - b).norm()
            }).fold(0.0, f64::max);
            let expected = under(&Pose::identity()).min(under(&flip));
            let found = mspd(&model, e, g, &c, &[Pose::identity(), flip]);
            prop_assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        }
    }
}
