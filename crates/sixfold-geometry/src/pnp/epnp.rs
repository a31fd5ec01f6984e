//! The pose from four or more points by EPnP (Lepetit, Moreno-Noguer and Fua, *EPnP: An Accurate O(n) Solution to the
//! PnP Problem*, IJCV 2009), which the dissertation used inside RANSAC.
//!
//! Points are weighted sums of four control points (three for a plane); the control points in the camera frame lie in
//! the null space of a 12x12 matrix. The combination of null vectors follows from the distances between the control points
//! (section 3.3, cases N = 1, 2, 3) and is refined by Gauss-Newton (section 3.4).

use nalgebra::{Matrix4, SMatrix, SVector, SymmetricEigen, Vector4};

use super::{Model, PnpError, Prepared};
use crate::{Camera, Mat3, Pose, Vec2, Vec3, pose::nearest_rotation};

/// Points whose thickness is below this fraction of their extent count as planar.
const PLANAR: f64 = 1e-4;

/// The pose that EPnP finds for at least four correspondences without outliers: object points in metres, image points
/// in pixels of the raw image (a distortion of `camera` is undone).
///
/// # Errors
/// [`PnpError`] as for [`pnp_ransac`](crate::pnp_ransac).
pub fn epnp(object_points: &[Vec3], image_points: &[Vec2], camera: &Camera) -> Result<Pose, PnpError> {
    let data = Prepared::new(object_points, image_points, camera)?;
    let model = solve(data.points.len(), |i| (data.points[i], data.rays[i])).ok_or(PnpError::NoModel)?;
    Ok(data.pose(&model))
}

/// EPnP over `n` correspondences of object point and point on the plane `z = 1`.
pub(super) fn solve(n: usize, at: impl Fn(usize) -> (Vec3, Vec2)) -> Option<Model> {
    let (control, planar) = control_points(n, &at)?;
    let count = if planar { 3 } else { 4 };
    let axes = Mat3::from_columns(&[
        control[1] - control[0],
        control[2] - control[0],
        if planar {
            (control[1] - control[0]).cross(&(control[2] - control[0])).normalize()
        } else {
            control[3] - control[0]
        },
    ]);
    let inverse = axes.try_inverse()?;
    let weights = |p: &Vec3| -> [f64; 4] {
        let c = inverse * (p - control[0]);
        if planar { [1.0 - c.x - c.y, c.x, c.y, 0.0] } else { [1.0 - c.x - c.y - c.z, c.x, c.y, c.z] }
    };
    // M^T M for rows (a_j, 0, -a_j u) and (0, a_j, -a_j v), control point by control point.
    let mut sums = [[[0.0f64; 4]; 4]; 4];
    for i in 0..n {
        let (p, m) = at(i);
        let a = weights(&p);
        let square = m.norm_squared();
        for j in 0..4 {
            for k in j..4 {
                let w = a[j] * a[k];
                sums[j][k][0] += w;
                sums[j][k][1] += w * m.x;
                sums[j][k][2] += w * m.y;
                sums[j][k][3] += w * square;
            }
        }
    }
    let mut mtm = SMatrix::<f64, 12, 12>::zeros();
    for j in 0..4 {
        for k in 0..4 {
            let [w, u, v, s] = sums[j.min(k)][j.max(k)];
            mtm.fixed_view_mut::<3, 3>(3 * j, 3 * k).copy_from(&Mat3::new(w, 0.0, -u, 0.0, w, -v, -u, -v, s));
        }
    }
    if planar {
        // There is no fourth control point: keep it out of the null space.
        let large = mtm.trace() + 1.0;
        for i in 9..12 {
            mtm[(i, i)] = large;
        }
    }
    let eigen = SymmetricEigen::new(mtm);
    let mut order: [usize; 12] = std::array::from_fn(|i| i);
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let null: [SVector<f64, 12>; 4] =
        std::array::from_fn(|i| eigen.eigenvectors.column(order[i]).into_owned());
    let system = BetaSystem::new(&control, count, &null);
    let mut best: Option<(f64, Model)> = None;
    let cases = if planar { 2 } else { 3 };
    for dimension in 1..=cases {
        let Some(mut betas) = system.start(dimension) else { continue };
        system.refine(&mut betas, if planar { 2 } else { 4 });
        let Some(model) = align(n, &at, &weights, &betas, &null) else { continue };
        let error: f64 = (0..n)
            .map(|i| {
                let (p, m) = at(i);
                let q = model.rotation * p + model.translation;
                if q.z > 0.0 { (q.xy() / q.z - m).norm_squared() } else { f64::INFINITY }
            })
            .sum();
        if error.is_finite() && best.as_ref().is_none_or(|b| error < b.0) {
            best = Some((error, model));
        }
    }
    best.map(|b| b.1)
}

