//! The pose from three points: AP3P (Ke and Roumeliotis, *An Efficient Algebraic Solution to the
//! Perspective-Three-Point Problem*, CVPR 2017).
//!
//! A quartic in the cosine of one angle gives up to four poses. The quartic is taken from the paper (its equations 28 to
//! 41). The rest differs: each root is converted into the three distances along the rays, which are refined by two steps of
//! Newton's method (as in Persson and Nordberg 2018, section 3.8), because a sine computed from a cosine near 1 loses half
//! of its digits.

use super::Model;
use crate::{Mat3, Pose, Vec3, pose::nearest_rotation};

/// Up to four poses in which three points lie on three rays: all `camera_from_object` for which `object_points[i]` (metres)
/// lies on the ray from the camera's centre through `rays[i]` (any length, z forward), in front of the camera. Empty for
/// points on one line.
///
/// ```
/// use sixfold_geometry::{Pose, Vec3, p3p};
/// let truth = Pose::exp(&[0.02, -0.1, 0.8, 0.3, -0.2, 0.5].into());
/// let points = [Vec3::new(0.04, 0.0, 0.01), Vec3::new(-0.02, 0.05, 0.0), Vec3::new(0.0, -0.03, 0.03)];
/// let rays = points.map(|p| truth.transform_point(&p));
/// let found = p3p(&rays, &points);
/// assert!(found.iter().any(|pose| pose.rotation_angle_to(&truth) < 1e-7));
/// ```
pub fn p3p(rays: &[Vec3; 3], object_points: &[Vec3; 3]) -> Vec<Pose> {
    let mut models = [Model::IDENTITY; 4];
    let count = ap3p(&rays.map(|r| r.normalize()), object_points, &mut models);
    models[..count].iter().map(|m| Pose::new(nearest_rotation(&m.rotation), m.translation)).collect()
}

/// As [`p3p`] for unit rays, into a fixed array; returns the number of poses.
pub(super) fn ap3p(b: &[Vec3; 3], w: &[Vec3; 3], out: &mut [Model; 4]) -> usize {
    // Frames of the paper: k1 along the first side, k3 normal to the first two rays.
    let u0 = w[0] - w[1];
    let u0_length = u0.norm();
    let k1 = u0 / u0_length;
    let k3 = b[0].cross(&b[1]);
    let k3_length = k3.norm();
    let k3 = k3 / k3_length;
    let tz = b[0].cross(&k3);
    let v1 = b[0].cross(&b[2]);
    let v2 = b[1].cross(&b[2]);
    let u1 = w[0] - w[2];
    let u1k1 = u1.dot(&k1);
    let k3b3 = k3.dot(&b[2]);
    let nl = u1.cross(&k1);
    let delta = nl.norm();
    if !(u0_length > 0.0 && k3_length > 0.0 && delta > 1e-9 * u0_length && k3b3.abs() > 1e-12) {
        return 0;
    }
    let nl = nl / delta;
    let f11 = delta * k3b3;
    let f13 = delta * k3.dot(&v1);
    let f15 = -u1k1 * k3b3;
    let u2k1 = u1k1 - u0_length;
    let (f21, f22) = (tz.dot(&v2), k3_length * k3b3);
    let f23 = delta * k3.dot(&v2);
    let f24 = u2k1 * f22;
    let f25 = -u2k1 * f21;
    let (f21, f22) = (delta * f21, delta * f22);
    let g1 = f13 * f22;
    let g2 = f13 * f25 - f15 * f23;
    let g3 = f11 * f23 - f13 * f21;
    let g4 = -f13 * f24;
    let g5 = f11 * f22;
    let g6 = f11 * f25 - f15 * f21;
    let g7 = -f15 * f24;
    let mut roots = [0.0; 4];
    let count = real_quartic_roots(
        [
            g5 * g5 + g1 * g1 + g3 * g3,
            2.0 * (g5 * g6 + g1 * g2 + g3 * g4),
            g6 * g6 + 2.0 * g5 * g7 + g2 * g2 + g4 * g4 - g1 * g1 - g3 * g3,
            2.0 * (g6 * g7 - g1 * g2 - g3 * g4),
            g7 * g7 - g2 * g2 - g4 * g4,
        ],
        &mut roots,
    );
    let distances = Distances::new(b, w);
    let world = Mat3::from_columns(&[k1, nl, k1.cross(&nl)]);
    let mut found = 0;
    for &cos1 in &roots[..count] {
        if !(cos1.abs() <= 1.0) {
            continue;
        }
        let sin1 = (1.0 - cos1 * cos1).sqrt().copysign(k3b3);
        let scale = sin1 / ((g5 * cos1 + g6) * cos1 + g7);
        let (cos3, sin3) = (scale * (g1 * cos1 + g2), scale * (g3 * cos1 + g4));
        // The third point is at p3 in the camera frame; the others follow from the rotation.
        let c13 =
            Mat3::new(cos3, 0.0, -sin3, sin1 * sin3, cos1, sin1 * cos3, cos1 * sin3, -sin1, cos1 * cos3);
        let turn = world * c13;
        let depth3 = sin1 * delta / k3b3;
        let to_camera = |d: Vec3| {
            let c = turn.tr_mul(&d);
            b[0] * c.x + k3 * c.y + tz * c.z + b[2] * depth3
        };
        let start = [to_camera(u1).dot(&b[0]), to_camera(u1 - u0).dot(&b[1]), depth3];
        let Some(depths) = distances.polish(start) else { continue };
        let Some(model) = from_depths(depths, b, w) else { continue };
        out[found] = model;
        found += 1;
    }
    found
}

