//! The training of the compact network: what a step is, and the samples that it learns from.

use crate::critic::Critic;
use crate::loss::{LossOptions, OutputKind, Targets, loss};
use crate::model::{Network, network_input};
use crate::networks::Compact;
use crate::object::SymmetryMap;
use crate::samples::SampleSource;
use burn::module::Module;
use burn::optim::{AdamWConfig, GradientsAccumulator, GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_nn::checkpoint::{Checkpoint, CheckpointError, CheckpointWriter};
use sixfold_nn::schedule::LearningRate;
use sixfold_nn::training::{Course, Ending, Trainee, run};
use sixfold_nn::training_log::TrainingRecord;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// How to train.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingOptions {
    /// Optimiser steps.
    pub steps: u64,
    /// Images of every object in a step.
    pub per_object: usize,
    /// Highest learning rate of the decoders; it falls to zero as a cosine.
    pub learning_rate: f64,
    /// The encoder's share of that rate: it is pretrained.
    pub encoder_share: f64,
    /// Steps over which the rate rises at first.
    pub warm_up: u64,
    /// Decoupled weight decay.
    pub weight_decay: f32,
    /// Stages of the encoder that stay as they are.
    pub frozen_stages: usize,
    /// Use the transformer loss (equation 3.2); otherwise plain L1 (equation 3.1).
    pub transformer_loss: bool,
    /// Weight of the adversarial loss (equation 3.4) against that of the coordinates; 0 trains without discriminators. The
    /// dissertation's is 0.01. A discriminator, one an object, sees coordinates within the object's whole silhouette.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub adversarial: f32,
    /// Seed of weights and samples.
    pub seed: u64,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Steps between records of the log.
    pub log_every: u64,
    /// Threads that make samples beside the training itself.
    pub sample_threads: usize,
}

/// Cards and checkpoints do not mention what is not used.
fn is_zero(weight: &f32) -> bool {
    *weight == 0.0
}

impl Default for TrainingOptions {
    fn default() -> Self {
        Self {
            steps: 8000,
            per_object: 4,
            learning_rate: 2e-3,
            encoder_share: 0.3,
            warm_up: 100,
            weight_decay: 1e-4,
            frozen_stages: 2,
            transformer_loss: true,
            adversarial: 0.0,
            seed: 0,
            checkpoint_every: 250,
            log_every: 25,
            sample_threads: 2,
        }
    }
}

pub use sixfold_nn::training::TrainingError;

/// How a training ended.
pub type TrainingOutcome<N = Network> = Ending<N>;

/// A batch: images of all objects, one object after another.
struct Batch {
    rgb: Vec<f32>,
    coordinates: Vec<f32>,
    object: Vec<f32>,
    visible: Vec<f32>,
    step: u64,
}

fn make_batch(source: &SampleSource, options: &TrainingOptions, step: u64) -> Batch {
    let mut batch = Batch { rgb: vec![], coordinates: vec![], object: vec![], visible: vec![], step };
    for object in 0..source.objects() {
        for image in 0..options.per_object {
            let sample = source.sample(object, options.seed, step * options.per_object as u64 + image as u64);
            batch.rgb.extend(network_input(&sample.rgb));
            batch.coordinates.extend(sample.coordinates);
            batch.object.extend(sample.object);
            batch.visible.extend(sample.visible);
        }
    }
    batch
}

struct State<'a> {
    network: Compact,
    encoder: ModuleOptimizer,
    decoders: ModuleOptimizer,
    /// One an object, or none.
    critics: Vec<Critic>,
    pools: &'a [Vec<SymmetryMap>],
    /// Of the input, pixels.
    side: usize,
    options: &'a TrainingOptions,
    device: &'a Device,
}

