//! `sixfold train nol`: trains a network that renders new views; the inputs are a seed and, preferably, photographs for
//! textures.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use sixfold_nn::choice::Choice;
use sixfold_nol::loss::psnr;
use sixfold_nol::network::{IntegratorKind, Parts};
use sixfold_nol::quality::Quality;
use sixfold_nol::recipe::{NolKind, NolRecipe};
use sixfold_nol::training::NolLosses;

use super::options::{Preset, by_network, choices, presets};
use super::{Measured, Shown, Summary, checked, command_line, loss, summary, train_in};

fn default() -> NolRecipe {
    NolRecipe::default()
}

/// Help with the defaults of both networks.
fn help(what: &str, of: impl Fn(NolKind) -> String) -> String {
    by_network(what, of(NolKind::Compact), of(NolKind::Paper))
}

#[derive(Debug, Args)]
pub(crate) struct TrainNolArguments {
    /// Train as published (docs/coverage.md): the dissertation's network and losses, eight sources, all poses rough
    #[arg(long, value_parser = choices::<Preset>())]
    pub preset: Option<Preset>,
    #[arg(long, value_parser = choices::<NolKind>(), help = presets("Network", default().network.name(), NolRecipe::published().network.name()))]
    pub network: Option<NolKind>,
    /// Losses to sum: the columns of the dissertation's table 4.6 (default: smooth)
    #[arg(long, value_parser = choices::<NolLosses>())]
    pub loss: Option<NolLosses>,
    /// ImageNet weights of DenseNet-121 in torchvision's layout (.pth), for --network paper
    #[arg(long, value_name = "FILE")]
    pub encoder: Option<PathBuf>,
    /// How the photographs' features are integrated
    #[arg(
        long,
        value_parser = choices::<IntegratorKind>(),
        default_value = default().parts.integrator.name()
    )]
    pub integrator: IntegratorKind,
    /// Train without the decoder: the loss compares the weighted colours
    #[arg(long)]
    pub no_decoder: bool,
    /// Folder of photographs (PNG, JPEG) for textures, backgrounds and clutter (default: procedural textures only)
    #[arg(long, value_name = "DIR")]
    pub backgrounds: Option<PathBuf>,
    #[arg(long, value_name = "N", help = help("Training steps", |k| k.options().common.steps.to_string()))]
    pub steps: Option<u64>,
    #[arg(
        long,
        value_name = "RATE",
        help = help("Maximum learning rate", |k| k.options().common.learning_rate.to_string())
    )]
    pub learning_rate: Option<f64>,
    /// Seed of weights and samples
    #[arg(long, default_value_t = default().seed)]
    pub seed: u64,
    /// Do not train: write the model of the last checkpoint in --out
    #[arg(long)]
    pub export: bool,
    /// Folder for the model and the training's checkpoints, log, curves and preview
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

impl TrainNolArguments {
    pub(super) fn recipe(&self) -> NolRecipe {
        let default = if self.preset.is_some() { NolRecipe::published() } else { default() };
        NolRecipe {
            network: self.network.unwrap_or(default.network),
            losses: self.loss,
            encoder: self.encoder.clone(),
            parts: Parts { integrator: self.integrator, decoder: !self.no_decoder },
            backgrounds: self.backgrounds.clone(),
            steps: self.steps,
            learning_rate: self.learning_rate,
            seed: self.seed,
            command: command_line(),
        }
    }
}

/// Trains, or resumes a training, and writes the model.
pub(super) fn train_nol(a: &TrainNolArguments) -> Result<Summary<Measured<Quality>>> {
    let recipe = checked(a.recipe())?;
    let shown = Shown {
        preparing: "samples",
        measuring: "model measured",
        message: |record| {
            format!(
                "colours {:.3}, features {:.3}, PSNR {:.2} dB (decoded {:.2}, averaging {:.2}), {:.2} steps/s",
                loss(record, "colours"),
                loss(record, "features"),
                psnr(loss(record, "squared error")),
                psnr(loss(record, "squared error decoded")),
                psnr(loss(record, "squared error of averaging")),
                record.samples_per_second
            )
        },
    };
    let trained = train_in(&recipe, (), &a.out, a.export, shown)?;
    Ok(summary(trained, |quality| Measured { quality }))
}