/// Centroid and principal axes scaled by the extent along them, and whether the points are a plane.
fn control_points(n: usize, at: &impl Fn(usize) -> (Vec3, Vec2)) -> Option<([Vec3; 4], bool)> {
    let mean = (0..n).map(|i| at(i).0).sum::<Vec3>() / n as f64;
    let mut covariance = Mat3::zeros();
    for i in 0..n {
        let d = at(i).0 - mean;
        covariance += d * d.transpose();
    }
    let eigen = SymmetricEigen::new(covariance / n as f64);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let extent = order.map(|i| eigen.eigenvalues[i].max(0.0).sqrt());
    if !(extent[0] > 0.0 && extent[1] > 1e-6 * extent[0]) {
        return None;
    }
    let planar = extent[2] < PLANAR * extent[0];
    let axis = |k: usize| mean + eigen.eigenvectors.column(order[k]) * extent[k];
    Some(([mean, axis(0), axis(1), axis(2)], planar))
}

/// Distances between control points, as quadratic forms in the betas.
struct BetaSystem {
    pairs: usize,
    /// Difference of the two control points in each null vector.
    differences: [[Vec3; 4]; 6],
    /// Squared distances in the object's frame.
    squares: [f64; 6],
}

impl BetaSystem {
    fn new(control: &[Vec3; 4], count: usize, null: &[SVector<f64, 12>; 4]) -> Self {
        let mut system = BetaSystem { pairs: 0, differences: [[Vec3::zeros(); 4]; 6], squares: [0.0; 6] };
        for a in 0..count {
            for b in a + 1..count {
                let k = system.pairs;
                system.differences[k] = std::array::from_fn(|i| {
                    (null[i].fixed_rows::<3>(3 * a) - null[i].fixed_rows::<3>(3 * b)).into_owned()
                });
                system.squares[k] = (control[a] - control[b]).norm_squared();
                system.pairs += 1;
            }
        }
        system
    }

    /// Betas for a null space of 1, 2 or 3 dimensions, from the products of betas as linear unknowns.
    fn start(&self, dimension: usize) -> Option<[f64; 4]> {
        const PRODUCTS: [(usize, usize); 6] = [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)];
        // With six distances five products can be solved for (beta 2 2 is left out), with three distances three.
        let unknowns = [1, 3, 5][dimension - 1];
        let mut h = SMatrix::<f64, 5, 5>::identity();
        let mut g = SVector::<f64, 5>::zeros();
        for i in 0..unknowns {
            for j in 0..unknowns {
                h[(i, j)] = (0..self.pairs)
                    .map(|k| self.product(k, PRODUCTS[i]) * self.product(k, PRODUCTS[j]))
                    .sum();
            }
            g[i] = (0..self.pairs).map(|k| self.product(k, PRODUCTS[i]) * self.squares[k]).sum();
        }
        let x = h.lu().solve(&g)?;
        let sign = if x[0] < 0.0 { -1.0 } else { 1.0 };
        let mut betas = [0.0; 4];
        betas[0] = (sign * x[0]).sqrt();
        if dimension > 1 {
            betas[1] = (sign * x[2]).max(0.0).sqrt().copysign(sign * x[1]);
        }
        if dimension > 2 {
            betas[2] = if betas[0] > 0.0 { sign * x[3] / betas[0] } else { 0.0 };
        }
        betas.iter().all(|b| b.is_finite()).then_some(betas)
    }

    fn product(&self, pair: usize, (i, j): (usize, usize)) -> f64 {
        let d = &self.differences[pair];
        d[i].dot(&d[j]) * if i == j { 1.0 } else { 2.0 }
    }

    /// Gauss-Newton on the distances (section 3.4).
    fn refine(&self, betas: &mut [f64; 4], unknowns: usize) {
        for _ in 0..10 {
            let mut h = Matrix4::identity() * 1e-300;
            let mut g = Vector4::zeros();
            for (d, &square) in self.differences.iter().zip(&self.squares).take(self.pairs) {
                let sum: Vec3 = (0..4).map(|i| d[i] * betas[i]).sum();
                let residual = sum.norm_squared() - square;
                let row = Vector4::from_fn(|i, _| if i < unknowns { 2.0 * d[i].dot(&sum) } else { 0.0 });
                h += row * row.transpose();
                g += row * residual;
            }
            for i in 0..4 {
                h[(i, i)] += if i < unknowns { 1e-9 * h[(i, i)] } else { 1.0 };
            }
            let Some(step) = h.cholesky().map(|c| c.solve(&g)) else { return };
            if !step.iter().all(|s| s.is_finite()) {
                return;
            }
            for i in 0..4 {
                betas[i] -= step[i];
            }
        }
    }
}

