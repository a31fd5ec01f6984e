//! The outlier threshold theta_o of an object, chosen on training images with artificial occlusion (dissertation, section 3.4.1).
//!
//! The dissertation chooses among three values "to include more numbers of visible pixels while excluding noisy pixels" and gives
//! no formula. Here the criterion is the intersection over union of the pixels kept by a threshold and the visible pixels, over all
//! samples: a missing visible pixel lowers it as much as a wrong pixel that is kept.

use crate::model::{Pix2PoseModel, Prediction};
use crate::samples::SampleSource;

/// The candidate values (section 3.4.1).
pub(crate) const CANDIDATES: [f32; 3] = [0.1, 0.2, 0.3];
/// Number of samples for the choice.
const SAMPLES: u64 = 64;
/// Samples in a batch.
const BATCH: u64 = 8;
/// Smallest probability of an object pixel, as in the first stage.
const VISIBLE: f32 = 0.5;

/// For each candidate the number of pixels that are kept and visible, and that are kept or visible.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct Overlap {
    both: [u64; CANDIDATES.len()],
    either: [u64; CANDIDATES.len()],
}

impl Overlap {
    /// Adds a prediction of the first stage and the object's visibility (1 or 0), pixel by pixel.
    pub(crate) fn add(&mut self, prediction: &Prediction, visible: &[f32]) {
        for (candidate, threshold) in CANDIDATES.iter().enumerate() {
            for ((seen, error), truth) in prediction.visible.iter().zip(&prediction.error).zip(visible) {
                let (kept, truth) = (*seen > VISIBLE && error < threshold, *truth > 0.5);
                self.both[candidate] += u64::from(kept && truth);
                self.either[candidate] += u64::from(kept || truth);
            }
        }
    }

    /// The candidate with the largest intersection over union; ties go to the smallest.
    pub(crate) fn best(&self) -> f32 {
        let ratio = |i: usize| self.both[i] as f64 / self.either[i].max(1) as f64;
        let best = (0..CANDIDATES.len()).rev().max_by(|a, b| ratio(*a).total_cmp(&ratio(*b)));
        CANDIDATES[best.unwrap_or(0)]
    }
}

/// The threshold of one object of a model, on samples of the first stage. The same source and seed give the same choice.
pub(crate) fn choose(model: &Pix2PoseModel, object_index: usize, source: &SampleSource, seed: u64) -> f32 {
    let mut overlap = Overlap::default();
    for batch in 0..SAMPLES / BATCH {
        let numbers = batch * BATCH..(batch + 1) * BATCH;
        let samples: Vec<_> = numbers.map(|n| source.sample(object_index, seed, n)).collect();
        let crops: Vec<f32> = samples.iter().flat_map(|s| s.rgb.iter().copied()).collect();
        let predictions = model.predict(object_index, &crops);
        predictions.iter().zip(&samples).for_each(|(p, sample)| overlap.add(p, &sample.visible));
    }
    overlap.best()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Six pixels with their expected errors; the first `visible` of them show the object.
    fn chosen(errors: [f32; 6], visible: usize) -> f32 {
        let prediction = Prediction {
            side: 0,
            coordinates: vec![[0.5; 3]; 6],
            error: errors.to_vec(),
            visible: vec![1.0; 6],
        };
        let truth: Vec<f32> = (0..6).map(|i| f32::from(u8::from(i < visible))).collect();
        let mut overlap = Overlap::default();
        overlap.add(&prediction, &truth);
        overlap.best()
    }

    #[test]
    fn the_threshold_keeps_visible_pixels_only() {
        assert_eq!(chosen([0.05, 0.05, 0.05, 0.15, 0.25, 0.4], 3), 0.1);
        assert_eq!(chosen([0.05, 0.05, 0.15, 0.15, 0.25, 0.25], 4), 0.2);
        assert_eq!(chosen([0.05, 0.15, 0.15, 0.25, 0.25, 0.4], 5), 0.3);
        // If all keep the same pixels, the smallest is chosen.
        assert_eq!(chosen([0.05; 6], 6), 0.1);
    }

    #[test]
    fn pixels_without_coordinates_are_not_kept() {
        let prediction = Prediction {
            side: 0,
            coordinates: vec![[0.0; 3]; 4],
            error: vec![0.05, 0.05, 0.15, 0.15],
            visible: vec![0.9, 0.9, 0.0, 0.0],
        };
        let mut overlap = Overlap::default();
        overlap.add(&prediction, &[1.0, 1.0, 0.0, 0.0]);
        assert_eq!(overlap, Overlap { both: [2; 3], either: [2; 3] });
    }
}
