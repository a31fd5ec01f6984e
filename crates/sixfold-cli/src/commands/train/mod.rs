//! `sixfold train`: data in, a model file out; interrupted at any time, it is resumed. One driver for the recipes of all
//! methods, and what is shown of it.

mod detector;
#[cfg(feature = "experience")]
mod dgcm;
#[cfg(feature = "physics")]
mod mttm;
mod nol;
mod options;
mod pix2pose;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Result, anyhow, bail};
use clap::CommandFactory;
use serde::Serialize;
use sixfold_nn::options::OptionError;
use sixfold_nn::recipe::{Recipe, Session, Trained, TrainingEvent, export, train};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::Outcome as Ended;
use sixfold_nn::training_log::TrainingRecord;

pub(crate) use self::detector::TrainDetectorArguments;
#[cfg(feature = "experience")]
pub(crate) use self::dgcm::TrainDgcmArguments;
#[cfg(feature = "physics")]
pub(crate) use self::mttm::TrainMttmArguments;
pub(crate) use self::nol::TrainNolArguments;
pub(crate) use self::pix2pose::{TrainPix2PoseArguments, train_pix2pose};
use crate::Outcome;
use crate::arguments::{Arguments, JsonArguments, TrainArguments, TrainCommand};
use crate::output::report;
use crate::progress::{Progress, interrupted};

pub(crate) fn run(a: &TrainArguments) -> Result<Outcome> {
    match &a.command {
        TrainCommand::Pix2pose(of) => show(&a.json, &of.out, &train_pix2pose(of)?, || ()),
        TrainCommand::Detector(of) => show(&a.json, &of.out, &detector::train_detector(of)?, || ()),
        TrainCommand::Nol(of) => {
            let summary = nol::train_nol(of)?;
            show(&a.json, &of.out, &summary, || {
                println!("like the truth, on new made-up objects:");
                for (name, score) in summary.more.quality.scores() {
                    println!("  {name}: {score:.3}");
                }
            })
        }
        #[cfg(feature = "physics")]
        TrainCommand::Mttm(of) => {
            let summary = mttm::train_mttm(of)?;
            show(&a.json, &of.out, &summary, || {
                let quality = &summary.more.quality;
                println!("on {} regions of made-up objects it was not trained on:", quality.regions);
                for (name, score) in quality.scores() {
                    println!("  {name}: {score:.3}");
                }
            })
        }
        #[cfg(feature = "experience")]
        TrainCommand::Dgcm(of) => show(&a.json, &of.out, &dgcm::train_dgcm(of)?, || ()),
    }
}

/// What a training came to; `M`: what only some of them say.
#[derive(Serialize)]
pub(crate) struct Summary<M> {
    pub model: String,
    pub steps: u64,
    /// Of training; `None` where a model was only exported.
    pub seconds: Option<f64>,
    pub losses: BTreeMap<String, f64>,
    #[serde(flatten)]
    pub more: M,
}

/// What was learnt from.
#[derive(Serialize)]
pub(crate) struct LearntFrom {
    pub objects: Vec<u32>,
    pub photographs: usize,
}

/// How good the model is on objects that it was not trained on.
#[derive(Serialize)]
struct Measured<Q> {
    quality: Q,
}

fn summary<R, M>(trained: Trained<R>, more: impl FnOnce(R) -> M) -> Summary<M> {
    let Trained { model, steps, seconds, losses, report } = trained;
    Summary { model: model.display().to_string(), steps, seconds, losses, more: more(report) }
}

fn show<M: Serialize>(
    json: &JsonArguments,
    out: &Path,
    summary: &Summary<M>,
    more: impl FnOnce(),
) -> Result<Outcome> {
    report(json, summary, || {
        match summary.seconds {
            Some(seconds) => {
                println!("{} steps in {seconds:.0} s: {}", summary.steps, summary.model);
                println!("learning curves: {}", out.join("training/curves.png").display());
            }
            None => println!("the model after {} steps: {}", summary.steps, summary.model),
        }
        more();
    })?;
    Ok(Outcome::Found)
}

