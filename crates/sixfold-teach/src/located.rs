//! Camera and poses of photographs that show the board.

use std::collections::BTreeMap;

use rayon::prelude::*;
use sixfold_board::{
    Board, BoardError, CalibrationOptions, Corner, Detections, Tag, board_pose, calibrate, detect_tags,
};
use sixfold_geometry::{Camera, Pose, RgbImage};

use crate::error::TeachError;

/// The tags that a photograph shows.
#[derive(Debug, Clone)]
pub struct SeenTags {
    /// The photograph's name in messages.
    pub name: String,
    /// Its width and height, pixels.
    pub size: (usize, usize),
    /// Its tags.
    pub tags: Vec<Tag>,
    /// Whether it is mirrored.
    pub mirrored: bool,
}

impl SeenTags {
    /// Searches for tags in a photograph.
    pub fn of(name: impl Into<String>, image: &RgbImage) -> SeenTags {
        let Detections { tags, mirrored, .. } = detect_tags(image);
        SeenTags { name: name.into(), size: image.size(), mirrored: mirrored > tags.len(), tags }
    }
}

/// Camera and poses of all photographs of a board.
#[derive(Debug, Clone)]
pub struct Located {
    /// The board.
    pub board: Board,
    /// The camera of all photographs.
    pub camera: Camera,
    /// For each photograph the camera's pose, or why it has none.
    pub camera_from_board: Vec<Result<Pose, String>>,
    /// Root mean square distance of the detected corners to the projected corners of the board, pixels.
    pub rms: f64,
}

/// Finds the camera, if it is not known, and its pose in each photograph. `ruler` is the measured length of the ruler on the
/// printed board, metres, if not 0.1.
///
/// # Errors
/// [`TeachError::NoBoard`], [`TeachError::CameraSize`], [`TeachError::Camera`].
pub fn locate(seen: &[SeenTags], camera: Option<&Camera>, ruler: Option<f64>) -> Result<Located, TeachError> {
    let tags: Vec<Tag> = seen.iter().flat_map(|s| s.tags.iter().cloned()).collect();
    let no_board = || TeachError::NoBoard { reasons: reasons(seen.iter().map(|s| (s, Some(few_tags(s))))) };
    let board = Board::of_tags(&tags).ok_or_else(no_board)?;
    let board = ruler.and_then(|ruler| board.with_ruler(ruler)).unwrap_or(board);
    let with_tags = seen.iter().filter(|s| !s.tags.is_empty());
    let size = common_size(with_tags.map(|s| s.size)).ok_or_else(no_board)?;
    let mut states: Vec<Result<(), String>> = seen.iter().map(|s| usable(s, size)).collect();
    let corners: Vec<Vec<Corner>> = seen
        .iter()
        .zip(&states)
        .map(|(s, state)| if state.is_ok() { board.corners(&s.tags) } else { vec![] })
        .collect();
    let (camera, poses, rms) = match camera {
        Some(camera) => with_camera(camera, size, &corners)?,
        None => without_camera(size, &corners).map_err(|source| {
            let why = |(s, c): (&SeenTags, &Vec<Corner>)| {
                usable(s, size).err().or((c.len() < 16).then(|| few_tags(s)))
            };
            let reasons = reasons(seen.iter().zip(&corners).map(|pair| (pair.0, why(pair))));
            TeachError::Camera { source, reasons }
        })?,
    };
    for (state, pose) in states.iter_mut().zip(&poses) {
        if let (Ok(()), Err(error)) = (&state, pose) {
            *state = Err(error.to_string());
        }
    }
    let camera_from_board = states
        .into_iter()
        .zip(poses)
        .map(|(state, pose)| state.and_then(|()| pose.map_err(|e| e.to_string())))
        .collect();
    Ok(Located { board, camera, camera_from_board, rms })
}

fn few_tags(seen: &SeenTags) -> String {
    format!("{} tags", seen.tags.len())
}

fn usable(seen: &SeenTags, (width, height): (usize, usize)) -> Result<(), String> {
    if seen.mirrored {
        return Err(BoardError::Mirrored.to_string());
    }
    if seen.size != (width, height) {
        let (w, h) = seen.size;
        return Err(format!(
            "{w}x{h} pixels, most photographs have {width}x{height}: expected whole images of one camera, as it stores them"
        ));
    }
    Ok(())
}

/// The most common size of the photographs.
pub(crate) fn common_size(sizes: impl Iterator<Item = (usize, usize)>) -> Option<(usize, usize)> {
    let mut counts: BTreeMap<(usize, usize), usize> = BTreeMap::new();
    for size in sizes {
        *counts.entry(size).or_default() += 1;
    }
    counts.into_iter().max_by_key(|(_, count)| *count).map(|(size, _)| size)
}

type Poses = (Camera, Vec<Result<Pose, BoardError>>, f64);

fn with_camera(camera: &Camera, size: (usize, usize), corners: &[Vec<Corner>]) -> Result<Poses, TeachError> {
    if (camera.width, camera.height) != size {
        return Err(TeachError::CameraSize {
            width: size.0,
            height: size.1,
            camera_width: camera.width,
            camera_height: camera.height,
        });
    }
    let found: Vec<_> = corners.par_iter().map(|c| board_pose(c, camera)).collect();
    let squares: Vec<f64> =
        found.iter().flatten().flat_map(|p| p.residuals.iter().map(|r| r.norm_squared())).collect();
    let rms = (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt();
    Ok((*camera, found.into_iter().map(|p| p.map(|p| p.camera_from_board)).collect(), rms))
}

fn without_camera(size: (usize, usize), corners: &[Vec<Corner>]) -> Result<Poses, BoardError> {
    let found = calibrate(corners, size, &CalibrationOptions::default())?;
    let poses = found.views.into_iter().map(|view| view.map(|v| v.camera_from_board)).collect();
    Ok((found.camera, poses, found.rms))
}

/// The first reasons, in one line: `; FILE: REASON; FILE: REASON`.
pub(crate) fn reasons<'a>(of: impl Iterator<Item = (&'a SeenTags, Option<String>)>) -> String {
    let all: Vec<String> = of.filter_map(|(s, reason)| Some(format!("; {}: {}", s.name, reason?))).collect();
    let mut text = all.iter().take(5).cloned().collect::<String>();
    if all.len() > 5 {
        text.push_str(&format!("; and {} more", all.len() - 5));
    }
    text
}
