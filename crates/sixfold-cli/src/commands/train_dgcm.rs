//! `sixfold train dgcm`: nothing but a seed in, a network for grasps from experience out.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use serde::Serialize;
use sixfold_dgcm::recipe::{self, Recipe};
use sixfold_nn::recipe::Trained;
use sixfold_nn::training::Ending;

use super::material::{Shown, command_line, interrupted_after, loss};
use sixfold_shell::progress::interrupted;

/// Which network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum DgcmKind {
    /// Plain convolutions on 96x96 pixels; trains on two cores
    Compact,
    /// The dissertation's: ResNet-50, 128x128 pixels; needs days on two cores
    Paper,
}

#[derive(Debug, Args)]
pub(crate) struct TrainDgcmArguments {
    /// Network
    #[arg(long, value_enum, default_value = "compact")]
    pub network: DgcmKind,
    /// ImageNet weights of ResNet-50 in torchvision's layout (.pth), for --network paper
    #[arg(long, value_name = "FILE")]
    pub encoder: Option<PathBuf>,
    /// Training steps (default: 4000; the dissertation's network: 116000)
    #[arg(long, value_name = "N")]
    pub steps: Option<u64>,
    /// Positive pairs in a step (default: 10, with 3 negative ones; the dissertation's network: 25 of both)
    #[arg(long, value_name = "N")]
    pub pairs: Option<usize>,
    /// Highest learning rate (default: 0.0005; the dissertation's network: 0.0001)
    #[arg(long, value_name = "RATE")]
    pub learning_rate: Option<f64>,
    /// Weight of the coordinates' loss beside the features' (default: 300; the dissertation's network: 1)
    #[arg(long, value_name = "WEIGHT")]
    pub lambda: Option<f64>,
    /// Simulated views to learn from, made at the start (about 35 kB of memory each)
    #[arg(long, value_name = "N", default_value = "6000")]
    pub views: usize,
    /// Seed of weights, objects, views and pairs
    #[arg(long, default_value = "0")]
    pub seed: u64,
    /// Train no further: write the model of the last checkpoint in --out
    #[arg(long)]
    pub export: bool,
    /// Folder for the model and the training's checkpoints, log and curves
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// What a training came to.
#[derive(Serialize)]
pub(super) struct DgcmSummary {
    pub model: String,
    pub views: usize,
    pub steps: u64,
    /// Of training; `None` where a model was only exported.
    pub seconds: Option<f64>,
    pub losses: std::collections::BTreeMap<String, f64>,
}

/// Trains, or goes on with a training, and writes the model.
pub(super) fn train_dgcm(a: &TrainDgcmArguments) -> Result<DgcmSummary> {
    if !(64..=1_000_000).contains(&a.views) {
        bail!("--views: found {}, expected 64 to 1000000", a.views);
    }
    if a.encoder.is_some() && a.network == DgcmKind::Compact {
        bail!("--encoder: the compact network starts from random weights; it belongs to --network paper");
    }
    let recipe = Recipe {
        network: match a.network {
            DgcmKind::Compact => recipe::DgcmKind::Compact,
            DgcmKind::Paper => recipe::DgcmKind::Paper,
        },
        encoder: a.encoder.clone(),
        steps: a.steps,
        pairs: a.pairs,
        learning_rate: a.learning_rate,
        lambda: a.lambda,
        views: a.views,
        seed: a.seed,
        command: command_line(),
    };
    let mut shown = Shown::new(|record| {
        format!(
            "metric {:.2}, distance {:.2} of similar and {:.2} of different pairs, coordinates off by {:.3}, {:.0} pairs/s",
            loss(record, "metric"),
            loss(record, "positive distance"),
            loss(record, "negative distance"),
            loss(record, "error on the object"),
            record.samples_per_second
        )
    });
    let ending = if a.export {
        Ending::Finished(recipe.export(&a.out)?)
    } else {
        recipe.train(&a.out, interrupted(), &mut |news| shown.hear(news))?
    };
    shown.finish();
    match ending {
        Ending::Finished(Trained { model, steps, seconds, losses }) => {
            let model = model.display().to_string();
            Ok(DgcmSummary { model, views: a.views, steps, seconds, losses })
        }
        Ending::Interrupted { step } => Err(interrupted_after(step)),
    }
}