impl Trainee for State<'_> {
    type Batch = Batch;

    fn step(&mut self, batch: Batch, rate: f64) -> BTreeMap<String, f64> {
        let Self { pools, side, options, device, .. } = *self;
        let count = options.per_object;
        let images = pools.len() * count;
        let kind = OutputKind::Compact;
        let loss_options = LossOptions::of(kind);
        let mut sums = [0.0; 3];
        let mut adversarial = [0.0; 2];
        // One object after another: their images together would not fit the processor's caches, and memory is what this
        // network waits for.
        let mut encoder_gradients = GradientsAccumulator::new();
        let mut decoder_gradients = GradientsAccumulator::new();
        let mut rgb = batch.rgb.as_slice();
        for (object, pool) in pools.iter().enumerate() {
            let (images_of_object, rest) = rgb.split_at(count * 3 * side * side);
            rgb = rest;
            let input = TensorData::new(images_of_object.to_vec(), [count, 3, side, side]);
            let output = self.network.forward(Tensor::from_data(input, device), &[(object, count)]).remove(0);
            let dims = output.dims();
            let pixels = dims[2] * dims[3];
            let range = |width: usize| object * count * width * pixels..(object + 1) * count * width * pixels;
            let targets = Targets {
                coordinates: &batch.coordinates[range(3)],
                object: &batch.object[range(1)],
                visible: &batch.visible[range(1)],
            };
            let raw = output.clone().inner().into_data();
            let raw = raw.as_slice::<f32>().unwrap_or_else(|error| unreachable!("f32 output: {error:?}"));
            let pool = if options.transformer_loss { &pool[..] } else { &pool[..1] };
            let value = loss(raw, &targets, pixels, pool, kind, &loss_options, 1.0 / images as f32);
            for (sum, term) in sums.iter_mut().zip([value.coordinates, value.error, value.visibility]) {
                *sum += term / pools.len() as f64;
            }
            let gradient = Tensor::<4>::from_data(TensorData::new(value.gradient, dims), device);
            let mut total = (output.clone() * gradient).sum();
            if let Some(critic) = self.critics.get_mut(object) {
                let [_, _, height, width] = dims;
                let of = |values: &[f32], channels: usize| {
                    let shape = [count, channels, height, width];
                    Tensor::<4>::from_data(TensorData::new(values.to_vec(), shape), device)
                };
                let silhouette = of(targets.object, 1);
                let rendered = of(targets.coordinates, 3) * silhouette.clone();
                let generated = output.narrow(1, 0, 3) * silhouette;
                adversarial[0] +=
                    critic.teach(generated.clone().detach(), rendered, batch.step, rate, device);
                let doubt = critic.doubt(generated);
                adversarial[1] += f64::from(doubt.clone().inner().into_scalar::<f32>());
                total = total + doubt.mul_scalar(options.adversarial * count as f32 / images as f32);
            }
            let mut gradients = total.backward();
            let of_encoder = GradientsParams::from_module(&mut gradients, &self.network.encoder);
            let of_decoders = GradientsParams::from_module(&mut gradients, &self.network.decoders);
            encoder_gradients.accumulate(&self.network.encoder, of_encoder);
            decoder_gradients.accumulate(&self.network.decoders, of_decoders);
        }
        self.network.encoder = self.encoder.step(
            rate * options.encoder_share,
            self.network.encoder.clone(),
            encoder_gradients.grads(),
        );
        self.network.decoders =
            self.decoders.step(rate, self.network.decoders.clone(), decoder_gradients.grads());
        let mut losses = BTreeMap::from(
            [("coordinates", sums[0]), ("error", sums[1]), ("visibility", sums[2])]
                .map(|(name, value)| (name.to_string(), value)),
        );
        if !self.critics.is_empty() {
            let [discriminator, doubt] = adversarial.map(|sum| sum / pools.len() as f64);
            losses.insert("discriminator".to_string(), discriminator);
            losses.insert("adversarial".to_string(), doubt);
        }
        losses
    }

    fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError> {
        let checkpoint = checkpoint
            .module("network", &self.network)?
            .optimiser("encoder", &self.encoder)?
            .optimiser("decoders", &self.decoders)?;
        self.critics.iter().try_fold(checkpoint, |checkpoint, critic| critic.save(checkpoint))
    }

    fn restore(self, checkpoint: &Checkpoint) -> Result<Self, CheckpointError> {
        Ok(State {
            network: checkpoint.module("network", self.network)?.freeze(self.options.frozen_stages),
            encoder: checkpoint.optimiser("encoder", self.encoder)?,
            decoders: checkpoint.optimiser("decoders", self.decoders)?,
            critics: self.critics.into_iter().map(|c| c.restore(checkpoint)).collect::<Result<_, _>>()?,
            ..self
        })
    }
}

