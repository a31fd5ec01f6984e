//! `sixfold train pix2pose`: trains on posed images and meshes, and writes a model file.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use sixfold_nn::choice::Choice;
use sixfold_pix2pose::adversarial::AdversarialOptions;
use sixfold_pix2pose::preset::Preset;
use sixfold_pix2pose::recipe::{MIN_VISIBILITY, NetworkKind, Pix2PoseRecipe};
use sixfold_pix2pose::training::Pix2PoseTrainingOptions;
use sixfold_shell::progress::Terminal;

use super::options::{self, Degrees, choices, presets};
use super::{
    LearntFrom, MaterialArguments, Summary, by_flag, checked, command_line, summary, training, training_set,
};

fn default() -> Pix2PoseRecipe {
    Pix2PoseRecipe::default()
}

/// The defaults of the compact network and of the dissertation's.
fn defaults() -> (Pix2PoseTrainingOptions, AdversarialOptions) {
    (default().compact_options(), default().dissertation_options())
}

fn steps_help() -> String {
    let (compact, paper) = defaults();
    format!(
        "Training steps, each with --per-object images of every object (default: {}; the dissertation's \
         networks: {}). 0: keep \
         the weights of --init, and only measure the constant error of their alignment again",
        compact.common.steps, paper.steps
    )
}

fn per_object_help() -> String {
    let (compact, paper) = defaults();
    let (compact, paper) = (compact.per_object, paper.batch);
    format!("Images of every object in a step (default: {compact}; the dissertation's networks: {paper})")
}

fn learning_rate_help() -> String {
    let (compact, paper) = defaults();
    let (compact, paper) = (compact.common.learning_rate, paper.learning_rate);
    format!("Maximum learning rate (default: {compact}; the dissertation's networks: {paper})")
}

fn network_help() -> String {
    let (ours, published) = (default().network.name(), Pix2PoseRecipe::published().network.name());
    presets("Network to train", ours, published)
}

fn render_fraction_help() -> String {
    let (ours, published) = (default().render_fraction, Pix2PoseRecipe::published().render_fraction);
    presets("Fraction of renders among the images, 0 to 1", ours, published)
}

/// The published training, or the parameters of one of its experiments.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TrainingPreset {
    /// As in the dissertation.
    Published,
    /// The parameters of one of its experiments.
    Of(Preset),
}

impl TrainingPreset {
    fn experiment(self) -> Option<Preset> {
        match self {
            TrainingPreset::Published => None,
            TrainingPreset::Of(preset) => Some(preset),
        }
    }
}

impl Choice for TrainingPreset {
    const ALL: &'static [TrainingPreset] = &[
        TrainingPreset::Published,
        TrainingPreset::Of(Preset::Bop),
        TrainingPreset::Of(Preset::Linemod),
        TrainingPreset::Of(Preset::Lmo),
        TrainingPreset::Of(Preset::Tless),
    ];

    fn name(self) -> &'static str {
        self.experiment().map_or(options::Preset::Published.name(), Preset::name)
    }

    fn help(self) -> &'static str {
        self.experiment().map_or(options::Preset::Published.help(), Preset::help)
    }
}

