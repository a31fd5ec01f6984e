//! One image of the first scenes: a row per scene, its first views in colour, then the depth of the first.

use std::path::Path;

use anyhow::Result;
use sixfold_bop::BopDataset;
use sixfold_geometry::RgbImage;
use sixfold_io::write_rgb;

use sixfold_shell::overlay;

/// Scenes and colour views shown.
const SCENES: usize = 6;
const VIEWS: usize = 3;
/// Width of an image in pixels.
const WIDTH: usize = 320;

pub(super) fn write(path: &Path, dataset: &BopDataset) -> Result<()> {
    let mut rows = vec![];
    for scene_id in dataset.scene_ids().into_iter().take(SCENES) {
        let scene = dataset.scene(scene_id)?;
        let mut row = vec![];
        for im_id in scene.image_ids().into_iter().take(VIEWS) {
            row.extend(scene.rgb(im_id)?.map(|image| smaller(&image)));
        }
        if let Some(first) = scene.image_ids().first()
            && let Some(depth) = scene.depth(*first)?
        {
            row.push(smaller(&overlay::depth_picture(&depth)));
        }
        rows.push(row);
    }
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let height = rows.iter().flatten().map(RgbImage::height).max().unwrap_or(0);
    if columns == 0 || height == 0 {
        return Ok(());
    }
    let mut sheet = RgbImage::filled(columns * WIDTH, rows.len() * height, [24; 3]);
    for (row, pictures) in rows.iter().enumerate() {
        for (column, picture) in pictures.iter().enumerate() {
            for y in 0..picture.height() {
                for x in 0..picture.width() {
                    sheet[(column * WIDTH + x, row * height + y)] = picture[(x, y)];
                }
            }
        }
    }
    Ok(write_rgb(path, &sheet)?)
}

/// The image at the preview's width: each pixel the mean of those it stands for.
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
