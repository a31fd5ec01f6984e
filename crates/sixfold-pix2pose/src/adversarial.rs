//! Training of the dissertation's generators: reconstruction, error prediction and a discriminator (equations 3.1 to
//! 3.5), for one object.
//!
//! Each iteration teaches the discriminator on rendered and on generated coordinate images, then the generator on
//! `lambda_1 * reconstruction + lambda_2 * error + adversarial`.

use crate::critic::Critic;
use crate::loss::{LossOptions, OutputKind, Targets, loss};
use crate::model::{paper_input, resnet_input};
use crate::networks::ResNet50Generator;
use crate::networks::{GeneratorOutput, PaperGenerator};
use crate::object::SymmetryMap;
use crate::samples::{Sample, SampleSource};
use crate::training::{TrainingError, TrainingOutcome};
use burn::module::Module;
use burn::optim::{AdamConfig, GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_nn::checkpoint::{Checkpoint, CheckpointError, CheckpointWriter};
use sixfold_nn::schedule::LearningRate;
use sixfold_nn::training::{Course, Trainee, run};
use sixfold_nn::training_log::TrainingRecord;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// How to train. The defaults are the dissertation's (section 3.4.1).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AdversarialOptions {
    /// Iterations (dissertation: 25,000).
    pub steps: u64,
    /// Images in a batch (dissertation: 50).
    pub batch: usize,
    /// Learning rate of generator and discriminator, divided by ten every `decay_every` iterations.
    pub learning_rate: f64,
    /// Iterations between divisions of the rate (dissertation: 12,000).
    pub decay_every: u64,
    /// Weight of the reconstruction, lambda_1.
    pub reconstruction: f32,
    /// Weight of the error prediction, lambda_2.
    pub error: f32,
    /// Teach a discriminator; without, the generator learns from its targets alone.
    pub adversarial: bool,
    /// Use the transformer loss (equation 3.2); otherwise plain L1 (equation 3.1).
    pub transformer_loss: bool,
    /// Seed of samples and labels.
    pub seed: u64,
    /// Iterations between checkpoints.
    pub checkpoint_every: u64,
    /// Iterations between records of the log.
    pub log_every: u64,
}

impl Default for AdversarialOptions {
    fn default() -> Self {
        Self {
            steps: 25_000,
            batch: 50,
            learning_rate: 1e-4,
            decay_every: 12_000,
            reconstruction: 100.0,
            error: 50.0,
            adversarial: true,
            transformer_loss: true,
            seed: 0,
            checkpoint_every: 100,
            log_every: 10,
        }
    }
}

/// A generator that can be trained: it makes coordinates and error of `batch x 3 x 128 x 128` images.
pub trait Generator: Module {
    /// Coordinates and expected error.
    fn generate(&self, x: Tensor<4>) -> GeneratorOutput;
    /// Pixel values in 0..1 as the network takes them.
    fn input(rgb: &[f32]) -> Vec<f32>;
}

impl Generator for PaperGenerator {
    fn generate(&self, x: Tensor<4>) -> GeneratorOutput {
        self.forward(x)
    }
    fn input(rgb: &[f32]) -> Vec<f32> {
        paper_input(rgb)
    }
}

impl Generator for ResNet50Generator {
    fn generate(&self, x: Tensor<4>) -> GeneratorOutput {
        self.forward(x)
    }
    fn input(rgb: &[f32]) -> Vec<f32> {
        resnet_input(rgb)
    }
}

/// What is trained, and what trains it.
struct State<'a, G> {
    generator: G,
    critic: Critic,
    generator_optimiser: ModuleOptimizer,
    pool: &'a [SymmetryMap],
    /// Of the images, pixels.
    side: usize,
    options: &'a AdversarialOptions,
    device: &'a Device,
}

/// The samples of an iteration, and which it is.
struct Batch {
    samples: Vec<Sample>,
    step: u64,
}