/// How a training is shown.
struct Shown {
    /// What is made ready before the first step.
    preparing: &'static str,
    /// What is measured after the last.
    measuring: &'static str,
    /// Behind the bar of the steps.
    message: fn(&TrainingRecord) -> String,
}

/// A recipe whose options are in their ranges, before its data are read.
fn checked<R: Recipe>(recipe: R) -> Result<R> {
    recipe.check().map_err(|error| by_flag(&error))?;
    Ok(recipe)
}

/// Trains in `out`, or resumes the training there, or only writes the model of its last checkpoint.
fn train_in<R: Recipe>(
    recipe: &R,
    data: R::Data,
    out: &Path,
    export_only: bool,
    shown: Shown,
) -> Result<Trained<R::Report>> {
    let mut bars = Bars { shown, bar: None };
    let mut receive = |event: TrainingEvent<'_>| bars.receive(event);
    let mut session = Session::new(out, interrupted(), &mut receive);
    let ended =
        if export_only { export(recipe, data, &mut session) } else { train(recipe, data, &mut session) };
    bars.finish();
    match ended {
        Ok(Ended::Finished(trained)) => Ok(trained),
        Ok(Ended::Interrupted { step: 0 }) => {
            bail!("interrupted; nothing was trained yet; run the same command again")
        }
        Ok(Ended::Interrupted { step }) => {
            bail!("interrupted after step {step}, which is kept; run the same command again to go on")
        }
        Err(TrainError::Option(error)) => Err(by_flag(&error)),
        Err(error) => Err(error.into()),
    }
}

/// An option out of its range, by the flag that sets it where there is one.
fn by_flag(error: &OptionError) -> anyhow::Error {
    let flag = error.field.replace('_', "-");
    let command = Arguments::command();
    let mut trainings =
        command.find_subcommand("train").into_iter().flat_map(|train| train.get_subcommands());
    if trainings.any(|training| training.get_arguments().any(|a| a.get_long() == Some(flag.as_str()))) {
        return anyhow!("--{flag}: found {}, expected {}", error.found, error.expected);
    }
    anyhow!("{error}")
}

/// A bar of what is done at the moment, and notes.
struct Bars {
    shown: Shown,
    bar: Option<(&'static str, Progress)>,
}

impl Bars {
    fn receive(&mut self, event: TrainingEvent<'_>) {
        match event {
            TrainingEvent::Note(text) => {
                self.finish();
                eprintln!("{text}");
            }
            TrainingEvent::Warning(text) => eprintln!("warning: {text}"),
            TrainingEvent::Preparing(done, all) => self.bar(self.shown.preparing, all).set(done),
            TrainingEvent::Steps(record, steps) => {
                let message = (self.shown.message)(record);
                let bar = self.bar("steps", steps as usize);
                bar.set(record.step as usize);
                bar.message(message);
            }
            TrainingEvent::Measuring(done, all) => self.bar(self.shown.measuring, all).set(done),
        }
    }

    fn bar(&mut self, what: &'static str, all: usize) -> &mut Progress {
        if self.bar.as_ref().is_some_and(|(before, _)| *before != what) {
            self.finish();
        }
        &mut self.bar.get_or_insert_with(|| (what, Progress::new(what, all))).1
    }

    fn finish(&mut self) {
        if let Some((_, bar)) = self.bar.take() {
            bar.finish();
        }
    }
}

/// The value of a loss, where the record has it.
fn loss(record: &TrainingRecord, name: &str) -> f64 {
    record.losses.get(name).copied().unwrap_or(f64::NAN)
}

/// What the user typed, for the card.
fn command_line() -> String {
    let words = std::env::args().skip(1).filter(|word| word != "--export");
    std::iter::once("sixfold".to_string()).chain(words).collect::<Vec<_>>().join(" ")
}