/// The law of cosines between the three rays.
struct Distances {
    /// Twice the cosine between rays 0 1, 0 2, 1 2.
    cosines: [f64; 3],
    squares: [f64; 3],
}

impl Distances {
    fn new(b: &[Vec3; 3], w: &[Vec3; 3]) -> Self {
        Distances {
            cosines: [2.0 * b[0].dot(&b[1]), 2.0 * b[0].dot(&b[2]), 2.0 * b[1].dot(&b[2])],
            squares: [
                (w[0] - w[1]).norm_squared(),
                (w[0] - w[2]).norm_squared(),
                (w[1] - w[2]).norm_squared(),
            ],
        }
    }

    /// Newton's method on the three distances; `None` when they end behind the camera or do not fit the triangle.
    fn polish(&self, mut d: [f64; 3]) -> Option<[f64; 3]> {
        const PAIRS: [(usize, usize); 3] = [(0, 1), (0, 2), (1, 2)];
        let c = &self.cosines;
        let residuals = |d: &[f64; 3]| -> [f64; 3] {
            std::array::from_fn(|k| {
                let (i, j) = PAIRS[k];
                d[i] * d[i] + d[j] * d[j] - c[k] * d[i] * d[j] - self.squares[k]
            })
        };
        let mut r = residuals(&d);
        for _ in 0..3 {
            // Jacobian rows (a0 a1 0), (b0 0 b2), (0 c1 c2).
            let (a0, a1) = (2.0 * d[0] - c[0] * d[1], 2.0 * d[1] - c[0] * d[0]);
            let (b0, b2) = (2.0 * d[0] - c[1] * d[2], 2.0 * d[2] - c[1] * d[0]);
            let (c1, c2) = (2.0 * d[1] - c[2] * d[2], 2.0 * d[2] - c[2] * d[1]);
            let det = -a0 * b2 * c1 - a1 * b0 * c2;
            let inverse = 1.0 / det;
            if !inverse.is_finite() {
                break;
            }
            let step = [
                (-b2 * c1 * r[0] - a1 * c2 * r[1] + a1 * b2 * r[2]) * inverse,
                (-b0 * c2 * r[0] + a0 * c2 * r[1] - a0 * b2 * r[2]) * inverse,
                (b0 * c1 * r[0] - a0 * c1 * r[1] - a1 * b0 * r[2]) * inverse,
            ];
            let next = [d[0] - step[0], d[1] - step[1], d[2] - step[2]];
            let next_r = residuals(&next);
            let size = |r: &[f64; 3]| r.iter().map(|v| v.abs()).sum::<f64>();
            if !(size(&next_r) < size(&r)) {
                break;
            }
            d = next;
            r = next_r;
        }
        let fits = (0..3).all(|k| r[k].abs() < 1e-6 * self.squares[k]);
        (fits && d.iter().all(|&v| v > 0.0)).then_some(d)
    }
}

