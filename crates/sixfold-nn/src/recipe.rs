//! Complete trainings, from data to a model file: the common driver of all methods. It prepares samples, resumes from the last
//! checkpoint of a training on the same inputs, trains, and lets the method save its model and measure it. Only one training runs
//! in a folder at a time.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use serde::Serialize;
use sixfold_geometry::Progress;
use sixfold_io::WriteLock;

use crate::checkpoint::Checkpoint;
use crate::fingerprint::Fingerprint;
use crate::options::OptionError;
use crate::train_error::TrainError;
use crate::training::{Outcome, Training, fit_on, restore};
use crate::training_log::TrainingRecord;
use crate::weights::{ModelCard, WeightsError, read_card};

/// Default name of a model's file.
const MODEL_FILE: &str = "model.safetensors";

/// Events that a training reports while it runs.
#[derive(Debug, Clone, Copy)]
pub enum TrainingEvent<'a> {
    /// Information for the user, such as the stage that starts now.
    Note(&'a str),
    /// A probable mistake.
    Warning(&'a str),
    /// Progress of the preparation before the first step: done, and total.
    Preparing(usize, usize),
    /// Progress of the steps: the latest record, and the total number of steps.
    Steps(&'a TrainingRecord, u64),
    /// Progress of the measurement after the last step: done, and total.
    Measuring(usize, usize),
}

/// Receives the events, from any thread, one at a time.
pub type TrainingEvents<'a> = dyn FnMut(TrainingEvent<'_>) + Send + 'a;

/// The caller's side of a training: its folder, the flag to stop it, and the receiver of its events.
pub struct Session<'a> {
    /// The folder for the model; its subfolder `training` has checkpoints, log and curves.
    pub out: &'a Path,
    /// Set to end the training after the current step.
    pub stop: &'a AtomicBool,
    /// Receives the events.
    pub events: &'a mut TrainingEvents<'a>,
}

impl<'a> Session<'a> {
    /// A session of a training in `out`.
    pub fn new(out: &'a Path, stop: &'a AtomicBool, events: &'a mut TrainingEvents<'a>) -> Self {
        Session { out, stop, events }
    }

    /// The model file.
    pub fn model(&self) -> PathBuf {
        self.out.join(MODEL_FILE)
    }

    /// The folder of checkpoints, log and curves.
    pub fn folder(&self) -> PathBuf {
        self.out.join("training")
    }

    /// Whether the training is to stop.
    pub fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Receives the progress of one function as events of one kind, and stops the function with the training.
    pub fn progress<'s>(
        &'s mut self,
        kind: fn(usize, usize) -> TrainingEvent<'static>,
    ) -> impl Progress + use<'s, 'a> {
        let (events, stop) = (Mutex::new(&mut *self.events), self.stop);
        move |done, total| {
            if let Ok(mut events) = events.lock() {
                events(kind(done, total));
            }
            !stop.load(Ordering::Relaxed)
        }
    }

    /// Sends information for the user.
    pub fn note(&mut self, text: &str) {
        (self.events)(TrainingEvent::Note(text));
    }

    /// Sends a warning about a probable mistake.
    pub fn warn(&mut self, text: &str) {
        (self.events)(TrainingEvent::Warning(text));
    }
}

/// The training of one method's model: options with their defaults (`Default`), and the method's part of [`train`].
pub trait Recipe: Default {
    /// Training data in addition to the options; `()` if everything is generated.
    type Data;
    /// The samples from which batches are made.
    type Samples;
    /// Networks with their optimisers.
    type Training: Training<Samples = Self::Samples>;
    /// Further data prepared before the first step, for the samples and the model.
    type Context;
    /// Result of measuring the trained model.
    type Report;

    /// Number of steps. With 0 the initial network is saved and measured unchanged.
    fn steps(&self) -> u64;

    /// Seed of weights and samples.
    fn seed(&self) -> u64;

    /// The command, for the model's card.
    fn command(&self) -> &str;

