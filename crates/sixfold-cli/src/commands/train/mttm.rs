//! `sixfold train mttm`: synthetic objects fall on a table, depth cameras view them, and a network learns to match regions
//! with templates. The only input is a seed.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use sixfold_mttm::quality::Quality;
use sixfold_mttm::recipe::{MttmKind, MttmRecipe};
use sixfold_nn::choice::Choice;

use super::options::{Preset, ResultArguments, by_network, choices, presets};
use super::{Measured, Shown, Summary, checked, command_line, loss, summary, train_in};

fn default() -> MttmRecipe {
    MttmRecipe::default()
}

const SCENES: &str = "Scenes in which they fall on a table, made at the start; each is seen by five cameras";

/// Help with the defaults of both networks.
fn help(what: &str, of: impl Fn(MttmKind) -> String) -> String {
    by_network(what, of(MttmKind::Compact), of(MttmKind::Paper))
}

#[derive(Debug, Args)]
pub(crate) struct TrainMttmArguments {
    /// Train as published (docs/coverage.md): the dissertation's network, losses, negative templates and number of scenes
    #[arg(long, value_parser = choices::<Preset>())]
    pub preset: Option<Preset>,
    #[arg(long, value_parser = choices::<MttmKind>(), help = presets("Network", default().network.name(), MttmRecipe::published().network.name()))]
    pub network: Option<MttmKind>,
    /// ImageNet weights of ResNet-50 in torchvision's layout (.pth), for --network paper
    #[arg(long, value_name = "FILE")]
    pub encoder: Option<PathBuf>,
    #[arg(long, value_name = "N", help = help("Training steps", |k| k.options().common.steps.to_string()))]
    pub steps: Option<u64>,
    #[arg(
        long,
        value_name = "N",
        help = help("Regions with an object in a step", |k| k.options().batch.anchors.to_string())
    )]
    pub anchors: Option<usize>,
    #[arg(
        long,
        value_name = "RATE",
        help = help("Maximum learning rate", |k| k.options().common.learning_rate.to_string())
    )]
    pub learning_rate: Option<f64>,
    /// Synthetic objects: half of them household shapes, half of them toys
    #[arg(long, value_name = "N", default_value_t = default().objects)]
    pub objects: usize,
    #[arg(long, value_name = "N", help = presets(SCENES, default().scenes, MttmRecipe::published().scenes))]
    pub scenes: Option<usize>,
    /// Seed of weights, objects, scenes and samples
    #[arg(long, default_value_t = default().seed)]
    pub seed: u64,
    #[command(flatten)]
    pub result: ResultArguments,
}

impl TrainMttmArguments {
    pub(super) fn recipe(&self) -> MttmRecipe {
        let default = if self.preset.is_some() { MttmRecipe::published() } else { default() };
        MttmRecipe {
            network: self.network.unwrap_or(default.network),
            encoder: self.encoder.clone(),
            steps: self.steps,
            anchors: self.anchors,
            learning_rate: self.learning_rate,
            objects: self.objects,
            scenes: self.scenes.unwrap_or(default.scenes),
            seed: self.seed,
            command: command_line(),
        }
    }
}

/// Trains, or resumes a training, and writes the model.
pub(super) fn train_mttm(a: &TrainMttmArguments) -> Result<Summary<Measured<Quality>>> {
    let recipe = checked(a.recipe())?;
    // Scenes are made before and after the training.
    let shown = Shown {
        preparing: "scenes",
        measuring: "test scenes",
        message: |record| {
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
        },
    };
    let trained = train_in(&recipe, (), &a.result.out, a.result.export, shown)?;
    Ok(summary(trained, |quality| Measured { quality }))
}
