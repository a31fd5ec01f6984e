//! The training loop of the compact network: samples made on the fly, checkpoints, interruption and resume.

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
use sixfold_nn::schedule::{LearningRate, LearningRateError};
use sixfold_nn::training_log::{
    TrainingLog, TrainingLogError, TrainingRecord, draw_curves, read_training_log,
};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Instant;

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
    /// Seed of weights and samples.
    pub seed: u64,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Steps between records of the log.
    pub log_every: u64,
    /// Threads that make samples beside the training itself.
    pub sample_threads: usize,
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
            seed: 0,
            checkpoint_every: 250,
            log_every: 25,
            sample_threads: 2,
        }
    }
}

/// Why a training could not go on. What was trained until the last checkpoint is kept.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// An option is out of range.
    #[error("training option {field}: expected {expected}, found {found}")]
    Option {
        /// Its name.
        field: &'static str,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// The learning rate.
    #[error(transparent)]
    LearningRate(#[from] LearningRateError),
    /// Reading or writing a checkpoint.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// Reading or writing the log.
    #[error(transparent)]
    Log(#[from] TrainingLogError),
    /// The folder holds a training with other options.
    #[error(
        "{folder}: holds a training with other options ({difference}); go on with the same ones, or start anew in another folder"
    )]
    OtherTraining {
        /// The folder.
        folder: String,
        /// Which option differs, and how.
        difference: String,
    },
    /// The loss is no number any more.
    #[error(
        "step {step}: the loss is not a number; start again from the last checkpoint with a lower learning rate (now {rate})"
    )]
    NotFinite {
        /// The step.
        step: u64,
        /// The learning rate.
        rate: f64,
    },
}

/// How a training ended.
#[derive(Debug)]
pub enum TrainingOutcome<N = Network> {
    /// All steps are done.
    Finished(N),
    /// It was asked to stop; a checkpoint of this step was written.
    Interrupted {
        /// Steps done.
        step: u64,
    },
}

impl<N> TrainingOutcome<N> {
    /// The same with another form of the network.
    pub fn map<M>(self, change: impl FnOnce(N) -> M) -> TrainingOutcome<M> {
        match self {
            TrainingOutcome::Finished(network) => TrainingOutcome::Finished(change(network)),
            TrainingOutcome::Interrupted { step } => TrainingOutcome::Interrupted { step },
        }
    }
}

/// A batch: images of all objects, one object after another.
struct Batch {
    rgb: Vec<f32>,
    coordinates: Vec<f32>,
    object: Vec<f32>,
    visible: Vec<f32>,
}

