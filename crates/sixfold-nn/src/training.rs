//! The training loop whatever is trained: batches made by threads of their own, the learning rate, the log with its
//! curves, checkpoints, and resuming after an interruption with the same bits as without one.

use crate::checkpoint::{Checkpoint, CheckpointError, CheckpointWriter};
use crate::fingerprint::Fingerprint;
use crate::learner::Checkpointed;
use crate::options::{Pace, TrainingOptions};
use crate::schedule::LearningRate;
use crate::train_error::TrainError;
use crate::training_log::{TrainingLog, TrainingRecord, draw_curves, read_training_log};
use serde::Serialize;
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
    /// All that the result depends on beside the inputs: a training with other settings is not resumed.
    pub settings: Fingerprint,
}

impl Plan {
    /// With the steps and the schedule of `options`.
    ///
    /// # Errors
    /// [`TrainError::Method`] for settings that are no JSON.
    pub fn new(
        options: &TrainingOptions,
        samples_per_step: usize,
        pace: Pace,
        settings: &impl Serialize,
    ) -> Result<Plan, TrainError> {
        let settings = Fingerprint::of(settings)?;
        Ok(Plan { steps: options.steps, schedule: options.schedule(), samples_per_step, pace, settings })
    }
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

/// `fit_on` samples that the caller made of nothing but the training's settings.
///
/// # Errors
/// As `fit_on`.
pub fn fit<T: Training>(
    training: &mut T,
    samples: &T::Samples,
    folder: &Path,
    stop: &AtomicBool,
    progress: impl FnMut(&TrainingRecord),
) -> Result<Outcome<()>, TrainError> {
    fit_on(&Fingerprint::default(), training, samples, folder, stop, progress)
}

/// Trains on `samples`, made of these `inputs`, in `folder`, which gets checkpoints, `log.jsonl` and `curves.png`; resumes where a
/// training with the same settings and inputs left off there, and ends with the same bits as one that was not interrupted. `stop`
/// ends it after the current step.
///
/// # Errors
/// [`TrainError`]; the last checkpoints stay.
pub(crate) fn fit_on<T: Training>(
    inputs: &Fingerprint,
    training: &mut T,
    samples: &T::Samples,
    folder: &Path,
    stop: &AtomicBool,
    mut progress: impl FnMut(&TrainingRecord),
) -> Result<Outcome<()>, TrainError> {
    let mut plan = training.plan(samples)?;
    plan.settings = plan.settings.merged(inputs);
    plan.pace.check()?;
    plan.schedule.check()?;
    let make_batch = training.batches(samples);
    let mut run = Run::start(training, plan, folder)?;
    let (first, steps) = (run.step, run.plan.steps);
    let producers = run.plan.pace.sample_threads.max(1);
    let quit = AtomicBool::new(false);
    std::thread::scope(|scope| {
        // Thread i makes the batches i, i + n, i + 2n, ...: which thread makes a batch does not change it.
        let batches: Vec<Receiver<T::Batch>> = (0..producers)
            .map(|producer| {
                let (send, receive) = sync_channel(2);
                let (first, quit, make_batch) = (first + producer as u64, &quit, &make_batch);
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
        let batch = |step: u64| batches[((step - first) % producers as u64) as usize].recv().ok();
        let outcome = run.steps(training, batch, stop, &mut progress);
        quit.store(true, Ordering::Relaxed);
        drop(batches);
        outcome
    })
}

/// A training under way.
struct Run<'a> {
    plan: Plan,
    folder: &'a Path,
    log: TrainingLog,
    /// Steps done.
    step: u64,
    /// Seconds until the last interruption.
    before: f64,
    started: Instant,
}

impl<'a> Run<'a> {
    /// Restores the training from the last checkpoint in `folder`, or writes the first one.
    fn start(training: &mut impl Training, plan: Plan, folder: &'a Path) -> Result<Self, TrainError> {
        let (mut step, mut before) = (0, 0.0);
        if let Some(checkpoint) = Checkpoint::latest(folder)? {
            if let Some(difference) = checkpoint.fingerprint()?.difference(&plan.settings) {
                return Err(TrainError::OtherTraining { folder: folder.to_owned(), difference });
            }
            restore(training, &checkpoint)?;
            before = checkpoint.state("seconds")?;
            step = checkpoint.step();
        } else {
            save(training, &plan.settings, folder, (0, 0.0))?;
        }
        let log = TrainingLog::open(&folder.join("log.jsonl"), step)?;
        Ok(Run { plan, folder, log, step, before, started: Instant::now() })
    }

    fn seconds(&self) -> f64 {
        self.before + self.started.elapsed().as_secs_f64()
    }

    /// Draws the curves of what the log holds.
    fn draw(&self) -> Result<(), TrainError> {
        let records = read_training_log(&self.folder.join("log.jsonl"))?;
        if !records.is_empty() {
            draw_curves(&records, &self.folder.join("curves.png"))?;
        }
        Ok(())
    }

    /// The steps that are left.
    fn steps<T: Training>(
        &mut self,
        training: &mut T,
        batch: impl Fn(u64) -> Option<T::Batch>,
        stop: &AtomicBool,
        progress: &mut impl FnMut(&TrainingRecord),
    ) -> Result<Outcome<()>, TrainError> {
        let pace = self.plan.pace;
        if self.step == self.plan.steps {
            // The run before may have been killed between its last checkpoint and the figure.
            self.draw()?;
        }
        let mut sums = Sums::new();
        while self.step < self.plan.steps {
            let Some(batch) = batch(self.step) else {
                // A thread of samples ended early: it panicked, and the scope will say so.
                return Ok(Outcome::Interrupted { step: self.step });
            };
            let rate = self.plan.schedule.at(self.step);
            let losses = training.step(batch, rate);
            if losses.values().any(|v| !v.is_finite()) {
                return Err(TrainError::NotFinite { step: self.step, rate });
            }
            self.step += 1;
            sums.add(losses);
            let last = self.step == self.plan.steps;
            if self.step.is_multiple_of(pace.log_every) || last {
                let samples = std::mem::replace(&mut sums, Sums::new());
                let record = samples.record(self.step, self.seconds(), rate, self.plan.samples_per_step);
                self.log.append(&record)?;
                progress(&record);
            }
            let stopped = stop.load(Ordering::Relaxed);
            if self.step.is_multiple_of(pace.checkpoint_every) || last || stopped {
                save(training, &self.plan.settings, self.folder, (self.step, self.seconds()))?;
                self.draw()?;
            }
            if stopped && !last {
                return Ok(Outcome::Interrupted { step: self.step });
            }
        }
        Ok(Outcome::Finished(()))
    }
}

/// Writes the checkpoint of a step, with the seconds until then.
fn save(
    training: &mut impl Training,
    settings: &Fingerprint,
    folder: &Path,
    (step, seconds): (u64, f64),
) -> Result<(), TrainError> {
    training.before_checkpoint(folder);
    let checkpoint = CheckpointWriter::new(step).fingerprint(settings)?.state("seconds", &seconds)?;
    let learners = training.learners();
    let checkpoint = learners.iter().try_fold(checkpoint, |checkpoint, learner| learner.save(checkpoint))?;
    checkpoint.write(folder)?;
    Ok(())
}

/// Losses since the last record.
struct Sums {
    losses: Losses,
    steps: u32,
    since: Instant,
}

impl Sums {
    fn new() -> Self {
        Sums { losses: Losses::new(), steps: 0, since: Instant::now() }
    }

    fn add(&mut self, losses: Losses) {
        self.steps += 1;
        for (name, value) in losses {
            *self.losses.entry(name).or_default() += value;
        }
    }

    /// Their means.
    fn record(self, step: u64, seconds: f64, learning_rate: f64, samples_per_step: usize) -> TrainingRecord {
        let samples = self.steps as usize * samples_per_step;
        TrainingRecord {
            step,
            seconds,
            learning_rate,
            samples_per_second: samples as f64 / self.since.elapsed().as_secs_f64(),
            losses: self.losses.into_iter().map(|(n, sum)| (n, sum / f64::from(self.steps))).collect(),
        }
    }
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
                settings: Fingerprint::of(&self.settings)?,
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
