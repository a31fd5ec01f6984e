//! Minimisation of the reprojection errors of corners over the board's poses and, optionally, the camera (Zhang 2000), by damped
//! Gauss-Newton steps (Levenberg 1944, Marquardt 1963) with Huber's weights.

use sixfold_geometry::nalgebra::{DMatrix, DVector, Vector6};
use sixfold_geometry::{BrownConrady, Camera, Pose, Vec2};

use crate::board::Corner;

/// Numbers of a camera: `fx fy cx cy k1 k2 p1 p2 k3`.
pub(crate) const INTRINSICS: usize = 9;
/// A residual beyond this many robust standard deviations counts in proportion to its length instead of its square.
const HUBER: f64 = 2.5;
const ITERATIONS: usize = 60;

/// The unknowns.
#[derive(Debug, Clone)]
pub(crate) struct Unknowns {
    pub camera: [f64; INTRINSICS],
    pub camera_from_board: Vec<Pose>,
}

/// The solution.
#[derive(Debug, Clone)]
pub(crate) struct Solution {
    pub unknowns: Unknowns,
    /// Residuals of the corners of every view, pixels.
    pub residuals: Vec<Vec<Vec2>>,
    /// Standard deviations of the numbers of the camera; zero for fixed ones.
    pub deviations: [f64; INTRINSICS],
}

pub(crate) fn numbers_of(camera: &Camera) -> [f64; INTRINSICS] {
    let d = camera.distortion.unwrap_or_default();
    [camera.fx, camera.fy, camera.cx, camera.cy, d.k1, d.k2, d.p1, d.p2, d.k3]
}

pub(crate) fn camera_of(n: &[f64; INTRINSICS], (width, height): (usize, usize)) -> Camera {
    let distortion = BrownConrady { k1: n[4], k2: n[5], p1: n[6], p2: n[7], k3: n[8] };
    let distortion = (distortion != BrownConrady::default()).then_some(distortion);
    Camera { fx: n[0], fy: n[1], cx: n[2], cy: n[3], width, height, distortion }
}

/// The projection of a corner; `None` behind the camera.
fn projected(n: &[f64; INTRINSICS], camera_from_board: &Pose, corner: &Corner) -> Option<Vec2> {
    let p = camera_from_board.transform_point(&corner.on_board);
    if !(p.z > 1e-6) {
        return None;
    }
    let lens = BrownConrady { k1: n[4], k2: n[5], p1: n[6], p2: n[7], k3: n[8] };
    let d = lens.distort(&Vec2::new(p.x / p.z, p.y / p.z));
    Some(Vec2::new(n[0] * d.x + n[2], n[1] * d.y + n[3]))
}

fn moved(pose: &Pose, twist: &[f64]) -> Pose {
    let step = Pose::exp(&Vector6::from_column_slice(twist));
    let r = step.rotation() * pose.rotation();
    Pose::new(r, step.rotation() * pose.translation() + step.translation())
}

fn residuals(unknowns: &Unknowns, views: &[Vec<Corner>]) -> Option<Vec<Vec<Vec2>>> {
    let of_view = |(pose, corners): (&Pose, &Vec<Corner>)| {
        corners
            .iter()
            .map(|c| Some(projected(&unknowns.camera, pose, c)? - c.pixel))
            .collect::<Option<Vec<_>>>()
    };
    unknowns.camera_from_board.iter().zip(views).map(of_view).collect()
}

/// 1.4826 times the median length: the standard deviation along one axis, robust to outliers, at least 0.02 pixels.
fn robust_deviation(residuals: &[Vec<Vec2>]) -> f64 {
    let mut lengths: Vec<f64> = residuals.iter().flatten().flat_map(|r| [r.x.abs(), r.y.abs()]).collect();
    lengths.sort_by(f64::total_cmp);
    lengths.get(lengths.len() / 2).map_or(0.02, |m| (1.4826 * m).max(0.02))
}

fn weight(residual: &Vec2, deviation: f64) -> f64 {
    (HUBER * deviation / residual.norm().max(1e-12)).min(1.0)
}

/// Huber's cost.
fn cost(residuals: &[Vec<Vec2>], deviation: f64) -> f64 {
    let limit = HUBER * deviation;
    let of = |r: &Vec2| {
        let length = r.norm();
        if length <= limit { length * length } else { limit * (2.0 * length - limit) }
    };
    residuals.iter().flatten().map(of).sum()
}

