//! `sixfold train planner`: grasps on synthetic objects are tried in a physics engine, and a planner learns which of them hold.
//! The only input is a seed.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use sixfold_planners::quality::PlannerQuality;
use sixfold_planners::recipe::{GpdRecipe, HafRecipe, PlannerOptions};
use sixfold_planners::trials::TrialSetOptions;

use super::options::ResultArguments;
use super::{Measured, Shown, Summary, checked, command_line, loss, summary, train_in};

/// Planner to train.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Learned {
    /// GPD (Ten Pas et al. 2017): a network on images of the region between the fingers
    Gpd,
    /// HAF (Fischinger et al. 2015): a linear classifier of height accumulated features
    Haf,
}

fn steps_help() -> String {
    let (gpd, haf) = (GpdRecipe::default().options().steps, HafRecipe::PASSES);
    format!("Training steps for gpd, passes over all grasps for haf (default: gpd {gpd}, haf {haf})")
}

#[derive(Debug, Args)]
pub(crate) struct TrainPlannerArguments {
    /// Planner to train
    #[arg(long, value_name = "NAME", value_enum)]
    pub planner: Learned,
    /// File of tried grasps, created or completed by this command; both planners can be trained on the same file (default:
    /// trials.jsonl in --out)
    #[arg(long, value_name = "FILE")]
    pub trials: Option<PathBuf>,
    /// Number of simulated scenes, four of each object, with up to 16 tried grasps each; two of ten objects are held out for the
    /// measurement at the end
    #[arg(long, value_name = "N", default_value_t = TrialSetOptions::default().scenes)]
    pub scenes: u64,
    #[arg(long, value_name = "N", help = steps_help())]
    pub steps: Option<u64>,
    #[arg(long, value_name = "RATE", help = format!("Maximum learning rate, gpd only (default: {})", GpdRecipe::default().options().learning_rate))]
    pub learning_rate: Option<f64>,
    /// Seed of objects, scenes, trials and training
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    #[command(flatten)]
    pub result: ResultArguments,
}

impl TrainPlannerArguments {
    pub(super) fn options(&self) -> PlannerOptions {
        PlannerOptions {
            trials: TrialSetOptions { scenes: self.scenes, seed: self.seed },
            file: self.trials.clone(),
            steps: self.steps,
            seed: self.seed,
            command: command_line(),
        }
    }
}

/// Trains, or resumes a training, and writes and measures the model.
pub(super) fn train_planner(a: &TrainPlannerArguments) -> Result<Summary<Measured<PlannerQuality>>> {
    let common = a.options();
    let shown = |message| Shown { preparing: "scenes", measuring: "grasps", message };
    let trained = match a.planner {
        Learned::Gpd => {
            let recipe = checked(GpdRecipe { common, learning_rate: a.learning_rate })?;
            let shown = shown(|record| {
                format!(
                    "cross entropy {:.3}, {:.2} classified correctly",
                    loss(record, "cross entropy"),
                    loss(record, "classified correctly")
                )
            });
            train_in(&recipe, (), &a.result.out, a.result.export, shown)?
        }
        Learned::Haf if a.learning_rate.is_some() => {
            bail!("--learning-rate: the training of haf has none; leave it out")
        }
        Learned::Haf => {
            let recipe = checked(HafRecipe { common })?;
            let shown = shown(|record| {
                format!(
                    "hinge loss {:.3}, {:.2} classified correctly",
                    loss(record, "hinge"),
                    loss(record, "classified correctly")
                )
            });
            train_in(&recipe, (), &a.result.out, a.result.export, shown)?
        }
    };
    Ok(summary(trained, |quality| Measured { quality }))
}
