//! An image of the training's progress, written with every checkpoint.

use std::path::Path;

use burn::tensor::Tensor;
use sixfold_synth::augment::Backgrounds;

use crate::network::{COLOURS, Network};
use crate::samples::{Batch, ViewSampleOptions, make_sample};
use crate::training::pass;
use sixfold_nn::device;

/// Rows of the image, and sources in each.
const ROWS: u64 = 5;
const SOURCES: usize = 5;
const SIDE: usize = 128;

/// The same synthetic objects in every image.
pub(crate) struct Preview {
    batch: Batch,
}

impl Preview {
    pub(crate) fn new(textures: &Backgrounds, options: &ViewSampleOptions, seed: u64) -> Self {
        // Sample numbers that no training reaches.
        let sample = |row| make_sample(textures, options, SIDE, SOURCES, seed, u64::MAX - row);
        let samples: Vec<_> = (0..ROWS).map(sample).collect();
        Preview { batch: Batch::of_samples(&samples) }
    }

    /// Writes an image with sources, the true target, the sources' average, X^D and X^phi to `folder`. A failure to write it does
    /// not stop the training.
    pub(crate) fn draw(&self, network: &Network, folder: &Path) {
        let passed = pass(network, self.batch.clone(), &device::chosen());
        let plain = |t: Tensor<4>| -> Vec<f32> { t.into_data().try_to_vec().unwrap_or_default() };
        let (average, _) = self.batch.average();
        let images = [
            plain(passed.target * passed.mask.clone()),
            average,
            plain(passed.blend.sum.narrow(1, 0, COLOURS)),
            plain(passed.image * passed.mask),
        ];
        let (rows, columns) = (self.batch.samples, SOURCES + images.len());
        let mut picture = vec![0u8; 3 * rows * columns * SIDE * SIDE];
        let mut put = |row: usize, column: usize, values: &[f32], number: usize| {
            for (c, plane) in
                values[number * COLOURS * SIDE * SIDE..].chunks(SIDE * SIDE).take(COLOURS).enumerate()
            {
                for (i, v) in plane.iter().enumerate() {
                    let (y, x) = (row * SIDE + i / SIDE, column * SIDE + i % SIDE);
                    picture[3 * (y * columns * SIDE + x) + c] = (127.5 * (v.clamp(-1.0, 1.0) + 1.0)) as u8;
                }
            }
        };
        for row in 0..rows {
            for k in 0..SOURCES {
                put(row, k, &self.batch.images, k * rows + row);
            }
            for (k, image) in images.iter().enumerate() {
                put(row, SOURCES + k, image, row);
            }
        }
        let (width, height) = ((columns * SIDE) as u32, (rows * SIDE) as u32);
        let file = folder.join("preview.png");
        // The first image is written before the first checkpoint, which creates the folder.
        let saved = std::fs::create_dir_all(folder).map_err(image::ImageError::IoError).and_then(|()| {
            image::save_buffer(&file, &picture, width, height, image::ExtendedColorType::Rgb8)
        });
        // If the image cannot be written, neither can the checkpoint after it, whose error is reported.
        let _ = saved;
    }
}
