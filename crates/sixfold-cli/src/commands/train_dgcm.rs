//! `sixfold train dgcm`: nothing but a seed in, a network for grasps from experience out.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use burn::tensor::Device;
use clap::{Args, ValueEnum};
use serde::Serialize;
use sixfold_dgcm::crop::CropOptions;
use sixfold_dgcm::model::DgcmModel;
use sixfold_dgcm::networks::{CompactConfig, Network, PaperConfig};
use sixfold_dgcm::samples::{Pool, PoolOptions};
use sixfold_dgcm::training::{Ending, TrainingOptions, TrainingPace, last_checkpoint, train};
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::ModelCard;

use super::material::command_line;
use crate::progress::{Progress, interrupted};

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
    let device = Device::flex().autodiff();
    let (network, crop, default) = match a.network {
        DgcmKind::Compact => {
            let network = Network::Compact(CompactConfig.init(a.seed, &device));
            (network, CropOptions::compact(), TrainingOptions::default())
        }
        DgcmKind::Paper => {
            let network = match &a.encoder {
                Some(file) => PaperConfig.from_imagenet(file, a.seed, &device).context("--encoder")?,
                None => PaperConfig.init(a.seed, &device),
            };
            (Network::Paper(network), CropOptions::paper(), TrainingOptions::paper())
        }
    };
    let options = TrainingOptions {
        steps: a.steps.unwrap_or(default.steps),
        pairs: a.pairs.unwrap_or(default.pairs),
        lambda: a.lambda.unwrap_or(default.lambda),
        learning_rate: a.learning_rate.unwrap_or(default.learning_rate),
        seed: a.seed,
        ..default
    };
    let pool_options = PoolOptions { views: a.views, crop, seed: a.seed, ..PoolOptions::default() };
    let folder = a.out.join("training");
    let path = a.out.join("model.safetensors");
    let mut card = ModelCard::new("", "DGCM-Net, grasps from experience");
    card.data = format!(
        "{} simulated depth views of procedural families (can, mug, cup, bottle, bowl, box, clamp, drill) with random axis scales; no scanned object and no photograph",
        a.views
    );
    card.seed = a.seed;
    card.command = command_line();
    card.extra = serde_json::json!({ "training": options, "pool": pool_options });
    let summary = |steps, seconds, losses| DgcmSummary {
        model: path.display().to_string(),
        views: a.views,
        steps,
        seconds,
        losses,
    };
    if a.export {
        let Some((network, step)) = last_checkpoint(&folder, network)? else {
            bail!("{}: holds no checkpoint; train first", folder.display());
        };
        card.steps = step;
        DgcmModel::new(network, crop, card).save(&path)?;
        return Ok(summary(step, None, Default::default()));
    }
    eprintln!("making {} views", a.views);
    let pool = Pool::new(&pool_options, |done| {
        if done % 1000 < 4 {
            eprintln!("  {done} of {}", a.views);
        }
    });
    let mut progress = Progress::new("steps", options.steps as usize);
    let mut last = TrainingRecord::default();
    let shown = |record: &TrainingRecord| {
        progress.set(record.step as usize);
        let loss = |name: &str| record.losses.get(name).copied().unwrap_or(f64::NAN);
        progress.message(format!(
            "metric {:.2}, distance {:.2} of similar and {:.2} of different pairs, coordinates off by {:.3}, {:.0} pairs/s",
            loss("metric"),
            loss("positive distance"),
            loss("negative distance"),
            loss("error on the object"),
            record.samples_per_second
        ));
        last = record.clone();
    };
    let pace = TrainingPace::default();
    let ending = train(&pool, network, &device, &folder, &options, &pace, interrupted(), shown)?;
    progress.finish();
    let network = match ending {
        Ending::Finished(network) => network,
        Ending::Interrupted { step } => {
            bail!("interrupted after step {step}, which is kept; run the same command again to go on")
        }
    };
    card.steps = options.steps;
    DgcmModel::new(network, crop, card).save(&path)?;
    Ok(summary(options.steps, Some(last.seconds), last.losses))
}
