//! Several images on one sheet, for people.

use std::path::Path;

use anyhow::Result;
use sixfold_bop::BopDataset;
use sixfold_geometry::RgbImage;
use sixfold_io::write_rgb;

use crate::overlay;

/// Scenes and colour views of a dataset shown.
const SCENES: usize = 6;
const VIEWS: usize = 3;
/// Width of an image of a dataset in pixels.
const WIDTH: usize = 320;
/// Colour around images that do not fill their cells.
const EMPTY: [u8; 3] = [24; 3];

/// Puts an image into a larger one.
fn paste(sheet: &mut RgbImage, image: &RgbImage, left: usize, top: usize) {
    for y in 0..image.height() {
        for x in 0..image.width() {
            sheet[(left + x, top + y)] = image[(x, y)];
        }
    }
}

/// Images row by row in cells of the given width and height in pixels, each with a text.
pub fn sheet(rows: &[Vec<(RgbImage, String)>], (width, height): (usize, usize)) -> Option<RgbImage> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    if columns == 0 || width == 0 || height == 0 {
        return None;
    }
    let mut sheet = RgbImage::filled(columns * width, rows.len() * height, EMPTY);
    for (row, list) in rows.iter().enumerate() {
        for (column, (image, text)) in list.iter().enumerate() {
            let (left, top) = (column * width, row * height);
            paste(&mut sheet, image, left, top);
            if !text.is_empty() {
                overlay::label(&mut sheet, [(left + 2) as f64, (top + 12) as f64], text, [255; 3]);
            }
        }
    }
    Some(sheet)
}

/// Writes square images row by row, each with a text; nothing where there is no image.
///
/// # Errors
/// When the file cannot be written.
pub fn write_sheet(path: &Path, rows: &[Vec<(RgbImage, String)>]) -> Result<()> {
    let side = rows.iter().flatten().map(|(image, _)| image.width()).max().unwrap_or(0);
    match sheet(rows, (side, side)) {
        Some(sheet) => Ok(write_rgb(path, &sheet)?),
        None => Ok(()),
    }
}

/// The first scenes of a dataset: a row per scene, its first views in colour, then the depth of the first. None without images.
///
/// # Errors
/// When an image cannot be read.
pub fn first_scenes(dataset: &BopDataset) -> Result<Option<RgbImage>> {
    let mut rows = vec![];
    for scene_id in dataset.scene_ids().into_iter().take(SCENES) {
        let scene = dataset.scene(scene_id)?;
        let mut row = vec![];
        for im_id in scene.image_ids().into_iter().take(VIEWS) {
            row.extend(scene.rgb(im_id)?.map(|image| (smaller(&image), String::new())));
        }
        if let Some(first) = scene.image_ids().first()
            && let Some(depth) = scene.depth(*first)?
        {
            row.push((smaller(&overlay::depth_picture(&depth)), String::new()));
        }
        rows.push(row);
    }
    let height = rows.iter().flatten().map(|(image, _)| image.height()).max().unwrap_or(0);
    Ok(sheet(&rows, (WIDTH, height)))
}

/// The image at the sheet's width: each pixel is the mean of the pixels that it replaces.
fn smaller(image: &RgbImage) -> RgbImage {
    let (width, height) = image.size();
    let scale = width as f64 / WIDTH as f64;
    let range = |k: usize, size: usize| {
        let low = ((k as f64 * scale) as usize).min(size - 1);
        low..(((k + 1) as f64 * scale).ceil() as usize).clamp(low + 1, size)
    };
    RgbImage::from_fn(WIDTH, ((height as f64 / scale) as usize).max(1), |x, y| {
        let mut sum = [0u32; 3];
        let mut count = 0;
        for v in range(y, height) {
            for u in range(x, width) {
                for (sum, c) in sum.iter_mut().zip(image[(u, v)]) {
                    *sum += u32::from(c);
                }
                count += 1;
            }
        }
        sum.map(|s| (s / count.max(1)) as u8)
    })
}
