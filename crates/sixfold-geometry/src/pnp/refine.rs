//! The pose that minimises the truncated squared reprojection error, `sum min(r^2, threshold^2)`, over all
//! correspondences: Levenberg-Marquardt in which residuals above the threshold have no influence (Blake and Zisserman 1987; Torr
//! and Zisserman's MSAC cost, 2000).

use super::{PnpError, Prepared};
use crate::{Camera, Mat3, NormalEquations, Pose, Vec2, Vec3};

/// Options of the refinement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefineOptions {
    /// Correspondences with a larger reprojection error have no influence, pixels.
    pub threshold_px: f64,
    /// Maximum number of steps.
    pub max_iterations: usize,
    /// Ends when a step lowers the cost by less than this fraction.
    pub convergence: f64,
}

impl Default for RefineOptions {
    fn default() -> Self {
        RefineOptions { threshold_px: 3.0, max_iterations: 50, convergence: 1e-9 }
    }
}

impl RefineOptions {
    /// Tests every field.
    ///
    /// # Errors
    /// [`PnpError::Option`].
    pub fn check(&self) -> Result<(), PnpError> {
        if !(self.threshold_px > 0.0 && self.threshold_px.is_finite()) {
            let found = self.threshold_px;
            return Err(PnpError::Option { option: "threshold_px", found, expected: "above 0 pixels" });
        }
        if !(self.convergence >= 0.0) {
            let found = self.convergence;
            return Err(PnpError::Option { option: "convergence", found, expected: "0 or more" });
        }
        Ok(())
    }
}

/// The result of a refinement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefineReport {
    /// The refined pose.
    pub camera_from_object: Pose,
    /// Sum over all correspondences of the squared reprojection error, each at most the squared threshold; pixels squared.
    pub cost: f64,
    /// Correspondences within the threshold.
    pub inlier_count: usize,
    /// Steps tried.
    pub iterations: usize,
}

/// Refines a pose over all correspondences, outliers included: object points in metres, image points in pixels of the
/// raw image (a distortion of `camera` is undone first; errors are measured in pinhole pixels).
///
/// # Errors
/// [`PnpError`] as for [`pnp_ransac`](crate::pnp_ransac); [`PnpError::NoModel`] when fewer than three correspondences
/// are within the threshold of `initial`.
pub fn refine_pose(
    object_points: &[Vec3],
    image_points: &[Vec2],
    camera: &Camera,
    initial: &Pose,
    options: &RefineOptions,
) -> Result<RefineReport, PnpError> {
    options.check()?;
    let data = Prepared::new(object_points, image_points, camera)?;
    let start = initial.with_translation(initial.transform_point(&data.centre));
    let refined = refine(&data, &start, options);
    if refined.inlier_count < 3 {
        return Err(PnpError::NoModel);
    }
    let pose = &refined.camera_from_object;
    let camera_from_object = pose.with_translation(pose.transform_point(&-data.centre));
    Ok(RefineReport { camera_from_object, ..refined })
}

/// As [`refine_pose`], for points relative to their centroid.
pub(super) fn refine(data: &Prepared, initial: &Pose, options: &RefineOptions) -> RefineReport {
    let limit = options.threshold_px * options.threshold_px;
    let mut pose = *initial;
    let mut equations = linearise(data, &pose, limit, |_, _| 1.0);
    let mut lambda = 1e-4;
    let mut iterations = 0;
    while iterations < options.max_iterations && equations.count >= 6 {
        iterations += 1;
        let Some(step) = equations.solve(lambda) else {
            lambda = lambda.max(1e-6) * 10.0;
            if lambda > 1e6 { break } else { continue }
        };
        let next = pose * Pose::exp(&step);
        let next_equations = linearise(data, &next, limit, |_, _| 1.0);
        if next_equations.cost < equations.cost {
            let gain = equations.cost - next_equations.cost;
            let small = gain <= options.convergence * equations.cost;
            pose = next;
            equations = next_equations;
            lambda = (lambda * 0.1).max(1e-10);
            if small {
                break;
            }
        } else {
            if step.amax() < 1e-10 || lambda > 1e6 {
                break;
            }
            lambda *= 10.0;
        }
    }
    RefineReport {
        camera_from_object: pose,
        cost: equations.cost,
        inlier_count: equations.count / 2,
        iterations,
    }
}

