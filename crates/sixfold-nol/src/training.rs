//! The training: samples through the network, the losses of equations 4.1 and 4.2, AdamW.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use burn::grad_clipping::GradientClippingConfig;
use burn::module::Module;
use burn::optim::{AdamWConfig, GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_augment::Backgrounds;
use sixfold_nn::checkpoint::{Checkpoint, CheckpointError, CheckpointWriter};
use sixfold_nn::recurrent::gather;
use sixfold_nn::schedule::LearningRate;
use sixfold_nn::training::{Course, Trainee, run};
pub use sixfold_nn::training::{Ending, TrainingError};
use sixfold_nn::training_log::TrainingRecord;

use crate::loss::{Perceptual, WEIGHTS, image_loss, smooth_loss, squared_error};
use crate::network::{Blend, COLOURS, Network};
use crate::preview::Preview;
use crate::samples::{Batch, BatchOptions, SampleOptions};

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
    /// Weights of colours, features and smoothness.
    pub weights: [f64; 3],
    /// How samples are made.
    pub samples: SampleOptions,
    /// How many in a step.
    pub batch: BatchOptions,
    /// Seed of weights and samples.
    pub seed: u64,
}

impl Default for TrainingOptions {
    fn default() -> Self {
        TrainingOptions {
            steps: 5000,
            learning_rate: 2e-3,
            warm_up: 100,
            weight_decay: 1e-4,
            longest_gradient: 5.0,
            weights: WEIGHTS,
            samples: SampleOptions::default(),
            batch: BatchOptions { sides: vec![96, 128, 160], most_sources: 8, sources: 10, most_samples: 4 },
            seed: 0,
        }
    }
}

impl TrainingOptions {
    /// The dissertation's: one target with eight sources of 256x256 pixels in a step, 35 epochs of 10,000 images.
    pub fn paper() -> Self {
        TrainingOptions {
            steps: 350_000,
            learning_rate: 1e-3,
            batch: BatchOptions { sides: vec![256], most_sources: 8, sources: 8, most_samples: 1 },
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
    /// Threads that make samples beside the training itself.
    pub sample_threads: usize,
}

impl Default for TrainingPace {
    fn default() -> Self {
        TrainingPace { checkpoint_every: 100, log_every: 25, sample_threads: 1 }
    }
}

/// A batch that went through the network.
pub(crate) struct Passed {
    /// X^S and the weights.
    pub blend: Blend,
    /// X^phi, or X^D without decoder: `B x 3 x side x side`, -1 to 1.
    pub image: Tensor<4>,
    /// X^GT.
    pub target: Tensor<4>,
    /// M^D, `B x 1 x side x side`.
    pub mask: Tensor<4>,
}

/// Takes a batch through the network, on `device`.
pub(crate) fn pass(network: &Network, batch: Batch, device: &Device) -> Passed {
    let (side, sources, samples) = (batch.side, batch.sources, batch.samples);
    let all = sources * samples;
    let tensor = |values: Vec<f32>, count: usize, channels: usize| {
        Tensor::<4>::from_data(TensorData::new(values, [count, channels, side, side]), device)
    };
    let valid: Vec<f32> = batch.cosines.iter().map(|c| f32::from(u8::from(*c > 0.0))).collect();
    let valid = tensor(valid, all, 1);
    let maps = network.encode(tensor(batch.images, all, COLOURS));
    let mut channels = vec![tensor(batch.colours, all, COLOURS)];
    channels.extend(maps.into_iter().map(|map| gather(map, batch.places.clone())));
    channels.push(tensor(batch.cosines, all, 1));
    let blend = network.blend(Tensor::cat(channels, 1), valid.clone(), sources);
    let mask = valid.reshape([sources, samples, side, side]).sum_dim(0).clamp_max(1.0);
    let colours = blend.sum.clone().narrow(1, 0, COLOURS);
    let image = network.decode(blend.sum.clone()).unwrap_or(colours);
    Passed {
        blend,
        image,
        target: tensor(batch.target, samples, COLOURS),
        mask: mask.reshape([samples, 1, side, side]),
    }
}

struct State<'a> {
    network: Network,
    optimiser: ModuleOptimizer,
    perceptual: &'a Perceptual,
    preview: &'a Preview,
    options: &'a TrainingOptions,
    device: &'a Device,
}

impl Trainee for State<'_> {
    type Batch = Batch;

