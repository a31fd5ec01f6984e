//! The command line, defined once: parsing, `--help` and completions all come from here.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use sixfold_shell::output::JsonArguments;
use sixfold_shell::training::MaterialArguments;

use crate::commands::completions::CompletionsArguments;
use crate::commands::demo::arguments::DemoArguments;
use crate::commands::detect_arguments::DetectArguments;
use crate::commands::estimate_arguments::EstimateArguments;
use crate::commands::eval::EvalArguments;
use crate::commands::experiments::Forwarded;
use crate::commands::grasp::arguments::GraspArguments;
use crate::commands::object_arguments::ObjectArguments;
use crate::commands::render::RenderArguments;
use crate::commands::simulate::SimulateArguments;

/// 6D object pose and grasp transfer from little data.
#[derive(Debug, Parser)]
#[command(
    name = "sixfold",
    version,
    after_help = "Example:\n  sixfold demo\n\nExit status: 0 found, 1 nothing found, 2 error."
)]
pub(crate) struct Arguments {
    /// Use this many threads (default: all cores); the results are the same for any number
    #[arg(long, global = true, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Estimate poses in the sample frames of this repository, score them and draw them
    #[command(after_help = "Example:\n  sixfold demo --out out/demo")]
    Demo(DemoArguments),
    /// Estimate the 6D pose of known objects, in one image or in a whole dataset
    #[command(after_help = "Examples:\n  \
        sixfold estimate --depth d.png --rgb c.png --camera camera.json --object mug.ply --unit mm --out out\n  \
        sixfold estimate --method pix2pose --weights model.safetensors --rgb c.png --camera camera.json --object mug.ply --unit mm --box 210,140,90,120 --out out\n  \
        sixfold estimate --method mttm --depth d.png --camera camera.json --object mug --out out\n  \
        sixfold estimate --dataset lmo --split test --out results.csv\n  \
        sixfold estimate --method pix2pose --weights model.safetensors --dataset lmo --boxes gt --out results.csv")]
    Estimate(Box<EstimateArguments>),
    /// Detect objects in colour images: boxes and masks, for `sixfold estimate` or any COCO tool
    #[command(after_help = "Examples:\n  \
        sixfold detect --weights detector.safetensors --rgb c.png --out out\n  \
        sixfold detect --weights detector.safetensors --dataset lmo --out detections.json")]
    Detect(Box<DetectArguments>),
    /// Score a result file against the ground truth of a BOP dataset
    #[command(
        after_help = "Example:\n  sixfold eval --dataset lmo --results results.csv --curves curves.png"
    )]
    Eval(EvalArguments),
    /// Grasps of a parallel-jaw gripper: propose them from depth, try them in simulation
    #[command(
        after_help = "Example:\n  sixfold grasp propose --depth d.png --camera camera.json --mask mask.png --out out"
    )]
    Grasp(GraspArguments),
    /// Render an object: depth, mask, normals, object coordinates, colour
    #[command(
        after_help = "Example:\n  sixfold render --object mug.ply --unit mm --camera camera.json --pose 0,0,0.6,0.5,0,0 --out out/mug"
    )]
    Render(RenderArguments),
    /// Write a dataset with simulated depth images, rendered from ground-truth poses on a table
    #[command(
        name = "simulate-depth",
        after_help = "Example:\n  sixfold simulate-depth --dataset lmo --split test --out lmo-simulated"
    )]
    SimulateDepth(SimulateArguments),
    /// Drop objects on a plane and write images of them from all around as a BOP dataset with ground truth
    #[cfg(feature = "physics")]
    #[command(
        name = "simulate-scenes",
        after_help = crate::commands::simulate_scenes::arguments::AFTER_HELP
    )]
    SimulateScenes(Box<crate::commands::simulate_scenes::arguments::SimulateScenesArguments>),
    /// Make a training set of new views from at most sixteen cluttered photographs with rough poses
    #[command(after_help = crate::commands::synthesize::arguments::AFTER_HELP)]
    Synthesize(Box<crate::commands::synthesize::arguments::SynthesizeArguments>),
    /// Train a network on a few posed photographs and renders
    #[command(
        after_help = "Example:\n  sixfold train pix2pose --dataset lmo --frames frames.json --out out/lmo"
    )]
    Train(TrainArguments),
    /// Measure a method on a dataset as its paper does, with its ablations (runs sixfold-experiments)
    #[command(disable_help_flag = true)]
    Reproduce(Forwarded),
    /// Keep objects under a name: add, list, show, remove
    #[command(after_help = "Example:\n  sixfold object add mug mug.ply --unit mm")]
    Object(ObjectArguments),
    /// Print shell completions
    #[command(
        after_help = "Example:\n  sixfold completions bash > ~/.local/share/bash-completion/completions/sixfold"
    )]
    Completions(CompletionsArguments),
}

#[derive(Debug, Args)]
pub(crate) struct TrainArguments {
    #[command(subcommand)]
    pub command: TrainCommand,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Subcommand)]
