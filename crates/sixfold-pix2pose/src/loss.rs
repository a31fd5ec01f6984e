//! Losses on the networks' outputs, with their gradients (equations 3.1 to 3.3).
//!
//! They are computed in one pass over the pixels. A training step passes the gradient to the network through the sum of output
//! times gradient, whose derivative it is.

use crate::object::SymmetryMap;
use rayon::prelude::*;
use sixfold_geometry::stats::sigmoid;

/// The meaning of a network's channels, and the weights of its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum OutputKind {
    /// The dissertation's network: three coordinates in -1..1 and the error in 0..1, after their activations. Background pixels
    /// have the target 0 and count; sums are divided by all pixels.
    Paper,
    /// Three linear coordinates, the error and the visibility through sigmoids. Coordinates count only on the object; sums are
    /// divided by the sum of the weights.
    Compact,
}

impl OutputKind {
    /// Channels of the output.
    pub(crate) fn channels(self) -> usize {
        match self {
            OutputKind::Paper => 4,
            OutputKind::Compact => 5,
        }
    }
}

/// Weights of the terms.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LossOptions {
    /// Weight of object pixels, beta of equation 3.1.
    pub beta: f32,
    /// Whether hidden pixels of the object have the weight beta too, as in equation 3.1; otherwise only visible ones, as in the
    /// author's code.
    pub whole_mask: bool,
    /// Weight of the error prediction relative to the reconstruction, `lambda_2 / lambda_1` of equation 3.5.
    pub error: f32,
    /// Weight of the visibility (compact network only).
    pub visibility: f32,
}

impl LossOptions {
    /// The dissertation's weights; for the compact network a larger one for the error, which counts only on the object.
    pub(crate) fn of(kind: OutputKind) -> Self {
        match kind {
            OutputKind::Paper => Self { beta: 3.0, whole_mask: false, error: 0.5, visibility: 0.0 },
            OutputKind::Compact => Self { beta: 3.0, whole_mask: false, error: 2.0, visibility: 0.3 },
        }
    }
}

/// Targets of a batch, image after image.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Targets<'a> {
    /// `batch x 3 x side x side`, normalised coordinates of the whole object.
    pub coordinates: &'a [f32],
    /// `batch x side x side`, 1 where the object is, including hidden parts.
    pub object: &'a [f32],
    /// `batch x side x side`, 1 where it is visible.
    pub visible: &'a [f32],
}

/// Means over the batch, and the gradient with respect to the output.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LossValue {
    /// Weighted L1 distance of the coordinates.
    pub coordinates: f64,
    /// Error prediction (before its weight).
    pub error: f64,
    /// Visibility (before its weight).
    pub visibility: f64,
    /// Gradient in the shape of the output, multiplied by the requested scale.
    pub gradient: Vec<f32>,
}

/// Loss and gradient of one object's images. `raw`, the network's output, is `batch x channels x pixels`; the gradient is that of
/// `scale *` the sum over the images (equation 3.2: for each image the minimum of the loss over the pool of symmetries).
///
/// # Panics
/// If the lengths are inconsistent or the pool is empty.
pub(crate) fn loss(
    raw: &[f32],
    targets: &Targets<'_>,
    pixels: usize,
    pool: &[SymmetryMap],
    kind: OutputKind,
    options: &LossOptions,
    scale: f32,
) -> LossValue {
    let channels = kind.channels();
    let batch = raw.len() / (channels * pixels);
    assert!(!pool.is_empty() && batch > 0 && raw.len() == batch * channels * pixels);
    assert!(targets.coordinates.len() == batch * 3 * pixels);
    assert!(targets.object.len() == batch * pixels && targets.visible.len() == batch * pixels);
    let mut gradient = vec![0.0; raw.len()];
    let terms: Vec<[f64; 3]> = gradient
        .par_chunks_mut(channels * pixels)
        .zip(raw.par_chunks(channels * pixels))
        .enumerate()
        .map(|(i, (gradient, raw))| {
            let image = Image {
                raw,
                coordinates: &targets.coordinates[i * 3 * pixels..][..3 * pixels],
                object: &targets.object[i * pixels..][..pixels],
                visible: &targets.visible[i * pixels..][..pixels],
                pixels,
                kind,
                options,
            };
            image.loss(pool, scale, gradient)
        })
        .collect();
    let mean = |term: usize| terms.iter().map(|t| t[term]).sum::<f64>() / batch as f64;
    LossValue { coordinates: mean(0), error: mean(1), visibility: mean(2), gradient }
}

struct Image<'a> {
    raw: &'a [f32],
    coordinates: &'a [f32],
    object: &'a [f32],
    visible: &'a [f32],
    pixels: usize,
    kind: OutputKind,
    options: &'a LossOptions,
}

