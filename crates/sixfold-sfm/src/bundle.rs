//! Bundle adjustment (Triggs, McLauchlan, Hartley and Fitzgibbon 2000): minimises the reprojection errors of all points in all
//! photographs by Levenberg-Marquardt steps with Cauchy's weights; points are eliminated first (Schur complement, section 6).
//!
//! Sums are computed over parts whose bounds do not depend on the number of threads.

use rayon::prelude::*;
use sixfold_geometry::nalgebra::{DMatrix, DVector, Matrix3, Vector6};
use sixfold_geometry::{Pose, Vec2, Vec3, stats::median};

use crate::lens::Lens;

/// Residuals of this many standard deviations get half the weight. Chosen by hand; not swept.
const CAUCHY: f64 = 2.0;
/// Smallest standard deviation of a residual, pixels. Chosen by hand; not swept.
const MIN_DEVIATION: f64 = 1e-3;
/// Number of parts of the sums. Chosen by hand; not swept.
const PARTS: usize = 8;
/// Residual of an observation behind its camera, pixels. Chosen by hand; not swept.
const BEHIND: f64 = 1e3;
/// Convergence: the sum of costs changes by less than this fraction. Chosen by hand; not swept.
const DONE: f64 = 1e-7;

/// An observation of a point in a photograph.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seen {
    pub camera: usize,
    pub pixel: Vec2,
}

/// The adjusted state.
#[derive(Debug, Clone)]
pub(crate) struct Bundle {
    pub lens: Lens,
    pub poses: Vec<Pose>,
    pub points: Vec<Vec3>,
}

/// One observation, linearised around the current state.
struct Linear {
    camera: usize,
    residual: Vec2,
    weight: f64,
    by_pose: [[f64; 6]; 2],
    by_point: [[f64; 3]; 2],
    by_lens: [[f64; 5]; 2],
}

pub(crate) fn moved(pose: &Pose, twist: &Vector6<f64>) -> Pose {
    let step = Pose::exp(twist);
    let rotation = step.rotation() * pose.rotation();
    Pose::new(rotation, step.rotation() * pose.translation() + step.translation())
}

impl Bundle {
    fn residual(&self, seen: &Seen, point: &Vec3) -> Option<Vec2> {
        Some(self.lens.project(&self.poses[seen.camera].transform_point(point))? - seen.pixel)
    }

    /// The standard deviation of residuals along one axis, robust to wrong ones, pixels.
    pub fn deviation(&self, seen: &[Vec<Seen>]) -> f64 {
        let mut all: Vec<f64> = vec![];
        for (point, seen) in self.points.iter().zip(seen) {
            let residuals = seen.iter().filter_map(|s| self.residual(s, point));
            all.extend(residuals.flat_map(|r| [r.x.abs(), r.y.abs()]));
        }
        median(&mut all).map_or(1.0, |m| (1.4826 * m).max(MIN_DEVIATION))
    }

    fn cost(&self, seen: &[Vec<Seen>], deviation: f64, guess: &Lens, free: &[usize]) -> f64 {
        let scale = (CAUCHY * deviation).powi(2);
        let of = |range: std::ops::Range<usize>| {
            let mut sum = 0.0;
            for i in range {
                for s in &seen[i] {
                    let square =
                        self.residual(s, &self.points[i]).map_or(BEHIND * BEHIND, |r| r.norm_squared());
                    sum += CAUCHY * CAUCHY * (square / scale).ln_1p();
                }
            }
            sum
        };
        let sums: Vec<f64> = parts(self.points.len()).into_par_iter().map(of).collect();
        let belief = guess.belief();
        let prior: f64 =
            free.iter().map(|k| ((self.lens.numbers[*k] - guess.numbers[*k]) / belief[*k]).powi(2)).sum();
        sums.iter().sum::<f64>() + prior
    }

    fn linear(&self, i: usize, seen: &[Vec<Seen>], deviation: f64) -> Vec<Linear> {
        let scale = (CAUCHY * deviation).powi(2);
        let of = |s: &Seen| {
            let pose = &self.poses[s.camera];
            let p = pose.transform_point(&self.points[i]);
            let (pixel, slopes, by_lens) = self.lens.project_with_slopes(&p)?;
            let residual = pixel - s.pixel;
            let weight = 1.0 / ((1.0 + residual.norm_squared() / scale) * deviation * deviation);
            let rotation = pose.rotation_matrix();
            let by_point = slopes.map(|row| (rotation.tr_mul(&Vec3::from(row))).into());
            let by_pose = slopes.map(|row| {
                let turn = p.cross(&Vec3::from(row));
                [row[0], row[1], row[2], turn.x, turn.y, turn.z]
            });
            Some(Linear { camera: s.camera, residual, weight, by_pose, by_point, by_lens })
        };
        seen[i].iter().filter_map(of).collect()
    }
}

