//! Simulated photographs of an object, the teaching from them, and the errors of poses and masks.

use std::path::Path;

use anyhow::Result;
use sixfold_geometry::random::{normal, stream};
use sixfold_geometry::{Camera, Pose, RgbImage, Vec2, Vec3, kabsch, stats::median};
use sixfold_io::write_depth;
use sixfold_render::DepthSensor;
use sixfold_shell::output::write_atomically;
use sixfold_teach::simulation::SimulatedCapture;
use sixfold_teach::{KnownLength, SalientSegmenter, ShapeOptions, TeachOptions, Teaching, World};

use super::teach::compose;

/// Writes the photographs below a folder.
pub(super) fn write_photographs(capture: &SimulatedCapture<'_>, files: &Path) -> Result<()> {
    for i in 0..capture.camera_from_board.len() {
        let Some(image) = capture.photograph(i) else { break };
        let file = files.join("photographs").join(format!("{i:02}.jpg"));
        write_atomically(&file, &jpeg(&image)?)?;
    }
    Ok(())
}

/// Metres for a unit of the depth images.
const DEPTH_UNIT: f64 = 1e-4;

/// Writes a simulated RealSense's depth images for the photographs.
pub(super) fn write_depth_images(capture: &SimulatedCapture<'_>, files: &Path) -> Result<()> {
    for i in 0..capture.camera_from_board.len() {
        let Some(depth) = capture.measured_depth(i, &DepthSensor::realsense()) else { break };
        write_depth(&files.join("depth").join(format!("{i:02}.png")), &depth, DEPTH_UNIT)?;
    }
    Ok(())
}

/// The object taught from them: on the board, or without one if a length or the camera is given; with depth images if there are any.
pub(super) fn teaching(
    files: &Path,
    photographs: usize,
    length: Option<KnownLength>,
    camera: Option<Camera>,
) -> Result<Teaching> {
    let world = if length.is_some() || camera.is_some() { World::Features } else { World::Board };
    let options = TeachOptions { world, camera, ..TeachOptions::default() };
    let mut teaching = Teaching::open(files.join("teaching"), &options)?;
    for i in 0..photographs {
        let file = files.join("photographs").join(format!("{i:02}.jpg"));
        teaching.add_photograph(&format!("{i:02}.jpg"), &std::fs::read(&file)?)?;
        let depth = files.join("depth").join(format!("{i:02}.png"));
        if depth.exists() {
            teaching.add_depth(i, &std::fs::read(&depth)?, DEPTH_UNIT)?;
        }
    }
    let shape = ShapeOptions::default();
    teaching.set_length(length)?;
    teaching.locate(&())?;
    teaching.find_masks(&SalientSegmenter::shipped()?, &shape, &())?;
    teaching.reconstruct(&shape, &())?;
    sixfold_io::write_rgb(&files.join("photographs.png"), &teaching.picture()?)?;
    Ok(teaching)
}

/// Medians over the photographs.
pub(super) struct Errors {
    pub with_pose: usize,
    pub camera_mm: f64,
    pub camera_deg: f64,
    pub mask_iou: f64,
}

/// Errors of poses and masks against the truth.
pub(super) fn errors(
    teaching: &Teaching,
    capture: &SimulatedCapture<'_>,
    board_from_world: &Pose,
) -> Result<Errors> {
    let (mut shifts, mut rotations, mut ious) = (vec![], vec![], vec![]);
    for (i, truth) in capture.camera_from_board.iter().enumerate() {
        let Some(found) = teaching.camera_from_board(i) else { continue };
        let found = compose(&found, &board_from_world.inverse());
        shifts.push(1000.0 * (found.inverse().translation() - truth.inverse().translation()).norm());
        rotations.push(found.rotation_angle_to(truth).to_degrees());
        if let (Some(mask), Some(there)) = (teaching.mask(i)?, capture.mask(i)) {
            let pairs = || mask.as_slice().iter().zip(there.as_slice());
            let both = pairs().filter(|(a, b)| **a && **b).count();
            ious.push(both as f64 / pairs().filter(|(a, b)| **a || **b).count() as f64);
        }
    }
    Ok(Errors {
        with_pose: shifts.len(),
        camera_mm: median(&mut shifts).unwrap_or(f64::NAN),
        camera_deg: median(&mut rotations).unwrap_or(f64::NAN),
        mask_iou: median(&mut ious).unwrap_or(f64::NAN),
    })
}

/// Two points of the cloth, marked in three photographs with an error of a pixel.
pub(super) fn marked_length(capture: &SimulatedCapture<'_>, camera: &Camera, seed: u64) -> KnownLength {
    let [first, second] = [Vec3::new(-0.12, -0.08, 0.0), Vec3::new(0.12, 0.08, 0.0)];
    let mut random = stream(seed, 9);
    let mut marked = |i: usize| {
        let mut pixel = |point: &Vec3| {
            let pixel = camera.project(&capture.camera_from_board[i].transform_point(point))?;
            let error = Vec2::new(f64::from(normal(&mut random)), f64::from(normal(&mut random)));
            Some((camera.distort_point(&pixel) + error).into())
        };
        (i, [pixel(&first), pixel(&second)])
    };
    let third = capture.camera_from_board.len() / 4;
    KnownLength { metres: (first - second).norm(), ends: [0, third, 2 * third].map(&mut marked).to_vec() }
}

/// The rigid motion (without scale) that best aligns the cameras with their true poses; that of a single camera.
pub(super) fn board_from_world(teaching: &Teaching, capture: &SimulatedCapture<'_>) -> Result<Pose> {
    let both = capture.camera_from_board.iter().enumerate().filter_map(|(i, truth)| {
        Some((teaching.camera_from_board(i)?.inverse().translation(), truth.inverse().translation()))
    });
    if let ([truth], Some(found)) = (&capture.camera_from_board[..], teaching.camera_from_board(0)) {
        return Ok(compose(&truth.inverse(), &found));
    }
    let (found, truth): (Vec<Vec3>, Vec<Vec3>) = both.unzip();
    Ok(kabsch(&found, &truth, None)?)
}

fn jpeg(image: &RgbImage) -> Result<Vec<u8>> {
    let (w, h) = image.size();
    let copy =
        image::RgbImage::from_fn(w as u32, h as u32, |x, y| image::Rgb(image[(x as usize, y as usize)]));
    let mut bytes = vec![];
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 90).encode_image(&copy)?;
    Ok(bytes)
}
