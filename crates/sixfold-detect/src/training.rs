//! The training of a detector: image after image through the network, gradients summed over a batch, AdamW.

use crate::loss::{LossWeights, RawOutput, loss};
use crate::network::{Detector, DetectorConfig, DetectorOutput, MASK_STRIDE};
use crate::samples::{SceneOptions, SceneSource};
use crate::targets::Targets;
use burn::module::Module;
use burn::optim::{AdamWConfig, GradientsAccumulator, GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sixfold_nn::checkpoint::{Checkpoint, CheckpointError, CheckpointWriter};
use sixfold_nn::schedule::LearningRate;
use sixfold_nn::training::{Course, Trainee, run};
pub use sixfold_nn::training::{Ending, TrainingError};
use sixfold_nn::training_log::TrainingRecord;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// How to train. All of it decides about the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingOptions {
    /// Optimiser steps.
    pub steps: u64,
    /// Images in a step.
    pub batch: usize,
    /// Highest learning rate of pyramid and heads; it falls to zero as a cosine.
    pub learning_rate: f64,
    /// The encoder's share of that rate: it is pretrained.
    pub encoder_share: f64,
    /// Steps over which the rate rises at first.
    pub warm_up: u64,
    /// Decoupled weight decay.
    pub weight_decay: f32,
    /// A tensor's gradient that is longer than this (Euclidean) is shortened to it.
    pub longest_gradient: f32,
    /// Stages of the encoder that stay as they are.
    pub frozen_stages: usize,
    /// Seed of weights and samples.
    pub seed: u64,
}

impl Default for TrainingOptions {
    fn default() -> Self {
        Self {
            steps: 8000,
            batch: 4,
            learning_rate: 2e-3,
            encoder_share: 0.3,
            warm_up: 200,
            weight_decay: 1e-4,
            longest_gradient: 10.0,
            frozen_stages: 2,
            seed: 0,
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
    /// Threads that make images beside the training itself.
    pub sample_threads: usize,
}

impl Default for TrainingPace {
    fn default() -> Self {
        Self { checkpoint_every: 250, log_every: 25, sample_threads: 2 }
    }
}

/// An image as the network wants it, and what it is to say of it.
pub struct TrainingImage {
    input: Vec<f32>,
    targets: Targets,
}

/// A network in training.
struct State<'a> {
    network: Detector,
    config: &'a DetectorConfig,
    encoder: ModuleOptimizer,
    heads: ModuleOptimizer,
    options: &'a TrainingOptions,
    side: usize,
    device: &'a Device,
}

fn numbers(tensor: &Tensor<4>) -> Vec<f32> {
    let data = tensor.clone().inner().into_data();
    data.try_to_vec().unwrap_or_else(|error| unreachable!("f32 output: {error:?}"))
}

/// What one image says: losses, gradients of encoder and of the rest.
struct Lesson {
    terms: [f64; 3],
    encoder: GradientsParams,
    heads: GradientsParams,
}

impl State<'_> {
    /// One image through the network and back. `network` is this thread's own copy ([`Module::fork`]): graphs that share
    /// parameters are one to Burn, and two threads that build and walk it lock each other out for good.
    fn learn(&self, network: &Detector, image: &TrainingImage, positives: usize, masks: usize) -> Lesson {
        let side = self.side;
        let input = TensorData::new(image.input.clone(), [1, 3, side, side]);
        let DetectorOutput { scores, boxes, prototypes } =
            network.forward(Tensor::from_data(input, self.device));
        let raw_scores: Vec<Vec<f32>> = scores.iter().map(numbers).collect();
        let raw_boxes: Vec<Vec<f32>> = boxes.iter().map(numbers).collect();
        let raw_prototypes = numbers(&prototypes);
        let raw = RawOutput {
            scores: &raw_scores,
            boxes: &raw_boxes,
            prototypes: &raw_prototypes,
            mask_width: side / MASK_STRIDE,
        };
        let value = loss(&raw, &image.targets, self.config, &LossWeights::default(), positives, masks);
        let terms = [value.scores, value.boxes, value.masks];
        let gradients = value.of_scores.into_iter().chain(value.of_boxes).chain([value.of_prototypes]);
        let outputs = scores.into_iter().chain(boxes).chain([prototypes]);
        let products = outputs.zip(gradients).map(|(out, gradient)| {
            let dims = out.dims();
            (out * Tensor::from_data(TensorData::new(gradient, dims), self.device)).sum()
        });
        let Some(sum) = products.reduce(|a, b| a + b) else { unreachable!("a detector has levels") };
        let mut gradients = sum.backward();
        let encoder = GradientsParams::from_module(&mut gradients, &network.encoder);
        let heads = GradientsParams::from_module(&mut gradients, network);
        Lesson { terms, encoder, heads }
    }
}

