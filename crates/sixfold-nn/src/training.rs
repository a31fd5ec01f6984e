//! The training loop whatever is trained: batches made by threads of their own, the learning rate, the log with its
//! curves, checkpoints, and going on after an interruption with the same bits as without one.

use crate::checkpoint::{Checkpoint, CheckpointError, CheckpointWriter};
use crate::schedule::{LearningRate, LearningRateError};
use crate::training_log::{TrainingLog, TrainingLogError, TrainingRecord, draw_curves, read_training_log};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Instant;

/// Networks and optimisers in training.
pub trait Trainee: Sized {
    /// What a step learns from.
    type Batch: Send;

    /// One step at a learning rate: losses by name.
    fn step(&mut self, batch: Self::Batch, rate: f64) -> BTreeMap<String, f64>;

    /// Adds networks and optimisers to a checkpoint.
    ///
    /// # Errors
    /// [`CheckpointError`].
    fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError>;

    /// Takes networks and optimisers from a checkpoint.
    ///
    /// # Errors
    /// [`CheckpointError`].
    fn restore(self, checkpoint: &Checkpoint) -> Result<Self, CheckpointError>;
}

/// How long and at what pace. Nothing here but `steps` and `schedule` changes the result.
#[derive(Debug, Clone)]
pub struct Course {
    /// Steps in all.
    pub steps: u64,
    /// Learning rate of every step.
    pub schedule: LearningRate,
    /// Samples in a batch, for the speed in the log.
    pub samples_per_step: usize,
    /// Steps between records of the log.
    pub log_every: u64,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Threads that make batches beside the training itself.
    pub sample_threads: usize,
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

/// How a call of [`run`] ended.
#[derive(Debug)]
pub enum Ending<T> {
    /// All steps are done.
    Finished(T),
    /// It was asked to stop; a checkpoint of this step was written.
    Interrupted {
        /// Steps done.
        step: u64,
    },
}

impl<T> Ending<T> {
    /// The same with another form of what was trained.
    pub fn map<U>(self, change: impl FnOnce(T) -> U) -> Ending<U> {
        match self {
            Ending::Finished(trained) => Ending::Finished(change(trained)),
            Ending::Interrupted { step } => Ending::Interrupted { step },
        }
    }
}

/// Trains in `folder`, which gets checkpoints, `log.jsonl` and `curves.png`; goes on where a training with the same
/// `options` left off there. `make_batch` gives the batch of a step, the same for the same step on any thread. `options`
/// (a structure of named fields) is what the result depends on. `stop` ends the training after the current step.
///
/// # Errors
/// [`TrainingError`]; the last checkpoints stay.
pub fn run<T: Trainee>(
    mut trainee: T,
    make_batch: impl Fn(u64) -> T::Batch + Sync,
    course: &Course,
    options: &impl Serialize,
    folder: &Path,
    stop: &AtomicBool,
    mut progress: impl FnMut(&TrainingRecord),
) -> Result<Ending<T>, TrainingError> {
    for (field, value) in [("log_every", course.log_every), ("checkpoint_every", course.checkpoint_every)] {
        if value == 0 {
            return Err(TrainingError::Option { field, expected: "at least 1", found: "0".to_string() });
        }
    }
    course.schedule.check()?;
    let asked = serde_json::to_value(options).unwrap_or_default();
    let save = |trainee: &T, step: u64, seconds: f64| -> Result<(), TrainingError> {
        let checkpoint = trainee.save(CheckpointWriter::new(step))?;
        checkpoint.state("options", &asked)?.state("seconds", &seconds)?.write(folder)?;
        Ok(())
    };
    let (mut step, mut before) = (0, 0.0);
    if let Some(checkpoint) = Checkpoint::latest(folder)? {
        let found: serde_json::Value = checkpoint.state("options")?;
        if let Some(difference) = difference(&found, &asked) {
            return Err(TrainingError::OtherTraining { folder: folder.display().to_string(), difference });
        }
        trainee = trainee.restore(&checkpoint)?;
        before = checkpoint.state("seconds")?;
        step = checkpoint.step();
    } else {
        save(&trainee, 0, 0.0)?;
    }
    let log_path = folder.join("log.jsonl");
    let mut log = TrainingLog::open(&log_path, step)?;
    let began = Instant::now();
    let producers = course.sample_threads.max(1);
    let quit = AtomicBool::new(false);
    std::thread::scope(|scope| {
        // Thread i makes the batches i, i + n, i + 2n, ...: which thread makes a batch does not change it.
        let batches: Vec<Receiver<T::Batch>> = (0..producers)
            .map(|producer| {
                let (send, receive) = sync_channel(2);
                let (first, quit, make_batch) = (step + producer as u64, &quit, &make_batch);
                scope.spawn(move || {
                    for number in (first..course.steps).step_by(producers) {
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
            while step < course.steps {
                let Ok(batch) = batches[((step - first) % producers as u64) as usize].recv() else {
                    // A thread of samples ended early: it panicked, and the scope will say so.
                    return Ok(Ending::Interrupted { step });
                };
                let rate = course.schedule.at(step);
                let losses = trainee.step(batch, rate);
                if losses.values().any(|v| !v.is_finite()) {
                    return Err(TrainingError::NotFinite { step, rate });
                }
                step += 1;
                counted += 1;
                for (name, value) in losses {
                    *sums.entry(name).or_default() += value;
                }
                let last = step == course.steps;
                if step % course.log_every == 0 || last {
                    let record = TrainingRecord {
                        step,
                        seconds: before + began.elapsed().as_secs_f64(),
                        learning_rate: rate,
                        samples_per_second: (counted as usize * course.samples_per_step) as f64
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
                if step % course.checkpoint_every == 0 || last || stopped {
                    save(&trainee, step, before + began.elapsed().as_secs_f64())?;
                    let records = read_training_log(&log_path)?;
                    if !records.is_empty() {
                        draw_curves(&records, &folder.join("curves.png"))?;
                    }
                }
                if stopped && !last {
                    return Ok(Ending::Interrupted { step });
                }
            }
            Ok(Ending::Finished(trainee))
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

    /// A number that remembers its batches.
    struct Sum(f64);

    impl Trainee for Sum {
        type Batch = u64;

        fn step(&mut self, batch: u64, rate: f64) -> BTreeMap<String, f64> {
            self.0 = 0.9 * self.0 + rate * batch as f64;
            BTreeMap::from([("sum".to_string(), self.0)])
        }

        fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError> {
            checkpoint.state("sum", &self.0)
        }

        fn restore(self, checkpoint: &Checkpoint) -> Result<Self, CheckpointError> {
            Ok(Sum(checkpoint.state("sum")?))
        }
    }

    fn course(sample_threads: usize) -> Course {
        Course {
            steps: 20,
            schedule: LearningRate::Constant { rate: 0.5 },
            samples_per_step: 1,
            log_every: 3,
            checkpoint_every: 4,
            sample_threads,
        }
    }

    #[test]
    fn stopped_and_taken_up_again_it_ends_the_same() {
        let options = serde_json::json!({"seed": 1, "name": "a"});
        let go = |folder: &Path, threads: usize, stop_at: Option<u64>| {
            let stop = AtomicBool::new(false);
            run(
                Sum(0.0),
                |n| n * n % 7,
                &course(threads),
                &options,
                folder,
                &stop,
                |r| {
                    stop.store(stop_at.is_some_and(|s| r.step >= s), Ordering::Relaxed);
                },
            )
        };
        let folder = tempfile::tempdir().unwrap();
        let Ending::Finished(straight) = go(&folder.path().join("a"), 1, None).unwrap() else { panic!() };
        let b = folder.path().join("b");
        assert!(matches!(go(&b, 2, Some(6)).unwrap(), Ending::Interrupted { step: 6 }));
        let Ending::Finished(resumed) = go(&b, 3, None).unwrap() else { panic!() };
        assert_eq!(straight.0.to_bits(), resumed.0.to_bits());
        let steps: Vec<u64> =
            read_training_log(&b.join("log.jsonl")).unwrap().iter().map(|r| r.step).collect();
        assert_eq!(steps, [3, 6, 9, 12, 15, 18, 20]);
        let other = serde_json::json!({"seed": 2, "name": "a"});
        let stop = AtomicBool::new(false);
        let message = run(Sum(0.0), |n| n, &course(1), &other, &b, &stop, |_| ()).err().unwrap().to_string();
        assert!(message.contains("seed was 1, is 2"), "{message}");
    }

    #[test]
    fn numbers_that_are_none_end_it() {
        let folder = tempfile::tempdir().unwrap();
        let stop = AtomicBool::new(false);
        let out = run(Sum(f64::NAN), |n| n, &course(1), &serde_json::json!({}), folder.path(), &stop, |_| ());
        assert!(out.err().unwrap().to_string().contains("step 0: the loss is not a number"));
        let endless = Course { log_every: 0, ..course(1) };
        let out = run(Sum(0.0), |n| n, &endless, &serde_json::json!({}), folder.path(), &stop, |_| ());
        assert!(out.err().unwrap().to_string().contains("log_every"));
    }
}