/// The rigid motion from object points to their reconstruction in the camera frame.
fn align(
    n: usize,
    at: &impl Fn(usize) -> (Vec3, Vec2),
    weights: &impl Fn(&Vec3) -> [f64; 4],
    betas: &[f64; 4],
    null: &[SVector<f64, 12>; 4],
) -> Option<Model> {
    let all: SVector<f64, 12> = (0..4).map(|i| null[i] * betas[i]).sum();
    let control: [Vec3; 4] = std::array::from_fn(|j| all.fixed_rows::<3>(3 * j).into_owned());
    let camera_point = |p: &Vec3| {
        let a = weights(p);
        (0..4).map(|j| control[j] * a[j]).sum::<Vec3>()
    };
    let (mut object_mean, mut camera_mean) = (Vec3::zeros(), Vec3::zeros());
    for i in 0..n {
        let p = at(i).0;
        object_mean += p;
        camera_mean += camera_point(&p);
    }
    object_mean /= n as f64;
    camera_mean /= n as f64;
    let sign = if camera_mean.z < 0.0 { -1.0 } else { 1.0 };
    let mut covariance = Mat3::zeros();
    for i in 0..n {
        let p = at(i).0;
        covariance += (camera_point(&p) - camera_mean) * (p - object_mean).transpose();
    }
    if !covariance.iter().all(|v| v.is_finite()) {
        return None;
    }
    let rotation = nearest_rotation(&(covariance * sign)).to_rotation_matrix().into_inner();
    Some(Model { rotation, translation: camera_mean * sign - rotation * object_mean })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn camera() -> Camera {
        Camera::new(572.4, 573.6, 325.3, 242.0, 640, 480).unwrap()
    }

    proptest! {
        #[test]
        fn exact_points_give_the_exact_pose(
            points in prop::collection::vec(prop::array::uniform3(-0.05..0.05f64), 7..40),
            t in (-0.1..0.1f64, -0.1..0.1f64, 0.4..1.5f64),
            w in prop::array::uniform3(-1.8..1.8f64), flat in any::<bool>(),
        ) {
            let truth = Pose::exp(&[0.0, 0.0, 0.0, w[0], w[1], w[2]].into()).with_translation(Vec3::new(t.0, t.1, t.2));
            let points: Vec<Vec3> =
                points.into_iter().map(|p| Vec3::new(p[0], p[1], if flat { 0.01 } else { p[2] })).collect();
            // The pose of a plane seen edge-on is not determined.
            prop_assume!(!flat || truth.transform_direction(&Vec3::z()).dot(&truth.translation().normalize()).abs() > 0.2);
            let pixels: Vec<Vec2> = points.iter().map(|p| camera().project(&truth.transform_point(p)).unwrap()).collect();
            let found = epnp(&points, &pixels, &camera()).unwrap();
            prop_assert!(found.rotation_angle_to(&truth) < 1e-4 && found.distance_to(&truth) < 1e-4,
                "{} {}", found.rotation_angle_to(&truth), found.distance_to(&truth));
        }
    }
}
