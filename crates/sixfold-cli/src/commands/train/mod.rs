//! `sixfold train`: trains on data and writes a model file; an interrupted training can be resumed. One driver for the
//! recipes of all methods, with its display.

mod detector;
#[cfg(feature = "experience")]
mod dgcm;
#[cfg(feature = "physics")]
mod mttm;
mod nol;
mod options;
mod pix2pose;
#[cfg(feature = "physics")]
mod planner;
mod proposals;
mod refiner;
#[cfg(test)]
mod tests;
mod views;

use std::path::Path;

use anyhow::{Result, anyhow};
use clap::{Args, CommandFactory, Subcommand};
use serde::Serialize;
use sixfold_nn::options::OptionError;
use sixfold_nn::recipe::{Recipe, Trained};
use sixfold_shell::Outcome;
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::training::{
    self, LearntFrom, MaterialArguments, Measured, Shown, Summary, command_line, loss, summary, training_set,
};

pub(crate) use self::detector::TrainDetectorArguments;
#[cfg(feature = "experience")]
pub(crate) use self::dgcm::TrainDgcmArguments;
#[cfg(feature = "physics")]
pub(crate) use self::mttm::TrainMttmArguments;
pub(crate) use self::nol::TrainNolArguments;
pub(crate) use self::pix2pose::{TrainPix2PoseArguments, train_pix2pose};
#[cfg(feature = "physics")]
pub(crate) use self::planner::TrainPlannerArguments;
pub(crate) use self::proposals::TrainProposalsArguments;
pub(crate) use self::refiner::TrainRefinerArguments;
pub(crate) use self::views::TrainViewsArguments;
use crate::arguments::Arguments;

#[derive(Debug, Args)]
pub(crate) struct TrainArguments {
    #[command(subcommand)]
    pub command: TrainCommand,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Subcommand)]
pub(crate) enum TrainCommand {
    /// Per-pixel object coordinates from RGB: poses with `sixfold estimate --method pix2pose`
    #[command(after_help = "Examples:\n  \
        sixfold train pix2pose --dataset lmo --frames frames.json --out out/lmo\n  \
        sixfold train pix2pose --object mug.ply --unit mm --out out/mug\n\n\
        After a stop, the same command resumes.")]
    Pix2pose(Box<TrainPix2PoseArguments>),
    /// Boxes and masks of objects in colour images: `sixfold detect`, `sixfold estimate --detector`
    #[command(after_help = "Examples:\n  \
        sixfold train detector --dataset lmo --frames frames.json --backgrounds photographs --out out/detector\n  \
        sixfold train detector --object mug.ply --unit mm --out out/mug-detector\n\n\
        After a stop, the same command resumes.")]
    Detector(Box<TrainDetectorArguments>),
    /// Train the network that transfers grasps from experience, on procedural objects
    #[cfg(feature = "experience")]
    #[command(after_help = "Example:\n  sixfold train dgcm --out out/dgcm\n\n\
        After a stop, the same command resumes.")]
    Dgcm(Box<TrainDgcmArguments>),
    /// Train the network that finds objects by their templates in depth, on procedural objects
    #[cfg(feature = "physics")]
    #[command(after_help = "Example:\n  sixfold train mttm --out out/mttm\n\n\
        After a stop, the same command resumes.")]
    Mttm(Box<TrainMttmArguments>),
    /// Train the network that renders new views of an object from few photographs, on procedural objects
    #[command(after_help = "Example:\n  sixfold train nol --backgrounds photographs --out out/nol\n\n\
        After a stop, the same command resumes.")]
    Nol(Box<TrainNolArguments>),
    /// Train the network that matches rendered views of any object with colour images, on procedural objects
    #[command(after_help = "Example:\n  sixfold train views --backgrounds photographs --out out/views\n\n\
        After a stop, the same command resumes.")]
    Views(Box<TrainViewsArguments>),
    /// Train the network that refines poses in colour images, of any object, on procedural objects
    #[command(
        after_help = "Example:\n  sixfold train refiner --backgrounds photographs --out out/refiner\n\n\
                      Writes model.safetensors with its card. The built-in refiner was trained with this command."
    )]
    Refiner(Box<TrainRefinerArguments>),
    /// Train the class-agnostic detector of objects in colour images, on procedural objects
    #[command(
        after_help = "Example:\n  sixfold train proposals --backgrounds photographs --out out/proposals\n\n\
                      After a stop, the same command resumes."
    )]
    Proposals(Box<TrainProposalsArguments>),
    /// Train a grasp planner, GPD or HAF, on grasps of procedural objects that are tried in a physics engine
    #[cfg(feature = "physics")]
    #[command(after_help = "Examples:\n  \
        sixfold train planner --planner gpd --trials out/trials.jsonl --out out/gpd\n  \
        sixfold train planner --planner haf --trials out/trials.jsonl --out out/haf\n\n\
        After a stop, the same command resumes.")]
    Planner(Box<TrainPlannerArguments>),
}

