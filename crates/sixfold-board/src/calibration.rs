//! A camera from several photographs of the board (Zhang 2000).

use sixfold_geometry::homography::homography;
use sixfold_geometry::{Camera, Pose, Vec2};

use crate::board::Corner;
use crate::bundle::{INTRINSICS, Solution, Unknowns, camera_of, numbers_of, solve};
use crate::error::BoardError;
use crate::pose::{allowed_misfit, check_corners, initial_pose, root_mean_square};

/// Minimum number of photographs for a camera with lens distortion.
const FEWEST: usize = 4;
/// Largest standard deviation of the focal length, as a fraction of it.
const KNOWN: f64 = 0.02;

/// Which parameters are estimated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CalibrationOptions {
    /// Whether lens distortion `k1 k2 p1 p2` is estimated; otherwise the camera is a pinhole.
    pub distortion: bool,
    /// Whether `k3` is estimated too, for wide lenses.
    pub third_radial: bool,
}

impl Default for CalibrationOptions {
    fn default() -> Self {
        CalibrationOptions { distortion: true, third_radial: false }
    }
}

/// The board in one of the photographs.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Takes points of the board to the camera's frame.
    pub camera_from_board: Pose,
    /// The residual of each corner: its difference to the projected corner of the board, pixels.
    pub residuals: Vec<Vec2>,
    /// Root mean square of the residuals, pixels.
    pub rms: f64,
}

/// A calibrated camera.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// The camera, with its distortion.
    pub camera: Camera,
    /// Standard deviations of `fx fy cx cy` in pixels and `k1 k2 p1 p2 k3`; zero for parameters that were not estimated.
    pub deviations: [f64; INTRINSICS],
    /// For every photograph, the board's pose in it, or why it was not used.
    pub views: Vec<Result<View, BoardError>>,
    /// Root mean square residual over the used photographs, pixels.
    pub rms: f64,
}

/// The camera of photographs of `size` pixels. Each of `photographs` holds the corners found in one of them
/// ([`Board::corners`](crate::Board::corners)). A photograph with too few tags, a blurred one, and one that does not fit the others
/// is left out with its reason.
///
/// # Errors
/// [`BoardError::TooFewPhotographs`], [`BoardError::Undetermined`] when all are taken from the same direction,
/// [`BoardError::NoSolution`].
pub fn calibrate(
    photographs: &[Vec<Corner>],
    size: (usize, usize),
    options: &CalibrationOptions,
) -> Result<Calibration, BoardError> {
    let mut states: Vec<Result<(), BoardError>> = photographs.iter().map(|p| check_corners(p)).collect();
    let mut solution = None;
    // Repeat after a photograph that does not fit was left out.
    for _ in 0..3 {
        let used: Vec<usize> = (0..states.len()).filter(|i| states[*i].is_ok()).collect();
        if used.len() < FEWEST {
            return Err(BoardError::TooFewPhotographs { found: used.len(), minimum: FEWEST });
        }
        let views: Vec<Vec<Corner>> = used.iter().map(|i| photographs[*i].clone()).collect();
        let found = of_views(&views, size, options)?;
        let mut all_fit = true;
        for ((i, residuals), corners) in used.iter().zip(&found.residuals).zip(&views) {
            let (rms, maximum) = (root_mean_square(residuals), allowed_misfit(corners));
            if rms > maximum {
                states[*i] = Err(BoardError::DoesNotFit { found: rms, maximum });
                all_fit = false;
            }
        }
        solution = Some(found);
        if all_fit {
            break;
        }
    }
    let solution = solution.filter(|s| s.residuals.len() == states.iter().filter(|s| s.is_ok()).count());
    finished(solution.ok_or(BoardError::NoSolution)?, states, size)
}