    fn step(&mut self, batch: Batch, rate: f64) -> BTreeMap<String, f64> {
        let (_, averaging) = batch.average();
        let out = pass(&self.network, batch, self.device);
        let (colours, features) =
            image_loss(out.image.clone(), out.target.clone(), out.mask.clone(), self.perceptual);
        let smoothness = smooth_loss(out.blend.sum.clone(), out.mask.clone());
        let number = |t: &Tensor<1>| f64::from(t.clone().inner().into_scalar::<f32>());
        let error = |image: &Tensor<4>| {
            let (target, mask) = (out.target.clone().inner(), out.mask.clone().inner());
            f64::from(squared_error(image.clone().inner(), target, mask).into_scalar::<f32>())
        };
        let losses = [
            ("colours", number(&colours)),
            ("features", number(&features)),
            ("smoothness", number(&smoothness)),
            ("squared error", error(&out.blend.sum.clone().narrow(1, 0, COLOURS))),
            ("squared error decoded", error(&out.image)),
            ("squared error of averaging", averaging),
        ];
        let [of_colours, of_features, of_smoothness] = self.options.weights;
        let sum = colours * of_colours + features * of_features + smoothness * of_smoothness;
        let gradients = GradientsParams::from_grads(sum.backward(), &self.network);
        self.network = self.optimiser.step(rate, self.network.clone(), gradients);
        losses.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }

    fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError> {
        self.preview.draw(&self.network.valid())?;
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
    architecture: &'static str,
    parts: crate::network::Parts,
    textures: usize,
}

/// Trains a network, whose tensors are on the autodiff `device`; `textures` are what objects, backgrounds and clutter look like.
///
/// Checkpoints, log, learning curves and `preview.png` (a row a made-up object: sources, the true target, the sources' average,
/// X^D, X^phi) go to `folder`; a training that was interrupted there goes on, with the same result as one that was not. `stop` ends it
/// after the current step.
///
/// # Errors
/// [`TrainingError`]; the last checkpoints stay.
#[allow(clippy::too_many_arguments)]
pub fn train(
    textures: &Backgrounds,
    network: Network,
    parts: crate::network::Parts,
    perceptual: &Perceptual,
    device: &Device,
    folder: &Path,
    options: &TrainingOptions,
    pace: &TrainingPace,
    stop: &AtomicBool,
    progress: impl FnMut(&TrainingRecord),
) -> Result<Ending<Network>, TrainingError> {
    check(options)?;
    let clip = GradientClippingConfig::Norm(options.longest_gradient);
    let optimiser =
        AdamWConfig::new().with_weight_decay(options.weight_decay).with_grad_clipping(Some(clip)).init();
    let preview = Preview::new(textures, &options.samples, options.seed, folder);
    let recorded = Recorded {
        training: options,
        architecture: network.architecture(),
        parts,
        textures: textures.images(),
    };
    let state = State { network, optimiser, perceptual, preview: &preview, options, device };
    let course = Course {
        steps: options.steps,
        schedule: LearningRate::Cosine {
            rate: options.learning_rate,
            last: 0.0,
            warm_up: options.warm_up.min(options.steps.saturating_sub(1)),
            steps: options.steps,
        },
        samples_per_step: 1,
        log_every: pace.log_every,
        checkpoint_every: pace.checkpoint_every,
        sample_threads: pace.sample_threads,
    };
    let batches = |step| Batch::of_step(textures, &options.samples, &options.batch, options.seed, step);
    Ok(run(state, batches, &course, &recorded, folder, stop, progress)?.map(|state| state.network.valid()))
}

fn check(options: &TrainingOptions) -> Result<(), TrainingError> {
    let wrong = |field, expected, found: String| Err(TrainingError::Option { field, expected, found });
    if options.steps == 0 {
        return wrong("steps", "at least 1", "0".to_owned());
    }
    let sides = &options.batch.sides;
    if sides.is_empty() || sides.iter().any(|s| !s.is_multiple_of(16) || !(32..=1024).contains(s)) {
        return wrong("batch.sides", "multiples of 16 from 32 to 1024 pixels", format!("{sides:?}"));
    }
    if !(1..=16).contains(&options.batch.most_sources) {
        return wrong("batch.most_sources", "1 to 16", options.batch.most_sources.to_string());
    }
    if options.weights.iter().any(|w| !(w.is_finite() && *w >= 0.0)) {
        return wrong("weights", "finite numbers, 0 or more", format!("{:?}", options.weights));
    }
    Ok(())
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
    use crate::network::{CHANNELS, CompactConfig, Parts};
    use std::sync::atomic::Ordering;

    fn options(steps: u64) -> TrainingOptions {
        TrainingOptions {
            steps,
            warm_up: 2,
            batch: BatchOptions { sides: vec![48, 64], most_sources: 3, sources: 4, most_samples: 2 },
            ..TrainingOptions::default()
        }
    }

    fn network(device: &Device) -> Network {
        Network::Compact(CompactConfig::default().init(3, device).unwrap())
    }

    #[test]
    fn on_one_batch_the_loss_falls() {
        let device = Device::flex().autodiff();
        let textures = Backgrounds::procedural();
        let options = options(1);
        let network = network(&device);
        let perceptual = Perceptual::of(&network, &device).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let preview = Preview::new(&textures, &options.samples, 0, folder.path());
        let optimiser = AdamWConfig::new().init();
        let mut state = State {
            network,
            optimiser,
            perceptual: &perceptual,
            preview: &preview,
            options: &options,
            device: &device,
        };
        let batch = Batch::of_step(&textures, &options.samples, &options.batch, 0, 4);
        let losses: Vec<f64> = (0..12)
            .map(|_| {
                let losses = state.step(batch.clone(), 2e-3);
                options.weights[0] * losses["colours"] + options.weights[1] * losses["features"]
            })
            .collect();
        assert!(losses[11] < 0.95 * losses[0], "{losses:?}");
    }

    #[test]
    fn it_goes_on_where_it_stopped() {
        let device = Device::flex().autodiff();
        let textures = Backgrounds::procedural();
        let options = options(6);
        let go = |folder: &Path, stop_at: Option<u64>, sample_threads: usize| {
            let stop = AtomicBool::new(false);
            let network = network(&device);
            let perceptual = Perceptual::of(&network, &device).unwrap();
            let pace = TrainingPace { checkpoint_every: 4, log_every: 1, sample_threads };
            let parts = Parts::default();
            train(&textures, network, parts, &perceptual, &device, folder, &options, &pace, &stop, |r| {
                stop.store(stop_at.is_some_and(|s| r.step >= s), Ordering::Relaxed);
            })
            .unwrap()
        };
        let numbers = |n: &Network| -> Vec<f32> {
            let device = Device::flex();
            let maps = n.encode(Tensor::<4>::ones([1, 3, 32, 32], &device) * 0.3);
            let x = Tensor::<4>::ones([2, CHANNELS, 8, 8], &device) * 0.2;
            let blend = n.blend(x, Tensor::ones([2, 1, 8, 8], &device), 2);
            let mut out: Vec<f32> = maps[3].clone().into_data().try_to_vec().unwrap();
            out.extend(n.decode(blend.sum).unwrap().into_data().try_to_vec::<f32>().unwrap());
            out
        };
        let folder = tempfile::tempdir().unwrap();
        let Ending::Finished(straight) = go(&folder.path().join("a"), None, 1) else { panic!() };
        let b = folder.path().join("b");
        assert!(matches!(go(&b, Some(3), 2), Ending::Interrupted { step: 3 }));
        let Ending::Finished(resumed) = go(&b, None, 1) else { panic!() };
        assert_eq!(numbers(&straight), numbers(&resumed));
        assert!(b.join("preview.png").exists());
        let wrong = TrainingOptions {
            batch: BatchOptions { sides: vec![50], ..options.batch.clone() },
            ..options.clone()
        };
        assert!(check(&wrong).unwrap_err().to_string().contains("batch.sides"));
    }
}
