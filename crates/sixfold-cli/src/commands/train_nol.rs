//! `sixfold train nol`: nothing but a seed in (better: photographs for textures too), a network that renders new views out.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use serde::Serialize;
use sixfold_nn::recipe::Trained;
use sixfold_nn::training::Ending;
use sixfold_nol::loss::psnr;
use sixfold_nol::network::{IntegratorKind, Parts};
use sixfold_nol::quality::Quality;
use sixfold_nol::recipe::{self, Recipe};

use super::material::{Shown, command_line, interrupted_after, loss};
use sixfold_shell::progress::interrupted;

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
    let recipe = Recipe {
        network: match a.network {
            NolKind::Compact => recipe::NolKind::Compact,
            NolKind::Paper => recipe::NolKind::Paper,
        },
        encoder: a.encoder.clone(),
        parts: Parts {
            integrator: match a.integrator {
                NolIntegrator::Lstm => IntegratorKind::Lstm,
                NolIntegrator::Average => IntegratorKind::Average,
            },
            decoder: !a.no_decoder,
        },
        backgrounds: a.backgrounds.clone(),
        steps: a.steps,
        learning_rate: a.learning_rate,
        seed: a.seed,
        command: command_line(),
    };
    let mut shown = Shown::new(|record| {
        format!(
            "colours {:.3}, features {:.3}, PSNR {:.2} dB (decoded {:.2}, averaging {:.2}), {:.2} steps/s",
            loss(record, "colours"),
            loss(record, "features"),
            psnr(loss(record, "squared error")),
            psnr(loss(record, "squared error decoded")),
            psnr(loss(record, "squared error of averaging")),
            record.samples_per_second
        )
    });
    let ending = if a.export {
        Ending::Finished(recipe.export(&a.out, &mut |news| shown.hear(news))?)
    } else {
        recipe.train(&a.out, interrupted(), &mut |news| shown.hear(news))?
    };
    shown.finish();
    match ending {
        Ending::Finished((Trained { model, steps, seconds, losses }, quality)) => {
            Ok(NolSummary { model: model.display().to_string(), steps, seconds, losses, quality })
        }
        Ending::Interrupted { step } => Err(interrupted_after(step)),
    }
}
