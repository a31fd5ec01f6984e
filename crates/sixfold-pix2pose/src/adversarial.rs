//! Training of the dissertation's generators: reconstruction, error prediction and a discriminator (equations 3.1 to
//! 3.5), for one object.
//!
//! Each iteration trains the discriminator on rendered and on generated coordinate images, then the generator on
//! `lambda_1 * reconstruction + lambda_2 * error + adversarial`.

use crate::loss::{LossOptions, OutputKind, Targets, loss};
use crate::model::{paper_input, resnet_input};
use crate::networks::ResNet50Generator;
use crate::networks::{GeneratorOutput, PaperGenerator};
use crate::object::SymmetryMap;
use crate::samples::{Sample, SampleSource};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_nn::critic::Critic;
use sixfold_nn::fingerprint::Fingerprint;
use sixfold_nn::learner::{Checkpointed, Learner};
use sixfold_nn::options::{OptionError, Pace};
use sixfold_nn::schedule::LearningRate;
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};

/// Side of images and targets, pixels.
const SIDE: usize = 128;

/// Options of the training. The defaults are the dissertation's (section 3.4.1).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AdversarialOptions {
    /// Iterations (dissertation: 25,000).
    pub steps: u64,
    /// Images in a batch (dissertation: 50).
    pub batch: usize,
    /// Learning rate of generator and discriminator, divided by ten every `decay_every` iterations.
    pub learning_rate: f64,
    /// Iterations between reductions of the rate (dissertation: 12,000).
    pub decay_every: u64,
    /// Weight of the reconstruction, lambda_1.
    pub reconstruction: f32,
    /// Weight of the error prediction, lambda_2.
    pub error: f32,
    /// Train a discriminator; otherwise the generator learns from its targets only.
    pub adversarial: bool,
    /// Use the transformer loss (equation 3.2); otherwise plain L1 (equation 3.1).
    pub transformer_loss: bool,
    /// Equation 3.1 with its beta on hidden pixels of the object too; otherwise on visible ones only, as in the author's code.
    pub whole_mask: bool,
    /// Seed of samples and labels.
    pub seed: u64,
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
            whole_mask: false,
            seed: 0,
        }
    }
}

impl AdversarialOptions {
    /// Checks every number.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_steps(self.steps)?;
        OptionError::unless(self.decay_every > 0, "decay_every", self.decay_every, "1 or more")?;
        OptionError::unless_samples("batch", self.batch, 1, "1 or more")?;
        let rate = self.learning_rate;
        let fits = rate.is_finite() && rate > 0.0;
        OptionError::unless(fits, "learning_rate", rate, "a finite number above 0")?;
        OptionError::unless_weight("error", f64::from(self.error))?;
        OptionError::unless_weight("reconstruction", f64::from(self.reconstruction))
    }

    fn schedule(&self) -> LearningRate {
        LearningRate::StepDecay {
            rate: self.learning_rate,
            factor: 0.1,
            at: (1..).map(|n| n * self.decay_every).take_while(|at| *at < self.steps).collect(),
        }
    }
}

/// A trainable generator: computes coordinates and expected error of `batch x 3 x 128 x 128` images.
pub trait Generator: Module {
    /// Coordinates and expected error.
    fn generate(&self, x: Tensor<4>) -> GeneratorOutput;
    /// Scales pixel values in 0..1 for the network.
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

/// A generator in training, and its discriminator.
pub struct AdversarialTraining<G> {
    generator: Learner<G>,
    critic: Critic,
    pool: Vec<SymmetryMap>,
    options: AdversarialOptions,
    /// How often the training logs and saves.
    pub pace: Pace,
    device: Device,
}

impl<G: Generator> AdversarialTraining<G> {
    /// Starts the training of a generator on the autodiff `device` for one object; `pool` has the object's symmetries, the identity
    /// first.
    pub fn new(
        generator: G,
        mut pool: Vec<SymmetryMap>,
        options: AdversarialOptions,
        device: Device,
    ) -> Self {
        if !options.transformer_loss {
            pool.truncate(1);
        }
        AdversarialTraining {
            generator: Learner::adam("generator", generator),
            critic: Critic::new("discriminator", options.seed, &device),
            pool,
            options,
            pace: Pace { checkpoint_every: 100, log_every: 10, sample_threads: 2 },
            device,
        }
    }

    /// The trained generator.
    pub fn into_network(self) -> G {
        self.generator.into_network()
    }
}

/// The samples of an iteration, and its number.
pub struct AdversarialBatch {
    samples: Vec<Sample>,
    step: u64,
}

impl<G: Generator> Training for AdversarialTraining<G> {
    type Samples = SampleSource;
    type Batch = AdversarialBatch;

    fn plan(&self, source: &SampleSource) -> Result<Plan, TrainError> {
        let options = &self.options;
        options.check()?;
        let one = source.objects() == 1 && !self.pool.is_empty();
        let expected = "one: this network learns a single object";
        OptionError::unless(one, "objects", source.objects(), expected)?;
        let (side, target) = (source.options().size, source.options().target());
        let expected = "128 pixels for images and targets";
        OptionError::unless(side == 128 && target == 128, "size", format!("{side} and {target}"), expected)?;
        Ok(Plan {
            steps: options.steps,
            schedule: options.schedule(),
            samples_per_step: options.batch,
            pace: self.pace,
            settings: Fingerprint::of(options)?,
        })
    }

    fn batches<'a>(&self, source: &'a SampleSource) -> Batches<'a, AdversarialBatch> {
        let (batch, seed) = (self.options.batch as u64, self.options.seed);
        Box::new(move |step| {
            let samples = (step * batch..(step + 1) * batch).map(|n| source.sample(0, seed, n));
            AdversarialBatch { samples: samples.collect(), step }
        })
    }

    fn step(&mut self, AdversarialBatch { samples, step }: AdversarialBatch, rate: f64) -> Losses {
        let (options, device, side) = (&self.options, &self.device, SIDE);
        let count = samples.len();
        let gather =
            |part: fn(&Sample) -> &[f32]| samples.iter().flat_map(part).copied().collect::<Vec<f32>>();
        let images = Tensor::<4>::from_data(
            TensorData::new(G::input(&gather(|s| &s.rgb)), [count, 3, side, side]),
            device,
        );
        let coordinates = gather(|s| &s.coordinates);
        let output = self.generator.network().generate(images);
        let mut losses = Losses::new();
        if options.adversarial {
            let real =
                Tensor::<4>::from_data(TensorData::new(coordinates.clone(), [count, 3, side, side]), device);
            let generated = output.coordinates.clone().detach();
            let loss = self.critic.step(generated, real, step, rate, device);
            losses.insert("discriminator".to_string(), loss);
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
            whole_mask: options.whole_mask,
            ..LossOptions::of(OutputKind::Paper)
        };
        let scale = options.reconstruction / count as f32;
        let value = loss(values, &targets, side * side, &self.pool, OutputKind::Paper, &weights, scale);
        losses.insert("coordinates".to_string(), value.coordinates);
        losses.insert("error".to_string(), value.error);
        let gradient = Tensor::<4>::from_data(TensorData::new(value.gradient, joined.dims()), device);
        let mut total = (joined * gradient).sum();
        if options.adversarial {
            let loss = self.critic.generator_loss(output.coordinates);
            let value = loss.clone().inner().into_scalar::<f32>();
            losses.insert("adversarial".to_string(), f64::from(value));
            total = total + loss;
        }
        self.generator.descend(rate, total);
        losses
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        vec![&mut self.generator, &mut self.critic.learner]
    }
}
