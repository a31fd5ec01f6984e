//! Intrinsics and poses of a camera from photographs of the printed board, for all commands on such photographs: computation,
//! lists in files, and images.

mod ends;
mod photographs;
mod pictures;

use std::path::PathBuf;

use anyhow::{Result, anyhow, bail};
use serde::Serialize;
use sixfold_board::{Board, BoardError, CalibrationOptions, Corner, Paper, board_pose, calibrate};
use sixfold_geometry::{Camera, Pose, RgbImage, Vec2};
use sixfold_io::CameraFile;

pub use self::ends::{Ends, TwoPixels};
use self::photographs::leave_out_other_sizes;
pub use self::photographs::{Photograph, photograph_files, read_photographs};

/// The value of `--ruler`, millimetres, in metres.
///
/// # Errors
/// When a ruler on a sheet of paper cannot have this length.
pub fn ruler_in_metres(ruler: Option<f64>) -> Result<Option<f64>> {
    let Some(millimetres) = ruler else { return Ok(None) };
    let metres = millimetres / 1000.0;
    match Board::new(Paper::A4).with_ruler(metres) {
        Some(_) => Ok(Some(metres)),
        None => bail!("--ruler: found {millimetres}, expected 10 to 1000 millimetres"),
    }
}

/// The camera and all photographs, as `photographs.json` lists them.
#[derive(Serialize)]
pub struct Calibrated {
    /// The paper that the board was printed on.
    pub paper: Paper,
    /// Side of a tag, metres.
    pub tag_side: f64,
    /// The camera.
    pub camera: Camera,
    /// Standard deviations of fx, fy, cx, cy, k1, k2, p1, p2, k3; absent for a given camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deviations: Option<[f64; 9]>,
    /// Root mean square of all residuals, pixels.
    pub rms_px: f64,
    /// All photographs, including those that are not used.
    pub photographs: Vec<Listed>,
}

/// A photograph.
#[derive(Serialize)]
pub struct Listed {
    /// Path of the file.
    pub file: PathBuf,
    /// Number of tags found in it.
    pub tags: usize,
    /// Pose of the board, row by row. Absent if the photograph is not used, as the fields below.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera_from_board: Option<[[f64; 4]; 4]>,
    /// Root mean square of its residuals, pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rms_px: Option<f64>,
    /// Why it is not used.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub left_out: Option<String>,
    /// The corners of its tags.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub corners: Vec<ListedCorner>,
}

/// A corner of a tag in a photograph.
#[derive(Serialize)]
pub struct ListedCorner {
    /// Number of the tag.
    pub tag: usize,
    /// Its detected position, pixels.
    pub pixel: [f64; 2],
    /// Difference to the projected corner of the board, pixels.
    pub residual: [f64; 2],
}

/// The board in a photograph that was used.
struct Used {
    camera_from_board: Pose,
    residuals: Vec<Vec2>,
    rms: f64,
}

/// The joint solution of all photographs.
struct Solved {
    camera: Camera,
    deviations: Option<[f64; 9]>,
    rms: f64,
    views: Vec<Result<Used, String>>,
}

impl Calibrated {
    /// Computes the poses with a known camera or, without one, the camera and the poses. `ruler` is the measured length of the
    /// board's ruler in metres, if it differs from the nominal length. Photographs of another size than most are left out.
    ///
    /// # Errors
    /// When no photograph shows a board, too few show enough of it, or the known camera does not fit the images.
    pub fn of(
        photographs: &mut [Photograph],
        ruler: Option<f64>,
        known: Option<&CameraFile>,
        options: &CalibrationOptions,
    ) -> Result<Calibration> {
        let tags: Vec<_> = photographs.iter().flat_map(|p| p.tags.iter().cloned()).collect();
        let Some(board) = Board::of_tags(&tags) else {
            bail!(
                "no photograph shows a board of `sixfold board`; {}",
                reasons(photographs.iter().map(|p| (&p.file, p.left_out.as_deref())))
            );
        };
        let board = ruler.and_then(|ruler| board.with_ruler(ruler)).unwrap_or(board);
        let size = leave_out_other_sizes(photographs)?;
        let corners: Vec<Vec<Corner>> = photographs
            .iter()
            .map(|p| if p.left_out.is_none() { board.corners(&p.tags) } else { vec![] })
            .collect();
        let solved = match known {
            Some(file) => with_camera(file, size, &corners)?,
            None => without_camera(options, size, &corners).map_err(|error| {
                let why = |p: &Photograph| p.left_out.clone();
                let reasons = reasons_of(photographs, &corners, why);
                anyhow!("{error}{reasons}")
            })?,
        };
        let (calibrated, poses) = listed(&board, solved, photographs, &corners);
        Ok(Calibration { calibrated, poses })
    }
}

/// A calibration with the poses as poses.
pub struct Calibration {
    /// The camera and all photographs.
    pub calibrated: Calibrated,
    /// `camera_from_board` of each photograph, including those that are left out because of their size.
    pub poses: Vec<Option<Pose>>,
}