fn finished(
    solution: Solution,
    states: Vec<Result<(), BoardError>>,
    size: (usize, usize),
) -> Result<Calibration, BoardError> {
    let camera = camera_of(&solution.unknowns.camera, size);
    let deviations = solution.deviations;
    let (focal, deviation) = (camera.fx, deviations[0].max(deviations[1]));
    if !(deviation <= KNOWN * focal) {
        return Err(BoardError::Undetermined { focal, deviation });
    }
    if camera.check_whole_image().is_err() {
        return Err(BoardError::NoSolution);
    }
    let rms = root_mean_square(&solution.residuals.concat());
    let mut views =
        solution.unknowns.camera_from_board.into_iter().zip(solution.residuals).map(|(pose, residuals)| {
            let rms = root_mean_square(&residuals);
            View { camera_from_board: pose, residuals, rms }
        });
    let of_state =
        |state: Result<(), BoardError>| state.and_then(|()| views.next().ok_or(BoardError::NoSolution));
    let views = states.into_iter().map(of_state).collect();
    Ok(Calibration { camera, deviations, views, rms })
}

fn of_views(
    views: &[Vec<Corner>],
    (width, height): (usize, usize),
    options: &CalibrationOptions,
) -> Result<Solution, BoardError> {
    let focal = initial_focal(views, width, height).unwrap_or(1.2 * width.max(height) as f64);
    let (cx, cy) = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    let start = Camera { fx: focal, fy: focal, cx, cy, width, height, distortion: None };
    let poses = views.iter().map(|v| initial_pose(v, &start)).collect::<Option<Vec<_>>>();
    let mut unknowns =
        Unknowns { camera: numbers_of(&start), camera_from_board: poses.ok_or(BoardError::NoSolution)? };
    // First only the pinhole parameters: a distortion fitted to rough poses may not be invertible.
    let mut stages: Vec<&[usize]> = vec![&[0, 1], &[0, 1, 2, 3]];
    if options.distortion {
        stages.push(&[0, 1, 2, 3, 4]);
        stages.push(if options.third_radial {
            &[0, 1, 2, 3, 4, 5, 6, 7, 8]
        } else {
            &[0, 1, 2, 3, 4, 5, 6, 7]
        });
    }
    let mut found = None;
    for free in stages {
        let solution = solve(unknowns.clone(), views, free).ok_or(BoardError::NoSolution)?;
        unknowns = solution.unknowns.clone();
        found = Some(solution);
    }
    found.ok_or(BoardError::NoSolution)
}

/// The focal length for which the board's axes are perpendicular and of equal length in every photograph, with the principal point
/// at the centre (Zhang 2000, section 3.1); `None` if all views are frontal.
fn initial_focal(views: &[Vec<Corner>], width: usize, height: usize) -> Option<f64> {
    let centre = Vec2::new(0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    let (mut numerator, mut denominator) = (0.0, 0.0);
    for view in views {
        let pairs: Vec<_> = view.iter().map(|c| (c.on_board.xy(), c.pixel - centre)).collect();
        let Some(h) = homography(&pairs) else { continue };
        // In units of the image's size, for numbers of similar magnitude.
        let s = 1.0 / width.max(height) as f64;
        let (a, b) = (h.column(0), h.column(1));
        let scale = (a.xy().norm_squared() + b.xy().norm_squared()) * s * s;
        for (xy, z) in [
            (a[0] * b[0] + a[1] * b[1], a[2] * b[2]),
            (a[0] * a[0] + a[1] * a[1] - b[0] * b[0] - b[1] * b[1], a[2] * a[2] - b[2] * b[2]),
        ] {
            let (xy, z) = (xy * s * s / scale, z / scale);
            // xy / f^2 = -z
            numerator -= xy * z;
            denominator += xy * xy;
        }
    }
    let inverse = numerator / denominator;
    let focal = width.max(height) as f64 / inverse.sqrt();
    (inverse > 0.0 && (0.2..20.0).contains(&(focal / width.max(height) as f64))).then_some(focal)
}
