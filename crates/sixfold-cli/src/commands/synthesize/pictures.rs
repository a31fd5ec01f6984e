//! Images of what was done: outlines at the poses before and after, and a sheet of new views.

use std::path::Path;

use anyhow::{Result, anyhow};
use sixfold_data::RoughImages;
use sixfold_geometry::{Camera, Pose, RgbImage};
use sixfold_io::write_rgb;
use sixfold_mesh::Mesh;
use sixfold_nol::SourceView;
use sixfold_nol::pose_file::PoseFile;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

use sixfold_shell::overlay;
use sixfold_shell::sheets::{paste, sheet};

/// Side of an image in a sheet.
const SIDE: usize = 160;
const BEFORE: [u8; 3] = [255, 220, 0];
const AFTER: [u8; 3] = [0, 255, 120];

/// Draws the outline of a mesh into a square crop.
fn outline(image: &mut RgbImage, mesh: &Mesh, camera: &Camera, pose: &Pose, color: [u8; 3]) {
    let mut frame = VisibilityBuffer::new(camera);
    frame.render(&[SceneObject { mesh, camera_from_object: *pose }], &RenderOptions::default());
    let (width, height) = image.size();
    let covered = |x: usize, y: usize| frame.inverse_depth()[y * width + x] > 0.0;
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let inner = covered(x, y);
            let border = [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)];
            if inner && border.iter().any(|(x, y)| !covered(*x, *y)) {
                image[(x, y)] = color;
            }
        }
    }
}

/// One row per object, one column per photograph: above the outline at the given pose, below at the refined one.
pub(super) fn refinement(path: &Path, images: &RoughImages, poses: &PoseFile) -> Result<()> {
    let columns = images.objects.iter().map(|o| o.images.len()).max().unwrap_or(0);
    if columns == 0 {
        return Ok(());
    }
    let mut sheet = RgbImage::filled(columns * SIDE, images.objects.len() * 2 * SIDE, [24; 3]);
    let mut records = poses.photographs.iter();
    for (row, object) in images.objects.iter().enumerate() {
        for (column, (image, record)) in object.images.iter().zip(records.by_ref()).enumerate() {
            let (given, refined) = (&image.posed, record.pose().map_err(|reason| anyhow!(reason))?);
            let view = SourceView::new(given, &object.mesh, SIDE)?;
            for (below, pose, color) in [(0, given.camera_from_object(), BEFORE), (1, &refined, AFTER)] {
                let mut picture = view.patch.to_rgb();
                outline(&mut picture, &object.mesh, &view.camera, pose, color);
                paste(&mut sheet, &picture, column * SIDE, (2 * row + below) * SIDE);
            }
        }
        overlay::label(&mut sheet, [2.0, (2 * row * SIDE + 12) as f64], "given", BEFORE);
        overlay::label(&mut sheet, [2.0, ((2 * row + 1) * SIDE + 12) as f64], "refined", AFTER);
    }
    Ok(write_rgb(path, &sheet)?)
}

/// A sheet of square images, row by row, each with a text.
pub(super) fn preview(path: &Path, rows: &[Vec<(RgbImage, String)>]) -> Result<()> {
    let side = rows.iter().flatten().map(|(p, _)| p.width()).max().unwrap_or(0);
    match sheet(rows, (side, side)) {
        Some(sheet) => Ok(write_rgb(path, &sheet)?),
        None => Ok(()),
    }
}
