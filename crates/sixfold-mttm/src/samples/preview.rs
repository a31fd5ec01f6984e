//! An image of training samples.

use sixfold_geometry::RgbImage;

use super::batch::Batch;
use crate::network::MAP;
use crate::patch::PLANES;

/// Pixels of the image per pixel of a patch.
const ZOOM: usize = 3;

/// A row for each of the first regions of a batch (patches of `side` pixels): the region, the object's cells in it, the positive
/// template, the negative one; normals as colours, grey where nothing was measured.
pub(crate) fn preview(batch: &Batch, side: usize, rows: usize) -> RgbImage {
    let rows = rows.min(batch.objects.len());
    let tile = side * ZOOM + ZOOM;
    let mut picture = RgbImage::filled(4 * tile, rows * tile, [255; 3]);
    let step = side / MAP;
    for row in 0..rows {
        for column in 0..4 {
            for y in 0..side * ZOOM {
                for x in 0..side * ZOOM {
                    let (u, v) = (x / ZOOM, y / ZOOM);
                    let normal = |values: &[f32]| {
                        let at = |k: usize| values[(row * PLANES + k) * side * side + v * side + u];
                        if at(4) < 0.5 {
                            return [90; 3];
                        }
                        let byte = |n: f32| (127.5 + 127.5 * n).clamp(0.0, 255.0) as u8;
                        [byte(at(0)), byte(at(1)), byte(-at(2))]
                    };
                    let color = match column {
                        0 => normal(&batch.regions),
                        1 => {
                            let fraction = batch.region_masks[row * MAP * MAP + v / step * MAP + u / step];
                            normal(&batch.regions).map(|c| (f32::from(c) * (0.25 + 0.75 * fraction)) as u8)
                        }
                        2 => normal(&batch.positives),
                        _ => normal(&batch.negatives),
                    };
                    picture[(column * tile + x, row * tile + y)] = color;
                }
            }
        }
    }
    picture
}