    /// Name of the model's file in [`Session::out`].
    fn model_file(&self) -> &'static str {
        MODEL_FILE
    }

    /// Checks every option that can be checked without data.
    ///
    /// # Errors
    /// [`OptionError`] with the first one that is out of its range.
    fn check(&self) -> Result<(), OptionError>;

    /// Everything on which the result depends: every option, and the contents of `data` and of each file that is read. Values that
    /// do not affect the result, such as names and threads, are excluded.
    ///
    /// # Errors
    /// [`TrainError`] for a file that cannot be read.
    fn inputs(&self, data: &Self::Data) -> Result<Fingerprint, TrainError>;

    /// The initial network with its optimisers, and the card as far as known. Reports invalid weights and data before anything else
    /// starts.
    ///
    /// # Errors
    /// [`TrainError`].
    fn prepare(
        &self,
        data: Self::Data,
        session: &mut Session<'_>,
    ) -> Result<Prepared<Self::Training, Self::Context>, TrainError>;

    /// Generates the samples; `None` when stopped meanwhile.
    ///
    /// # Errors
    /// [`TrainError`].
    fn samples(
        &self,
        context: &mut Self::Context,
        session: &mut Session<'_>,
    ) -> Result<Option<Self::Samples>, TrainError>;

    /// Saves the model in [`Session::model`], first without measuring, so that the training is not lost. Then measures it and saves
    /// it with the result; `None` when stopped meanwhile.
    ///
    /// # Errors
    /// [`TrainError`].
    fn finish(
        &self,
        prepared: Prepared<Self::Training, Self::Context>,
        session: &mut Session<'_>,
    ) -> Result<Option<Self::Report>, TrainError>;
}

/// The state before the first step and, with trained weights, after the last.
pub struct Prepared<T, C> {
    /// Networks with their optimisers.
    pub training: T,
    /// Describes the origin of the model.
    pub card: ModelCard,
    /// Further data for the samples and the model.
    pub context: C,
}

/// The result of a training.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Trained<R = ()> {
    /// The model file.
    pub model: PathBuf,
    /// Number of steps.
    pub steps: u64,
    /// Seconds of training; `None` if a model was only exported.
    pub seconds: Option<f64>,
    /// The last record's losses by name.
    pub losses: BTreeMap<String, f64>,
    /// Result of measuring the model.
    pub report: R,
}

/// Trains, or resumes the training in the session's folder, and writes the model there.
///
/// # Errors
/// [`TrainError`]; the last checkpoints are kept. In particular [`TrainError::OtherTraining`] if the folder contains a training on
/// other inputs, and [`TrainError::Lock`] while another one runs there.
pub fn train<R: Recipe>(
    recipe: &R,
    data: R::Data,
    session: &mut Session<'_>,
) -> Result<Outcome<Trained<R::Report>>, TrainError> {
    recipe.check()?;
    let (folder, steps) = (session.folder(), recipe.steps());
    let _lock = WriteLock::take(&folder)?;
    if steps == 0 {
        let prepared = recipe.prepare(data, session)?;
        return finish(recipe, prepared, None, session);
    }
    let inputs = recipe.inputs(&data)?;
    // Checked before the preparation, which may take hours.
    if let Some(checkpoint) = Checkpoint::latest(&folder)? {
        check_inputs(&checkpoint, &inputs, &folder)?;
    }
    let mut prepared = recipe.prepare(data, session)?;
    let Some(samples) = recipe.samples(&mut prepared.context, session)? else {
        return Ok(Outcome::Interrupted { step: Checkpoint::latest(&folder)?.map_or(0, |c| c.step()) });
    };
    let mut last = TrainingRecord::default();
    let outcome = fit_on(&inputs, &mut prepared.training, &samples, &folder, session.stop, |record| {
        (session.events)(TrainingEvent::Steps(record, steps));
        last = record.clone();
    })?;
    if let Outcome::Interrupted { step } = outcome {
        return Ok(Outcome::Interrupted { step });
    }
    drop(samples);
    describe(recipe, &mut prepared.card, steps);
    finish(recipe, prepared, Some(last), session)
}

