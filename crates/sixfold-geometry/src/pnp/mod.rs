//! The pose of an object from correspondences between its points and image points (PnP), with outliers.
//!
//! [`pnp_ransac`] draws samples ([`ransac`]), solves each ([`ap3p`] or [`epnp`]), and refines the best pose over all
//! correspondences ([`refine`]). Image points are pixels of the raw image: if the camera has a distortion, it is removed first, and
//! every error is measured in pinhole pixels.

mod ap3p;
mod epnp;
mod ransac;
mod refine;

use nalgebra::SymmetricEigen;
use thiserror::Error;

use crate::pose::nearest_rotation;
use crate::{Camera, CameraError, Mat3, Pose, Vec2, Vec3};

pub use ap3p::p3p;
pub use epnp::epnp;
pub use refine::{RefineOptions, RefineReport, Trust, refine_pose, refine_trusted};

/// Why no pose could be found.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum PnpError {
    /// The lists have different lengths.
    #[error("{object_points} object points, {image_points} image points: expected equal numbers")]
    Lengths {
        /// Length of the first list.
        object_points: usize,
        /// Length of the second list.
        image_points: usize,
    },
    /// Too few correspondences to determine a pose.
    #[error("{found} correspondences: at least 4 are needed")]
    TooFew {
        /// How many were given.
        found: usize,
    },
    /// A coordinate is NaN or infinite.
    #[error("{what} {index} has a coordinate that is not finite")]
    NotFinite {
        /// Which list.
        what: &'static str,
        /// Index in it.
        index: usize,
    },
    /// The camera's distortion has no inverse at an image point.
    #[error("the lens distortion cannot be undone at image point {index}")]
    Undistortable {
        /// Index of the point.
        index: usize,
    },
    /// The points lie on one line or at one place.
    #[error("the {what} are collinear or coincide: they do not determine a pose")]
    Degenerate {
        /// Which points.
        what: &'static str,
    },
    /// No pose explains more correspondences than those of its own sample.
    #[error(
        "no pose agrees with enough correspondences: wrong correspondences, camera or unit, or too small a threshold"
    )]
    NoModel,
    /// The camera is not usable.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// An option is out of range.
    #[error("option {option}: found {found}, expected {expected}")]
    Option {
        /// Name of the option.
        option: &'static str,
        /// Its value.
        found: f64,
        /// The expected value.
        expected: &'static str,
    },
}

/// The solver that computes poses from a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PnpSolver {
    /// Three points, Ke and Roumeliotis (2017).
    #[default]
    Ap3p,
    /// Five points, Lepetit et al. (2009): the dissertation's choice. Needs many more samples when there are outliers.
    Epnp,
}

/// Options of the search for a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PnpOptions {
    /// A correspondence with a smaller reprojection error is an inlier, pixels.
    pub threshold_px: f64,
    /// Maximum number of samples.
    pub max_iterations: usize,
    /// Minimum number of samples, however good the first are.
    pub min_iterations: usize,
    /// The search ends once a sample without outliers was drawn with this probability.
    pub confidence: f64,
    /// Seed of the samples: the same input, options and seed give the same bytes.
    pub seed: u64,
    /// The solver that computes poses from a sample.
    pub solver: PnpSolver,
    /// Maximum number of steps of the local optimisation of each new best pose; 0 for none.
    pub local_iterations: usize,
    /// Refine the result over all correspondences.
    pub refine: bool,
    /// The last step of the refinement estimates the noise from all errors below this many thresholds and weights each
    /// correspondence by its probability of being an inlier; 0 keeps the hard threshold. On noise near the threshold this lowers
    /// the rotation error by a third.
    pub noise_window: f64,
}

impl Default for PnpOptions {
    fn default() -> Self {
        PnpOptions {
            threshold_px: 3.0,
            max_iterations: 10_000,
            min_iterations: 200,
            confidence: 0.9999,
            seed: 0,
            solver: PnpSolver::Ap3p,
            local_iterations: 6,
            refine: true,
            noise_window: 3.0,
        }
    }
}

