//! Distances between projections of model points at two poses: MSPD and the 2D projection error.

use sixfold_geometry::{Camera, Pose, Vec3};

use crate::points::ModelPoints;

/// The third row and the focal rows of `[R | t]`, scaled so that `x / z` is in pixels without principal point.
struct Projector {
    u: [f64; 4],
    v: [f64; 4],
    w: [f64; 4],
}

impl Projector {
    fn new(camera: &Camera, pose: &Pose) -> Self {
        let (r, t): (_, Vec3) = (pose.rotation_matrix(), pose.translation());
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
    let (inverse_e, inverse_g) = (1.0 / depth_e, 1.0 / depth_g);
    let du = dot(&e.u, x, y, z) * inverse_e - dot(&g.u, x, y, z) * inverse_g;
    let dv = dot(&e.v, x, y, z) * inverse_e - dot(&g.v, x, y, z) * inverse_g;
    (du * du + dv * dv, if depth_e < depth_g { depth_e } else { depth_g })
}

/// Maximum Symmetry-Aware Projection Distance in pixels (BOP Challenge 2019; Hodan et al. 2020, section 2.2): the
/// largest distance between the projections of corresponding vertices, under the symmetry for which it is
/// smallest. Infinite when a vertex lies at or behind the camera; `symmetries` must hold the identity.
pub fn mspd(
    points: &ModelPoints,
    estimate: &Pose,
    ground_truth: &Pose,
    camera: &Camera,
    symmetries: &[Pose],
) -> f64 {
    let e = Projector::new(camera, estimate);
    let mut best = f64::INFINITY;
    for symmetry in symmetries {
        let g = Projector::new(camera, &(ground_truth * symmetry));
        best = best.min(largest_squared_shift(points, &e, &g, best));
    }
    best.sqrt()
}

fn largest_squared_shift(points: &ModelPoints, e: &Projector, g: &Projector, give_up: f64) -> f64 {
    // Chunks of this many vertices are finished before asking whether this symmetry is already out.
    const CHUNK: usize = 256;
    let mut largest = [0.0f64; 4];
    let mut nearest = [f64::INFINITY; 4];
    let chunks = points.x.chunks(CHUNK).zip(points.y.chunks(CHUNK)).zip(points.z.chunks(CHUNK));
    for ((xs, ys), zs) in chunks {
        let (x4, x_rest) = xs.as_chunks::<4>();
        let (y4, y_rest) = ys.as_chunks::<4>();
        let (z4, z_rest) = zs.as_chunks::<4>();
        for ((x, y), z) in x4.iter().zip(y4).zip(z4) {
            for lane in 0..4 {
                let (shift, depth) = squared_shift(e, g, x[lane], y[lane], z[lane]);
                largest[lane] = if shift > largest[lane] { shift } else { largest[lane] };
                nearest[lane] = if depth < nearest[lane] { depth } else { nearest[lane] };
            }
        }
        for ((&x, &y), &z) in x_rest.iter().zip(y_rest).zip(z_rest) {
            let (shift, depth) = squared_shift(e, g, x, y, z);
            largest[0] = if shift > largest[0] { shift } else { largest[0] };
            nearest[0] = if depth < nearest[0] { depth } else { nearest[0] };
        }
        if nearest.iter().any(|&depth| depth <= 0.0) {
            return f64::INFINITY;
        }
        let so_far = largest.iter().fold(0.0f64, |a, &b| a.max(b));
        if so_far > give_up {
            return so_far;
        }
    }
    largest.iter().fold(0.0f64, |a, &b| a.max(b))
}

/// The mean distance in pixels between the projections of corresponding points (Brachmann et al. 2016).
/// Infinite when a point lies at or behind the camera.
pub fn projection_error(
    points: &ModelPoints,
    estimate: &Pose,
    ground_truth: &Pose,
    camera: &Camera,
) -> f64 {
    let (e, g) = (Projector::new(camera, estimate), Projector::new(camera, ground_truth));
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
        assert!((mspd(&points, &e, &g, &camera(), &identity) - 15.0).abs() < 1e-9);
        assert!((projection_error(&points, &e, &g, &camera()) - 11.25).abs() < 1e-9);
        let down = Pose::from_translation(Vec3::new(0.0, 0.03, 1.0));
        assert!((mspd(&points, &down, &g, &camera(), &identity) - 12.0).abs() < 1e-9);
    }

    #[test]
    fn an_estimate_behind_the_camera_is_infinitely_wrong() {
        let points = ModelPoints::new(&[Vec3::zeros()]).unwrap();
        let g = Pose::from_translation(Vec3::new(0.0, 0.0, 1.0));
        let e = Pose::from_translation(Vec3::new(0.0, 0.0, -1.0));
        assert_eq!(mspd(&points, &e, &g, &camera(), &[Pose::identity()]), f64::INFINITY);
        assert_eq!(projection_error(&points, &e, &g, &camera()), f64::INFINITY);
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
            let found = mspd(&model, &e, &g, &c, &[Pose::identity(), flip]);
            prop_assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        }
    }
}