fn make_batch(source: &SampleSource, options: &TrainingOptions, step: u64) -> Batch {
    let mut batch = Batch { rgb: vec![], coordinates: vec![], object: vec![], visible: vec![] };
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

struct State {
    network: Compact,
    encoder: ModuleOptimizer,
    decoders: ModuleOptimizer,
}

impl State {
    fn write(
        &self,
        step: u64,
        seconds: f64,
        options: &TrainingOptions,
        folder: &Path,
    ) -> Result<(), TrainingError> {
        CheckpointWriter::new(step)
            .module("network", &self.network)?
            .optimiser("encoder", &self.encoder)?
            .optimiser("decoders", &self.decoders)?
            .state("options", options)?
            .state("seconds", &seconds)?
            .write(folder)?;
        Ok(())
    }

    /// One step: losses by name.
    fn step(
        &mut self,
        batch: Batch,
        pools: &[Vec<SymmetryMap>],
        side: usize,
        options: &TrainingOptions,
        rate: f64,
        device: &Device,
    ) -> BTreeMap<String, f64> {
        let count = options.per_object;
        let images = pools.len() * count;
        let kind = OutputKind::Compact;
        let loss_options = LossOptions::of(kind);
        let mut sums = [0.0; 3];
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
            let mut gradients = (output * gradient).sum().backward();
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
        [("coordinates", sums[0]), ("error", sums[1]), ("visibility", sums[2])]
            .map(|(name, value)| (name.to_string(), value))
            .into()
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
    mut progress: impl FnMut(&TrainingRecord),
) -> Result<TrainingOutcome, TrainingError> {
    let schedule = check(source, pools, options)?;
    let optimiser = || AdamWConfig::new().with_weight_decay(options.weight_decay).init();
    let mut state = State { network, encoder: optimiser(), decoders: optimiser() };
    if state.network.decoders.len() != pools.len() {
        let found = format!("{} decoders for {} objects", state.network.decoders.len(), pools.len());
        return Err(TrainingError::Option { field: "network", expected: "one decoder an object", found });
    }
    let (mut step, mut before) = (0, 0.0);
    if let Some(checkpoint) = Checkpoint::latest(folder)? {
        let found: TrainingOptions = checkpoint.state("options")?;
        if let Some(difference) = difference(&found, options) {
            return Err(TrainingError::OtherTraining { folder: folder.display().to_string(), difference });
        }
        state.network = checkpoint.module("network", state.network)?;
        state.encoder = checkpoint.optimiser("encoder", state.encoder)?;
        state.decoders = checkpoint.optimiser("decoders", state.decoders)?;
        before = checkpoint.state("seconds")?;
        step = checkpoint.step();
    } else {
        state.write(0, 0.0, options, folder)?;
    }
    state.network = state.network.freeze(options.frozen_stages);
    let log_path = folder.join("log.jsonl");
    let mut log = TrainingLog::open(&log_path, step)?;
    let began = Instant::now();
    let producers = options.sample_threads.max(1);
    let quit = AtomicBool::new(false);
    std::thread::scope(|scope| {
        // Thread i makes the batches i, i + n, i + 2n, ...: which thread makes a batch does not change it.
        let batches: Vec<Receiver<Batch>> = (0..producers)
            .map(|producer| {
                let (send, receive) = sync_channel(2);
                let (first, quit) = (step + producer as u64, &quit);
                scope.spawn(move || {
                    for number in (first..options.steps).step_by(producers) {
                        if quit.load(Ordering::Relaxed)
                            || send.send(make_batch(source, options, number)).is_err()
                        {
                            return;
                        }
                    }
                });
                receive
            })
            .collect();
        let outcome = (|| {
            let first = step;
            let mut sums: BTreeMap<String, f64> = BTreeMap::new();
            let (mut since, mut counted) = (Instant::now(), 0);
            while step < options.steps {
                let Ok(batch) = batches[((step - first) % producers as u64) as usize].recv() else {
                    // A thread of samples ended early: it panicked, and the scope will say so.
                    return Ok(TrainingOutcome::Interrupted { step });
                };
                let rate = schedule.at(step);
                let side = source.options().size;
                let losses = state.step(batch, pools, side, options, rate, device);
                if losses.values().any(|v| !v.is_finite()) {
                    return Err(TrainingError::NotFinite { step, rate });
                }
                step += 1;
                counted += 1;
                for (name, value) in losses {
                    *sums.entry(name).or_default() += value;
                }
                let last = step == options.steps;
                if step % options.log_every == 0 || last {
                    let record = TrainingRecord {
                        step,
                        seconds: before + began.elapsed().as_secs_f64(),
                        learning_rate: rate,
                        samples_per_second: (counted as usize * options.per_object * pools.len()) as f64
                            / since.elapsed().as_secs_f64(),
                        losses: std::mem::take(&mut sums)
                            .into_iter()
                            .map(|(name, sum)| (name, sum / f64::from(counted)))
                            .collect(),
                    };
                    (since, counted) = (Instant::now(), 0);
                    log.append(&record)?;
                    progress(&record);
                }
                let stopped = stop.load(Ordering::Relaxed);
                if step % options.checkpoint_every == 0 || last || stopped {
                    state.write(step, before + began.elapsed().as_secs_f64(), options, folder)?;
                    let records = read_training_log(&log_path)?;
                    if !records.is_empty() {
                        draw_curves(&records, &folder.join("curves.png"))?;
                    }
                }
                if stopped && !last {
                    return Ok(TrainingOutcome::Interrupted { step });
                }
            }
            Ok(TrainingOutcome::Finished(Network::Compact(Box::new(state.network.valid()))))
        })();
        quit.store(true, Ordering::Relaxed);
        drop(batches);
        outcome
    })
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
    for (field, value) in [
        ("per_object", options.per_object as u64),
        ("log_every", options.log_every),
        ("checkpoint_every", options.checkpoint_every),
    ] {
        if value == 0 {
            return wrong(field, "at least 1", "0".to_string());
        }
    }
    if !(0.0..=1.0).contains(&options.encoder_share) {
        return wrong("encoder_share", "0 to 1", options.encoder_share.to_string());
    }
    let schedule = LearningRate::Cosine {
        rate: options.learning_rate,
        last: 0.0,
        warm_up: options.warm_up.min(options.steps.saturating_sub(1)),
        steps: options.steps,
    };
    schedule.check()?;
    Ok(schedule)
}

/// The first option that changes the result and differs; how often to log or save does not.
fn difference(found: &TrainingOptions, asked: &TrainingOptions) -> Option<String> {
    let neutral = |options: &TrainingOptions| TrainingOptions {
        checkpoint_every: 0,
        log_every: 0,
        sample_threads: 0,
        ..options.clone()
    };
    let (found, asked) =
        (serde_json::to_value(neutral(found)).ok()?, serde_json::to_value(neutral(asked)).ok()?);
    let (found, asked) = (found.as_object()?, asked.as_object()?);
    found.iter().find(|(name, value)| asked.get(*name) != Some(*value)).map(|(name, value)| {
        format!("{name} was {value}, is {}", asked.get(name).cloned().unwrap_or_default())
    })
}
