//! Similarity of a rendering and a photograph where the object is visible: peak signal-to-noise ratio, structural similarity (Wang
//! et al., *Image Quality Assessment: From Error Visibility to Structural Similarity*, 2004) and a perceptual distance on the
//! features of a trained network (Zhang et al., *The Unreasonable Effectiveness of Deep Features as a Perceptual Metric*, 2018,
//! without its learned weights).

use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_geometry::Mask;
use sixfold_nn::device;
use sixfold_nn::lite0::{Lite0, imagenet_encoder};
use sixfold_nn::weights::WeightsError;
use sixfold_synth::augment::Patch;

use crate::loss::psnr;

/// Standard deviation of the window of structural similarity, pixels; the window extends 5 pixels from its centre.
const SIGMA: f64 = 1.5;
const REACH: isize = 5;
/// The constants of structural similarity for values from 0 to 1.
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;
/// Feature maps that the perceptual distance compares: those at 1/2, 1/4 and 1/8 of the resolution.
const TAPS: usize = 3;

/// Values of the three measures.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Similarity {
    /// Peak signal-to-noise ratio, decibels; larger is better.
    pub psnr: f64,
    /// Structural similarity, at most 1; larger is better.
    pub ssim: f64,
    /// Perceptual distance, 0 or more; smaller is better.
    pub perceptual: f64,
}

/// Peak signal-to-noise ratio in decibels over the pixels of a mask. Both images have the mask's size and values from 0 to 1.
/// 100 for images without difference; `None` for an empty mask.
pub(crate) fn psnr_within(image: &Patch, truth: &Patch, mask: &Mask) -> Option<f64> {
    let area = mask.as_slice().len();
    let (mut sum, mut count) = (0.0, 0usize);
    for at in (0..area).filter(|at| mask.as_slice()[*at]) {
        for c in 0..3 {
            sum += f64::from(image.data[c * area + at] - truth.data[c * area + at]).powi(2);
        }
        count += 3;
    }
    (count > 0).then(|| psnr(sum / count as f64))
}

/// Structural similarity: the mean over the pixels of a mask and over red, green and blue. The Gaussian
/// window (sigma 1.5 pixels, 11 x 11 pixels) includes only pixels in the mask, so that pixels outside the object have no influence.
/// `None` for an empty mask.
pub(crate) fn ssim_within(image: &Patch, truth: &Patch, mask: &Mask) -> Option<f64> {
    let (width, height) = mask.size();
    let area = width * height;
    let inside: Vec<f64> = mask.as_slice().iter().map(|m| f64::from(u8::from(*m))).collect();
    let weight = window(&inside, width, height);
    let count = inside.iter().sum::<f64>();
    if count == 0.0 {
        return None;
    }
    let mut sum = 0.0;
    for c in 0..3 {
        let plane = |patch: &Patch| -> Vec<f64> {
            patch.data[c * area..(c + 1) * area].iter().map(|v| f64::from(*v)).collect()
        };
        let (x, y) = (plane(image), plane(truth));
        let mean = |f: &dyn Fn(usize) -> f64| {
            let values: Vec<f64> = (0..area).map(|i| inside[i] * f(i)).collect();
            window(&values, width, height)
        };
        let moments = [
            mean(&|i| x[i]),
            mean(&|i| y[i]),
            mean(&|i| x[i] * x[i]),
            mean(&|i| y[i] * y[i]),
            mean(&|i| x[i] * y[i]),
        ];
        for i in (0..area).filter(|i| inside[*i] > 0.0) {
            let [mx, my, xx, yy, xy] = std::array::from_fn(|k| moments[k][i] / weight[i]);
            let (vx, vy, cov) = (xx - mx * mx, yy - my * my, xy - mx * my);
            sum += (2.0 * mx * my + C1) * (2.0 * cov + C2)
                / ((mx * mx + my * my + C1) * (vx.max(0.0) + vy.max(0.0) + C2));
        }
    }
    Some(sum / (3.0 * count))
}

/// Sums under the Gaussian window, with zeros beyond the image.
fn window(values: &[f64], width: usize, height: usize) -> Vec<f64> {
    let taps: Vec<f64> = (-REACH..=REACH).map(|k| (-(k * k) as f64 / (2.0 * SIGMA * SIGMA)).exp()).collect();
    let along = |values: &[f64], step: usize, lines: usize, line_step: usize, length: usize| {
        let mut out = vec![0.0; values.len()];
        for line in 0..lines {
            for i in 0..length as isize {
                let mut sum = 0.0;
                for (k, tap) in (-REACH..=REACH).zip(&taps) {
                    if (0..length as isize).contains(&(i + k)) {
                        sum += tap * values[line * line_step + (i + k) as usize * step];
                    }
                }
                out[line * line_step + i as usize * step] = sum;
            }
        }
        out
    };
    let rows = along(values, 1, height, width, width);
    along(&rows, width, width, 1, height)
}