impl PnpOptions {
    /// Tests every field.
    ///
    /// # Errors
    /// [`PnpError::Option`].
    pub fn check(&self) -> Result<(), PnpError> {
        let bad = |option, found, expected| Err(PnpError::Option { option, found, expected });
        if !(self.threshold_px > 0.0 && self.threshold_px.is_finite()) {
            return bad("threshold_px", self.threshold_px, "above 0 pixels");
        }
        if !(self.confidence > 0.0 && self.confidence < 1.0) {
            return bad("confidence", self.confidence, "between 0 and 1");
        }
        if !(self.noise_window >= 0.0 && self.noise_window.is_finite()) {
            return bad("noise_window", self.noise_window, "0 or more");
        }
        if self.max_iterations == 0 {
            return bad("max_iterations", 0.0, "at least 1");
        }
        if self.min_iterations > self.max_iterations {
            return bad("min_iterations", self.min_iterations as f64, "at most max_iterations");
        }
        Ok(())
    }
}

/// The result of the search.
#[derive(Debug, Clone, PartialEq)]
pub struct PnpReport {
    /// The pose.
    pub camera_from_object: Pose,
    /// Per correspondence, whether its reprojection error is below the threshold.
    pub inliers: Vec<bool>,
    /// Number of inliers.
    pub inlier_count: usize,
    /// Samples drawn.
    pub iterations: usize,
    /// Mean over all correspondences of `1 - min(error / threshold, 1)^2`: 0 no support, 1 perfect.
    pub score: f64,
    /// Root mean square reprojection error of the inliers, pixels.
    pub rms_px: f64,
}

/// Finds `camera_from_object` from correspondences of which many may be wrong. Object points in metres in the object's
/// frame, image points in pixels of the raw image; a distortion of `camera` is undone first.
///
/// ```
/// use sixfold_geometry::{Camera, PnpOptions, Pose, Vec3, pnp_ransac};
/// let camera = Camera::new(572.4, 573.6, 325.3, 242.0, 640, 480)?;
/// let truth = Pose::exp(&[0.02, -0.1, 0.8, 0.3, -0.2, 0.5].into());
/// let points: Vec<Vec3> = (0..30).map(|i| 0.05 * Vec3::new((i as f64).sin(), (2.3 * i as f64).sin(), (3.7 * i as f64).sin())).collect();
/// let mut pixels: Vec<_> = points.iter().map(|p| camera.project(&truth.transform_point(p)).unwrap()).collect();
/// pixels[3].x += 40.0;
/// let found = pnp_ransac(&points, &pixels, &camera, &PnpOptions::default())?;
/// assert!(found.camera_from_object.rotation_angle_to(&truth) < 1e-6);
/// assert_eq!(found.inlier_count, 29);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`PnpError`].
pub fn pnp_ransac(
    object_points: &[Vec3],
    image_points: &[Vec2],
    camera: &Camera,
    options: &PnpOptions,
) -> Result<PnpReport, PnpError> {
    options.check()?;
    let data = Prepared::new(object_points, image_points, camera)?;
    let found = match options.solver {
        PnpSolver::Ap3p => ransac::search::<ransac::Ap3pKernel>(&data, options),
        PnpSolver::Epnp => ransac::search::<ransac::EpnpKernel>(&data, options),
    }
    .ok_or(PnpError::NoModel)?;
    let mut pose = found.pose;
    if options.refine {
        let refinement = RefineOptions { threshold_px: options.threshold_px, ..RefineOptions::default() };
        pose = refine::refine(&data, &pose, &refinement).camera_from_object;
        if options.noise_window > 0.0 {
            let window_px = options.noise_window * options.threshold_px;
            let likely = refine::refine_by_mixture(&data, &pose, window_px, 15);
            // Noise and pose are estimated together; if the result has much less support than before, it is discarded.
            let score = |pose: &Pose| data.report(pose, options.threshold_px, 0).score;
            if score(&likely) > 0.8 * score(&pose) {
                pose = likely;
            }
        }
    }
    let report = data.report(&pose, options.threshold_px, found.iterations);
    if report.inlier_count < 4 { Err(PnpError::NoModel) } else { Ok(report) }
}

/// A rotation and a translation, before they are a [`Pose`].
#[derive(Debug, Clone, Copy)]
struct Model {
    rotation: Mat3,
    translation: Vec3,
}