/// The rigid motion between two equal triangles.
fn from_depths(d: [f64; 3], b: &[Vec3; 3], w: &[Vec3; 3]) -> Option<Model> {
    let p: [Vec3; 3] = std::array::from_fn(|i| b[i] * d[i]);
    let camera = frame(&p)?;
    let object = frame(w)?;
    let rotation = camera * object.transpose();
    Some(Model { rotation, translation: p[0] - rotation * w[0] })
}

/// Orthonormal axes of a triangle, as columns.
fn frame(p: &[Vec3; 3]) -> Option<Mat3> {
    let x = (p[1] - p[0]).try_normalize(0.0)?;
    let z = x.cross(&(p[2] - p[0])).try_normalize(0.0)?;
    Some(Mat3::from_columns(&[x, z.cross(&x), z]))
}

/// Real roots of `c0 x^4 + c1 x^3 + c2 x^2 + c3 x + c4` (Ferrari 1545), polished by Newton's method.
fn real_quartic_roots(c: [f64; 5], out: &mut [f64; 4]) -> usize {
    let inverse = 1.0 / c[0];
    if !inverse.is_finite() {
        return 0;
    }
    let [b, cc, d, e] = [c[1] * inverse, c[2] * inverse, c[3] * inverse, c[4] * inverse];
    // x = y - b/4: y^4 + p y^2 + q y + r.
    let b2 = b * b;
    let p = cc - 0.375 * b2;
    let q = d - 0.5 * b * cc + 0.125 * b2 * b;
    let r = e - 0.25 * b * d + 0.0625 * b2 * cc - 3.0 / 256.0 * b2 * b2;
    let m = largest_cubic_root(p, 0.25 * p * p - r, -0.125 * q * q);
    let mut count = 0;
    let mut add = |half: f64, discriminant: f64, scale: f64| {
        // A double root is still a root if rounding makes its discriminant slightly negative.
        if discriminant < -1e-9 * scale {
            return;
        }
        let s = discriminant.max(0.0).sqrt();
        for y in [half + s, half - s] {
            out[count] = y - 0.25 * b;
            count += 1;
        }
    };
    if m > 1e-14 * (p.abs() + r.abs().sqrt()) {
        let s = (2.0 * m).sqrt();
        let t = q / (2.0 * s);
        // y^2 + s y + (p/2 + m - t) and y^2 - s y + (p/2 + m + t)
        let k = 0.5 * p + m;
        let scale = 0.25 * s * s + k.abs() + t.abs();
        add(-0.5 * s, 0.25 * s * s - (k - t), scale);
        add(0.5 * s, 0.25 * s * s - (k + t), scale);
    } else {
        // Biquadratic.
        let discriminant = (0.25 * p * p - r).max(0.0).sqrt();
        for y2 in [-0.5 * p + discriminant, -0.5 * p - discriminant] {
            if y2 >= 0.0 {
                add(0.0, y2, 1.0);
            }
        }
    }
    for x in &mut out[..count] {
        for _ in 0..2 {
            let f = (((*x + b) * *x + cc) * *x + d) * *x + e;
            let slope = ((4.0 * *x + 3.0 * b) * *x + 2.0 * cc) * *x + d;
            let step = f / slope;
            if step.is_finite() && step.abs() < 0.1 {
                *x -= step;
            }
        }
    }
    count
}

