//! The training of DGCM-Net: pairs through the network, the losses of equations 6.2 to 6.4, AdamW.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use burn::grad_clipping::GradientClippingConfig;
use burn::module::Module;
use burn::optim::{AdamWConfig, GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_nn::checkpoint::{Checkpoint, CheckpointError, CheckpointWriter};
use sixfold_nn::schedule::LearningRate;
use sixfold_nn::training::{Course, Trainee, run};
pub use sixfold_nn::training::{Ending, TrainingError};
use sixfold_nn::training_log::TrainingRecord;
use sixfold_synth::shapes::Family;

use crate::loss::{MARGIN, coordinate_loss, cross_loss, metric_loss};
use crate::networks::Network;
use crate::samples::{Pair, PairOptions, Pool, PoolOptions};

/// How to train. All of it decides about the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingOptions {
    /// Optimiser steps.
    pub steps: u64,
    /// Positive pairs in a step.
    pub pairs: usize,
    /// Negative pairs in a step.
    pub negatives: usize,
    /// Highest learning rate; it falls to zero as a cosine.
    pub learning_rate: f64,
    /// Steps over which the rate rises at first.
    pub warm_up: u64,
    /// Decoupled weight decay.
    pub weight_decay: f32,
    /// Weight of the coordinates in equation 6.4.
    pub lambda: f64,
    /// Weight of equation 6.2 for all pairs of views in a batch that show different families, beside the drawn pairs.
    pub cross_pairs: f64,
    /// A tensor's gradient that is longer than this (Euclidean) is shortened to it.
    pub longest_gradient: f32,
    /// How pairs are drawn.
    pub samples: PairOptions,
    /// Seed of weights and pairs.
    pub seed: u64,
}

impl Default for TrainingOptions {
    fn default() -> Self {
        TrainingOptions {
            steps: 4000,
            pairs: 10,
            negatives: 3,
            learning_rate: 5e-4,
            warm_up: 200,
            weight_decay: 1e-4,
            lambda: 300.0,
            cross_pairs: 1.0,
            longest_gradient: 50.0,
            samples: PairOptions::default(),
            seed: 0,
        }
    }
}

impl TrainingOptions {
    /// The dissertation's: 25 positive and 25 negative pairs, rate 0.0001, both losses alike. (It divides the rate by ten
    /// every 5 of 35 epochs; the cosine here ends at zero as well.)
    pub fn paper() -> Self {
        TrainingOptions {
            steps: 116_000,
            pairs: 25,
            learning_rate: 1e-4,
            lambda: 1.0,
            cross_pairs: 0.0,
            ..Self::default()
        }
    }
}

/// What does not change the result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrainingPace {
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Steps between records of the log.
    pub log_every: u64,
    /// Threads that make pairs beside the training itself.
    pub sample_threads: usize,
}

impl Default for TrainingPace {
    fn default() -> Self {
        TrainingPace { checkpoint_every: 250, log_every: 25, sample_threads: 1 }
    }
}

struct State<'a> {
    network: Network,
    optimiser: ModuleOptimizer,
    options: &'a TrainingOptions,
    device: &'a Device,
}

/// Pairs as tensors' numbers: the positive ones first.
pub struct Batch {
    input: Vec<f32>,
    experience: Vec<f32>,
    vd_noc: Vec<f32>,
    target: Vec<f32>,
    mask: Vec<f32>,
    /// Families of both views of every pair.
    families: Vec<(Family, Family)>,
}

fn make_batch(pool: &Pool, options: &TrainingOptions, step: u64) -> Batch {
    let mut batch = Batch {
        input: vec![],
        experience: vec![],
        vd_noc: vec![],
        target: vec![],
        mask: vec![],
        families: vec![],
    };
    for (positive, count) in [(true, options.pairs as u64), (false, options.negatives as u64)] {
        for number in 0..count {
            let number = 2 * (step * count + number) + u64::from(positive);
            let pair: Pair = pool.pair(positive, &options.samples, options.seed, number);
            batch.families.push(pair.families);
            batch.input.extend(pair.input);
            batch.experience.extend(pair.experience);
            if positive {
                batch.vd_noc.extend(pair.vd_noc);
                batch.target.extend(pair.target);
                batch.mask.extend(pair.mask);
            }
        }
    }
    batch
}

