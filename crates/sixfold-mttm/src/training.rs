//! The training: regions and templates through the network, the losses of equations 5.3 to 5.6, AdamW.

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

use crate::loss::{GAMMA, column, cross_loss, distance_loss, mask_loss, pair_loss, triplet_loss};
use crate::network::{MAP, Network, masked};
use crate::patch::PLANES;
use crate::samples::{Batch, BatchOptions, Pool, PoolOptions};

/// How to train. All of it decides about the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingOptions {
    /// Optimiser steps.
    pub steps: u64,
    /// Highest learning rate; it falls to zero as a cosine.
    pub learning_rate: f64,
    /// Steps over which the rate rises at first.
    pub warm_up: u64,
    /// Decoupled weight decay.
    pub weight_decay: f32,
    /// A tensor's gradient that is longer than this (Euclidean) is shortened to it.
    pub longest_gradient: f32,
    /// What is in a step.
    pub batch: BatchOptions,
    /// Weight of the positive templates of all other objects in the batch as negative ones (equation 5.3).
    pub cross: f64,
    /// Weight of the loss of the place of the reference point, and of the loss of matching; 0 for the dissertation's.
    pub offset: f64,
    /// See `offset`.
    pub matching: f64,
    /// Seed of weights and samples.
    pub seed: u64,
}

impl Default for TrainingOptions {
    fn default() -> Self {
        TrainingOptions {
            steps: 8000,
            learning_rate: 1e-3,
            warm_up: 200,
            weight_decay: 1e-4,
            longest_gradient: 5.0,
            batch: BatchOptions::default(),
            cross: 1.0,
            offset: 4.0,
            matching: 0.5,
            seed: 0,
        }
    }
}