#[derive(Debug, Args)]
pub(crate) struct TrainPix2PoseArguments {
    #[command(flatten)]
    pub material: MaterialArguments,
    /// Folder for checkpoints, learning curves and the finished model
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    #[arg(long, value_parser = choices::<NetworkKind>(), help = network_help())]
    pub network: Option<NetworkKind>,
    #[arg(long, value_name = "N", help = steps_help())]
    pub steps: Option<u64>,
    #[arg(long, value_name = "N", help = per_object_help())]
    pub per_object: Option<usize>,
    #[arg(long, value_name = "RATE", help = learning_rate_help())]
    pub learning_rate: Option<f64>,
    /// Train the compact network with a discriminator for each object, as in the dissertation
    #[arg(long, conflicts_with = "no_adversarial")]
    pub adversarial: bool,
    /// Train a network of the dissertation without its discriminator
    #[arg(long)]
    pub no_adversarial: bool,
    /// torchvision's ResNet-50 weights (.pth or .safetensors) for --network resnet50 (default: random)
    #[arg(long, value_name = "FILE")]
    pub encoder: Option<PathBuf>,
    /// Number of the five stages of the ImageNet encoder that are not trained
    #[arg(long, value_name = "N", default_value_t = default().frozen_stages)]
    pub frozen_stages: usize,
    #[arg(long, value_name = "FRACTION", help = render_fraction_help())]
    pub render_fraction: Option<f32>,
    /// Fraction of renders with a pose near that of a photograph, 0 to 1; the others are from any direction above
    #[arg(long, value_name = "FRACTION", default_value_t = default().near_photographs)]
    pub near_photographs: f32,
    /// Largest rotation of photographs in the image plane, degrees
    #[arg(long, value_name = "DEGREES", default_value_t = Degrees { radians: default().rotation })]
    pub rotation: Degrees,
    /// Side of the network's input in pixels; the output has half of it
    #[arg(long, value_name = "PIXELS", default_value_t = default().size)]
    pub size: usize,
    /// Continue from the weights of another training instead of ImageNet's
    #[arg(long, value_name = "FILE.safetensors")]
    pub init: Option<PathBuf>,
    /// Render the meshes in random colours, for CAD models without texture
    #[arg(long)]
    pub no_mesh_colors: bool,
    /// Train on the meshes' convex hulls, as if the exact meshes were not known
    #[arg(long)]
    pub convex_hull: bool,
    /// Plain L1 for symmetric objects instead of the transformer loss
    #[arg(long)]
    pub no_transformer_loss: bool,
    /// Plain L1 with poses limited to one side of a symmetric object, instead of the transformer loss
    #[arg(long)]
    pub view_limits: bool,
    /// Train as published; or take symmetric poses, outlier thresholds and occlusion of an experiment of the dissertation (its
    /// appendix A); or both, with a comma (default: symmetries of the dataset, thresholds of the BOP entries)
    #[arg(long, value_name = "NAME[,NAME]", value_parser = choices::<TrainingPreset>(), value_delimiter = ',')]
    pub preset: Vec<TrainingPreset>,
    /// Do not train: write the model of the last checkpoint in --out
    #[arg(long)]
    pub export: bool,
    /// Seed of weights and samples
    #[arg(long, default_value_t = default().seed)]
    pub seed: u64,
}

impl TrainPix2PoseArguments {
    pub(super) fn recipe(&self) -> Pix2PoseRecipe {
        let published = self.preset.contains(&TrainingPreset::Published);
        let default = if published { Pix2PoseRecipe::published() } else { default() };
        Pix2PoseRecipe {
            network: self.network.unwrap_or(default.network),
            published,
            steps: self.steps,
            per_object: self.per_object,
            learning_rate: self.learning_rate,
            adversarial: self.adversarial.then_some(true).or(self.no_adversarial.then_some(false)),
            encoder: self.encoder.clone(),
            frozen_stages: self.frozen_stages,
            render_fraction: self.render_fraction.unwrap_or(default.render_fraction),
            near_photographs: self.near_photographs,
            rotation: self.rotation.radians,
            size: self.size,
            init: self.init.clone(),
            mesh_colors: !self.no_mesh_colors,
            convex_hull: self.convex_hull,
            transformer_loss: !self.no_transformer_loss,
            view_limits: self.view_limits,
            preset: self.preset.iter().find_map(|preset| preset.experiment()),
            backgrounds: self.material.backgrounds.clone(),
            seed: self.seed,
            command: command_line(),
        }
    }
}

/// Trains, or resumes a training, and writes the model.
pub(crate) fn train_pix2pose(a: &TrainPix2PoseArguments) -> Result<Summary<LearntFrom>> {
    let recipe = checked(a.recipe())?;
    let material = training_set(&a.material, MIN_VISIBILITY)?;
    let objects = material.objects.iter().map(|o| o.id).collect();
    let learnt_from = LearntFrom { objects, photographs: material.images.len() };
    let trained =
        training::train_pix2pose(&recipe, material, &a.out, a.export, &Terminal::default(), by_flag)?;
    Ok(summary(trained, |()| learnt_from))
}
