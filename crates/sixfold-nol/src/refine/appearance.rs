//! The common appearance of the photographs at points of the surface.
//!
//! The dissertation uses the first rendering of its network as the common appearance, in one target view. Points spread over the
//! whole surface cover all target views at once.

use sixfold_geometry::{Pose, Vec3};

use crate::maps::Maps;
use crate::source::SourceView;

/// Values of one photograph at every point: channels, and a weight (0: not visible).
#[derive(Debug, Clone, Default)]
pub(crate) struct PointSamples {
    /// `points * channels` numbers.
    pub values: Vec<f32>,
    pub weights: Vec<f32>,
}

/// Samples one photograph at all points at its current pose, where `allowed` (0 to 1 per pixel of the crop) permits.
pub(crate) fn sample_points(
    view: &SourceView,
    maps: &Maps,
    allowed: &[f32],
    points: &[Vec3],
    normals: &[Vec3],
) -> PointSamples {
    sample_points_at(view, view.camera_from_object(), maps, allowed, points, normals)
}

/// The same with a pose near the current one.
pub(crate) fn sample_points_at(
    view: &SourceView,
    pose: &Pose,
    maps: &Maps,
    allowed: &[f32],
    points: &[Vec3],
    normals: &[Vec3],
) -> PointSamples {
    let channels = maps.channels();
    let mut shown =
        PointSamples { values: vec![0.0; points.len() * channels], weights: vec![0.0; points.len()] };
    let side = view.side();
    for (i, (point, normal)) in points.iter().zip(normals).enumerate() {
        let Some(([x, y], cosine)) = view.see_at(pose, point, normal) else { continue };
        let at = (y.round() as usize).min(side - 1) * side + (x.round() as usize).min(side - 1);
        let weight = cosine * allowed[at];
        if weight > 0.0 {
            maps.sample(x, y, &mut shown.values[i * channels..(i + 1) * channels]);
            shown.weights[i] = weight;
        }
    }
    shown
}

/// Largest difference in mean brightness that is attributed to the light, with brightness from 0 to 1.
const BRIGHTER: f64 = 0.15;

/// Gain and offset per channel that map a photograph's values to the common ones, because light and exposure differ.
#[derive(Debug, Clone)]
pub(crate) struct Light {
    pub gain: Vec<f32>,
    pub offset: Vec<f32>,
}

impl Light {
    pub(crate) fn neutral(channels: usize) -> Self {
        Light { gain: vec![1.0; channels], offset: vec![0.0; channels] }
    }

    /// Least squares of `common` on `shown`, regularised towards no change.
    pub(crate) fn fit(shown: &PointSamples, common: &[f32], common_weights: &[f32], channels: usize) -> Self {
        let mut light = Light::neutral(channels);
        for c in 0..channels {
            // Sums over points: weight, x, y, xx, xy.
            let mut s = [0.0f64; 5];
            for (i, w) in shown.weights.iter().enumerate() {
                if *w <= 0.0 || common_weights[i] <= 0.0 {
                    continue;
                }
                let (x, y) = (f64::from(shown.values[i * channels + c]), f64::from(common[i * channels + c]));
                let robust = 1.0 / (1.0 + ((x - y) / 0.1).powi(2));
                let w = f64::from(*w) * robust;
                for (sum, v) in s.iter_mut().zip([1.0, x, y, x * x, x * y]) {
                    *sum += w * v;
                }
            }
            if s[0] < 20.0 {
                continue;
            }
            let (mx, my) = (s[1] / s[0], s[2] / s[0]);
            let (xx, xy) = (s[3] / s[0] - mx * mx, s[4] / s[0] - mx * my);
            // Regularised towards a gain of one, with the weight of a variance of 0.002.
            let gain = ((xy + 0.002) / (xx + 0.002)).clamp(0.5, 2.0);
            // A larger shift is not caused by the light but by another object.
            let shift = (my - mx).clamp(-BRIGHTER, BRIGHTER);
            light.gain[c] = gain as f32;
            light.offset[c] = (shift + (1.0 - gain) * mx) as f32;
        }
        light
    }

    pub(crate) fn apply(&self, values: &mut [f32]) {
        let channels = self.gain.len();
        for (k, v) in values.iter_mut().enumerate() {
            *v = self.gain[k % channels] * *v + self.offset[k % channels];
        }
    }
}

/// The common appearance: a robust mean over photographs, in which those far from the mean have less weight.
#[derive(Debug, Clone)]
pub(crate) struct Common {
    /// Sums of weighted values, `points * channels`.
    sums: Vec<f32>,
    /// Sums of weights.
    weights: Vec<f32>,
    /// The weight of each photograph at every point.
    parts: Vec<Vec<f32>>,
    channels: usize,
}

/// Difference in colour (of 0 to 1, root of the mean square over channels) at which a photograph has a quarter of its weight.
const FAR: f32 = 0.08;

impl Common {
    /// From values that were adjusted to a common light.
    pub(crate) fn new(shown: &[PointSamples], channels: usize) -> Self {
        let points = shown.first().map_or(0, |s| s.weights.len());
        let mut common = Common {
            sums: vec![0.0; points * channels],
            weights: vec![0.0; points],
            parts: shown.iter().map(|s| s.weights.clone()).collect(),
            channels,
        };
        // A first mean, then two with weights from the previous one.
        for round in 0..3 {
            if round > 0 {
                let mean = common.mean();
                for (part, shown) in common.parts.iter_mut().zip(shown) {
                    for (i, part) in part.iter_mut().enumerate() {
                        if shown.weights[i] <= 0.0 {
                            continue;
                        }
                        let range = i * channels..(i + 1) * channels;
                        let square: f32 = shown.values[range.clone()]
                            .iter()
                            .zip(&mean[range])
                            .map(|(a, b)| (a - b) * (a - b))
                            .sum::<f32>()
                            / channels as f32;
                        *part = shown.weights[i] / (1.0 + square / (FAR * FAR)).powi(2);
                    }
                }
            }
            common.sums.fill(0.0);
            common.weights.fill(0.0);
            for (part, shown) in common.parts.iter().zip(shown) {
                for (i, w) in part.iter().enumerate().filter(|(_, w)| **w > 0.0) {
                    common.weights[i] += w;
                    for c in 0..channels {
                        common.sums[i * channels + c] += w * shown.values[i * channels + c];
                    }
                }
            }
        }
        common
    }

    /// The mean at every point; 0 where no photograph shows it.
    pub(crate) fn mean(&self) -> Vec<f32> {
        let mut mean = self.sums.clone();
        for (values, w) in mean.chunks_exact_mut(self.channels.max(1)).zip(&self.weights) {
            values.iter_mut().for_each(|v| *v = if *w > 0.0 { *v / w } else { 0.0 });
        }
        mean
    }

    /// The mean of all photographs but one, and their total weight.
    pub(crate) fn without(&self, k: usize, shown: &PointSamples) -> (Vec<f32>, Vec<f32>) {
        let mut mean = self.sums.clone();
        let mut weights = self.weights.clone();
        for (i, part) in self.parts[k].iter().enumerate() {
            let left = (weights[i] - part).max(0.0);
            // The difference of nearly equal sums is unreliable.
            let left = if left > 1e-3 { left } else { 0.0 };
            for c in 0..self.channels {
                let at = i * self.channels + c;
                mean[at] = if left > 0.0 { (mean[at] - part * shown.values[at]) / left } else { 0.0 };
            }
            weights[i] = left;
        }
        (mean, weights)
    }
}