impl TrainingOptions {
    /// The dissertation's losses alone (equation 5.6), and about 25 epochs of 20,000 scenes.
    pub fn paper() -> Self {
        TrainingOptions {
            steps: 100_000,
            learning_rate: 1e-4,
            batch: BatchOptions { anchors: 16, without_object: 0, ..BatchOptions::default() },
            cross: 0.0,
            offset: 0.0,
            matching: 0.0,
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
    /// Threads that make batches beside the training itself.
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

impl State<'_> {
    fn patches(&self, values: Vec<f32>) -> Tensor<4> {
        let side = self.network.side();
        let count = values.len() / (PLANES * side * side);
        Tensor::from_data(TensorData::new(values, [count, PLANES, side, side]), self.device)
    }

    fn cells(&self, values: Vec<f32>) -> Tensor<4> {
        let count = values.len() / (MAP * MAP);
        Tensor::from_data(TensorData::new(values, [count, 1, MAP, MAP]), self.device)
    }

    fn rows(&self, values: Vec<f32>, length: usize) -> Tensor<2> {
        let count = values.len() / length;
        Tensor::from_data(TensorData::new(values, [count, length]), self.device)
    }
}

impl Trainee for State<'_> {
    type Batch = Batch;

    fn step(&mut self, batch: Batch, rate: f64) -> BTreeMap<String, f64> {
        let options = self.options;
        let count = batch.objects.len();
        let others = options.batch.without_object;
        let network = &self.network;

        // Everything goes through the first part of the network at once.
        let values = [batch.regions, batch.positives, batch.negatives].concat();
        let maps = network.maps(self.patches(values));
        let part = |start: usize, count: usize| maps.clone().narrow(0, start, count);
        let regions = part(0, count);
        let region_masks = self.cells(batch.region_masks);
        let positives = masked(part(count + others, count), self.cells(batch.positive_masks));
        let negatives = masked(part(2 * count + others, count), self.cells(batch.negative_masks));

        // Descriptors of regions as they are (the first matching) and without their background (the second).
        let bare = masked(regions.clone(), region_masks.clone());
        let all = Tensor::cat(vec![regions.clone(), bare, positives.clone(), negatives.clone()], 0);
        let descriptors = network.descriptor(all);
        let rows = |k: usize| descriptors.clone().narrow(0, k * count, count);
        let (positive, negative) = (rows(2), rows(3));
        let counts: Vec<f32> = batch.distances.iter().map(|d| f32::from(u8::from(*d > 0.0))).collect();
        let margins = column(batch.distances.iter().map(|d| 2.0 * d).collect(), self.device);
        let counts = column(counts, self.device);
        let different: Vec<f32> = batch
            .objects
            .iter()
            .flat_map(|a| batch.objects.iter().map(move |b| f32::from(u8::from(a != b))))
            .collect();
        let different = self.rows(different, count);
        let both = |of: &dyn Fn(&Tensor<2>) -> Tensor<1>| (of(&rows(0)) + of(&rows(1))) * 0.5;
        let triplet =
            both(&|region| triplet_loss(region, &positive, &negative, margins.clone(), counts.clone()));
        let cross = both(&|region| cross_loss(region, &positive, different.clone()));
        let pair = both(&|region| pair_loss(region, &positive));

        // Pairs: with the positive template, the negative one, a template of another object; regions without an object.
        let mut left = vec![regions.clone(), regions.clone()];
        let mut right = vec![positives.clone(), negatives];
        let mut truth: Vec<f32> = vec![1.0; count];
        truth.extend(vec![0.0; count]);
        let third = count / 2;
        if options.matching > 0.0 && third > 0 {
            // The next objects' templates, without an object's own.
            left.push(regions.narrow(0, 0, third));
            right.push(positives.clone().narrow(0, third, third));
            truth.extend(
                (0..third).map(|k| f32::from(u8::from(batch.objects[k] == batch.objects[third + k]))),
            );
            let empty = others.min(count);
            if empty > 0 {
                left.push(part(count, empty));
                right.push(positives.narrow(0, 0, empty));
                truth.extend(vec![0.0; empty]);
            }
        }
        let compared = network.compare(Tensor::cat(left, 0), Tensor::cat(right, 0));
        let mask = mask_loss(compared.mask.narrow(0, 0, count), region_masks);
        let rotation = distance_loss(compared.rotation.narrow(0, 0, count), self.rows(batch.rotations, 4));
        let offset = distance_loss(compared.offset.narrow(0, 0, count), self.rows(batch.offsets, 3));
        let matching = mask_loss(compared.matching, column(truth, self.device));

        let numbers = [&triplet, &cross, &pair, &mask, &rotation, &offset, &matching].map(|t| {
            let value: Vec<f32> = t.clone().inner().into_data().try_to_vec().unwrap_or_default();
            value.first().map_or(f64::NAN, |v| f64::from(*v))
        });
        let sum = triplet
            + cross * options.cross
            + pair
            + mask
            + rotation
            + offset * options.offset
            + matching * options.matching;
        let gradients = GradientsParams::from_grads(sum.backward(), &self.network);
        self.network = self.optimiser.step(rate, self.network.clone(), gradients);
        ["triplet", "other objects", "pair", "mask", "rotation", "offset", "matching"]
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
    anchors: usize,
    architecture: &'static str,
    gamma: f64,
}

/// Trains a network, whose tensors are on the autodiff `device`, on a pool of regions.
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
    if options.steps == 0 || options.batch.anchors < 2 {
        let found = format!("{} and {}", options.steps, options.batch.anchors);
        return wrong("steps and batch.anchors", "at least 1 and 2", found);
    }
    if pool.with_object().len() < 8 {
        return wrong("regions", "at least 8 with an object", pool.with_object().len().to_string());
    }
    if pool.options().anchors.side != network.side() {
        let found = format!("regions of {}, network of {}", pool.options().anchors.side, network.side());
        return wrong("anchors.side", "the side of the network's input, pixels", found);
    }
    for (field, weight) in
        [("cross", options.cross), ("offset", options.offset), ("matching", options.matching)]
    {
        if !(weight >= 0.0 && weight.is_finite()) {
            return wrong(field, "a finite number, 0 or more", weight.to_string());
        }
    }
    let clip = GradientClippingConfig::Norm(options.longest_gradient);
    let optimiser =
        AdamWConfig::new().with_weight_decay(options.weight_decay).with_grad_clipping(Some(clip)).init();
    let recorded = Recorded {
        training: options,
        pool: pool.options(),
        anchors: pool.with_object().len(),
        architecture: network.architecture(),
        gamma: GAMMA,
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
        samples_per_step: options.batch.anchors,
        log_every: pace.log_every,
        checkpoint_every: pace.checkpoint_every,
        sample_threads: pace.sample_threads,
    };
    let batches = |step| Batch::of_step(pool, &options.batch, options.seed, step);
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
    use crate::network::CompactConfig;
    use crate::quality::quality;
    use crate::samples::Arrangement;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use sixfold_geometry::{Pose, Vec3};
    use sixfold_mesh::Mesh;
    use sixfold_synth::shapes::{Family, member};

    /// Household shapes side by side on a table.
    fn pool() -> Pool {
        let meshes: Vec<Mesh> = [Family::Mug, Family::Box, Family::Drill, Family::Can]
            .iter()
            .map(|f| member(*f, &mut ChaCha8Rng::seed_from_u64(3)).unwrap().mesh)
            .collect();
        let arrangement: Arrangement = (0..4)
            .map(|k| {
                let place = Vec3::new(0.16 * f64::from(k % 2) - 0.08, 0.2 * f64::from(k / 2) - 0.1, 0.0);
                (k as usize, Pose::from_translation(place))
            })
            .collect();
        let options = PoolOptions { views: 3, ..PoolOptions::for_side(CompactConfig::SIDE) };
        let stop = AtomicBool::new(false);
        Pool::new(&meshes, &[arrangement.clone(), arrangement], &options, &stop, || ()).unwrap()
    }

    #[test]
    fn it_learns_and_goes_on_where_it_stopped() {
        let pool = pool();
        assert!(pool.with_object().len() >= 12, "{}", pool.with_object().len());
        assert!(!pool.without_object().is_empty());
        let device = Device::flex().autodiff();
        let batch = BatchOptions { anchors: 6, without_object: 2, ..BatchOptions::default() };
        let options = TrainingOptions { steps: 24, warm_up: 2, batch, ..TrainingOptions::default() };
        let pace = TrainingPace { checkpoint_every: 5, log_every: 4, sample_threads: 1 };
        let go = |folder: &Path, stop_at: Option<u64>| {
            let stop = AtomicBool::new(false);
            let network = Network::Compact(CompactConfig.init(3, &device));
            let mut records = vec![];
            let ending = train(&pool, network, &device, folder, &options, &pace, &stop, |r| {
                stop.store(stop_at.is_some_and(|s| r.step >= s), std::sync::atomic::Ordering::Relaxed);
                records.push(r.losses["mask"]);
            });
            (ending.unwrap(), records)
        };
        let folder = tempfile::tempdir().unwrap();
        let (Ending::Finished(straight), losses) = go(&folder.path().join("a"), None) else { panic!() };
        assert!(losses.last() < losses.first(), "{losses:?}");
        let b = folder.path().join("b");
        assert!(matches!(go(&b, Some(8)).0, Ending::Interrupted { step: 8 }));
        let (Ending::Finished(resumed), _) = go(&b, None) else { panic!() };
        assert_eq!(quality(&straight, &pool), quality(&resumed, &pool));
    }

    #[test]
    fn batches_are_a_function_of_seed_and_step() {
        let pool = pool();
        let batch = |step| Batch::of_step(&pool, &BatchOptions::default(), 7, step);
        assert_eq!(batch(3), batch(3));
        assert_ne!(batch(3), batch(4));
        // What is said of a pair holds in its numbers: the object's cells are known in region and template.
        let b = batch(5);
        let on_object = b.region_masks.iter().filter(|m| **m > 0.5).count();
        assert!(on_object > 40 * 15, "{on_object}");
        assert!(
            b.rotations
                .chunks(4)
                .all(|q| (q.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-4 && q[0] > 0.9)
        );
        assert!(b.offsets.iter().all(|v| v.abs() < 0.6));
    }
}