impl Trainee for State<'_> {
    type Batch = Batch;

    fn step(&mut self, batch: Batch, rate: f64) -> BTreeMap<String, f64> {
        let (pairs, side) = (self.options.pairs, self.network.side());
        let all = pairs + self.options.negatives;
        let tensor = |values: Vec<f32>, count: usize, channels: usize| {
            Tensor::<4>::from_data(TensorData::new(values, [count, channels, side, side]), self.device)
        };
        let input = self.network.geometry(tensor(batch.input, all, 3));
        let experience = self.network.geometry(tensor(batch.experience, all, 3));
        let (metric, near, far) = metric_loss(&input.feature, &experience.feature, pairs);
        let different: Vec<f32> = batch
            .families
            .iter()
            .flat_map(|a| batch.families.iter().map(|b| f32::from(u8::from(a.0 != b.1))))
            .collect();
        let different = Tensor::from_data(TensorData::new(different, [all, all]), self.device);
        let cross = cross_loss(&input.feature, &experience.feature, different);
        let code = self.network.vd_noc(tensor(batch.vd_noc, pairs, 3));
        let features = experience.feature.narrow(0, 0, pairs);
        let out = self.network.decode(&input.narrow(0, pairs), features, &code);
        let (coordinates, error) =
            coordinate_loss(out, tensor(batch.target, pairs, 3), tensor(batch.mask, pairs, 1));
        let numbers = [&metric, &cross, &coordinates, &near, &far, &error].map(|t| {
            let value: Vec<f32> = t.clone().inner().into_data().try_to_vec().unwrap_or_default();
            value.first().map_or(f64::NAN, |v| f64::from(*v))
        });
        let sum = metric + cross * self.options.cross_pairs + coordinates * self.options.lambda;
        let gradients = sum.backward();
        let gradients = GradientsParams::from_grads(gradients, &self.network);
        self.network = self.optimiser.step(rate, self.network.clone(), gradients);
        [
            "metric",
            "cross pairs",
            "coordinates",
            "positive distance",
            "negative distance",
            "error on the object",
        ]
        .into_iter()
        .map(str::to_owned)
        .zip(numbers)
        .collect()
    }

    fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError> {
        checkpoint.module("network", &self.network)?.optimiser("optimiser", &self.optimiser)
    }

    fn restore(self, checkpoint: &Checkpoint) -> Result<Self, CheckpointError> {
        Ok(State {
            network: checkpoint.module("network", self.network)?,
            optimiser: checkpoint.optimiser("optimiser", self.optimiser)?,
            ..self
        })
    }
}

/// All that decides about the result.
#[derive(Serialize)]
struct Recorded<'a> {
    #[serde(flatten)]
    training: &'a TrainingOptions,
    pool: &'a PoolOptions,
    architecture: &'static str,
    margin: f64,
}

