//! The training loop whatever is trained: batches made by threads of their own, the learning rate, the log with its
//! curves, checkpoints, and resuming after an interruption with the same bits as without one.

use crate::checkpoint::{Checkpoint, CheckpointError, CheckpointWriter};
use crate::learner::Checkpointed;
use crate::options::Pace;
use crate::schedule::LearningRate;
use crate::train_error::TrainError;
use crate::training_log::{TrainingLog, TrainingRecord, draw_curves, read_training_log};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Instant;

/// Losses and scores of a step by name.
pub type Losses = BTreeMap<String, f64>;

/// Gives the batch of a step, the same for the same step on any thread.
pub type Batches<'a, B> = Box<dyn Fn(u64) -> B + Sync + 'a>;

/// What a method brings to the loop: networks with their optimisers, batches, and what a step does with one.
pub trait Training {
    /// What batches are made from.
    type Samples;
    /// What a step learns from.
    type Batch: Send;

    /// How to train on `samples`.
    ///
    /// # Errors
    /// [`TrainError::Option`] for options out of their range, and samples that do not fit the network.
    fn plan(&self, samples: &Self::Samples) -> Result<Plan, TrainError>;

    /// The batches of all steps.
    fn batches<'a>(&self, samples: &'a Self::Samples) -> Batches<'a, Self::Batch>;

    /// One step at a learning rate.
    fn step(&mut self, batch: Self::Batch, rate: f64) -> Losses;

    /// What checkpoints hold.
    fn learners(&mut self) -> Vec<&mut dyn Checkpointed>;

    /// Called after `learners` were taken from a checkpoint, for what a checkpoint does not keep.
    fn restored(&mut self) {}

    /// Called before a checkpoint is written to `folder`.
    fn before_checkpoint(&mut self, _folder: &Path) {}
}

/// How long and at what pace. The result depends on `steps`, `schedule` and `settings` alone.
#[derive(Debug, Clone)]
pub struct Plan {
    /// Steps in all.
    pub steps: u64,
    /// Learning rate of every step.
    pub schedule: LearningRate,
    /// Samples in a batch, for the speed in the log.
    pub samples_per_step: usize,
    /// How often is logged and saved.
    pub pace: Pace,
    /// All that the result depends on, an object: a training with other settings is not resumed.
    pub settings: serde_json::Value,
}

/// How a training ended.
#[derive(Debug)]
pub enum Outcome<T> {
    /// All steps are done.
    Finished(T),
    /// It was asked to stop; a checkpoint of this step was written.
    Interrupted {
        /// Steps done.
        step: u64,
    },
}

/// Takes the learners of a training from a checkpoint.
///
/// # Errors
/// [`CheckpointError`] for a checkpoint of another network.
pub fn restore<T: Training>(training: &mut T, checkpoint: &Checkpoint) -> Result<(), CheckpointError> {
    for learner in training.learners() {
        learner.restore(checkpoint)?;
    }
    training.restored();
    Ok(())
}

