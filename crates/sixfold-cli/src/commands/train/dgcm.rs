//! `sixfold train dgcm`: trains a network for grasps from experience; the only input is a seed.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use serde::Serialize;
use sixfold_dgcm::quality::Quality;
use sixfold_dgcm::recipe::{DgcmKind, DgcmRecipe};
use sixfold_nn::choice::Choice;

use super::options::{Preset, ResultArguments, by_network, choices, presets};
use super::{Shown, Summary, checked, command_line, loss, summary, train_in};

fn default() -> DgcmRecipe {
    DgcmRecipe::default()
}

fn published() -> DgcmRecipe {
    DgcmRecipe::published()
}

const VIEWS: &str = "Simulated views to learn from, made at the start (about 35 kB of memory each)";

/// Help with the defaults of both networks.
fn help(what: &str, of: impl Fn(DgcmKind) -> String) -> String {
    by_network(what, of(DgcmKind::Compact), of(DgcmKind::Paper))
}

fn pairs_help() -> String {
    let (compact, paper) = (DgcmKind::Compact.options(), DgcmKind::Paper.options());
    let default = format!("{}, with {} negative ones", compact.pairs, compact.negatives);
    by_network("Positive pairs in a step", default, format!("{} of both", paper.pairs))
}

#[derive(Debug, Args)]
pub(crate) struct TrainDgcmArguments {
    /// Train as published (docs/coverage.md): the dissertation's network, pairs, rate and views
    #[arg(long, value_parser = choices::<Preset>())]
    pub preset: Option<Preset>,
    #[arg(long, value_parser = choices::<DgcmKind>(), help = presets("Network", default().network.name(), published().network.name()))]
    pub network: Option<DgcmKind>,
    /// ImageNet weights of ResNet-50 in torchvision's layout (.pth), for --network paper
    #[arg(long, value_name = "FILE")]
    pub encoder: Option<PathBuf>,
    /// Continue from the weights of such a training
    #[arg(long, value_name = "FILE.safetensors")]
    pub init: Option<PathBuf>,
    /// Train only the alignment of both views; everything else stays as in --init
    #[arg(long, requires = "init")]
    pub alignment_only: bool,
    #[arg(long, value_name = "N", help = help("Training steps", |k| k.options().common.steps.to_string()))]
    pub steps: Option<u64>,
    #[arg(long, value_name = "N", help = pairs_help())]
    pub pairs: Option<usize>,
    #[arg(
        long,
        value_name = "RATE",
        help = help("Maximum learning rate", |k| k.options().common.learning_rate.to_string())
    )]
    pub learning_rate: Option<f64>,
    #[arg(
        long,
        value_name = "WEIGHT",
        help = help("Weight of the coordinate loss relative to the feature loss", |k| k.options().lambda.to_string())
    )]
    pub lambda: Option<f64>,
    #[arg(long, value_name = "N", help = presets(VIEWS, default().views, published().views))]
    pub views: Option<usize>,
    /// Seed of weights, objects, views and pairs
    #[arg(long, default_value_t = default().seed)]
    pub seed: u64,
    #[command(flatten)]
    pub result: ResultArguments,
}

impl TrainDgcmArguments {
    pub(super) fn recipe(&self) -> DgcmRecipe {
        let default = if self.preset.is_some() { published() } else { default() };
        DgcmRecipe {
            network: self.network.unwrap_or(default.network),
            encoder: self.encoder.clone(),
            init: self.init.clone(),
            alignment_only: self.alignment_only,
            steps: self.steps,
            pairs: self.pairs,
            learning_rate: self.learning_rate,
            lambda: self.lambda,
            views: self.views.unwrap_or(default.views),
            seed: self.seed,
            command: command_line(),
        }
    }
}

/// The amount of training data, and what the model is worth on other objects.
#[derive(Serialize)]
pub(super) struct OnViews {
    views: usize,
    pub quality: Quality,
}

/// Trains, or resumes a training, and writes the model.
pub(super) fn train_dgcm(a: &TrainDgcmArguments) -> Result<Summary<OnViews>> {
    let recipe = checked(a.recipe())?;
    let shown = Shown {
        preparing: "views",
        measuring: "test views",
        message: |record| {
            let of = |name| record.losses.contains_key(name).then(|| loss(record, name));
            let metric = of("metric").map_or(String::new(), |metric| {
                let (near, far) = (loss(record, "positive distance"), loss(record, "negative distance"));
                format!("metric {metric:.2}, distance {near:.2} of similar and {far:.2} of different pairs, ")
            });
            let aligned = of("aligned error on the object");
            let aligned = aligned.map_or(String::new(), |error| format!(" ({error:.3} after alignment)"));
            let (off, speed) = (loss(record, "error on the object"), record.samples_per_second);
            format!("{metric}coordinates off by {off:.3}{aligned}, {speed:.0} pairs/s")
        },
    };
    let trained = train_in(&recipe, (), &a.result.out, a.result.export, shown)?;
    Ok(summary(trained, |quality| OnViews { views: recipe.views, quality }))
}
