//! The camera's pose from one photograph of the board.

use sixfold_geometry::homography::homography;
use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion};
use sixfold_geometry::{Camera, Mat3, Pose, Vec2, Vec3};

use crate::board::Corner;
use crate::bundle::{Unknowns, numbers_of, solve};
use crate::error::BoardError;

/// Minimum number of tags in a usable photograph: with one or two, the board's tilt is ambiguous.
pub(crate) const FEWEST_TAGS: usize = 4;
/// Largest edge width, as a fraction of a tag's side: one cell; with wider edges neighbouring cells merge.
const WIDEST_EDGE: f64 = 1.0 / 8.0;
/// Edges narrower than this many pixels never count as blurred.
const SHARP: f64 = 4.0;
/// Largest distance of corners from the projected board, as a fraction of a tag's side, and in pixels.
const MISFIT: (f64, f64) = (0.02, 1.0);

/// The board in a photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardPose {
    /// Takes points of the board to the camera's frame.
    pub camera_from_board: Pose,
    /// The residual of each corner: its difference to the projected corner of the board, pixels.
    pub residuals: Vec<Vec2>,
    /// Root mean square of the residuals, pixels.
    pub rms: f64,
}

/// The board's pose in a photograph of a known camera, from corners in stored pixels (lens distortion
/// included).
///
/// # Errors
/// [`BoardError::TooFewTags`], [`BoardError::Blurred`], [`BoardError::DoesNotFit`].
pub fn board_pose(corners: &[Corner], camera: &Camera) -> Result<BoardPose, BoardError> {
    check_corners(corners)?;
    let start = initial_pose(corners, camera).ok_or(BoardError::NoSolution)?;
    let views = [corners.to_vec()];
    let solutions = [start, leaning_the_other_way(&start)].map(|pose| {
        let unknowns = Unknowns { camera: numbers_of(camera), camera_from_board: vec![pose] };
        solve(unknowns, &views, &[])
    });
    let found = solutions
        .into_iter()
        .flatten()
        .filter_map(|mut s| {
            let residuals = s.residuals.pop()?;
            let rms = root_mean_square(&residuals);
            Some(BoardPose { camera_from_board: s.unknowns.camera_from_board[0], residuals, rms })
        })
        .min_by(|a, b| a.rms.total_cmp(&b.rms))
        .ok_or(BoardError::NoSolution)?;
    let maximum = allowed_misfit(corners);
    if found.rms > maximum {
        return Err(BoardError::DoesNotFit { found: found.rms, maximum });
    }
    Ok(found)
}

/// An error if corners are too few or too blurred.
pub(crate) fn check_corners(corners: &[Corner]) -> Result<(), BoardError> {
    if corners.len() < 4 * FEWEST_TAGS {
        return Err(BoardError::TooFewTags { found: corners.len() / 4, minimum: FEWEST_TAGS });
    }
    let width = median(corners.iter().map(|c| c.edge_width));
    let maximum = (WIDEST_EDGE * median(corners.iter().map(|c| c.side))).max(SHARP);
    if width > maximum {
        return Err(BoardError::Blurred { width, maximum });
    }
    Ok(())
}

/// Largest allowed distance of corners from the projected board, pixels.
pub(crate) fn allowed_misfit(corners: &[Corner]) -> f64 {
    (MISFIT.0 * median(corners.iter().map(|c| c.side))).max(MISFIT.1)
}

pub(crate) fn root_mean_square(residuals: &[Vec2]) -> f64 {
    (residuals.iter().map(|r| r.norm_squared()).sum::<f64>() / residuals.len().max(1) as f64).sqrt()
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// The pose from the homography between board and image (Zhang 2000, section 3.1).
pub(crate) fn initial_pose(corners: &[Corner], camera: &Camera) -> Option<Pose> {
    let normalised = |pixel: &Vec2| {
        let p = camera.undistort_point(pixel)?;
        Some(Vec2::new((p.x - camera.cx) / camera.fx, (p.y - camera.cy) / camera.fy))
    };
    let pairs = corners.iter().map(|c| Some((c.on_board.xy(), normalised(&c.pixel)?)));
    let map = homography(&pairs.collect::<Option<Vec<_>>>()?)?;
    pose_of(&map)
}

fn pose_of(map: &Mat3) -> Option<Pose> {
    let (h1, h2, h3) = (map.column(0), map.column(1), map.column(2));
    let mut scale = 2.0 / (h1.norm() + h2.norm());
    if h3[2] < 0.0 {
        scale = -scale;
    }
    let (r1, r2, t): (Vec3, Vec3, Vec3) = (h1 * scale, h2 * scale, h3 * scale);
    let rough = Mat3::from_columns(&[r1, r2, r1.cross(&r2)]);
    let svd = rough.svd(true, true);
    let rotation = svd.u? * svd.v_t?;
    let good = rotation.determinant() > 0.0 && t.iter().all(|v| v.is_finite()) && t.z > 0.0;
    good.then(|| {
        Pose::new(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation)), t)
    })
}

/// The ambiguous second pose: a distant flat object looks nearly the same when tilted the other way
/// (Schweighofer and Pinz 2006).
fn leaning_the_other_way(pose: &Pose) -> Pose {
    let Some(sight) = pose.translation().try_normalize(1e-12) else { return *pose };
    let normal = pose.transform_direction(&Vec3::z());
    let mirrored = sight * (2.0 * normal.dot(&sight)) - normal;
    match UnitQuaternion::rotation_between(&normal, &mirrored) {
        Some(turn) => Pose::new(turn * pose.rotation(), pose.translation()),
        None => *pose,
    }
}