impl Calibration {
    /// How many photographs are used.
    pub fn used(&self) -> usize {
        self.calibrated.photographs.iter().filter(|p| p.left_out.is_none()).count()
    }

    /// All photographs with the tags in them and the board's axes: x red, y green, z blue.
    pub fn overview(&self, photographs: &[Photograph]) -> RgbImage {
        pictures::photographs(photographs, &self.calibrated, &self.poses)
    }

    /// The enlarged residuals of all corners at their positions in the photographs, one colour per photograph.
    pub fn residuals(&self) -> RgbImage {
        pictures::residuals(&self.calibrated)
    }
}

/// The poses with a known camera.
fn with_camera(file: &CameraFile, size: (usize, usize), corners: &[Vec<Corner>]) -> Result<Solved> {
    let mut camera = file.camera;
    if file.sized {
        camera.check_image(size.0, size.1)?;
    } else {
        (camera.width, camera.height) = size;
        camera.check_whole_image()?;
    }
    let views: Vec<Result<Used, String>> = corners
        .iter()
        .map(|c| {
            let found = board_pose(c, &camera).map_err(|e| e.to_string())?;
            Ok(Used {
                camera_from_board: found.camera_from_board,
                residuals: found.residuals,
                rms: found.rms,
            })
        })
        .collect();
    let residuals: Vec<&Vec2> = views.iter().flatten().flat_map(|v| &v.residuals).collect();
    let sum: f64 = residuals.iter().map(|r| r.norm_squared()).sum();
    let rms = (sum / residuals.len().max(1) as f64).sqrt();
    Ok(Solved { camera, deviations: None, rms, views })
}

/// The camera and the poses.
fn without_camera(
    options: &CalibrationOptions,
    size: (usize, usize),
    corners: &[Vec<Corner>],
) -> Result<Solved, BoardError> {
    let found = calibrate(corners, size, options)?;
    let views = found.views.into_iter().map(|view| {
        let view = view.map_err(|e| e.to_string())?;
        Ok(Used { camera_from_board: view.camera_from_board, residuals: view.residuals, rms: view.rms })
    });
    let views = views.collect();
    Ok(Solved { camera: found.camera, deviations: Some(found.deviations), rms: found.rms, views })
}

/// The list to be written, and the pose of each photograph.
fn listed(
    board: &Board,
    solved: Solved,
    photographs: &[Photograph],
    corners: &[Vec<Corner>],
) -> (Calibrated, Vec<Option<Pose>>) {
    let poses = solved.views.iter().map(|v| v.as_ref().ok().map(|v| v.camera_from_board)).collect();
    let of = |((photograph, corners), view): ((&Photograph, &Vec<Corner>), &Result<Used, String>)| {
        let reason = photograph.left_out.clone().or_else(|| view.as_ref().err().cloned());
        let view = view.as_ref().ok().filter(|_| reason.is_none());
        let corner = |(c, r): (&Corner, &Vec2)| ListedCorner {
            tag: c.tag,
            pixel: [c.pixel.x, c.pixel.y],
            residual: [r.x, r.y],
        };
        Listed {
            file: photograph.file.clone(),
            tags: photograph.tags.len(),
            camera_from_board: view.map(|v| v.camera_from_board.rows()),
            rms_px: view.map(|v| v.rms),
            left_out: reason,
            corners: view.map_or_else(Vec::new, |v| corners.iter().zip(&v.residuals).map(corner).collect()),
        }
    };
    let calibrated = Calibrated {
        paper: board.paper(),
        tag_side: board.tag_side(),
        camera: solved.camera,
        deviations: solved.deviations,
        rms_px: solved.rms,
        photographs: photographs.iter().zip(corners).zip(&solved.views).map(of).collect(),
    };
    (calibrated, poses)
}

/// The reasons why photographs cannot be used, for an error that ends the command.
fn reasons_of(
    photographs: &[Photograph],
    corners: &[Vec<Corner>],
    why: impl Fn(&Photograph) -> Option<String>,
) -> String {
    let reasons: Vec<(&PathBuf, Option<String>)> = photographs
        .iter()
        .zip(corners)
        .map(|(p, c)| {
            let few = (c.len() < 16).then(|| format!("{} tags", c.len() / 4));
            (&p.file, why(p).or(few))
        })
        .collect();
    let text = reasons_text(reasons.iter().map(|(f, r)| (*f, r.as_deref())));
    if text.is_empty() { text } else { format!("; {text}") }
}

fn reasons<'a>(of: impl Iterator<Item = (&'a PathBuf, Option<&'a str>)>) -> String {
    let text = reasons_text(of);
    if text.is_empty() { "show more of the board, sharp and well lit".to_owned() } else { text }
}

/// The first reasons, in one line.
fn reasons_text<'a>(of: impl Iterator<Item = (&'a PathBuf, Option<&'a str>)>) -> String {
    let all: Vec<String> =
        of.filter_map(|(file, reason)| reason.map(|r| format!("{}: {r}", file.display()))).collect();
    let mut text = all.iter().take(5).cloned().collect::<Vec<_>>().join("; ");
    if all.len() > 5 {
        text.push_str(&format!("; and {} more", all.len() - 5));
    }
    text
}
