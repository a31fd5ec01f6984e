//! The training of HAF's linear classifier: a support vector machine with hinge loss by dual coordinate descent (Hsieh et al. 2008,
//! "A dual coordinate descent method for large-scale linear SVM"), with one pass over all candidates per step. Then the logistic
//! curve over its margin (Platt 1999).

use rand::RngExt;
use rayon::prelude::*;
use sixfold_geometry::random::stream;
use sixfold_grasp::learned::{HafModel, HeightFeature, HeightGrid};
use sixfold_nn::learner::Checkpointed;
use sixfold_nn::options::Pace;
use sixfold_nn::schedule::LearningRate;
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};
use sixfold_nn::{Checkpoint, CheckpointError, CheckpointWriter};

use crate::haf_features::chosen;
use crate::samples::Sample;

/// Cost of a candidate on the wrong side of the margin: C of the support vector machine. Chosen by hand; not swept.
const COST: f64 = 1e-3;

/// Features of height grids, with mean 0 and variance 1.
#[derive(Debug)]
pub struct HafSamples {
    features: Vec<HeightFeature>,
    means: Vec<f64>,
    deviations: Vec<f64>,
    /// A row for each candidate and each of its mirror images; the last number is 1.
    rows: Vec<Vec<f32>>,
    signs: Vec<f64>,
}

impl HafSamples {
    /// Selects features and computes them.
    pub(crate) fn new(samples: &[Sample<HeightGrid>], seed: u64) -> HafSamples {
        let features = chosen(samples, seed);
        let rows: Vec<(Vec<f64>, f64)> = samples
            .par_iter()
            .flat_map_iter(|sample| {
                let sign = if sample.held { 1.0 } else { -1.0 };
                let features = &features;
                [(false, false), (true, false), (false, true), (true, true)].map(|(closing, across)| {
                    let grid = sample.seen.mirrored(closing, across);
                    (features.iter().map(|f| f64::from(f.value(&grid))).collect(), sign)
                })
            })
            .collect();
        let count = rows.len().max(1) as f64;
        let over = |of: &dyn Fn(&[f64], usize) -> f64| -> Vec<f64> {
            (0..features.len()).map(|k| rows.iter().map(|r| of(&r.0, k)).sum::<f64>() / count).collect()
        };
        let means = over(&|row, k| row[k]);
        let squares = over(&|row, k| (row[k] - means[k]).powi(2));
        let deviations: Vec<f64> = squares.iter().map(|v| v.sqrt().max(1e-6)).collect();
        let scaled = |row: &[f64]| {
            let value = |k: usize| ((row[k] - means[k]) / deviations[k]) as f32;
            (0..row.len()).map(value).chain(std::iter::once(1.0)).collect()
        };
        let signs = rows.iter().map(|r| r.1).collect();
        let rows = rows.iter().map(|r| scaled(&r.0)).collect();
        HafSamples { features, means, deviations, rows, signs }
    }

    /// The planner with trained weights.
    pub(crate) fn model(&self, weights: &[f64], card: serde_json::Value) -> HafModel {
        let count = self.features.len();
        let weight = |k: usize| weights[k] / self.deviations[k];
        let bias = weights[count] - (0..count).map(|k| weight(k) * self.means[k]).sum::<f64>();
        let margins: Vec<f64> = self.rows.iter().map(|row| dot(weights, row)).collect();
        let features =
            self.features.iter().cloned().enumerate().map(|(k, f)| (f, weight(k) as f32)).collect();
        let probability = curve(&margins, &self.signs).map(|v| v as f32);
        HafModel { features, bias: bias as f32, probability, card }
    }
}

fn dot(weights: &[f64], row: &[f32]) -> f64 {
    weights.iter().zip(row).map(|(w, x)| w * f64::from(*x)).sum()
}

/// Slope and offset of the logistic curve that predicts the signs from the margins best, by Newton's method.
fn curve(margins: &[f64], signs: &[f64]) -> [f64; 2] {
    let [mut slope, mut offset] = [1.0, 0.0];
    for _ in 0..30 {
        let (mut g, mut h) = ([1e-6 * slope, 0.0], [1e-6, 0.0, 1e-6]);
        for (m, sign) in margins.iter().zip(signs) {
            let p = 1.0 / (1.0 + (-(slope * m + offset)).exp());
            let (error, weight) = (p - f64::from(u8::from(*sign > 0.0)), p * (1.0 - p));
            g = [g[0] + error * m, g[1] + error];
            h = [h[0] + weight * m * m, h[1] + weight * m, h[2] + weight];
        }
        let determinant = h[0] * h[2] - h[1] * h[1];
        if determinant < 1e-9 {
            break;
        }
        slope -= (h[2] * g[0] - h[1] * g[1]) / determinant;
        offset -= (h[0] * g[1] - h[1] * g[0]) / determinant;
    }
    [slope, offset]
}

/// A classifier in training.
pub struct HafTraining {
    passes: u64,
    seed: u64,
    /// Weights of the scaled features, then the bias.
    pub(crate) weights: Vec<f64>,
    /// Dual variable of each candidate, 0 to [`COST`]; empty before the first pass.
    duals: Vec<f64>,
}

impl HafTraining {
    pub(crate) fn new(passes: u64, seed: u64) -> Self {
        HafTraining { passes, seed, weights: vec![], duals: vec![] }
    }