impl<G: Generator> Trainee for State<'_, G> {
    type Batch = Batch;

    fn step(&mut self, Batch { samples, step }: Batch, rate: f64) -> BTreeMap<String, f64> {
        let Self { pool, side, options, device, .. } = *self;
        let count = samples.len();
        let gather =
            |part: fn(&Sample) -> &[f32]| samples.iter().flat_map(part).copied().collect::<Vec<f32>>();
        let images = Tensor::<4>::from_data(
            TensorData::new(G::input(&gather(|s| &s.rgb)), [count, 3, side, side]),
            device,
        );
        let coordinates = gather(|s| &s.coordinates);
        let output = self.generator.generate(images);
        let mut losses = BTreeMap::new();
        if options.adversarial {
            let real =
                Tensor::<4>::from_data(TensorData::new(coordinates.clone(), [count, 3, side, side]), device);
            let generated = output.coordinates.clone().detach();
            let teaching = self.critic.teach(generated, real, step, rate, device);
            losses.insert("discriminator".to_string(), teaching);
        }
        let joined = Tensor::cat(vec![output.coordinates.clone(), output.error], 1);
        let values = joined.clone().inner().into_data();
        let values = values.as_slice::<f32>().unwrap_or_else(|error| unreachable!("f32 output: {error:?}"));
        let targets = Targets {
            coordinates: &coordinates,
            object: &gather(|s| &s.object),
            visible: &gather(|s| &s.visible),
        };
        let weights = LossOptions {
            error: options.error / options.reconstruction,
            ..LossOptions::of(OutputKind::Paper)
        };
        let scale = options.reconstruction / count as f32;
        let value = loss(values, &targets, side * side, pool, OutputKind::Paper, &weights, scale);
        losses.insert("coordinates".to_string(), value.coordinates);
        losses.insert("error".to_string(), value.error);
        let gradient = Tensor::<4>::from_data(TensorData::new(value.gradient, joined.dims()), device);
        let mut total = (joined * gradient).sum();
        if options.adversarial {
            let doubt = self.critic.doubt(output.coordinates);
            let known = doubt.clone().inner().into_scalar::<f32>();
            losses.insert("adversarial".to_string(), f64::from(known));
            total = total + doubt;
        }
        let gradients = GradientsParams::from_grads(total.backward(), &self.generator);
        self.generator = self.generator_optimiser.step(rate, self.generator.clone(), gradients);
        losses
    }

    fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError> {
        let checkpoint = checkpoint
            .module("generator", &self.generator)?
            .optimiser("generator", &self.generator_optimiser)?;
        self.critic.save(checkpoint)
    }

    fn restore(self, checkpoint: &Checkpoint) -> Result<Self, CheckpointError> {
        Ok(State {
            generator: checkpoint.module("generator", self.generator)?,
            critic: self.critic.restore(checkpoint)?,
            generator_optimiser: checkpoint.optimiser("generator", self.generator_optimiser)?,
            ..self
        })
    }
}

/// Trains a generator for the one object of `source`; as [`crate::training::train`] otherwise.
///
/// # Errors
/// [`TrainingError`]; the last checkpoints stay.
#[allow(clippy::too_many_arguments)]
pub fn train_adversarial<G: Generator>(
    source: &SampleSource,
    pool: &[SymmetryMap],
    generator: G,
    device: &Device,
    folder: &Path,
    options: &AdversarialOptions,
    stop: &AtomicBool,
    progress: impl FnMut(&TrainingRecord),
) -> Result<TrainingOutcome<G>, TrainingError> {
    let wrong = |field, expected, found: String| Err(TrainingError::Option { field, expected, found });
    let side = source.options().size;
    if source.objects() != 1 || pool.is_empty() {
        return wrong("objects", "one: this network learns a single object", source.objects().to_string());
    }
    if side != 128 || source.options().target() != 128 {
        return wrong(
            "size",
            "128 pixels for images and targets",
            format!("{side} and {}", source.options().target()),
        );
    }
    for (field, value) in [("batch", options.batch as u64), ("decay_every", options.decay_every)] {
        if value == 0 {
            return wrong(field, "at least 1", "0".to_string());
        }
    }
    let state = State {
        generator,
        critic: Critic::new("discriminator", options.seed, device),
        generator_optimiser: AdamConfig::new().init(),
        pool: if options.transformer_loss { pool } else { &pool[..1] },
        side,
        options,
        device,
    };
    let course = Course {
        steps: options.steps,
        schedule: LearningRate::StepDecay {
            rate: options.learning_rate,
            factor: 0.1,
            at: (1..).map(|n| n * options.decay_every).take_while(|at| *at < options.steps).collect(),
        },
        samples_per_step: options.batch,
        log_every: options.log_every,
        checkpoint_every: options.checkpoint_every,
        sample_threads: 2,
    };
    let decisive = AdversarialOptions { checkpoint_every: 0, log_every: 0, ..options.clone() };
    let batch = |step| {
        let first = step * options.batch as u64;
        let samples = (first..first + options.batch as u64).map(|n| source.sample(0, options.seed, n));
        Batch { samples: samples.collect(), step }
    };
    let ending = run(state, batch, &course, &decisive, folder, stop, progress)?;
    Ok(ending.map(|state| state.generator.valid()))
}