fn parts(count: usize) -> Vec<std::ops::Range<usize>> {
    (0..PARTS).map(|k| count * k / PARTS..count * (k + 1) / PARTS).collect()
}

/// A point's part of the equations: the inverse of its own block, its gradient, and its coupling to the other unknowns.
struct PointPart {
    inverse: Matrix3<f64>,
    gradient: Vec3,
    /// First unknown, and one row for each unknown from there.
    couplings: Vec<(usize, Vec<Vec3>)>,
}

/// The equations of lens and poses.
struct System {
    matrix: DMatrix<f64>,
    gradient: DVector<f64>,
    /// The diagonal before the points were eliminated.
    diagonal: DVector<f64>,
}

impl System {
    fn zeros(count: usize) -> System {
        System {
            matrix: DMatrix::zeros(count, count),
            gradient: DVector::zeros(count),
            diagonal: DVector::zeros(count),
        }
    }

    /// Adds the observations of a point, which is eliminated; `None` if they do not determine the point.
    fn add(&mut self, linear: &[Linear], free: &[usize], damping: f64) -> Option<PointPart> {
        let (mut own, mut gradient) = (Matrix3::zeros(), Vec3::zeros());
        let mut couplings: Vec<(usize, Vec<Vec3>)> = vec![(0, vec![Vec3::zeros(); free.len()])];
        for l in linear {
            let first = free.len() + 6 * l.camera;
            let mut coupling = vec![Vec3::zeros(); 6];
            for axis in 0..2 {
                let (r, w) = (l.residual[axis], l.weight);
                let point = Vec3::from(l.by_point[axis]);
                let pose = &l.by_pose[axis];
                own += point * point.transpose() * w;
                gradient += point * (w * r);
                let lens: Vec<f64> = free.iter().map(|k| l.by_lens[axis][*k]).collect();
                for (a, ja) in lens.iter().enumerate() {
                    couplings[0].1[a] += point * (w * ja);
                    self.gradient[a] += w * ja * r;
                    self.diagonal[a] += w * ja * ja;
                    (0..=a).for_each(|b| self.matrix[(a, b)] += w * ja * lens[b]);
                    (0..6).for_each(|b| self.matrix[(first + b, a)] += w * ja * pose[b]);
                }
                for (a, ja) in pose.iter().enumerate() {
                    coupling[a] += point * (w * ja);
                    self.gradient[first + a] += w * ja * r;
                    self.diagonal[first + a] += w * ja * ja;
                    (0..=a).for_each(|b| self.matrix[(first + a, first + b)] += w * ja * pose[b]);
                }
            }
            couplings.push((first, coupling));
        }
        couplings.retain(|(_, rows)| !rows.is_empty());
        (0..3).for_each(|k| own[(k, k)] += damping * own[(k, k)] + 1e-12);
        let inverse = own.try_inverse()?;
        for (at, rows) in &couplings {
            for (a, row) in rows.iter().enumerate() {
                let scaled = inverse * row;
                self.gradient[at + a] -= scaled.dot(&gradient);
                for (other, others) in couplings.iter().filter(|c| c.0 <= *at) {
                    let most = if other == at { a + 1 } else { others.len() };
                    for (b, with) in others[..most].iter().enumerate() {
                        self.matrix[(at + a, other + b)] -= scaled.dot(with);
                    }
                }
            }
        }
        Some(PointPart { inverse, gradient, couplings })
    }
}

/// The state with the lowest cost near a start; only the parameters `free` of the lens may change, with a prior around those of
/// `guess`. The first pose is fixed. `seen` holds the observations of each point.
pub(crate) fn adjusted(
    start: Bundle,
    seen: &[Vec<Seen>],
    guess: &Lens,
    free: &[usize],
    iterations: usize,
) -> Bundle {
    let mut now = start;
    let mut damping = 1e-4;
    for _ in 0..iterations {
        let deviation = now.deviation(seen);
        let before = now.cost(seen, deviation, guess, free);
        let linear: Vec<Vec<Linear>> =
            (0..now.points.len()).into_par_iter().map(|i| now.linear(i, seen, deviation)).collect();
        let mut done = true;
        while damping < 1e8 {
            let next = stepped(&now, &linear, guess, free, damping);
            let then = next.as_ref().map_or(f64::INFINITY, |n| n.cost(seen, deviation, guess, free));
            if let Some(next) = next.filter(|_| then < before) {
                done = before - then < DONE * before;
                now = next;
                damping = (0.1 * damping).max(1e-12);
                break;
            }
            damping *= 10.0;
        }
        if done {
            break;
        }
    }
    now
}