/// Writes the model of the last checkpoint in the session's folder, as [`train`] does at the end.
///
/// # Errors
/// As [`train`]; [`TrainError::NoCheckpoint`] if nothing was trained yet.
pub fn export<R: Recipe>(
    recipe: &R,
    data: R::Data,
    session: &mut Session<'_>,
) -> Result<Outcome<Trained<R::Report>>, TrainError> {
    recipe.check()?;
    let folder = session.folder();
    let _lock = WriteLock::take(&folder)?;
    let Some(checkpoint) = Checkpoint::latest(&folder)? else {
        return Err(TrainError::NoCheckpoint { folder });
    };
    check_inputs(&checkpoint, &recipe.inputs(&data)?, &folder)?;
    let mut prepared = recipe.prepare(data, session)?;
    restore(&mut prepared.training, &checkpoint)?;
    describe(recipe, &mut prepared.card, checkpoint.step());
    finish(recipe, prepared, None, session)
}

/// Returns an error unless the training in `folder` has these inputs.
fn check_inputs(checkpoint: &Checkpoint, inputs: &Fingerprint, folder: &Path) -> Result<(), TrainError> {
    match checkpoint.fingerprint()?.difference_from_part(inputs) {
        None => Ok(()),
        Some(difference) => Err(TrainError::OtherTraining { folder: folder.to_owned(), difference }),
    }
}

fn describe(recipe: &impl Recipe, card: &mut ModelCard, steps: u64) {
    card.steps = steps;
    card.seed = recipe.seed();
    recipe.command().clone_into(&mut card.command);
}

fn finish<R: Recipe>(
    recipe: &R,
    prepared: Prepared<R::Training, R::Context>,
    last: Option<TrainingRecord>,
    session: &mut Session<'_>,
) -> Result<Outcome<Trained<R::Report>>, TrainError> {
    let (model, steps) = (session.out.join(recipe.model_file()), prepared.card.steps);
    std::fs::create_dir_all(session.out)
        .map_err(|source| WeightsError::Write { file: model.clone(), source })?;
    let Some(report) = recipe.finish(prepared, session)? else {
        return Ok(Outcome::Interrupted { step: steps });
    };
    let (seconds, losses) = last.map_or((None, BTreeMap::new()), |r| (Some(r.seconds), r.losses));
    Ok(Outcome::Finished(Trained { model, steps, seconds, losses, report }))
}