impl Image<'_> {
    fn weight(&self, pixel: usize) -> f32 {
        let weighty = if self.options.whole_mask { self.object } else { self.visible };
        if weighty[pixel] > 0.5 {
            return self.options.beta;
        }
        match self.kind {
            OutputKind::Paper => 1.0,
            OutputKind::Compact => self.object[pixel],
        }
    }

    fn prediction(&self, pixel: usize) -> [f32; 3] {
        std::array::from_fn(|c| self.raw[c * self.pixels + pixel])
    }

    fn target(&self, pixel: usize, symmetry: &SymmetryMap) -> [f32; 3] {
        if self.object[pixel] <= 0.5 {
            return [0.0; 3];
        }
        symmetry.apply(std::array::from_fn(|c| self.coordinates[c * self.pixels + pixel]))
    }

    /// Sum of weighted distances for one symmetry.
    fn distance(&self, predictions: &[[f32; 3]], weights: &[f32], symmetry: &SymmetryMap) -> f64 {
        let mut sum = 0.0;
        for (pixel, (prediction, weight)) in predictions.iter().zip(weights).enumerate() {
            if *weight > 0.0 {
                let target = self.target(pixel, symmetry);
                let l1: f32 = prediction.iter().zip(target).map(|(p, t)| (p - t).abs()).sum();
                sum += f64::from(weight * l1 / 3.0);
            }
        }
        sum
    }

    fn loss(&self, pool: &[SymmetryMap], scale: f32, gradient: &mut [f32]) -> [f64; 3] {
        let n = self.pixels;
        let predictions: Vec<[f32; 3]> = (0..n).map(|p| self.prediction(p)).collect();
        let weights: Vec<f32> = (0..n).map(|p| self.weight(p)).collect();
        let best = if pool.len() == 1 {
            &pool[0]
        } else {
            let sums: Vec<f64> = pool.iter().map(|s| self.distance(&predictions, &weights, s)).collect();
            let minimum = (0..pool.len()).min_by(|a, b| sums[*a].total_cmp(&sums[*b])).unwrap_or(0);
            &pool[minimum]
        };
        let total = match self.kind {
            OutputKind::Paper => n as f32,
            OutputKind::Compact => weights.iter().sum::<f32>().max(1.0),
        };
        let mut terms = [0.0f64; 3];
        for pixel in 0..n {
            let weight = weights[pixel];
            if weight > 0.0 {
                let prediction = predictions[pixel];
                let target = self.target(pixel, best);
                let mut l1 = 0.0;
                for c in 0..3 {
                    let difference = prediction[c] - target[c];
                    l1 += difference.abs() / 3.0;
                    let sign = if difference == 0.0 { 0.0 } else { difference.signum() };
                    gradient[c * n + pixel] = scale * sign / 3.0 * weight / total;
                }
                terms[0] += f64::from(weight * l1 / total);
                let output = self.raw[3 * n + pixel];
                let (error, slope) = match self.kind {
                    OutputKind::Paper => (output, 1.0),
                    OutputKind::Compact => (sigmoid(output), sigmoid(output) * (1.0 - sigmoid(output))),
                };
                let difference = error - l1.min(1.0);
                // The dissertation's error prediction (equation 3.3) counts every pixel once.
                let weight = if self.kind == OutputKind::Paper { 1.0 } else { weight };
                terms[1] += f64::from(weight * difference * difference / total);
                gradient[3 * n + pixel] =
                    scale * self.options.error * 2.0 * difference * slope * weight / total;
            }
            if self.kind == OutputKind::Compact {
                let logit = self.raw[4 * n + pixel];
                let visible = self.visible[pixel];
                // Binary cross entropy of a logit without overflow.
                let entropy = logit.max(0.0) - logit * visible + (-logit.abs()).exp().ln_1p();
                terms[2] += f64::from(entropy / n as f32);
                gradient[4 * n + pixel] =
                    scale * self.options.visibility * (sigmoid(logit) - visible) / n as f32;
            }
        }
        terms
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const IDENTITY: SymmetryMap =
        SymmetryMap { linear: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], offset: [0.0; 3] };
    const HALF_TURN: SymmetryMap =
        SymmetryMap { linear: [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]], offset: [0.0; 3] };

    struct Case {
        raw: Vec<f32>,
        coordinates: Vec<f32>,
        object: Vec<f32>,
        visible: Vec<f32>,
    }

    fn case(kind: OutputKind, pixels: usize, seed: u64) -> Case {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let object: Vec<f32> = (0..pixels).map(|_| f32::from(rng.random::<f32>() < 0.6)).collect();
        let visible = object.iter().map(|o| o * f32::from(rng.random::<f32>() < 0.7)).collect();
        Case {
            raw: (0..kind.channels() * pixels).map(|_| rng.random_range(-1.5..1.5)).collect(),
            coordinates: (0..3 * pixels).map(|i| object[i % pixels] * rng.random_range(-1.0..1.0)).collect(),
            object,
            visible,
        }
    }

    fn total(case: &Case, raw: &[f32], kind: OutputKind, pool: &[SymmetryMap]) -> (f64, Vec<f32>) {
        let targets =
            Targets { coordinates: &case.coordinates, object: &case.object, visible: &case.visible };
        let options = LossOptions::of(kind);
        let value = loss(raw, &targets, case.object.len(), pool, kind, &options, 1.0);
        let sum = value.coordinates
            + f64::from(options.error) * value.error
            + f64::from(options.visibility) * value.visibility;
        (sum, value.gradient)
    }

    #[test]
    fn gradients_are_the_slopes_of_the_loss() {
        for kind in [OutputKind::Paper, OutputKind::Compact] {
            let case = case(kind, 12, 7);
            let pool = [IDENTITY, HALF_TURN];
            let (_, gradient) = total(&case, &case.raw, kind, &pool);
            // The error's target depends on the coordinates, but no gradient flows through it: that term is excluded from the
            // coordinate channels by comparing only the error and visibility channels there.
            for index in 0..case.raw.len() {
                let step = 1e-3;
                let shifted = |by: f32| {
                    let mut raw = case.raw.clone();
                    raw[index] += by;
                    let options = LossOptions::of(kind);
                    let targets = Targets {
                        coordinates: &case.coordinates,
                        object: &case.object,
                        visible: &case.visible,
                    };
                    let v = loss(&raw, &targets, 12, &pool, kind, &options, 1.0);
                    if index < 36 {
                        v.coordinates
                    } else {
                        f64::from(options.error) * v.error + f64::from(options.visibility) * v.visibility
                    }
                };
                let slope = (shifted(step) - shifted(-step)) / f64::from(2.0 * step);
                let found = f64::from(gradient[index]);
                assert!((slope - found).abs() < 2e-4, "{kind:?} {index}: {slope} {found}");
            }
        }
    }

    #[test]
    fn a_symmetric_prediction_costs_nothing_only_with_its_symmetry_in_the_pool() {
        let mut case = case(OutputKind::Compact, 20, 3);
        for pixel in 0..20 {
            for c in 0..3 {
                let sign = if c < 2 { -1.0 } else { 1.0 };
                case.raw[c * 20 + pixel] = sign * case.coordinates[c * 20 + pixel];
            }
        }
        let targets =
            Targets { coordinates: &case.coordinates, object: &case.object, visible: &case.visible };
        let options = LossOptions::of(OutputKind::Compact);
        let value = |pool: &[SymmetryMap]| {
            loss(&case.raw, &targets, 20, pool, OutputKind::Compact, &options, 1.0).coordinates
        };
        assert!(value(&[IDENTITY, HALF_TURN]) < 1e-6);
        assert!(value(&[IDENTITY]) > 0.1);
    }

    #[test]
    fn hidden_pixels_weigh_beta_in_equation_3_1() {
        // Four pixels: visible, hidden, hidden, background; each with a different error, of which the hidden ones have the weight
        // 3.
        let errors = [0.1, 0.2, 0.4, 0.8f32];
        let raw: Vec<f32> = (0..16).map(|i| if i < 12 { errors[i % 4] } else { 0.0 }).collect();
        let object = [1.0, 1.0, 1.0, 0.0];
        let targets = Targets { coordinates: &[0.0; 12], object: &object, visible: &[1.0, 0.0, 0.0, 0.0] };
        let value = |whole_mask| {
            let options = LossOptions { whole_mask, ..LossOptions::of(OutputKind::Paper) };
            loss(&raw, &targets, 4, &[IDENTITY], OutputKind::Paper, &options, 1.0).coordinates
        };
        assert!((value(true) - (3.0 * (0.1 + 0.2 + 0.4) + 0.8) / 4.0).abs() < 1e-6, "{}", value(true));
        assert!((value(false) - (3.0 * 0.1 + 0.2 + 0.4 + 0.8) / 4.0).abs() < 1e-6, "{}", value(false));
    }

    #[test]
    fn visible_pixels_weigh_beta_and_background_counts_in_the_papers_loss_only() {
        // Two pixels: one visible with an error of 0.3, one background where 0.6 is predicted.
        let mut raw = vec![0.0; 10];
        for c in 0..3 {
            raw[c * 2] = 0.3;
            raw[c * 2 + 1] = 0.6;
        }
        let targets = Targets { coordinates: &[0.0; 6], object: &[1.0, 0.0], visible: &[1.0, 0.0] };
        let compact = LossOptions::of(OutputKind::Compact);
        let value = loss(&raw, &targets, 2, &[IDENTITY], OutputKind::Compact, &compact, 1.0);
        assert!((value.coordinates - 0.3).abs() < 1e-6);
        let paper = LossOptions::of(OutputKind::Paper);
        let value = loss(&raw[..8], &targets, 2, &[IDENTITY], OutputKind::Paper, &paper, 1.0);
        let expected = (3.0 * 0.3 + 0.6) / 2.0;
        assert!((value.coordinates - expected).abs() < 1e-6);
    }
}