/// The unknowns with the minimum cost near a start; of the camera, only the parameters `free` may change.
pub(crate) fn solve(start: Unknowns, views: &[Vec<Corner>], free: &[usize]) -> Option<Solution> {
    let mut unknowns = start;
    let mut now = residuals(&unknowns, views)?;
    let mut damping = 1e-3;
    let mut last = None;
    for _ in 0..ITERATIONS {
        let deviation = robust_deviation(&now);
        let (h, g) = normal_equations(&unknowns, views, &now, free, deviation)?;
        let before = cost(&now, deviation);
        let mut done = true;
        while damping < 1e8 {
            let mut damped = h.clone();
            for i in 0..damped.nrows() {
                damped[(i, i)] += damping * h[(i, i)] + 1e-12;
            }
            let step = damped.cholesky().map(|c| c.solve(&-&g));
            let next = step.filter(|s| s.iter().all(|v| v.is_finite())).map(|s| stepped(&unknowns, &s, free));
            let then = next.as_ref().and_then(|next| residuals(next, views));
            if let (Some(next), Some(then)) = (next, then)
                && cost(&then, deviation) < before
            {
                done = before - cost(&then, deviation) < 1e-10 * before;
                (unknowns, now) = (next, then);
                damping = (0.2 * damping).max(1e-12);
                break;
            }
            damping *= 5.0;
        }
        last = Some((h, deviation));
        if done {
            break;
        }
    }
    let (h, deviation) = last?;
    let mut deviations = [0.0; INTRINSICS];
    if !free.is_empty() {
        let inverse = h.cholesky()?.inverse();
        for (i, number) in free.iter().enumerate() {
            deviations[*number] = deviation * inverse[(i, i)].max(0.0).sqrt();
        }
    }
    Some(Solution { unknowns, residuals: now, deviations })
}

fn stepped(unknowns: &Unknowns, step: &DVector<f64>, free: &[usize]) -> Unknowns {
    let mut camera = unknowns.camera;
    for (i, number) in free.iter().enumerate() {
        camera[*number] += step[i];
    }
    let pose =
        |(i, pose): (usize, &Pose)| moved(pose, &step.as_slice()[free.len() + 6 * i..free.len() + 6 * i + 6]);
    Unknowns { camera, camera_from_board: unknowns.camera_from_board.iter().enumerate().map(pose).collect() }
}

/// Weighted sums of Jacobians, by central differences.
fn normal_equations(
    unknowns: &Unknowns,
    views: &[Vec<Corner>],
    now: &[Vec<Vec2>],
    free: &[usize],
    deviation: f64,
) -> Option<(DMatrix<f64>, DVector<f64>)> {
    let count = free.len() + 6 * views.len();
    let (mut h, mut g) = (DMatrix::zeros(count, count), DVector::zeros(count));
    for (i, (corners, residuals)) in views.iter().zip(now).enumerate() {
        let pose = &unknowns.camera_from_board[i];
        let places: Vec<usize> = (0..free.len()).chain((0..6).map(|k| free.len() + 6 * i + k)).collect();
        let changed: Vec<_> = (0..places.len())
            .map(|k| {
                let at = |sign: f64| {
                    let (mut camera, mut twist) = (unknowns.camera, [0.0; 6]);
                    let size = match free.get(k) {
                        Some(number) => {
                            let size = if *number < 4 { 1e-3 } else { 1e-6 };
                            camera[*number] += sign * size;
                            size
                        }
                        None => {
                            twist[k - free.len()] = sign * 1e-6;
                            1e-6
                        }
                    };
                    (camera, moved(pose, &twist), size)
                };
                (at(1.0), at(-1.0))
            })
            .collect();
        for (corner, residual) in corners.iter().zip(residuals) {
            let mut jacobian = Vec::with_capacity(places.len());
            for ((camera, pose, size), (other_camera, other_pose, _)) in &changed {
                let forth = projected(camera, pose, corner)?;
                let back = projected(other_camera, other_pose, corner)?;
                jacobian.push((forth - back) / (2.0 * size));
            }
            let weight = weight(residual, deviation);
            for (a, ja) in places.iter().zip(&jacobian) {
                g[*a] += weight * ja.dot(residual);
                for (b, jb) in places.iter().zip(&jacobian) {
                    h[(*a, *b)] += weight * ja.dot(jb);
                }
            }
        }
    }
    Some((h, g))
}