pub(crate) fn run(a: &TrainArguments) -> Result<Outcome> {
    match &a.command {
        TrainCommand::Pix2pose(of) => show(&a.json, &of.out, &train_pix2pose(of)?, || ()),
        TrainCommand::Detector(of) => show(&a.json, &of.out, &detector::train_detector(of)?, || ()),
        TrainCommand::Nol(of) => {
            let summary = nol::train_nol(of)?;
            show(&a.json, &of.out, &summary, || {
                println!("similarity to the ground truth, on new synthetic objects:");
                for (name, score) in summary.more.quality.scores() {
                    println!("  {name}: {score:.3}");
                }
            })
        }
        TrainCommand::Views(of) => show(&a.json, &of.result.out, &views::train_views(of)?, || ()),
        TrainCommand::Proposals(of) => show(&a.json, &of.result.out, &proposals::train_proposals(of)?, || ()),
        TrainCommand::Refiner(of) => show(&a.json, &of.result.out, &refiner::train_refiner(of)?, || ()),
        #[cfg(feature = "physics")]
        TrainCommand::Planner(of) => {
            let summary = planner::train_planner(of)?;
            show(&a.json, &of.result.out, &summary, || {
                println!("on grasps of objects that were not learned from:");
                for (name, score) in summary.more.quality.scores() {
                    println!("  {name}: {score:.3}");
                }
            })
        }
        #[cfg(feature = "physics")]
        TrainCommand::Mttm(of) => {
            let summary = mttm::train_mttm(of)?;
            show(&a.json, &of.result.out, &summary, || {
                let quality = &summary.more.quality;
                println!("on {} regions of synthetic objects it was not trained on:", quality.regions);
                for (name, score) in quality.scores() {
                    println!("  {name}: {score:.3}");
                }
            })
        }
        #[cfg(feature = "experience")]
        TrainCommand::Dgcm(of) => {
            let summary = dgcm::train_dgcm(of)?;
            show(&a.json, &of.result.out, &summary, || {
                let quality = &summary.more.quality;
                println!("on {} pairs of views of objects it was not trained on:", quality.pairs);
                for (name, score) in quality.scores() {
                    println!("  {name}: {score:.3}");
                }
            })
        }
    }
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

/// Checks that a recipe's options are in their ranges, before its data are read.
fn checked<R: Recipe>(recipe: R) -> Result<R> {
    recipe.check().map_err(|error| by_flag(&error))?;
    Ok(recipe)
}

/// As the library's, with options named by their flags.
fn train_in<R: Recipe>(
    recipe: &R,
    data: R::Data,
    out: &Path,
    export_only: bool,
    shown: Shown,
) -> Result<Trained<R::Report>> {
    training::train_in(recipe, data, out, export_only, shown, by_flag)
}

/// An option out of its range, named by its flag if there is one.
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
