//! `sixfold train mttm`: made-up objects fall on a table, depth cameras look at them, and a network learns to match regions
//! with templates. Nothing but a seed goes in.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use serde::Serialize;
use sixfold_mttm::quality::Quality;
use sixfold_mttm::recipe::{self, Recipe};
use sixfold_nn::recipe::{News, Trained};
use sixfold_nn::training::Ending;

use super::material::{Shown, command_line, interrupted_after, loss};
use sixfold_shell::progress::{Progress, interrupted};

/// Which network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum MttmKind {
    /// Plain convolutions on regions of 28x28 pixels; trains on two cores
    Compact,
    /// The dissertation's sizes: ResNet-50; needs days on two cores
    Paper,
}

#[derive(Debug, Args)]
pub(crate) struct TrainMttmArguments {
    /// Network
    #[arg(long, value_enum, default_value = "compact")]
    pub network: MttmKind,
    /// ImageNet weights of ResNet-50 in torchvision's layout (.pth), for --network paper
    #[arg(long, value_name = "FILE")]
    pub encoder: Option<PathBuf>,
    /// Training steps (default: 8000; the dissertation's network: 100000)
    #[arg(long, value_name = "N")]
    pub steps: Option<u64>,
    /// Regions with an object in a step (default: 40; the dissertation's network: 16)
    #[arg(long, value_name = "N")]
    pub anchors: Option<usize>,
    /// Highest learning rate (default: 0.001; the dissertation's network: 0.0001)
    #[arg(long, value_name = "RATE")]
    pub learning_rate: Option<f64>,
    /// Made-up objects: half of them household shapes, half of them toys
    #[arg(long, value_name = "N", default_value = "300")]
    pub objects: usize,
    /// Scenes in which they fall on a table, made at the start; each is seen by five cameras
    #[arg(long, value_name = "N", default_value = "500")]
    pub scenes: usize,
    /// Seed of weights, objects, scenes and samples
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
pub(super) struct MttmSummary {
    pub model: String,
    pub steps: u64,
    /// Of training; `None` where a model was only exported.
    pub seconds: Option<f64>,
    pub losses: std::collections::BTreeMap<String, f64>,
    /// On made-up objects that were not trained on.
    pub quality: Quality,
}

/// Trains, or goes on with a training, and writes the model.
pub(super) fn train_mttm(a: &TrainMttmArguments) -> Result<MttmSummary> {
    for (field, found, least, most) in
        [("--objects", a.objects, 16, 100_000), ("--scenes", a.scenes, 4, 1_000_000)]
    {
        if !(least..=most).contains(&found) {
            bail!("{field}: found {found}, expected {least} to {most}");
        }
    }
    if a.encoder.is_some() && a.network == MttmKind::Compact {
        bail!("--encoder: the compact network starts from random weights; it belongs to --network paper");
    }
    let recipe = Recipe {
        network: match a.network {
            MttmKind::Compact => recipe::MttmKind::Compact,
            MttmKind::Paper => recipe::MttmKind::Paper,
        },
        encoder: a.encoder.clone(),
        steps: a.steps,
        anchors: a.anchors,
        learning_rate: a.learning_rate,
        objects: a.objects,
        scenes: a.scenes,
        seed: a.seed,
        command: command_line(),
    };
    let mut shown = Shown::new(|record| {
        format!(
            "triplet {:.3}, other objects {:.3}, mask {:.3}, rotation {:.3}, offset {:.3}, matching {:.3}, {:.0} regions/s",
            loss(record, "triplet"),
            loss(record, "other objects"),
            loss(record, "mask"),
            loss(record, "rotation"),
            loss(record, "offset"),
            loss(record, "matching"),
            record.samples_per_second
        )
    });
    // Scenes are made before the training and after it.
    let mut scenes: Option<Progress> = None;
    let mut hear = |news: News<'_>| match news {
        News::Preparing(done, all) => scenes.get_or_insert_with(|| Progress::new("scenes", all)).set(done),
        News::Measuring(done, all) => {
            shown.finish();
            scenes.get_or_insert_with(|| Progress::new("test scenes", all)).set(done);
        }
        other => {
            if let Some(bar) = scenes.take() {
                bar.finish();
            }
            shown.hear(other);
        }
    };
    let ending = if a.export {
        recipe.export(&a.out, interrupted(), &mut hear)?
    } else {
        recipe.train(&a.out, interrupted(), &mut hear)?
    };
    match ending {
        Ending::Finished((Trained { model, steps, seconds, losses }, quality)) => {
            Ok(MttmSummary { model: model.display().to_string(), steps, seconds, losses, quality })
        }
        Ending::Interrupted { step: 0 } => {
            bail!("interrupted; nothing was trained yet; run the same command again")
        }
        Ending::Interrupted { step } => Err(interrupted_after(step)),
    }
}