pub(crate) enum TrainCommand {
    /// Per-pixel object coordinates from RGB: poses with `sixfold estimate --method pix2pose`
    #[command(after_help = "Examples:\n  \
        sixfold train pix2pose --dataset lmo --frames frames.json --out out/lmo\n  \
        sixfold train pix2pose --object mug.ply --unit mm --out out/mug\n\n\
        Interrupted, it goes on when the same command is given again.")]
    Pix2pose(Box<TrainPix2PoseArguments>),
    /// Boxes and masks of objects in colour images: `sixfold detect`, `sixfold estimate --detector`
    #[command(after_help = "Examples:\n  \
        sixfold train detector --dataset lmo --frames frames.json --backgrounds photographs --out out/detector\n  \
        sixfold train detector --object mug.ply --unit mm --out out/mug-detector\n\n\
        Interrupted, it goes on when the same command is given again.")]
    Detector(Box<TrainDetectorArguments>),
    /// Train the network that transfers grasps from experience, on made-up objects
    #[cfg(feature = "experience")]
    #[command(after_help = "Example:\n  sixfold train dgcm --out out/dgcm\n\n\
        Stopped, the same command goes on.")]
    Dgcm(Box<crate::commands::train_dgcm::TrainDgcmArguments>),
    /// Train the network that finds objects by their templates in depth, on made-up objects
    #[cfg(feature = "physics")]
    #[command(after_help = "Example:\n  sixfold train mttm --out out/mttm\n\n\
        Stopped, the same command goes on.")]
    Mttm(Box<crate::commands::train_mttm::TrainMttmArguments>),
    /// Train the network that renders new views of an object from few photographs, on made-up objects
    #[command(after_help = "Example:\n  sixfold train nol --backgrounds photographs --out out/nol\n\n\
        Stopped, the same command goes on.")]
    Nol(Box<crate::commands::train_nol::TrainNolArguments>),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum DetectorKind {
    /// EfficientNet-Lite0 with a pyramid of three levels; trains on two cores
    Compact,
    /// ResNet-50 with RetinaNet's pyramid and heads, as in the dissertation; asks for a GPU or patience
    Retinanet,
}

impl DetectorKind {
    /// As the library has it.
    pub fn kind(self) -> sixfold_detect::recipe::DetectorKind {
        match self {
            DetectorKind::Compact => sixfold_detect::recipe::DetectorKind::Compact,
            DetectorKind::Retinanet => sixfold_detect::recipe::DetectorKind::Retinanet,
        }
    }
}

#[derive(Debug, Args)]
pub(crate) struct TrainDetectorArguments {
    #[command(flatten)]
    pub material: MaterialArguments,
    /// Folder for checkpoints, learning curves and the finished model
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Which network learns
    #[arg(long, value_enum, default_value = "compact")]
    pub network: DetectorKind,
    /// Training steps
    #[arg(long, value_name = "N", default_value = "8000")]
    pub steps: u64,
    /// Images in a step
    #[arg(long, value_name = "N", default_value = "4")]
    pub batch: usize,
    /// Highest learning rate
    #[arg(long, value_name = "RATE", default_value = "0.002")]
    pub learning_rate: f64,
    /// The pretrained encoder's share of the learning rate, 0 to 1
    #[arg(long, value_name = "SHARE", default_value = "0.3")]
    pub encoder_share: f64,
    /// Stages of the ImageNet encoder that stay as they are, of five
    #[arg(long, value_name = "N", default_value = "2")]
    pub frozen_stages: usize,
    /// torchvision's ResNet-50 weights (.pth or .safetensors) for --network retinanet (default: random)
    #[arg(long, value_name = "FILE")]
    pub encoder: Option<PathBuf>,
    /// Side of the training images in pixels, a multiple of 32 (retinanet: 128)
    #[arg(long, value_name = "PIXELS", default_value = "320")]
    pub size: usize,
    /// Share of training images that are parts of photographs, 0 to 1
    #[arg(long, value_name = "SHARE", default_value = "0.45")]
    pub photograph_share: f32,
    /// Share of renders among pasted objects that have photographs, 0 to 1
    #[arg(long, value_name = "SHARE", default_value = "0.4")]
    pub render_share: f32,
    /// Largest turn in the image plane, degrees
    #[arg(long, value_name = "DEGREES", default_value = "15")]
    pub rotation: f32,
    /// Draw the meshes in random colours, as untextured CAD models
    #[arg(long)]
    pub no_mesh_colors: bool,
    /// Larger images will be reduced to so many pixels along their longer side before detection
    #[arg(long, value_name = "PIXELS", default_value = "640")]
    pub longest_side: usize,
    /// Score below which detections will be left out unless something else is asked for, 0 to 1
    #[arg(long, value_name = "SCORE", default_value = "0.4")]
    pub threshold: f32,
    /// Go on from the weights of another training of the same objects instead of ImageNet's
    #[arg(long, value_name = "FILE.safetensors")]
    pub init: Option<PathBuf>,
    /// Train no further: write the model of the last checkpoint in --out
    #[arg(long)]
    pub export: bool,
    /// Seed of weights and samples
    #[arg(long, default_value = "0")]
    pub seed: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum NetworkKind {
    /// ImageNet encoder shared by all objects, a small decoder for each; trains on two cores
    Compact,
    /// The dissertation's generator with its discriminator, one object; asks for a GPU or patience
    Paper,
    /// The same with a ResNet-50 encoder, as in the entry to BOP 2020
    Resnet50,
}

impl NetworkKind {
    /// As the library has it.
    pub fn kind(self) -> sixfold_pix2pose::recipe::NetworkKind {
        match self {
            NetworkKind::Compact => sixfold_pix2pose::recipe::NetworkKind::Compact,
            NetworkKind::Paper => sixfold_pix2pose::recipe::NetworkKind::Paper,
            NetworkKind::Resnet50 => sixfold_pix2pose::recipe::NetworkKind::ResNet50,
        }
    }
}

/// An experiment of the dissertation's chapter 3.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Preset {
    /// The entries to the BOP challenges: three thresholds, symmetries of the dataset
    Bop,
    /// LineMOD
    Linemod,
    /// LineMOD Occlusion
    Lmo,
    /// T-LESS
    Tless,
}

impl Preset {
    /// As the library has it.
    pub fn preset(self) -> sixfold_pix2pose::preset::Preset {
        match self {
            Preset::Bop => sixfold_pix2pose::preset::Preset::Bop,
            Preset::Linemod => sixfold_pix2pose::preset::Preset::Linemod,
            Preset::Lmo => sixfold_pix2pose::preset::Preset::Lmo,
            Preset::Tless => sixfold_pix2pose::preset::Preset::Tless,
        }
    }
}

#[derive(Debug, Args)]
pub(crate) struct TrainPix2PoseArguments {
    #[command(flatten)]
    pub material: MaterialArguments,
    /// Folder for checkpoints, learning curves and the finished model
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Which network learns
    #[arg(long, value_enum, default_value = "compact")]
    pub network: NetworkKind,
    /// Training steps; each takes so many images of every object (default: 8000; the dissertation's networks: 25000). 0: the
    /// weights of --init as they are, with their alignment's constant error measured anew
    #[arg(long, value_name = "N")]
    pub steps: Option<u64>,
    /// Images of every object in a step (default: 4; the dissertation's networks: 50)
    #[arg(long, value_name = "N")]
    pub per_object: Option<usize>,
    /// Highest learning rate (default: 0.002; the dissertation's networks: 0.0001)
    #[arg(long, value_name = "RATE")]
    pub learning_rate: Option<f64>,
    /// Train the compact network against discriminators, one an object, as the dissertation's are
    #[arg(long, conflicts_with = "no_adversarial")]
    pub adversarial: bool,
    /// Train a network of the dissertation without its discriminator
    #[arg(long)]
    pub no_adversarial: bool,
    /// torchvision's ResNet-50 weights (.pth or .safetensors) for --network resnet50 (default: random)
    #[arg(long, value_name = "FILE")]
    pub encoder: Option<PathBuf>,
    /// Stages of the ImageNet encoder that stay as they are, of five
    #[arg(long, value_name = "N", default_value = "2")]
    pub frozen_stages: usize,
    /// Share of renders among the images, 0 to 1
    #[arg(long, value_name = "SHARE", default_value = "0.5")]
    pub render_share: f32,
    /// Share of renders whose pose lies near one of a photograph, 0 to 1; the others look from anywhere above
    #[arg(long, value_name = "SHARE", default_value = "0.5")]
    pub near_photographs: f32,
    /// Largest turn of photographs in the image plane, degrees
    #[arg(long, value_name = "DEGREES", default_value = "45")]
    pub rotation: f32,
    /// Side of the network's input in pixels; the output has half of it
    #[arg(long, value_name = "PIXELS", default_value = "128")]
    pub size: usize,
    /// Go on from the weights of another training instead of ImageNet's
    #[arg(long, value_name = "FILE.safetensors")]
    pub init: Option<PathBuf>,
    /// Draw the meshes in random colours, as untextured CAD models
    #[arg(long)]
    pub no_mesh_colors: bool,
    /// Learn the coordinates of the meshes' convex hulls, as if nothing better were known of the objects
    #[arg(long)]
    pub convex_hull: bool,
    /// Plain L1 for symmetric objects instead of the transformer loss
    #[arg(long)]
    pub no_transformer_loss: bool,
    /// Plain L1 with one side of a symmetric object standing for all, instead of the transformer loss
    #[arg(long)]
    pub view_limits: bool,
    /// Symmetric poses, outlier thresholds and occlusion of an experiment of the dissertation (its appendix A) (default:
    /// symmetries of the dataset, thresholds of the BOP entries)
    #[arg(long, value_enum)]
    pub preset: Option<Preset>,
    /// Train no further: write the model of the last checkpoint in --out
    #[arg(long)]
    pub export: bool,
    /// Seed of weights and samples
    #[arg(long, default_value = "0")]
    pub seed: u64,
}