/// The image adjusted to the light of the truth: gain and offset per channel by least squares over the mask, clipped to 0 to 1.
/// This makes images under different lamps or exposures comparable.
pub fn in_light_of(image: &Patch, truth: &Patch, mask: &Mask) -> Patch {
    let area = mask.as_slice().len();
    let mut lit = image.clone();
    for c in 0..3 {
        let mut s = [0.0f64; 5];
        for at in (0..area).filter(|at| mask.as_slice()[*at]) {
            let (x, y) = (f64::from(image.data[c * area + at]), f64::from(truth.data[c * area + at]));
            s.iter_mut().zip([1.0, x, y, x * x, x * y]).for_each(|(sum, v)| *sum += v);
        }
        if s[0] < 2.0 {
            continue;
        }
        let (mx, my) = (s[1] / s[0], s[2] / s[0]);
        let variance = s[3] / s[0] - mx * mx;
        // A single colour does not determine the gain; a negative gain would mean a different image.
        let gain = if variance > 1e-8 { ((s[4] / s[0] - mx * my) / variance).max(0.0) } else { 1.0 };
        let offset = my - gain * mx;
        for v in &mut lit.data[c * area..(c + 1) * area] {
            *v = (gain * f64::from(*v) + offset).clamp(0.0, 1.0) as f32;
        }
    }
    lit
}

/// The pixels of a mask for which all pixels within `reach` along both axes are in the mask too.
pub fn without_border(mask: &Mask, reach: usize) -> Mask {
    let (width, height) = mask.size();
    Mask::from_fn(width, height, |x, y| {
        x >= reach
            && y >= reach
            && x + reach < width
            && y + reach < height
            && (y - reach..=y + reach).all(|v| (x - reach..=x + reach).all(|u| mask[(u, v)]))
    })
}

/// The image shifted by whole pixels, up to `reach` along both axes, to the position where it is most similar to the ground truth
/// in the pixels of a mask that is at least as far from the image's border ([`without_border`]). Annotated poses have errors of a
/// few pixels; this keeps them out of the comparison.
pub fn in_place_of(image: &Patch, truth: &Patch, mask: &Mask, reach: usize) -> Patch {
    let (width, height) = mask.size();
    let area = width * height;
    let inside: Vec<usize> = (0..area).filter(|at| mask.as_slice()[*at]).collect();
    let reach = reach as isize;
    let moved = |at: usize, [dx, dy]: [isize; 2]| (at as isize + dy * width as isize + dx) as usize;
    let error = |shift: [isize; 2]| -> f64 {
        inside
            .iter()
            .map(|at| {
                let from = moved(*at, shift);
                (0..3)
                    .map(|c| f64::from(image.data[c * area + from] - truth.data[c * area + at]).powi(2))
                    .sum::<f64>()
            })
            .sum()
    };
    let mut best = ([0, 0], error([0, 0]));
    for dy in -reach..=reach {
        for dx in -reach..=reach {
            let error = error([dx, dy]);
            if error < best.1 {
                best = ([dx, dy], error);
            }
        }
    }
    let mut placed = image.clone();
    for at in inside {
        for c in 0..3 {
            placed.data[c * area + at] = image.data[c * area + moved(at, best.0)];
        }
    }
    placed
}

/// Compares renderings with photographs.
#[derive(Debug)]
pub struct ImageSimilarity {
    encoder: Lite0,
    device: Device,
}

/// A photograph with which renderings are compared, and the mask of compared pixels.
#[derive(Debug)]
pub struct Truth<'a> {
    patch: &'a Patch,
    mask: &'a Mask,
    maps: Vec<Map>,
}

/// Features normalised to length 1 at every position: channels, then rows.
#[derive(Debug)]
struct Map {
    channels: usize,
    size: [usize; 2],
    values: Vec<f32>,
}

impl ImageSimilarity {
    /// With the shipped EfficientNet-Lite0 encoder (trained on ImageNet).
    ///
    /// # Errors
    /// [`WeightsError`] if the shipped encoder has another version than the program.
    pub fn new() -> Result<Self, WeightsError> {
        let device = device::chosen();
        Ok(ImageSimilarity { encoder: imagenet_encoder(&device)?, device })
    }