    /// A pass over all candidates in a random order.
    fn pass(&mut self, samples: &HafSamples, pass: u64) -> Losses {
        let count = samples.rows.len();
        self.weights.resize(samples.features.len() + 1, 0.0);
        self.duals.resize(count, 0.0);
        let mut order: Vec<usize> = (0..count).collect();
        let mut random = stream(self.seed, pass);
        for k in 1..count {
            order.swap(k, random.random_range(0..=k));
        }
        for i in order {
            let (row, sign) = (&samples.rows[i], samples.signs[i]);
            let squared: f64 = row.iter().map(|x| f64::from(*x).powi(2)).sum();
            let gradient = sign * dot(&self.weights, row) - 1.0;
            let dual = (self.duals[i] - gradient / squared).clamp(0.0, COST);
            let change = (dual - self.duals[i]) * sign;
            self.duals[i] = dual;
            self.weights.iter_mut().zip(row).for_each(|(w, x)| *w += change * f64::from(*x));
        }
        let margin = |i: usize| samples.signs[i] * dot(&self.weights, &samples.rows[i]);
        let hinge = (0..count).map(|i| (1.0 - margin(i)).max(0.0)).sum::<f64>() / count.max(1) as f64;
        let right = (0..count).filter(|&i| margin(i) > 0.0).count() as f64 / count.max(1) as f64;
        Losses::from([("hinge".to_owned(), hinge), ("classified correctly".to_owned(), right)])
    }
}

/// Numbers as bits: JSON may change the last digit.
fn bits(values: &[f64]) -> Vec<u64> {
    values.iter().map(|v| v.to_bits()).collect()
}

impl Checkpointed for HafTraining {
    fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError> {
        checkpoint.state("weights", &bits(&self.weights))?.state("duals", &bits(&self.duals))
    }

    fn restore(&mut self, checkpoint: &Checkpoint) -> Result<(), CheckpointError> {
        let read = |name: &str| -> Result<Vec<f64>, CheckpointError> {
            Ok(checkpoint.state::<Vec<u64>>(name)?.into_iter().map(f64::from_bits).collect())
        };
        (self.weights, self.duals) = (read("weights")?, read("duals")?);
        Ok(())
    }
}

impl Training for HafTraining {
    type Samples = std::sync::Arc<HafSamples>;
    type Batch = (std::sync::Arc<HafSamples>, u64);

    fn plan(&self, samples: &Self::Samples) -> Result<Plan, TrainError> {
        #[derive(serde::Serialize)]
        struct Settings {
            steps: u64,
            seed: u64,
            cost: f64,
            features: usize,
        }
        let (steps, seed, features) = (self.passes, self.seed, samples.features.len());
        let settings =
            sixfold_nn::fingerprint::Fingerprint::of(&Settings { steps, seed, cost: COST, features })?;
        let schedule = LearningRate::Constant { rate: 1.0 };
        Ok(Plan { steps, schedule, samples_per_step: samples.rows.len(), pace: Pace::default(), settings })
    }

    fn batches<'a>(&self, samples: &'a Self::Samples) -> Batches<'a, Self::Batch> {
        Box::new(move |step| (samples.clone(), step))
    }

    fn step(&mut self, (samples, pass): Self::Batch, _: f64) -> Losses {
        self.pass(&samples, pass)
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        vec![self]
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use sixfold_grasp::learned::CELLS;
    use sixfold_nn::training::{Outcome, fit};

    use super::*;

    /// Ridges across the hand that are held if they are near its centre and high, with noise.
    fn samples() -> Vec<Sample<HeightGrid>> {
        (0..300)
            .map(|number| {
                let mut random = stream(7, number);
                let (at, height) = (random.random_range(1..CELLS - 1), random.random_range(0..2u32));
                let mut cell = |x: usize| {
                    let noise = 0.002 * random.random::<f32>();
                    noise + if x.abs_diff(at) <= 1 { 0.02 + 0.02 * height as f32 } else { -0.03 }
                };
                let heights = std::array::from_fn(|_| std::array::from_fn(&mut cell));
                let held = height == 1 && (4..10).contains(&at);
                Sample { seen: HeightGrid::from_heights(heights), held, scene: number }
            })
            .collect()
    }

    fn trained(samples: &Arc<HafSamples>, folder: &Path, stop_at: Option<u64>) -> Option<HafTraining> {
        let mut training = HafTraining::new(60, 3);
        let stop = AtomicBool::new(false);
        let outcome = fit(&mut training, samples, folder, &stop, |record| {
            stop.store(stop_at.is_some_and(|step| record.step >= step), Ordering::Relaxed);
        });
        matches!(outcome.unwrap(), Outcome::Finished(())).then_some(training)
    }

    #[test]
    fn central_ridges_are_classified_and_an_interrupted_training_ends_the_same() {
        let seen = samples();
        let samples = Arc::new(HafSamples::new(&seen, 0));
        let folder = tempfile::tempdir().unwrap();
        let straight = trained(&samples, &folder.path().join("a"), None).unwrap();
        let interrupted = folder.path().join("b");
        assert!(trained(&samples, &interrupted, Some(25)).is_none());
        let resumed = trained(&samples, &interrupted, None).unwrap();
        assert_eq!(bits(&straight.weights), bits(&resumed.weights));
        let model = samples.model(&straight.weights, serde_json::json!({}));
        let right = seen.iter().filter(|s| (model.margin(&s.seen) > 0.0) == s.held).count();
        assert!(right > 270, "{right} of 300");
        // The model's own features give the margins of the training.
        let margin = dot(&straight.weights, &samples.rows[0]);
        assert!((f64::from(model.margin(&seen[0].seen)) - margin).abs() < 1e-2, "{margin}");
        // Higher margins have a higher probability, and the mean probability equals the success rate.
        let scores: Vec<f64> = seen.iter().map(|s| model.score(&s.seen)).collect();
        let held = seen.iter().filter(|s| s.held).count() as f64 / 300.0;
        assert!((scores.iter().sum::<f64>() / 300.0 - held).abs() < 0.03);
        assert!(model.probability[0] > 0.0);
    }
}