/// The origin of a training's initial weights for its card, including that of their own initial weights.
///
/// # Errors
/// [`WeightsError`] for a file that is not a weight file.
pub fn continued_from(init: Option<&Path>) -> Result<serde_json::Value, WeightsError> {
    let Some(file) = init else { return Ok(serde_json::Value::Null) };
    let card = read_card(file)?;
    Ok(serde_json::json!({
        "file": file.display().to_string(),
        "command": card.command,
        "data": card.data,
        "steps": card.steps,
        "seed": card.seed,
        "continued_from": card.extra["continued_from"],
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::{CheckpointError, CheckpointWriter};
    use crate::learner::Checkpointed;
    use crate::options::Pace;
    use crate::schedule::LearningRate;
    use crate::training::{Batches, Losses, Plan};
    use crate::weights::ModelCard;

    /// Sums its batches; the model file contains the sum.
    struct Sum {
        value: u64,
        steps: u64,
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
        type Samples = u64;
        type Batch = u64;

        fn plan(&self, _: &u64) -> Result<Plan, TrainError> {
            Ok(Plan {
                steps: self.steps,
                schedule: LearningRate::Constant { rate: 1.0 },
                samples_per_step: 1,
                pace: Pace { log_every: 1, ..Pace::default() },
                settings: Fingerprint::default().with("steps", self.steps),
            })
        }

        fn batches<'a>(&self, offset: &'a u64) -> Batches<'a, u64> {
            Box::new(move |step| step + offset)
        }

        fn step(&mut self, batch: u64, _: f64) -> Losses {
            self.value += batch;
            Losses::from([("sum".to_owned(), self.value as f64)])
        }

        fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
            vec![self]
        }
    }

    #[derive(Default)]
    struct SumRecipe {
        steps: u64,
    }

    impl Recipe for SumRecipe {
        type Data = u64;
        type Samples = u64;
        type Training = Sum;
        type Context = u64;
        type Report = String;

        fn steps(&self) -> u64 {
            self.steps
        }

        fn seed(&self) -> u64 {
            7
        }

        fn command(&self) -> &str {
            "sum"
        }

        fn check(&self) -> Result<(), OptionError> {
            OptionError::unless(self.steps < 100, "steps", self.steps, "less than 100")
        }

        fn inputs(&self, data: &u64) -> Result<Fingerprint, TrainError> {
            Ok(Fingerprint::default().with("offset", *data))
        }

        fn prepare(&self, data: u64, _: &mut Session<'_>) -> Result<Prepared<Sum, u64>, TrainError> {
            let card = ModelCard::new("sum", "Sum");
            Ok(Prepared { training: Sum { value: 0, steps: self.steps }, card, context: data })
        }

        fn samples(&self, data: &mut u64, session: &mut Session<'_>) -> Result<Option<u64>, TrainError> {
            session.note("making samples");
            Ok((!session.is_stopped()).then_some(*data))
        }

        fn finish(
            &self,
            Prepared { training, card, .. }: Prepared<Sum, u64>,
            session: &mut Session<'_>,
        ) -> Result<Option<String>, TrainError> {
            std::fs::write(session.model(), training.value.to_string()).map_err(TrainError::method)?;
            Ok(Some(format!("{} {} {}", card.command, card.seed, card.steps)))
        }
    }

    #[test]
    fn it_trains_resumes_exports_and_measures() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("out");
        let stop = AtomicBool::new(false);
        let mut seen = vec![];
        let mut events = |event: TrainingEvent<'_>| {
            if let TrainingEvent::Steps(record, steps) = event {
                seen.push((record.step, steps));
                stop.store(record.step == 2, Ordering::Relaxed);
            }
        };
        let mut session = Session::new(&out, &stop, &mut events);
        let recipe = SumRecipe { steps: 4 };
        let error = export(&recipe, 10, &mut session).unwrap_err();
        assert!(matches!(error, TrainError::NoCheckpoint { .. }), "{error}");
        let interrupted = train(&recipe, 10, &mut session).unwrap();
        assert!(matches!(interrupted, Outcome::Interrupted { step: 2 }));
        assert!(!session.model().exists());
        // Stopped before there are samples: nothing more happens.
        assert!(matches!(train(&recipe, 10, &mut session).unwrap(), Outcome::Interrupted { step: 2 }));
        let Outcome::Finished(exported) = export(&recipe, 10, &mut session).unwrap() else { panic!() };
        assert_eq!((exported.steps, exported.seconds, exported.report.as_str()), (2, None, "sum 7 2"));
        assert_eq!(std::fs::read_to_string(&exported.model).unwrap(), "21");
        stop.store(false, Ordering::Relaxed);
        let Outcome::Finished(trained) = train(&recipe, 10, &mut session).unwrap() else { panic!() };
        assert_eq!((trained.steps, trained.report.as_str()), (4, "sum 7 4"));
        assert!(trained.seconds.unwrap() > 0.0 && trained.losses["sum"] == 46.0);
        assert_eq!(std::fs::read_to_string(&trained.model).unwrap(), "46");
        assert_eq!(seen, [(1, 4), (2, 4), (3, 4), (4, 4)]);
    }

    #[test]
    fn without_steps_the_weights_are_measured_and_wrong_options_come_first() {
        let folder = tempfile::tempdir().unwrap();
        let (stop, mut events) = (AtomicBool::new(false), |_: TrainingEvent<'_>| ());
        let mut session = Session::new(folder.path(), &stop, &mut events);
        let Outcome::Finished(measured) = train(&SumRecipe { steps: 0 }, 3, &mut session).unwrap() else {
            panic!()
        };
        assert_eq!((measured.seconds, measured.report.as_str()), (None, " 0 0"));
        assert!(!session.folder().exists());
        let error = train(&SumRecipe { steps: 100 }, 3, &mut session).unwrap_err().to_string();
        assert_eq!(error, "steps: found 100, expected less than 100");
    }

    #[test]
    fn a_training_on_other_inputs_is_neither_resumed_nor_exported_nor_taken_as_done() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("out");
        let stop = AtomicBool::new(false);
        let mut notes = 0;
        let mut events = |event: TrainingEvent<'_>| {
            notes += u32::from(matches!(event, TrainingEvent::Note(_)));
            if let TrainingEvent::Steps(record, _) = event {
                stop.store(record.step == 2, Ordering::Relaxed);
            }
        };
        let mut session = Session::new(&out, &stop, &mut events);
        let recipe = SumRecipe { steps: 4 };
        let said = |error: TrainError| {
            let text = error.to_string();
            assert!(matches!(error, TrainError::OtherTraining { .. }), "{text}");
            assert!(text.contains("training: holds a training") && text.contains("another folder"), "{text}");
            text
        };
        assert!(matches!(train(&recipe, 10, &mut session).unwrap(), Outcome::Interrupted { step: 2 }));
        stop.store(false, Ordering::Relaxed);
        for error in [train(&recipe, 11, &mut session), export(&recipe, 11, &mut session)] {
            assert!(said(error.unwrap_err()).contains("offset was 10, is 11"));
        }
        assert!(!session.model().exists());
        assert!(matches!(train(&recipe, 10, &mut session).unwrap(), Outcome::Finished(_)));
        let model = std::fs::read(session.model()).unwrap();
        // Already finished, but not for other inputs; for another number of steps only after samples are generated.
        assert!(said(train(&recipe, 11, &mut session).unwrap_err()).contains("offset was 10, is 11"));
        assert!(
            said(train(&SumRecipe { steps: 5 }, 10, &mut session).unwrap_err()).contains("steps was 4, is 5")
        );
        assert_eq!(std::fs::read(session.model()).unwrap(), model);
        // Samples were generated only for the right inputs: started, resumed, and with another number of steps.
        assert_eq!(notes, 3);
    }

    #[test]
    fn a_training_of_an_earlier_version_is_not_resumed() {
        let folder = tempfile::tempdir().unwrap();
        let (stop, mut events) = (AtomicBool::new(false), |_: TrainingEvent<'_>| ());
        let mut session = Session::new(folder.path(), &stop, &mut events);
        let before = CheckpointWriter::new(3).state("options", &serde_json::json!({ "steps": 4 })).unwrap();
        before.state("sum", &3).unwrap().write(&session.folder()).unwrap();
        for ended in [
            train(&SumRecipe { steps: 4 }, 1, &mut session),
            export(&SumRecipe { steps: 4 }, 1, &mut session),
        ] {
            let error = ended.unwrap_err().to_string();
            assert!(
                error.contains("does not say from which inputs") && error.contains("another folder"),
                "{error}"
            );
        }
    }

    #[test]
    fn two_trainings_in_one_folder_the_second_is_refused_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("out");
        let stop = AtomicBool::new(false);
        let mut refused = vec![];
        let mut events = |event: TrainingEvent<'_>| {
            if let TrainingEvent::Steps(..) = event {
                let mut quiet = |_: TrainingEvent<'_>| ();
                let mut second = Session::new(&out, &stop, &mut quiet);
                refused.push(train(&SumRecipe { steps: 4 }, 10, &mut second).unwrap_err().to_string());
                refused.push(export(&SumRecipe { steps: 4 }, 10, &mut second).unwrap_err().to_string());
            }
        };
        let mut session = Session::new(&out, &stop, &mut events);
        assert!(matches!(train(&SumRecipe { steps: 4 }, 10, &mut session).unwrap(), Outcome::Finished(_)));
        // When it is finished the next one may run.
        assert!(matches!(export(&SumRecipe { steps: 4 }, 10, &mut session).unwrap(), Outcome::Finished(_)));
        assert!(refused.len() == 8 && refused.iter().all(|e| e.contains("another process")), "{refused:?}");
    }
}