/// The largest real root of `x^3 + a x^2 + b x + c` (Cardano; three real roots after Viete).
fn largest_cubic_root(a: f64, b: f64, c: f64) -> f64 {
    let q = (a * a - 3.0 * b) / 9.0;
    let r = (2.0 * a * a * a - 9.0 * a * b + 27.0 * c) / 54.0;
    let mut x = if r * r < q * q * q {
        let cos = (r / (q * q * q).sqrt()).clamp(-1.0, 1.0);
        // -2 sqrt(q) cos((theta + 2 pi) / 3) is the largest of the three.
        -2.0 * q.sqrt() * ((cos.acos() + std::f64::consts::TAU) / 3.0).cos() - a / 3.0
    } else {
        let s = -(r.abs() + (r * r - q * q * q).max(0.0).sqrt()).cbrt().copysign(r);
        s + if s == 0.0 { 0.0 } else { q / s } - a / 3.0
    };
    for _ in 0..2 {
        let step = (((x + a) * x + b) * x + c) / ((3.0 * x + 2.0 * a) * x + b);
        if step.is_finite() {
            x -= step;
        }
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(4000))]
        #[test]
        fn the_truth_is_among_the_solutions(
            points in prop::array::uniform3(prop::array::uniform3(-0.1..0.1f64)),
            t in (-0.3..0.3f64, -0.3..0.3f64, 0.4..2.0f64),
            w in prop::array::uniform3(-1.8..1.8f64),
        ) {
            let truth = Pose::exp(&[0.0, 0.0, 0.0, w[0], w[1], w[2]].into()).with_translation(Vec3::new(t.0, t.1, t.2));
            let w = points.map(Vec3::from);
            let rays = w.map(|p| truth.transform_point(&p).normalize());
            // Well-conditioned triangles: not slim, and not near the danger cylinder, on which two solutions coincide.
            let normal = (w[1] - w[0]).cross(&(w[2] - w[0]));
            let longest = (w[1] - w[0]).norm().max((w[2] - w[0]).norm()).max((w[2] - w[1]).norm());
            prop_assume!(normal.norm() > 0.1 * longest * longest && longest > 0.02);
            prop_assume!(conditioning(&truth, &w) > 2e-4);
            let found = p3p(&rays, &w);
            let best = found.iter().map(|p| p.rotation_angle_to(&truth) + p.distance_to(&truth)).fold(f64::INFINITY, f64::min);
            prop_assert!(best < 1e-7, "{best:e} of {} solutions", found.len());
            for pose in &found {
                for (p, ray) in w.iter().zip(&rays) {
                    let seen = pose.transform_point(p).normalize();
                    prop_assert!((seen - ray).norm() < 1e-7, "{:e}", (seen - ray).norm());
                }
            }
        }
    }

    /// How far the distances are from a double solution: the determinant of their Jacobian, dimensionless.
    fn conditioning(truth: &Pose, w: &[Vec3; 3]) -> f64 {
        let p = w.map(|q| truth.transform_point(&q));
        let b = p.map(|q| q.normalize());
        let pairs = [(0, 1), (0, 2), (1, 2)];
        let mut jacobian = Mat3::zeros();
        for (row, (i, j)) in pairs.into_iter().enumerate() {
            let d = p[i] - p[j];
            jacobian[(row, i)] = d.dot(&b[i]) / d.norm();
            jacobian[(row, j)] = -d.dot(&b[j]) / d.norm();
        }
        jacobian.determinant().abs()
    }

    #[test]
    fn points_on_a_line_give_nothing() {
        let w = [Vec3::zeros(), Vec3::x() * 0.05, Vec3::x() * 0.1];
        let rays = w.map(|p| (p + Vec3::new(0.0, 0.01, 0.5)).normalize());
        assert!(p3p(&rays, &w).is_empty());
        assert!(p3p(&rays, &[Vec3::x(); 3]).is_empty());
        assert!(p3p(&[Vec3::z(); 3], &[Vec3::x(), Vec3::y(), Vec3::z()]).is_empty());
    }

    #[test]
    fn roots_of_quartics_by_hand() {
        let mut roots = [0.0; 4];
        // (x - 1)(x + 2)(x - 3)(x - 0.5)
        let n = real_quartic_roots([2.0, -5.0, -8.0, 17.0, -6.0], &mut roots);
        roots[..n].sort_by(f64::total_cmp);
        assert_eq!(n, 4);
        for (root, expected) in roots.iter().zip([-2.0, 0.5, 1.0, 3.0]) {
            assert!((root - expected).abs() < 1e-12, "{roots:?}");
        }
        assert_eq!(real_quartic_roots([1.0, 0.0, 2.0, 0.0, 1.0], &mut roots), 0);
    }
}