/// Trains on `samples` in `folder`, which gets checkpoints, `log.jsonl` and `curves.png`; resumes where a training with the
/// same settings left off there, and ends with the same bits as one that was not interrupted. `stop` ends it after the
/// current step.
///
/// # Errors
/// [`TrainError`]; the last checkpoints stay.
pub fn fit<T: Training>(
    training: &mut T,
    samples: &T::Samples,
    folder: &Path,
    stop: &AtomicBool,
    mut progress: impl FnMut(&TrainingRecord),
) -> Result<Outcome<()>, TrainError> {
    let plan = training.plan(samples)?;
    let Plan { steps, ref schedule, samples_per_step, pace, ref settings } = plan;
    pace.check()?;
    schedule.check()?;
    let make_batch = training.batches(samples);
    let save = |training: &mut T, step: u64, seconds: f64| -> Result<(), TrainError> {
        training.before_checkpoint(folder);
        let checkpoint = CheckpointWriter::new(step).state("options", settings)?.state("seconds", &seconds)?;
        let saved = training.learners().iter().try_fold(checkpoint, |written, l| l.save(written))?;
        saved.write(folder)?;
        Ok(())
    };
    let (mut step, mut before) = (0, 0.0);
    if let Some(checkpoint) = Checkpoint::latest(folder)? {
        let found: serde_json::Value = checkpoint.state("options")?;
        if let Some(difference) = difference(&found, settings) {
            return Err(TrainError::OtherTraining { folder: folder.to_owned(), difference });
        }
        restore(training, &checkpoint)?;
        before = checkpoint.state("seconds")?;
        step = checkpoint.step();
    } else {
        save(training, 0, 0.0)?;
    }
    let log_path = folder.join("log.jsonl");
    let mut log = TrainingLog::open(&log_path, step)?;
    let started = Instant::now();
    let producers = pace.sample_threads.max(1);
    let quit = AtomicBool::new(false);
    std::thread::scope(|scope| {
        // Thread i makes the batches i, i + n, i + 2n, ...: which thread makes a batch does not change it.
        let batches: Vec<Receiver<T::Batch>> = (0..producers)
            .map(|producer| {
                let (send, receive) = sync_channel(2);
                let (first, quit, make_batch) = (step + producer as u64, &quit, &make_batch);
                scope.spawn(move || {
                    for number in (first..steps).step_by(producers) {
                        if quit.load(Ordering::Relaxed) || send.send(make_batch(number)).is_err() {
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
            while step < steps {
                let Ok(batch) = batches[((step - first) % producers as u64) as usize].recv() else {
                    // A thread of samples ended early: it panicked, and the scope will say so.
                    return Ok(Outcome::Interrupted { step });
                };
                let rate = schedule.at(step);
                let losses = training.step(batch, rate);
                if losses.values().any(|v| !v.is_finite()) {
                    return Err(TrainError::NotFinite { step, rate });
                }
                step += 1;
                counted += 1;
                for (name, value) in losses {
                    *sums.entry(name).or_default() += value;
                }
                let last = step == steps;
                if step % pace.log_every == 0 || last {
                    let record = TrainingRecord {
                        step,
                        seconds: before + started.elapsed().as_secs_f64(),
                        learning_rate: rate,
                        samples_per_second: (counted as usize * samples_per_step) as f64
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
                if step % pace.checkpoint_every == 0 || last || stopped {
                    save(training, step, before + started.elapsed().as_secs_f64())?;
                    let records = read_training_log(&log_path)?;
                    if !records.is_empty() {
                        draw_curves(&records, &folder.join("curves.png"))?;
                    }
                }
                if stopped && !last {
                    return Ok(Outcome::Interrupted { step });
                }
            }
            Ok(Outcome::Finished(()))
        })();
        quit.store(true, Ordering::Relaxed);
        drop(batches);
        outcome
    })
}

/// The first field that differs, in words.
fn difference(found: &serde_json::Value, asked: &serde_json::Value) -> Option<String> {
    let empty = serde_json::Map::new();
    let (found, asked) = (found.as_object().unwrap_or(&empty), asked.as_object().unwrap_or(&empty));
    found
        .iter()
        .chain(asked)
        .map(|(name, _)| (name, found.get(name), asked.get(name)))
        .find(|(_, was, is)| was != is)
        .map(|(name, was, is)| {
            let show =
                |value: Option<&serde_json::Value>| value.map_or("not there".into(), ToString::to_string);
            format!("{name} was {}, is {}", show(was), show(is))
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    /// A number that remembers its batches.
    struct Sum {
        value: f64,
        sample_threads: usize,
        log_every: u64,
        settings: Value,
    }

    impl Checkpointed for Sum {
        fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError> {
            checkpoint.state("sum", &self.value)
        }

        fn restore(&mut self, checkpoint: &Checkpoint) -> Result<(), CheckpointError> {
            self.value = checkpoint.state("sum")?;
            Ok(())
        }
    }

    impl Training for Sum {
        type Samples = fn(u64) -> u64;
        type Batch = u64;

        fn plan(&self, _: &Self::Samples) -> Result<Plan, TrainError> {
            Ok(Plan {
                steps: 20,
                schedule: LearningRate::Constant { rate: 0.5 },
                samples_per_step: 1,
                pace: Pace {
                    log_every: self.log_every,
                    checkpoint_every: 4,
                    sample_threads: self.sample_threads,
                },
                settings: self.settings.clone(),
            })
        }

        fn batches<'a>(&self, samples: &'a Self::Samples) -> Batches<'a, u64> {
            Box::new(samples)
        }

        fn step(&mut self, batch: u64, rate: f64) -> Losses {
            self.value = 0.9 * self.value + rate * batch as f64;
            BTreeMap::from([("sum".to_string(), self.value)])
        }

        fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
            vec![self]
        }
    }

    fn sum(value: f64, sample_threads: usize) -> Sum {
        Sum { value, sample_threads, log_every: 3, settings: json!({"seed": 1, "name": "a"}) }
    }

    #[test]
    fn stopped_and_taken_up_again_it_ends_the_same() {
        let go = |folder: &Path, threads: usize, stop_at: Option<u64>| {
            let stop = AtomicBool::new(false);
            let mut sum = sum(0.0, threads);
            let outcome = fit(&mut sum, &((|n| n * n % 7) as fn(u64) -> u64), folder, &stop, |r| {
                stop.store(stop_at.is_some_and(|s| r.step >= s), Ordering::Relaxed);
            });
            (outcome.unwrap(), sum.value)
        };
        let folder = tempfile::tempdir().unwrap();
        let (Outcome::Finished(()), straight) = go(&folder.path().join("a"), 1, None) else { panic!() };
        let b = folder.path().join("b");
        assert!(matches!(go(&b, 2, Some(6)).0, Outcome::Interrupted { step: 6 }));
        let (Outcome::Finished(()), resumed) = go(&b, 3, None) else { panic!() };
        assert_eq!(straight.to_bits(), resumed.to_bits());
        let steps: Vec<u64> =
            read_training_log(&b.join("log.jsonl")).unwrap().iter().map(|r| r.step).collect();
        assert_eq!(steps, [3, 6, 9, 12, 15, 18, 20]);
        let mut other = Sum { settings: json!({"seed": 2, "name": "a"}), ..sum(0.0, 1) };
        let stop = AtomicBool::new(false);
        let message =
            fit(&mut other, &((|n| n) as fn(u64) -> u64), &b, &stop, |_| ()).unwrap_err().to_string();
        assert!(message.contains("seed was 1, is 2"), "{message}");
    }

    #[test]
    fn numbers_that_are_none_end_it() {
        let folder = tempfile::tempdir().unwrap();
        let stop = AtomicBool::new(false);
        let numbers: fn(u64) -> u64 = |n| n;
        let out = fit(&mut sum(f64::NAN, 1), &numbers, folder.path(), &stop, |_| ());
        assert!(out.unwrap_err().to_string().contains("step 0: the loss is not a number"));
        let mut endless = Sum { log_every: 0, ..sum(0.0, 1) };
        let out = fit(&mut endless, &numbers, folder.path(), &stop, |_| ());
        assert!(out.unwrap_err().to_string().contains("log_every"));
    }
}
