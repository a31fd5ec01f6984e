//! The refiner's training: displacements under a Laplace distribution whose spread is learned too, for the points that the
//! photograph shows nearby; and whether it shows them.

use burn::tensor::{Device, Tensor, TensorData, activation};
use serde::{Deserialize, Serialize};
use sixfold_nn::learner::{Checkpointed, Learner};
use sixfold_nn::options::{OptionError, Pace, TrainingOptions};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};
use sixfold_nn::xfeat::{CELL, MULTIPLE};
use sixfold_synth::augment::Backgrounds;

use super::network::{CELL_INPUTS, PICTURE_INPUTS, REACH, RefinerNetwork};
use super::pair;
use super::samples::{Kind, RENDERS, RefinerSample, make_sample};
use crate::features::Extractor;

/// Logarithm of the smallest and the largest spread, cells.
pub(crate) const SPREADS: [f64; 2] = [-4.0, 1.5];
/// Displacements up to this many cells count as nearby.
const NEAR: f32 = REACH as f32 + 0.5;
/// Displacements up to this many cells count as zero.
const HERE: f32 = 0.4;

/// Options of the training. All of them affect the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RefinerTrainingOptions {
    /// Steps, learning rate, seed.
    #[serde(flatten)]
    pub common: TrainingOptions,
    /// Side of the crops around detections, pixels; a multiple of 32.
    pub side: usize,
    /// Side of the crops around poses, which every other step uses, pixels; a multiple of 32.
    pub close_side: usize,
    /// Photographs in a step, each with four renders; half as many in crops around poses.
    pub batch: usize,
}

impl Default for RefinerTrainingOptions {
    fn default() -> Self {
        RefinerTrainingOptions {
            common: TrainingOptions {
                steps: 12_000,
                learning_rate: 1e-3,
                warm_up: 200,
                weight_decay: 1e-4,
                max_grad_norm: Some(5.0),
                seed: 0,
            },
            side: 160,
            close_side: 224,
            batch: 4,
        }
    }
}

impl RefinerTrainingOptions {
    /// The crops of a step, their side, and their number.
    fn crops(&self, step: u64) -> (Kind, usize, usize) {
        if step.is_multiple_of(2) {
            (Kind::Detected, self.side, self.batch)
        } else {
            (Kind::Close, self.close_side, self.batch.div_ceil(2))
        }
    }

    /// Checks every number.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.common.check()?;
        for (option, side) in [("side", self.side), ("close_side", self.close_side)] {
            let fits = side.is_multiple_of(MULTIPLE) && (MULTIPLE..=512).contains(&side);
            OptionError::unless(fits, option, side, "a multiple of 32 from 32 to 512 pixels")?;
        }
        OptionError::unless_samples("batch", self.batch, 1, "1 or more")
    }
}

/// Textures, and the network whose features are compared.
pub struct Source {
    /// Textures, backgrounds and occluders.
    pub textures: Backgrounds,
    /// The frozen network.
    pub extractor: Extractor,
}

/// A batch as tensor data; `P` pairs, `N` cells in a crop.
#[derive(Debug, Clone, Default)]
pub struct Batch {
    pairs: usize,
    /// Side of the crops, pixels.
    side: usize,
    pictures: Vec<f32>,
    cells: Vec<f32>,
    /// `P x 2 x N`, cells.
    flow: Vec<f32>,
    /// `P x 3 x N`: whether a cell shows the object; whether the photograph shows its point nearby, and at the same position.
    truth: Vec<f32>,
}

impl Batch {
    fn of(samples: &[RefinerSample], extractor: &Extractor, side: usize) -> Batch {
        let area = (side / CELL).pow(2);
        let inputs: Vec<Vec<f32>> = samples
            .iter()
            .flat_map(|s| {
                std::iter::once(s.photograph.clone()).chain(s.renders.iter().map(|r| r.shown.input.clone()))
            })
            .collect();
        // A network that cannot run has invalid weights; the training itself then reports the failure.
        let maps = extractor.features(&inputs, side).unwrap_or_default();
        let mut batch = Batch { side, ..Batch::default() };
        for (sample, maps) in samples.iter().zip(maps.chunks_exact(1 + RENDERS)) {
            for (render, seen) in sample.renders.iter().zip(&maps[1..]) {
                let pair = pair(&render.shown, seen, &sample.photograph, &maps[0]);
                batch.pairs += 1;
                batch.pictures.extend(pair.picture);
                batch.cells.extend(pair.cells);
                let mut flow = vec![0.0; 2 * area];
                let mut truth = vec![0.0; 3 * area];
                for (i, cell) in render.shown.cells.iter().enumerate() {
                    let (cell, [x, y]) = (usize::from(*cell), render.flow[i]);
                    let length = x.abs().max(y.abs());
                    truth[cell] = 1.0;
                    truth[area + cell] = f32::from(render.visible[i] && length < NEAR);
                    truth[2 * area + cell] = f32::from(render.visible[i] && x.hypot(y) < HERE);
                    (flow[cell], flow[area + cell]) = (x, y);
                }
                batch.flow.extend(flow);
                batch.truth.extend(truth);
            }
        }
        batch
    }
}