    /// Prepares the reference for comparisons: a photograph, in the pixels of a mask of its size.
    pub fn truth<'a>(&self, patch: &'a Patch, mask: &'a Mask) -> Truth<'a> {
        Truth { patch, mask, maps: self.features(patch) }
    }

    /// All measures of a rendering (of the truth's size, values from 0 to 1); `None` if the mask is empty.
    pub fn compare(&self, image: &Patch, truth: &Truth<'_>) -> Option<Similarity> {
        Some(Similarity {
            psnr: psnr_within(image, truth.patch, truth.mask)?,
            ssim: ssim_within(image, truth.patch, truth.mask)?,
            perceptual: self.perceptual(image, truth)?,
        })
    }

    /// Squared differences of features normalised to length 1 at every position: the mean over the mask, then over the maps.
    /// Outside the mask both images show the truth.
    fn perceptual(&self, image: &Patch, truth: &Truth<'_>) -> Option<f64> {
        let area = truth.mask.as_slice().len();
        let mut within = truth.patch.clone();
        for at in (0..area).filter(|at| truth.mask.as_slice()[*at]) {
            (0..3).for_each(|c| within.data[c * area + at] = image.data[c * area + at]);
        }
        let mut sum = 0.0;
        for (map, true_map) in self.features(&within).iter().zip(&truth.maps) {
            let covered = cover(truth.mask, map.size);
            let cells = covered.len();
            let (mut distance, mut weight) = (0.0, 0.0);
            for (cell, covered) in covered.iter().enumerate().filter(|(_, w)| **w > 0.0) {
                let square: f64 = (0..map.channels)
                    .map(|c| {
                        f64::from(map.values[c * cells + cell] - true_map.values[c * cells + cell]).powi(2)
                    })
                    .sum();
                distance += covered * square;
                weight += covered;
            }
            if weight == 0.0 {
                return None;
            }
            sum += distance / weight;
        }
        Some(sum / truth.maps.len().max(1) as f64)
    }

    fn features(&self, patch: &Patch) -> Vec<Map> {
        let values: Vec<f32> = patch.data.iter().map(|v| (255.0 * v - 127.0) / 128.0).collect();
        let image = TensorData::new(values, [1, 3, patch.height, patch.width]);
        let maps = self.encoder.forward_stages(Tensor::from_data(image, &self.device), TAPS);
        maps.into_iter()
            .map(|map| {
                let [_, channels, rows, columns] = map.dims();
                let mut values: Vec<f32> = map
                    .into_data()
                    .try_to_vec()
                    .unwrap_or_else(|error| unreachable!("f32 output: {error:?}"));
                let cells = rows * columns;
                for cell in 0..cells {
                    let length = (0..channels).map(|c| values[c * cells + cell].powi(2)).sum::<f32>().sqrt();
                    (0..channels).for_each(|c| values[c * cells + cell] /= length + 1e-10);
                }
                Map { channels, size: [rows, columns], values }
            })
            .collect()
    }
}