impl Model {
    const IDENTITY: Model = Model {
        rotation: Mat3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        translation: Vec3::new(0.0, 0.0, 0.0),
    };

    fn pose(&self) -> Pose {
        Pose::new(nearest_rotation(&self.rotation), self.translation)
    }
}

/// Checked correspondences: points relative to their centroid, undistorted image points on the plane `z = 1`.
struct Prepared {
    points: Vec<Vec3>,
    centre: Vec3,
    rays: Vec<Vec2>,
    /// Without distortion.
    camera: Camera,
}

impl Prepared {
    fn new(object_points: &[Vec3], image_points: &[Vec2], camera: &Camera) -> Result<Self, PnpError> {
        camera.check()?;
        if object_points.len() != image_points.len() {
            return Err(PnpError::Lengths {
                object_points: object_points.len(),
                image_points: image_points.len(),
            });
        }
        let n = object_points.len();
        if n < 4 {
            return Err(PnpError::TooFew { found: n });
        }
        if let Some(index) = object_points.iter().position(|p| !p.iter().all(|c| c.is_finite())) {
            return Err(PnpError::NotFinite { what: "object point", index });
        }
        if let Some(index) = image_points.iter().position(|p| !p.iter().all(|c| c.is_finite())) {
            return Err(PnpError::NotFinite { what: "image point", index });
        }
        let centre = object_points.iter().sum::<Vec3>() / n as f64;
        let points: Vec<Vec3> = object_points.iter().map(|p| p - centre).collect();
        let mut rays = Vec::with_capacity(n);
        for (index, m) in image_points.iter().enumerate() {
            let m = camera.undistort_point(m).ok_or(PnpError::Undistortable { index })?;
            rays.push(Vec2::new((m.x - camera.cx) / camera.fx, (m.y - camera.cy) / camera.fy));
        }
        if !spread_in_two(points.iter().copied()) {
            return Err(PnpError::Degenerate { what: "object points" });
        }
        let mean = rays.iter().sum::<Vec2>() / n as f64;
        if !spread_in_two(rays.iter().map(|m| (m - mean).push(0.0))) {
            return Err(PnpError::Degenerate { what: "image points" });
        }
        Ok(Prepared { points, centre, rays, camera: camera.without_distortion() })
    }

    /// The pose for the caller's points.
    fn pose(&self, model: &Model) -> Pose {
        let pose = model.pose();
        pose.with_translation(pose.transform_point(&-self.centre))
    }

    fn report(&self, pose: &Pose, threshold_px: f64, iterations: usize) -> PnpReport {
        let limit = threshold_px * threshold_px;
        let rotation = pose.rotation_matrix();
        let translation = pose.translation();
        let (mut squares, mut gain) = (0.0, 0.0);
        let inliers: Vec<bool> = self
            .points
            .iter()
            .zip(&self.rays)
            .map(|(x, m)| {
                let p = rotation * x + translation;
                let du = self.camera.fx * (p.x / p.z - m.x);
                let dv = self.camera.fy * (p.y / p.z - m.y);
                let square = du * du + dv * dv;
                let inlier = p.z > 0.0 && square < limit;
                if inlier {
                    squares += square;
                    gain += 1.0 - square / limit;
                }
                inlier
            })
            .collect();
        let inlier_count = inliers.iter().filter(|&&i| i).count();
        PnpReport {
            camera_from_object: pose.with_translation(pose.transform_point(&-self.centre)),
            inlier_count,
            iterations,
            score: gain / self.points.len() as f64,
            rms_px: (squares / inlier_count.max(1) as f64).sqrt(),
            inliers,
        }
    }
}

/// Whether points relative to their mean extend in at least two directions.
fn spread_in_two(points: impl Iterator<Item = Vec3>) -> bool {
    let mut covariance = Mat3::zeros();
    for p in points {
        covariance += p * p.transpose();
    }
    let mut values = SymmetricEigen::new(covariance).eigenvalues;
    values.as_mut_slice().sort_by(f64::total_cmp);
    values[2] > 0.0 && values[1] > 1e-12 * values[2]
}

#[cfg(test)]
mod tests;