/// A network in training.
pub struct RefinerTraining {
    learner: Learner<RefinerNetwork>,
    options: RefinerTrainingOptions,
    /// How often the training logs and saves.
    pub pace: Pace,
    device: Device,
}

impl RefinerTraining {
    /// Starts the training of a network whose tensors are on the autodiff `device`.
    pub fn new(network: RefinerNetwork, options: RefinerTrainingOptions, device: Device) -> Self {
        let learner = Learner::adam_w("network", network, &options.common);
        let pace = Pace { checkpoint_every: 200, ..Pace::default() };
        RefinerTraining { learner, options, pace, device }
    }

    /// The trained network.
    pub fn into_network(self) -> RefinerNetwork {
        self.learner.into_network()
    }

    /// The losses of displacement, of the nearby logit and of the same-position logit, and the mean error of displacements, cells.
    fn losses(&self, batch: Batch) -> [Tensor<1>; 4] {
        let (pairs, side) = (batch.pairs, batch.side);
        let n = side / CELL;
        let tensor = |values: Vec<f32>, channels: usize, side: usize| {
            Tensor::<4>::from_data(TensorData::new(values, [pairs, channels, side, side]), &self.device)
        };
        let out = self
            .learner
            .network()
            .forward(tensor(batch.pictures, PICTURE_INPUTS, side), tensor(batch.cells, CELL_INPUTS, n));
        let truth = tensor(batch.truth, 3, n);
        let [object, near, here] = [0, 1, 2].map(|k| truth.clone().narrow(1, k, 1));
        let cells = object.clone().sum() + 1.0;
        let shown = near.clone().sum() + 1.0;
        let off = (out.clone().narrow(1, 0, 2) - tensor(batch.flow, 2, n)).abs();
        let spread = out.clone().narrow(1, 2, 1).clamp(SPREADS[0], SPREADS[1]);
        // For both coordinates together: |x| / b + |y| / b + 2 log b.
        let off = off.sum_dim(1);
        let error = (off.clone() * near.clone()).sum() / shown.clone() * 0.5;
        let laplace = ((off * (-spread.clone()).exp() + spread * 2.0) * near.clone()).sum() / shown;
        let entropy = |k: usize, truth: Tensor<4>| {
            let x = out.clone().narrow(1, k, 1);
            // log(1 + exp(x)) - x t
            let loss = activation::softplus(x.clone(), 1.0) - x * truth;
            (loss * object.clone()).sum() / cells.clone()
        };
        [laplace, entropy(3, near), entropy(4, here), error]
    }
}

impl Training for RefinerTraining {
    type Samples = Source;
    type Batch = Batch;

    fn plan(&self, source: &Source) -> Result<Plan, TrainError> {
        self.options.check()?;
        let settings = serde_json::json!({ "training": self.options, "textures": source.textures.images() });
        Plan::new(&self.options.common, self.options.batch, self.pace, &settings)
    }

    fn batches<'a>(&self, source: &'a Source) -> Batches<'a, Batch> {
        let options = self.options.clone();
        Box::new(move |step| {
            let (kind, side, count) = options.crops(step);
            let first = step * options.batch as u64;
            let samples: Vec<RefinerSample> = (first..first + count as u64)
                .map(|number| make_sample(&source.textures, kind, side, options.common.seed, number))
                .collect();
            Batch::of(&samples, &source.extractor, side)
        })
    }

    fn step(&mut self, batch: Batch, rate: f64) -> Losses {
        let [displacement, near, here, error] = self.losses(batch);
        let number = |t: &Tensor<1>| f64::from(t.clone().inner().into_scalar::<f32>());
        let losses = [
            ("displacement", number(&displacement)),
            ("near", number(&near)),
            ("here", number(&here)),
            ("error", number(&error)),
        ];
        self.learner.descend(rate, displacement + near + here);
        losses.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        vec![&mut self.learner]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_losses_of_one_batch_fall() {
        let device = Device::flex().autodiff();
        let options = RefinerTrainingOptions { side: 96, batch: 2, ..RefinerTrainingOptions::default() };
        let source = Source { textures: Backgrounds::procedural(), extractor: Extractor::shipped().unwrap() };
        let network = RefinerNetwork::random(0, &device);
        let mut training = RefinerTraining::new(network, options, device);
        let batch = training.batches(&source)(0);
        let (object, near): (Vec<f32>, Vec<f32>) = batch
            .truth
            .chunks_exact(3 * 144)
            .flat_map(|t| t[..144].iter().copied().zip(t[144..288].iter().copied()))
            .unzip();
        // Nearby cells are on the object, and there are both kinds of cells.
        assert!(object.iter().zip(&near).all(|(o, n)| o >= n));
        assert!(near.contains(&1.0) && object.iter().zip(&near).any(|(o, n)| *o > *n));
        let first = training.step(batch.clone(), 2e-3);
        for _ in 0..25 {
            training.step(batch.clone(), 2e-3);
        }
        let last = training.step(batch, 2e-3);
        for loss in ["displacement", "near", "here", "error"] {
            assert!(last[loss] < 0.9 * first[loss].abs(), "{loss}: {} then {}", first[loss], last[loss]);
        }
    }
}
