//! `sixfold train detector`: trains a detector from photographs with ground truth and from models, and writes its file.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use sixfold_detect::network::EncoderKind;
use sixfold_detect::recipe::{DetectorKind, DetectorRecipe, MIN_VISIBILITY};
use sixfold_nn::choice::Choice;

use super::options::{Degrees, Preset, choices, presets};
use super::{
    LearntFrom, MaterialArguments, Shown, Summary, checked, command_line, loss, summary, train_in,
    training_set,
};

fn default() -> DetectorRecipe {
    DetectorRecipe::default()
}

fn published() -> DetectorRecipe {
    DetectorRecipe::published()
}

const PHOTOGRAPHS: &str = "Fraction of training images that are parts of photographs, 0 to 1";
const RENDERS: &str = "Fraction of renders among the pasted objects of which there are photographs, 0 to 1";

#[derive(Debug, Args)]
pub(crate) struct TrainDetectorArguments {
    #[command(flatten)]
    pub material: MaterialArguments,
    /// Folder for checkpoints, learning curves and the finished model
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Train as published, as far as implemented (docs/coverage.md): ResNet-50, only objects cut out of photographs
    #[arg(long, value_parser = choices::<Preset>())]
    pub preset: Option<Preset>,
    #[arg(long, value_parser = choices::<DetectorKind>(), help = presets("Network to train", default().network.name(), published().network.name()))]
    pub network: Option<DetectorKind>,
    /// Encoder of the networks with anchors (default: resnet50, or that of --init)
    #[arg(long, value_parser = choices::<EncoderKind>())]
    pub backbone: Option<EncoderKind>,
    /// Training steps
    #[arg(long, value_name = "N", default_value_t = default().steps)]
    pub steps: u64,
    /// Images in a step
    #[arg(long, value_name = "N", default_value_t = default().batch)]
    pub batch: usize,
    /// Maximum learning rate
    #[arg(long, value_name = "RATE", default_value_t = default().learning_rate)]
    pub learning_rate: f64,
    /// Learning rate of the pretrained encoder, as a fraction of --learning-rate, 0 to 1
    #[arg(long, value_name = "FRACTION", default_value_t = default().encoder_rate)]
    pub encoder_rate: f64,
    /// Number of the five stages of the ImageNet encoder that are not trained
    #[arg(long, value_name = "N", default_value_t = default().frozen_stages)]
    pub frozen_stages: usize,
    /// torchvision's ResNet-50 weights (.pth or .safetensors) for --network retinanet (default: random). For the networks with anchors
    /// on ResNet-50, which need it, these or torchvision's weights of the same network, as trained on COCO
    #[arg(long, value_name = "FILE")]
    pub encoder: Option<PathBuf>,
    /// Side of the training images in pixels, a multiple of 32 (retinanet: 128)
    #[arg(long, value_name = "PIXELS", default_value_t = default().size)]
    pub size: usize,
    #[arg(long, value_name = "FRACTION", help = presets(PHOTOGRAPHS, default().photograph_fraction, published().photograph_fraction))]
    pub photograph_fraction: Option<f32>,
    #[arg(long, value_name = "FRACTION", help = presets(RENDERS, default().render_fraction, published().render_fraction))]
    pub render_fraction: Option<f32>,
    /// Largest rotation in the image plane, degrees
    #[arg(long, value_name = "DEGREES", default_value_t = Degrees { radians: default().rotation })]
    pub rotation: Degrees,
    /// Render the meshes in random colours, for CAD models without texture
    #[arg(long)]
    pub no_mesh_colors: bool,
    /// Larger images are reduced to this length of their longer side, pixels, before detection
    #[arg(long, value_name = "PIXELS", default_value_t = default().longest_side)]
    pub longest_side: usize,
    /// Default score threshold of the detector, 0 to 1
    #[arg(long, value_name = "SCORE", default_value_t = default().threshold)]
    pub threshold: f32,
    /// Continue from the weights of another training of the same objects instead of ImageNet's
    #[arg(long, value_name = "FILE.safetensors")]
    pub init: Option<PathBuf>,
    /// Do not train: write the model of the last checkpoint in --out
    #[arg(long)]
    pub export: bool,
    /// Seed of weights and samples
    #[arg(long, default_value_t = default().seed)]
    pub seed: u64,
}

impl TrainDetectorArguments {
    pub(super) fn recipe(&self) -> DetectorRecipe {
        let default = if self.preset.is_some() { published() } else { default() };
        DetectorRecipe {
            network: self.network.unwrap_or(default.network),
            backbone: self.backbone,
            steps: self.steps,
            batch: self.batch,
            learning_rate: self.learning_rate,
            encoder_rate: self.encoder_rate,
            frozen_stages: self.frozen_stages,
            encoder: self.encoder.clone(),
            size: self.size,
            photograph_fraction: self.photograph_fraction.unwrap_or(default.photograph_fraction),
            render_fraction: self.render_fraction.unwrap_or(default.render_fraction),
            rotation: self.rotation.radians,
            mesh_colors: !self.no_mesh_colors,
            longest_side: self.longest_side,
            threshold: self.threshold,
            init: self.init.clone(),
            backgrounds: self.material.backgrounds.clone(),
            seed: self.seed,
            command: command_line(),
        }
    }
}

/// Trains, or resumes a training, and writes the model.
pub(super) fn train_detector(a: &TrainDetectorArguments) -> Result<Summary<LearntFrom>> {
    let recipe = checked(a.recipe())?;
    let material = training_set(&a.material, MIN_VISIBILITY)?;
    let objects = material.objects.iter().map(|o| o.id).collect();
    let learnt_from = LearntFrom { objects, photographs: material.images.len() };
    let shown = Shown {
        preparing: "samples",
        measuring: "model measured",
        message: |record| {
            let [scores, boxes, masks] = ["scores", "boxes", "masks"].map(|name| loss(record, name));
            let speed = record.samples_per_second;
            format!("scores {scores:.3}, boxes {boxes:.3}, masks {masks:.3}, {speed:.1} images/s")
        },
    };
    let trained = train_in(&recipe, material, &a.out, a.export, shown)?;
    Ok(summary(trained, |()| learnt_from))
}