impl Trainee for State<'_> {
    type Batch = Vec<TrainingImage>;

    fn step(&mut self, batch: Self::Batch, rate: f64) -> BTreeMap<String, f64> {
        let count = |of: fn(&Targets) -> usize| batch.iter().map(|i| of(&i.targets)).sum::<usize>();
        let positives = count(|t| t.positives.len());
        let masks = count(|t| t.mask_positives.len());
        // An image a thread: together in one tensor they would not fit the processor's caches, and much between the
        // convolutions runs on one thread. Threads of their own, not of rayon's pool, whose kernels must not wait for a
        // whole image.
        let threads = rayon::current_num_threads().clamp(1, batch.len().max(1));
        let state = &*self;
        let lessons: Vec<Vec<Lesson>> = std::thread::scope(|scope| {
            let workers: Vec<_> = (0..threads)
                .map(|first| {
                    let images = batch.iter().skip(first).step_by(threads);
                    let network = state.network.clone().fork(state.device);
                    scope.spawn(move || images.map(|i| state.learn(&network, i, positives, masks)).collect())
                })
                .collect();
            let join = |worker: std::thread::ScopedJoinHandle<'_, _>| match worker.join() {
                Ok(lessons) => lessons,
                Err(panic) => std::panic::resume_unwind(panic),
            };
            workers.into_iter().map(join).collect()
        });
        // Summed in the order of the images, whichever thread had them.
        let mut of_encoder = GradientsAccumulator::new();
        let mut of_heads = GradientsAccumulator::new();
        let mut sums = [0.0; 3];
        let mut lessons: Vec<_> = lessons.into_iter().map(Vec::into_iter).collect();
        for image in 0..batch.len() {
            let Some(lesson) = lessons[image % threads].next() else { continue };
            sums.iter_mut().zip(lesson.terms).for_each(|(sum, term)| *sum += term);
            of_encoder.accumulate(&self.network.encoder, lesson.encoder);
            of_heads.accumulate(&self.network, lesson.heads);
        }
        let encoder = self.network.encoder.clone();
        self.network.encoder =
            self.encoder.step(rate * self.options.encoder_share, encoder, of_encoder.grads());
        self.network = self.heads.step(rate, self.network.clone(), of_heads.grads());
        [("scores", sums[0]), ("boxes", sums[1]), ("masks", sums[2])]
            .map(|(name, value)| (name.to_string(), value))
            .into()
    }

    fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError> {
        checkpoint
            .module("network", &self.network)?
            .optimiser("encoder", &self.encoder)?
            .optimiser("heads", &self.heads)
    }

    fn restore(self, checkpoint: &Checkpoint) -> Result<Self, CheckpointError> {
        Ok(State {
            network: checkpoint.module("network", self.network)?.freeze(self.options.frozen_stages),
            encoder: checkpoint.optimiser("encoder", self.encoder)?,
            heads: checkpoint.optimiser("heads", self.heads)?,
            ..self
        })
    }
}

/// The images of a step.
fn make_batch(
    source: &SceneSource,
    config: &DetectorConfig,
    options: &TrainingOptions,
    step: u64,
) -> Vec<TrainingImage> {
    let side = source.options().size;
    (0..options.batch as u64)
        .map(|image| {
            let sample = source.sample(options.seed, step * options.batch as u64 + image);
            let targets = Targets::new(&sample.annotation, config);
            let mut input = sample.rgb;
            config.input(&mut input, side * side);
            TrainingImage { input, targets }
        })
        .collect()
}

