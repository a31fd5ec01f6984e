//! `sixfold train nol`: nothing but a seed in (better: photographs for textures too), a network that renders new views out.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use burn::tensor::Device;
use clap::{Args, ValueEnum};
use serde::Serialize;
use sixfold_augment::{Backgrounds, PhotographOptions};
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::ModelCard;
use sixfold_nol::loss::{Perceptual, psnr};
use sixfold_nol::model::NolModel;
use sixfold_nol::network::{CompactConfig, IntegratorKind, Network, PaperConfig, Parts};
use sixfold_nol::quality::{Quality, QualityOptions, quality};
use sixfold_nol::training::{Ending, TrainingOptions, TrainingPace, last_checkpoint, train};

use super::material::command_line;
use crate::progress::{Progress, interrupted};

/// Share of procedural textures between the photographs.
const PROCEDURAL_SHARE: f32 = 0.2;

/// Which network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum NolKind {
    /// On a frozen EfficientNet-Lite0; trains on two cores
    Compact,
    /// The dissertation's, on DenseNet-121; needs weeks on two cores
    Paper,
}

/// How sources are integrated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum NolIntegrator {
    /// Convolutional LSTM over the sources
    Lstm,
    /// Their mean, for comparison
    Average,
}

#[derive(Debug, Args)]
pub(crate) struct TrainNolArguments {
    /// Network
    #[arg(long, value_enum, default_value = "compact")]
    pub network: NolKind,
    /// ImageNet weights of DenseNet-121 in torchvision's layout (.pth), for --network paper
    #[arg(long, value_name = "FILE")]
    pub encoder: Option<PathBuf>,
    /// How the photographs' features are integrated
    #[arg(long, value_enum, default_value = "lstm")]
    pub integrator: NolIntegrator,
    /// Leave the decoder out: the loss looks at the weighted colours themselves
    #[arg(long)]
    pub no_decoder: bool,
    /// Folder of photographs (PNG, JPEG) for textures, backgrounds and clutter (default: procedural textures only)
    #[arg(long, value_name = "DIR")]
    pub backgrounds: Option<PathBuf>,
    /// Training steps (default: 5000; the dissertation's network: 350000)
    #[arg(long, value_name = "N")]
    pub steps: Option<u64>,
    /// Highest learning rate (default: 0.002; the dissertation's network: 0.001)
    #[arg(long, value_name = "RATE")]
    pub learning_rate: Option<f64>,
    /// Seed of weights and samples
    #[arg(long, default_value = "0")]
    pub seed: u64,
    /// Train no further: write the model of the last checkpoint in --out
    #[arg(long)]
    pub export: bool,
    /// Folder for the model and the training's checkpoints, log, curves and preview
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// What a training came to.
#[derive(Serialize)]
pub(super) struct NolSummary {
    pub model: String,
    pub steps: u64,
    /// Of training; `None` where a model was only exported.
    pub seconds: Option<f64>,
    pub losses: std::collections::BTreeMap<String, f64>,
    /// On made-up objects that were not trained on.
    pub quality: Quality,
}

/// Trains, or goes on with a training, and writes the model.
pub(super) fn train_nol(a: &TrainNolArguments) -> Result<NolSummary> {
    if a.encoder.is_some() && a.network == NolKind::Compact {
        bail!(
            "--encoder: the compact network has its encoder within the program; it belongs to --network paper"
        );
    }
    let parts = Parts {
        integrator: match a.integrator {
            NolIntegrator::Lstm => IntegratorKind::Lstm,
            NolIntegrator::Average => IntegratorKind::Average,
        },
        decoder: !a.no_decoder,
    };
    let device = Device::flex().autodiff();
    let (network, default) = match a.network {
        NolKind::Compact => {
            let network = CompactConfig { parts }.init(a.seed, &device)?;
            (Network::Compact(network), TrainingOptions::default())
        }
        NolKind::Paper => {
            let config = PaperConfig { parts };
            let network = match &a.encoder {
                Some(file) => config.from_imagenet(file, a.seed, &device).context("--encoder")?,
                None => config.init(a.seed, &device),
            };
            (Network::Paper(network), TrainingOptions::paper())
        }
    };
    let options = TrainingOptions {
        steps: a.steps.unwrap_or(default.steps),
        learning_rate: a.learning_rate.unwrap_or(default.learning_rate),
        seed: a.seed,
        ..default
    };
    let textures = match &a.backgrounds {
        Some(folder) => Backgrounds::from_folder(folder, &PhotographOptions::default())
            .context("--backgrounds")?
            .with_procedural_share(PROCEDURAL_SHARE),
        None => Backgrounds::procedural(),
    };
    let perceptual = Perceptual::of(&network, &device)?;
    let folder = a.out.join("training");
    let path = a.out.join("model.safetensors");
    let mut card = ModelCard::new("", "Neural Object Learning, new views from few photographs");
    card.data = format!(
        "made-up household shapes (procedural families, alone and grown together) with textures from {}; no scanned object",
        match textures.images() {
            0 => "noise".to_owned(),
            n => format!("{n} photographs and noise"),
        }
    );
    card.seed = a.seed;
    card.command = command_line();
    card.extra = serde_json::json!({ "training": options });
    let finish = |network: Network, steps: u64, seconds, losses| -> Result<NolSummary> {
        card.steps = steps;
        let mut model = NolModel::new(network, parts, card);
        // First without scores: nothing that was trained may be lost.
        model.save(&path)?;
        let quality = quality(&model, &textures, &options.samples, &QualityOptions::default())?;
        model.card_mut().scores = quality.scores();
        model.save(&path)?;
        Ok(NolSummary { model: path.display().to_string(), steps, seconds, losses, quality })
    };
    if a.export {
        let Some((network, step)) = last_checkpoint(&folder, network)? else {
            bail!("{}: holds no checkpoint; train first", folder.display());
        };
        return finish(network, step, None, Default::default());
    }
    let mut progress = Progress::new("steps", options.steps as usize);
    let mut last = TrainingRecord::default();
    let shown = |record: &TrainingRecord| {
        progress.set(record.step as usize);
        let loss = |name: &str| record.losses.get(name).copied().unwrap_or(f64::NAN);
        progress.message(format!(
            "colours {:.3}, features {:.3}, PSNR {:.2} dB (decoded {:.2}, averaging {:.2}), {:.2} steps/s",
            loss("colours"),
            loss("features"),
            psnr(loss("squared error")),
            psnr(loss("squared error decoded")),
            psnr(loss("squared error of averaging")),
            record.samples_per_second
        ));
        last = record.clone();
    };
    let pace = TrainingPace::default();
    let ending = train(
        &textures,
        network,
        parts,
        &perceptual,
        &device,
        &folder,
        &options,
        &pace,
        interrupted(),
        shown,
    )?;
    progress.finish();
    let network = match ending {
        Ending::Finished(network) => network,
        Ending::Interrupted { step } => {
            bail!("interrupted after step {step}, which is kept; run the same command again to go on")
        }
    };
    finish(network, options.steps, Some(last.seconds), last.losses)
}