/// Trains a network, whose tensors are on the autodiff `device`, on a pool of views.
///
/// Checkpoints, log and learning curves go to `folder`; a training that was interrupted there goes on, with the same result
/// as one that was not. `stop` ends it after the current step.
///
/// # Errors
/// [`TrainingError`]; the last checkpoints stay.
#[allow(clippy::too_many_arguments)]
pub fn train(
    pool: &Pool,
    network: Network,
    device: &Device,
    folder: &Path,
    options: &TrainingOptions,
    pace: &TrainingPace,
    stop: &AtomicBool,
    progress: impl FnMut(&TrainingRecord),
) -> Result<Ending<Network>, TrainingError> {
    let wrong = |field, expected, found: String| Err(TrainingError::Option { field, expected, found });
    if options.steps == 0 || options.pairs == 0 {
        return wrong("steps and pairs", "at least 1", format!("{} and {}", options.steps, options.pairs));
    }
    if pool.views().len() < 16 {
        return wrong("views", "at least 16", pool.views().len().to_string());
    }
    if pool.options().crop.side != network.side() {
        let found = format!("views of {}, network of {}", pool.options().crop.side, network.side());
        return wrong("crop.side", "the side of the network's input, pixels", found);
    }
    if !(options.lambda >= 0.0 && options.lambda.is_finite()) {
        return wrong("lambda", "a finite number, 0 or more", options.lambda.to_string());
    }
    let clip = GradientClippingConfig::Norm(options.longest_gradient);
    let optimiser =
        AdamWConfig::new().with_weight_decay(options.weight_decay).with_grad_clipping(Some(clip)).init();
    let recorded = Recorded {
        training: options,
        pool: pool.options(),
        architecture: network.architecture(),
        margin: MARGIN,
    };
    let state = State { network, optimiser, options, device };
    let course = Course {
        steps: options.steps,
        schedule: LearningRate::Cosine {
            rate: options.learning_rate,
            last: 0.0,
            warm_up: options.warm_up.min(options.steps.saturating_sub(1)),
            steps: options.steps,
        },
        samples_per_step: options.pairs + options.negatives,
        log_every: pace.log_every,
        checkpoint_every: pace.checkpoint_every,
        sample_threads: pace.sample_threads,
    };
    let batches = |step| make_batch(pool, options, step);
    Ok(run(state, batches, &course, &recorded, folder, stop, progress)?.map(|state| state.network.valid()))
}

/// The network of the last checkpoint in `folder`, filled into `network`, and the steps it has done; `None` if there is no
/// checkpoint.
///
/// # Errors
/// [`TrainingError::Checkpoint`].
pub fn last_checkpoint(folder: &Path, network: Network) -> Result<Option<(Network, u64)>, TrainingError> {
    let Some(checkpoint) = Checkpoint::latest(folder)? else { return Ok(None) };
    Ok(Some((checkpoint.module("network", network)?.valid(), checkpoint.step())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::networks::CompactConfig;

    #[test]
    fn it_learns_and_goes_on_where_it_stopped() {
        let pool = Pool::new(&PoolOptions { views: 64, ..PoolOptions::default() }, |_| ());
        let device = Device::flex().autodiff();
        let options =
            TrainingOptions { steps: 16, pairs: 2, negatives: 1, warm_up: 2, ..TrainingOptions::default() };
        let pace = TrainingPace { checkpoint_every: 5, log_every: 4, sample_threads: 1 };
        let go = |folder: &Path, stop_at: Option<u64>| {
            let stop = AtomicBool::new(false);
            let network = Network::Compact(CompactConfig.init(3, &device));
            let mut records = vec![];
            let ending = train(&pool, network, &device, folder, &options, &pace, &stop, |r| {
                stop.store(stop_at.is_some_and(|s| r.step >= s), std::sync::atomic::Ordering::Relaxed);
                records.push(r.losses["metric"]);
            });
            (ending.unwrap(), records)
        };
        let numbers = |n: &Network| -> Vec<f32> {
            let x = Tensor::<4>::ones([1, 3, 96, 96], &Device::flex()) * 0.5;
            n.geometry(x).feature.into_data().try_to_vec().unwrap()
        };
        let folder = tempfile::tempdir().unwrap();
        let (Ending::Finished(straight), losses) = go(&folder.path().join("a"), None) else { panic!() };
        assert!(losses.last() < losses.first(), "{losses:?}");
        let b = folder.path().join("b");
        assert!(matches!(go(&b, Some(8)).0, Ending::Interrupted { step: 8 }));
        let (Ending::Finished(resumed), _) = go(&b, None) else { panic!() };
        assert_eq!(numbers(&straight), numbers(&resumed));
    }
}