/// Trains a compact network, whose tensors are on the autodiff `device`, on `source`; `pools` holds every object's symmetries, the identity first.
///
/// Checkpoints, log and learning curves go to `folder`; a training that was interrupted there goes on, with the same
/// result as one that was not. `stop` ends it after the current step.
///
/// # Errors
/// [`TrainingError`]; the last checkpoints stay.
#[allow(clippy::too_many_arguments)]
pub fn train(
    source: &SampleSource,
    pools: &[Vec<SymmetryMap>],
    network: Compact,
    device: &Device,
    folder: &Path,
    options: &TrainingOptions,
    stop: &AtomicBool,
    progress: impl FnMut(&TrainingRecord),
) -> Result<TrainingOutcome, TrainingError> {
    let schedule = check(source, pools, options)?;
    if network.decoders.len() != pools.len() {
        let found = format!("{} decoders for {} objects", network.decoders.len(), pools.len());
        return Err(TrainingError::Option { field: "network", expected: "one decoder an object", found });
    }
    let optimiser = || AdamWConfig::new().with_weight_decay(options.weight_decay).init();
    let state = State {
        network: network.freeze(options.frozen_stages),
        encoder: optimiser(),
        decoders: optimiser(),
        critics: if options.adversarial > 0.0 {
            (0..pools.len())
                .map(|o| Critic::new(format!("discriminator-{o}"), options.seed, device))
                .collect()
        } else {
            vec![]
        },
        pools,
        side: source.options().size,
        options,
        device,
    };
    let course = Course {
        steps: options.steps,
        schedule,
        samples_per_step: options.per_object * pools.len(),
        log_every: options.log_every,
        checkpoint_every: options.checkpoint_every,
        sample_threads: options.sample_threads,
    };
    // How often is logged and saved, and by how many threads, does not change the result.
    let decisive =
        TrainingOptions { checkpoint_every: 0, log_every: 0, sample_threads: 0, ..options.clone() };
    let batch = |step| make_batch(source, options, step);
    let ending = run(state, batch, &course, &decisive, folder, stop, progress)?;
    Ok(ending.map(|state| Network::Compact(Box::new(state.network.valid()))))
}

/// The network of the last checkpoint in `folder`, filled into `network`, and the steps it has done; `None` if there is
/// no checkpoint.
///
/// # Errors
/// [`TrainingError::Checkpoint`].
pub fn last_checkpoint(folder: &Path, network: Compact) -> Result<Option<(Compact, u64)>, TrainingError> {
    let Some(checkpoint) = Checkpoint::latest(folder)? else { return Ok(None) };
    Ok(Some((checkpoint.module("network", network)?.valid(), checkpoint.step())))
}

fn check(
    source: &SampleSource,
    pools: &[Vec<SymmetryMap>],
    options: &TrainingOptions,
) -> Result<LearningRate, TrainingError> {
    let wrong = |field, expected, found: String| Err(TrainingError::Option { field, expected, found });
    if pools.len() != source.objects() || pools.iter().any(Vec::is_empty) {
        return wrong(
            "pools",
            "one list with the identity for every object",
            format!("{} lists", pools.len()),
        );
    }
    let (side, target) = (source.options().size, source.options().target());
    if side % 16 != 0 || target * 2 != side {
        return wrong(
            "size",
            "a multiple of 16 with targets of half the side",
            format!("{side} and {target}"),
        );
    }
    if options.per_object == 0 {
        return wrong("per_object", "at least 1", "0".to_string());
    }
    if !(options.adversarial >= 0.0 && options.adversarial.is_finite()) {
        return wrong("adversarial", "0 or more", options.adversarial.to_string());
    }
    if !(0.0..=1.0).contains(&options.encoder_share) {
        return wrong("encoder_share", "0 to 1", options.encoder_share.to_string());
    }
    Ok(LearningRate::Cosine {
        rate: options.learning_rate,
        last: 0.0,
        warm_up: options.warm_up.min(options.steps.saturating_sub(1)),
        steps: options.steps,
    })
}