/// The most likely pose when errors are normally distributed in both pixel directions for inliers and uniformly for outliers.
/// The standard deviation and the outliers' density are estimated from the errors below `window_px`, alternating with the pose
/// (expectation maximisation, Dempster, Laird and Rubin 1977). This replaces the hard threshold: a point's weight is the
/// probability that it is an inlier.
pub(super) fn refine_by_mixture(data: &Prepared, initial: &Pose, window_px: f64, iterations: usize) -> Pose {
    let window = window_px * window_px;
    let mut pose = *initial;
    // Initial values: a standard deviation of a quarter of the window, and half of its points outliers.
    let (mut variance, mut fraction) = (window / 16.0, 0.5);
    let mut squares = Vec::with_capacity(data.points.len());
    for _ in 0..iterations {
        squares.clear();
        linearise(data, &pose, window, |_, square| {
            squares.push(square);
            0.0
        });
        let probability = |square: f64, variance: f64, fraction: f64| {
            let inlier = fraction / (2.0 * variance) * (-0.5 * square / variance).exp();
            inlier / (inlier + (1.0 - fraction) / window)
        };
        for _ in 0..3 {
            let (mut weights, mut sum) = (0.0, 0.0);
            for &square in &squares {
                let w = probability(square, variance, fraction);
                weights += w;
                sum += w * square;
            }
            if !(weights > 6.0) {
                return *initial;
            }
            variance = (0.5 * sum / weights).max(1e-12 * window);
            fraction = (weights / squares.len() as f64).clamp(0.01, 0.999);
        }
        let equations = linearise(data, &pose, window, |_, square| probability(square, variance, fraction));
        let Some(step) = equations.solve(1e-9) else { return *initial };
        pose = pose * Pose::exp(&step);
        if step.amax() < 1e-7 {
            break;
        }
    }
    pose
}

/// Expected accuracy of an image point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trust {
    /// Expected error, pixels.
    pub spread_px: f64,
    /// Probability that it is not an outlier, 0 to 1.
    pub weight: f64,
}

/// Refines a pose over correspondences of different accuracy: least squares of the errors divided by their spreads, with the
/// Cauchy loss, by iterative reweighting (Holland and Welsch 1977).
///
/// # Errors
/// As for [`refine_pose`]; [`PnpError::NoModel`] when the trusted correspondences do not determine a pose.
pub fn refine_trusted(
    object_points: &[Vec3],
    image_points: &[Vec2],
    trust: &[Trust],
    camera: &Camera,
    initial: &Pose,
) -> Result<Pose, PnpError> {
    if trust.len() != image_points.len() {
        return Err(PnpError::Lengths { object_points: trust.len(), image_points: image_points.len() });
    }
    let data = Prepared::new(object_points, image_points, camera)?;
    if trust.iter().filter(|t| t.weight > MIN_WEIGHT).count() < 3 {
        return Err(PnpError::NoModel);
    }
    let mut pose = initial.with_translation(initial.transform_point(&data.centre));
    for _ in 0..TRUSTED_STEPS {
        let weight = |i: usize, square: f64| {
            let Trust { spread_px, weight } = trust[i];
            let variance = spread_px * spread_px;
            weight / (variance + square)
        };
        let step = linearise(&data, &pose, f64::INFINITY, weight).solve(1e-6).ok_or(PnpError::NoModel)?;
        pose = pose * Pose::exp(&step);
        if !pose.translation().iter().all(|c| c.is_finite()) || pose.translation().z <= 0.0 {
            return Err(PnpError::NoModel);
        }
        if step.amax() < 1e-8 {
            break;
        }
    }
    Ok(pose.with_translation(pose.transform_point(&-data.centre)))
}

/// Points with a smaller weight are ignored.
const MIN_WEIGHT: f64 = 1e-6;
/// Maximum number of steps of [`refine_trusted`].
const TRUSTED_STEPS: usize = 20;

/// The normal equations of the correspondences within the threshold; their cost counts all. The twist moves the object
/// in its own frame, about its centroid, where rotation and translation are least correlated.
fn linearise(
    data: &Prepared,
    pose: &Pose,
    limit: f64,
    mut weight: impl FnMut(usize, f64) -> f64,
) -> NormalEquations {
    let r: Mat3 = pose.rotation_matrix();
    let t = pose.translation();
    let (fx, fy) = (data.camera.fx, data.camera.fy);
    let mut sum = NormalEquations::default();
    let mut outside = 0usize;
    for (i, (x, m)) in data.points.iter().zip(&data.rays).enumerate() {
        let p = r * x + t;
        let inverse = 1.0 / p.z;
        let (a, b) = (p.x * inverse, p.y * inverse);
        let (ru, rv) = (fx * (a - m.x), fy * (b - m.y));
        let square = ru * ru + rv * rv;
        if !(p.z > 0.0 && square < limit) {
            outside += 1;
            continue;
        }
        let weight = weight(i, square);
        let (su, sv) = (fx * inverse, fy * inverse);
        // Rows of d(pixel)/d(point), rotated into the object's frame.
        let gu = Vec3::new(
            su * (r[(0, 0)] - a * r[(2, 0)]),
            su * (r[(0, 1)] - a * r[(2, 1)]),
            su * (r[(0, 2)] - a * r[(2, 2)]),
        );
        let gv = Vec3::new(
            sv * (r[(1, 0)] - b * r[(2, 0)]),
            sv * (r[(1, 1)] - b * r[(2, 1)]),
            sv * (r[(1, 2)] - b * r[(2, 2)]),
        );
        let (wu, wv) = (x.cross(&gu), x.cross(&gv));
        sum.add(&[gu.x, gu.y, gu.z, wu.x, wu.y, wu.z], ru, weight);
        sum.add(&[gv.x, gv.y, gv.z, wv.x, wv.y, wv.z], rv, weight);
    }
    sum.cost += outside as f64 * limit;
    sum
}