/// Fraction of the mask in every cell of a coarser grid.
fn cover(mask: &Mask, [rows, columns]: [usize; 2]) -> Vec<f64> {
    let (width, height) = mask.size();
    let mut inside = vec![0.0; rows * columns];
    let mut all = vec![0.0f64; rows * columns];
    for (i, m) in mask.as_slice().iter().enumerate() {
        let cell = (i / width) * rows / height * columns + (i % width) * columns / width;
        all[cell] += 1.0;
        inside[cell] += f64::from(u8::from(*m));
    }
    inside.iter().zip(&all).map(|(v, all)| v / all.max(1.0)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn patch(f: impl Fn(usize, usize) -> f32) -> Patch {
        let mut patch = Patch::filled(32, 32, [0.0; 3]);
        for (i, v) in patch.data.iter_mut().enumerate() {
            *v = f(i % 32, i / 32 % 32);
        }
        patch
    }

    #[test]
    fn signal_to_noise_counts_the_mask_alone() {
        let left = Mask::from_fn(32, 32, |x, _| x < 16);
        let truth = patch(|_, _| 0.5);
        // An error of 0.1 in half of the mask, large errors outside it: a mean squared error of 0.005, 23.0103 dB.
        let image = patch(|x, y| if x >= 16 { 0.0 } else { 0.5 + 0.1 * (y % 2) as f32 });
        assert!((psnr_within(&image, &truth, &left).unwrap() - 23.0103).abs() < 1e-3);
        assert_eq!(psnr_within(&truth, &truth, &left), Some(100.0));
        assert_eq!(psnr_within(&truth, &truth, &Mask::filled(32, 32, false)), None);
    }

    #[test]
    fn a_rendering_that_is_off_by_pixels_is_put_in_its_place() {
        let board = |x: usize, y: usize| 0.5 + 0.3 * ((x as f32 * 0.7).sin() * (y as f32 * 0.45).cos());
        let truth = patch(board);
        let image = patch(|x, y| board(x + 3, y.saturating_sub(2)));
        let inner = without_border(&Mask::filled(32, 32, true), 4);
        assert_eq!(inner.as_slice().iter().filter(|m| **m).count(), 24 * 24);
        assert!(inner[(4, 4)] && inner[(27, 27)] && !inner[(3, 10)] && !inner[(10, 28)]);
        let before = psnr_within(&image, &truth, &inner).unwrap();
        let placed = in_place_of(&image, &truth, &inner, 4);
        assert_eq!(psnr_within(&placed, &truth, &inner), Some(100.0), "{before}");
        assert!(before < 30.0);
        // The shift is limited: it cannot reach this position.
        let near = in_place_of(&image, &truth, &inner, 1);
        assert!(psnr_within(&near, &truth, &inner).unwrap() < 60.0);
        // A hole in a mask is a border.
        let hole = Mask::from_fn(32, 32, |x, y| (x, y) != (16, 16));
        assert!(!without_border(&hole, 2)[(14, 18)] && without_border(&hole, 2)[(13, 16)]);
    }

    #[test]
    fn structural_similarity_has_the_values_of_its_formula() {
        let left = Mask::from_fn(32, 32, |x, _| x < 16);
        // Without structure the means remain: (2 x 0.4 x 0.6 + C1) / (0.16 + 0.36 + C1). Pixels outside the mask have no influence.
        let a = patch(|x, _| if x < 16 { 0.4 } else { 0.9 });
        let b = patch(|_, _| 0.6);
        let expected = 0.4801 / 0.5201;
        assert!((ssim_within(&a, &b, &left).unwrap() - expected).abs() < 1e-5);
        assert!((ssim_within(&a, &a, &left).unwrap() - 1.0).abs() < 1e-9);
        // A checkerboard with squares of one pixel, and its inverse: covariance -0.04, variances 0.04.
        let board = |sign: f32| patch(move |x, y| 0.5 + sign * if (x + y) % 2 == 0 { 0.2 } else { -0.2 });
        let inner = Mask::filled(32, 32, true);
        let found = ssim_within(&board(1.0), &board(-1.0), &inner).unwrap();
        let expected = (-0.08 + C2) / (0.08 + C2);
        assert!((found - expected).abs() < 0.01, "{found} {expected}");
        assert_eq!(ssim_within(&a, &b, &Mask::filled(32, 32, false)), None);
    }

    #[test]
    fn light_is_taken_out() {
        let mask = Mask::filled(32, 32, true);
        let truth = patch(|x, y| 0.2 + 0.01 * x as f32 + 0.005 * y as f32);
        let image = patch(|x, y| 0.5 * (0.2 + 0.01 * x as f32 + 0.005 * y as f32) + 0.1);
        assert!(psnr_within(&image, &truth, &mask).unwrap() < 30.0);
        assert!(psnr_within(&in_light_of(&image, &truth, &mask), &truth, &mask).unwrap() > 90.0);
    }

    #[test]
    fn the_perceptual_distance_reacts_to_blur_within_the_mask_only() {
        let judge = ImageSimilarity::new().unwrap();
        let mask = Mask::from_fn(32, 32, |x, y| (8..24).contains(&x) && (8..24).contains(&y));
        let board = patch(|x, y| if (x / 4 + y / 4) % 2 == 0 { 0.8 } else { 0.2 });
        let truth = judge.truth(&board, &mask);
        let mut beside = board.clone();
        beside.data[0] = 0.0;
        assert_eq!(judge.compare(&beside, &truth).unwrap().perceptual, 0.0);
        let blurred = |sigma: f32| {
            let mut patch = board.clone();
            patch.blur(sigma);
            judge.compare(&patch, &truth).unwrap()
        };
        let (little, much) = (blurred(0.7), blurred(3.0));
        assert!(0.0 < little.perceptual && little.perceptual < much.perceptual, "{little:?} {much:?}");
        assert!(little.ssim > much.ssim && little.psnr > much.psnr);
        // Features of length 1 differ by at most 2.
        assert!(much.perceptual < 4.0);
    }

    #[test]
    fn a_coarse_grid_holds_fractions_of_the_mask() {
        let mask = Mask::from_fn(4, 4, |x, y| x == 0 || y == 3);
        assert_eq!(cover(&mask, [2, 2]), vec![0.5, 0.0, 0.75, 0.5]);
    }
}