fn stepped(
    now: &Bundle,
    linear: &[Vec<Linear>],
    guess: &Lens,
    free: &[usize],
    damping: f64,
) -> Option<Bundle> {
    let count = free.len() + 6 * now.poses.len();
    let of = |range: std::ops::Range<usize>| {
        let mut system = System::zeros(count);
        let points: Vec<Option<PointPart>> = range.map(|i| system.add(&linear[i], free, damping)).collect();
        (system, points)
    };
    let found: Vec<(System, Vec<Option<PointPart>>)> = parts(linear.len()).into_par_iter().map(of).collect();
    let mut sum = System::zeros(count);
    for (part, _) in &found {
        sum.matrix += &part.matrix;
        sum.gradient += &part.gradient;
        sum.diagonal += &part.diagonal;
    }
    let belief = guess.belief();
    for (a, k) in free.iter().enumerate() {
        let weight = 1.0 / belief[*k].powi(2);
        sum.matrix[(a, a)] += weight;
        sum.gradient[a] += weight * (now.lens.numbers[*k] - guess.numbers[*k]);
    }
    for a in 0..count {
        sum.matrix[(a, a)] += damping * sum.diagonal[a] + 1e-12;
    }
    // The first pose is fixed.
    for a in free.len()..(free.len() + 6).min(count) {
        sum.matrix[(a, a)] += 1e6 * (sum.diagonal[a] + 1.0);
    }
    let step = sum.matrix.cholesky()?.solve(&-&sum.gradient);
    if !step.iter().all(|v| v.is_finite()) {
        return None;
    }
    let mut next = now.clone();
    free.iter().enumerate().for_each(|(a, k)| next.lens.numbers[*k] += step[a]);
    if !(next.lens.numbers[0] > 0.0) {
        return None;
    }
    for (i, pose) in next.poses.iter_mut().enumerate().skip(1) {
        *pose = moved(
            pose,
            &Vector6::from_column_slice(&step.as_slice()[free.len() + 6 * i..free.len() + 6 * i + 6]),
        );
    }
    for (point, part) in next.points.iter_mut().zip(found.iter().flat_map(|(_, points)| points)) {
        let Some(part) = part else { continue };
        let mut gradient = part.gradient;
        for (at, rows) in &part.couplings {
            rows.iter().enumerate().for_each(|(a, row)| gradient += row * step[at + a]);
        }
        *point -= part.inverse * gradient;
    }
    Some(next)
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::Camera;

    use super::*;

    #[test]
    fn wrong_observations_do_not_move_the_solution() {
        let camera =
            Camera { fx: 800.0, fy: 800.0, cx: 320.0, cy: 240.0, width: 640, height: 480, distortion: None };
        let lens = Lens::of(&camera);
        let poses: Vec<Pose> = (0..6)
            .map(|k| Pose::exp(&[0.2 * f64::from(k), 0.0, 2.0, 0.0, -0.1 * f64::from(k), 0.0].into()))
            .collect();
        let points: Vec<Vec3> = (0..60)
            .map(|i| Vec3::from_fn(|axis, _| 0.4 * (f64::from(i) * [1.3, 2.1, 3.7][axis]).sin()))
            .collect();
        let truth = Bundle { lens, poses, points };
        // Every eighth observation is shifted by 40 pixels to one side.
        let wrong = |i: usize, k: usize| (i * 6 + k) % 8 == 3;
        let pixel =
            |i: usize, k: usize| lens.project(&truth.poses[k].transform_point(&truth.points[i])).unwrap();
        let observed =
            |i: usize, k: usize| pixel(i, k) + Vec2::new(if wrong(i, k) { 40.0 } else { 0.0 }, 0.0);
        let seen: Vec<Vec<Seen>> = (0..truth.points.len())
            .map(|i| (0..6).map(|camera| Seen { camera, pixel: observed(i, camera) }).collect())
            .collect();
        let mut start = truth.clone();
        for (k, pose) in start.poses.iter_mut().enumerate().skip(1) {
            let s = k as f64;
            *pose = moved(
                pose,
                &Vector6::new(0.01 * s.sin(), 0.01, -0.01 * s.cos(), 0.01, 0.005 * s.sin(), -0.01),
            );
        }
        let found = adjusted(start, &seen, &lens, &[], 40);
        for i in 0..truth.points.len() {
            for k in 0..6 {
                let off = found.lens.project(&found.poses[k].transform_point(&found.points[i])).unwrap()
                    - pixel(i, k);
                assert!(off.norm() < 0.01, "point {i}, photograph {k}: {} pixels", off.norm());
            }
        }
    }
}