/// All that decides about the result.
#[derive(Serialize)]
struct Recorded<'a> {
    #[serde(flatten)]
    training: &'a TrainingOptions,
    network: &'a DetectorConfig,
    samples: &'a SceneOptions,
    photographs: usize,
}

/// Trains a network, whose tensors are on the autodiff `device`, on `source`.
///
/// Checkpoints, log and learning curves go to `folder`; a training that was interrupted there goes on, with the same
/// result as one that was not. `stop` ends it after the current step.
///
/// # Errors
/// [`TrainingError`]; the last checkpoints stay.
#[allow(clippy::too_many_arguments)]
pub fn train(
    source: &SceneSource,
    network: Detector,
    config: &DetectorConfig,
    device: &Device,
    folder: &Path,
    options: &TrainingOptions,
    pace: &TrainingPace,
    stop: &AtomicBool,
    progress: impl FnMut(&TrainingRecord),
) -> Result<Ending<Detector>, TrainingError> {
    let wrong = |field, expected, found: String| Err(TrainingError::Option { field, expected, found });
    if options.steps == 0 || options.batch == 0 {
        return wrong("steps and batch", "at least 1", format!("{} and {}", options.steps, options.batch));
    }
    if !(0.0..=1.0).contains(&options.encoder_share) {
        return wrong("encoder_share", "0 to 1", options.encoder_share.to_string());
    }
    let (side, alignment) = (source.options().size, config.alignment());
    if !side.is_multiple_of(alignment) {
        return wrong(
            "size",
            "a multiple of the coarsest level's stride",
            format!("{side} pixels with a stride of {alignment}"),
        );
    }
    let clip = burn::grad_clipping::GradientClippingConfig::Norm(options.longest_gradient);
    let optimiser = || {
        AdamWConfig::new()
            .with_weight_decay(options.weight_decay)
            .with_grad_clipping(Some(clip.clone()))
            .init()
    };
    let state = State {
        network: network.freeze(options.frozen_stages),
        config,
        encoder: optimiser(),
        heads: optimiser(),
        options,
        side,
        device,
    };
    let course = Course {
        steps: options.steps,
        schedule: LearningRate::Cosine {
            rate: options.learning_rate,
            last: 0.0,
            warm_up: options.warm_up.min(options.steps.saturating_sub(1)),
            steps: options.steps,
        },
        samples_per_step: options.batch,
        log_every: pace.log_every,
        checkpoint_every: pace.checkpoint_every,
        sample_threads: pace.sample_threads,
    };
    let recorded = Recorded {
        training: options,
        network: config,
        samples: source.options(),
        photographs: source.photographs(),
    };
    let batches = |step| make_batch(source, config, options, step);
    Ok(match run(state, batches, &course, &recorded, folder, stop, progress)? {
        Ending::Finished(state) => Ending::Finished(state.network.valid()),
        Ending::Interrupted { step } => Ending::Interrupted { step },
    })
}

/// The network of the last checkpoint in `folder`, filled into `network`, and the steps it has done; `None` if there is
/// no checkpoint.
///
/// # Errors
/// [`TrainingError::Checkpoint`].
pub fn last_checkpoint(folder: &Path, network: Detector) -> Result<Option<(Detector, u64)>, TrainingError> {
    let Some(checkpoint) = Checkpoint::latest(folder)? else { return Ok(None) };
    Ok(Some((checkpoint.module("network", network)?.valid(), checkpoint.step())))
}

/// Milliseconds that one training image takes to be made, over so many, on all threads (for benchmarks).
pub fn sample_time(source: &SceneSource, count: u64) -> f64 {
    let start = std::time::Instant::now();
    (0..count).into_par_iter().for_each(|n| drop(source.sample(0, n)));
    1000.0 * start.elapsed().as_secs_f64() / count as f64
}
