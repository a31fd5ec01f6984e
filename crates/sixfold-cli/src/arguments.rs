//! The command line, defined once for parsing, `--help` and completions.

use clap::{Parser, Subcommand};
use sixfold_shell::meshes::MeshArguments;

use sixfold_shell::PixelLimit;

use crate::commands::NETWORKS;
use crate::commands::board::BoardArguments;
use crate::commands::calibrate::CalibrateArguments;
use crate::commands::completions::CompletionsArguments;
use crate::commands::demo::DemoArguments;
use crate::commands::detect_arguments::DetectArguments;
use crate::commands::estimate::arguments::{AFTER_HELP as ESTIMATE_HELP, EstimateArguments};
use crate::commands::eval::EvalArguments;
use crate::commands::experiments::Forwarded;
use crate::commands::grasp::arguments::GraspArguments;
use crate::commands::import::ImportArguments;
use crate::commands::object::arguments::ObjectArguments;
use crate::commands::render::RenderArguments;
use crate::commands::serve::ServeArguments;
use crate::commands::simulate::SimulateArguments;
use crate::commands::synthesize::{AFTER_HELP as SYNTHESIZE_HELP, SynthesizeArguments};
use crate::commands::teach::{AFTER_HELP as TEACH_HELP, TeachArguments};
use crate::commands::train::TrainArguments;
use sixfold_shell::processor::ProcessorArguments;

/// 6D object pose and grasp transfer from little data.
#[derive(Debug, Parser)]
#[command(
    name = "sixfold",
    version,
    after_help = "Example:\n  sixfold demo\n\nExit status: 0 found, 1 nothing found, 2 error."
)]
pub(crate) struct Arguments {
    #[command(flatten)]
    pub processor: ProcessorArguments,
    #[command(flatten)]
    pub images: PixelLimit,
    #[command(flatten)]
    pub meshes: MeshArguments,
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Find poses in the sample frames, score them and write overlays
    #[command(after_help = "Example:\n  sixfold demo --out out/demo")]
    Demo(DemoArguments),
    /// Estimate the 6D pose of known objects, in one image or in a whole dataset
    #[command(after_help = ESTIMATE_HELP)]
    Estimate(Box<EstimateArguments>),
    /// Detect objects in colour images: boxes and masks, for `sixfold estimate` or any COCO tool
    #[command(hide = !NETWORKS, after_help = "Examples:\n  \
        sixfold detect --weights detector.safetensors --rgb c.png --out out\n  \
        sixfold detect --method views --object mug.ply can.ply --unit mm --rgb c.png --out out\n  \
        sixfold detect --method views --dataset lmo --out detections.json\n  \
        sixfold detect --weights detector.safetensors --dataset lmo --out detections.json")]
    Detect(Box<DetectArguments>),
    /// Score a result file against the ground truth of a BOP dataset
    #[command(
        after_help = "Example:\n  sixfold eval --dataset lmo --results results.csv --curves curves.png"
    )]
    Eval(EvalArguments),
    /// Propose grasps of a parallel-jaw gripper from depth, and try them in simulation
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
    /// Drop objects on a plane, render them from all around, and write a BOP dataset with ground truth
    #[cfg(feature = "physics")]
    #[command(
        name = "simulate-scenes",
        after_help = crate::commands::simulate_scenes::arguments::AFTER_HELP
    )]
    SimulateScenes(Box<crate::commands::simulate_scenes::arguments::SimulateScenesArguments>),
    /// Convert a dataset of another format into a BOP dataset
    #[command(after_help = "Examples:\n  \
        sixfold import ho3d HO3D_v3 --models YCB_Video_Models/models --every 30 --out ho3d\n  \
        sixfold import smot SMOT --split train --out smot\n  \
        sixfold import nol obj_01.hdf5 --camera camera_SMOT.json --out nol-source")]
    Import(ImportArguments),
    /// Make a training set of new views from at most sixteen cluttered photographs with rough poses
    #[command(hide = !NETWORKS, after_help = SYNTHESIZE_HELP)]
    Synthesize(Box<SynthesizeArguments>),
    /// Train a network
    #[command(
        hide = !NETWORKS,
        after_help = "Example:\n  sixfold train pix2pose --dataset lmo --frames frames.json --out out/lmo"
    )]
    Train(TrainArguments),
    /// Measure a method on a dataset as its paper does, with its ablations (runs sixfold-experiments)
    #[command(disable_help_flag = true)]
    Reproduce(Forwarded),
    /// Keep objects under a name: add, list, show, remove
    #[command(after_help = "Example:\n  sixfold object add mug mug.ply --unit mm")]
    Object(ObjectArguments),
    /// Write a board of AprilTags to print, for `sixfold teach` and `sixfold calibrate`
    #[command(after_help = "Example:\n  sixfold board --paper a4 --out board.pdf")]
    Board(BoardArguments),
    /// Compute a camera's intrinsics, and its pose in each photograph, from photographs of the printed board
    #[command(after_help = "Examples:\n  \
        sixfold calibrate photographs --out out/calibration\n  \
        sixfold calibrate photographs --camera out/calibration/camera.json --out out/poses")]
    Calibrate(CalibrateArguments),
    /// Learn a new object from photographs of it, on the printed board or without one, and store it under a name
    #[command(hide = !NETWORKS, after_help = TEACH_HELP)]
    Teach(Box<TeachArguments>),
    /// Start a server with web pages and an HTTP API for objects, poses and grasps
    #[command(hide = !crate::commands::serve::IS_BUILT_IN, after_help = crate::commands::serve::AFTER_HELP)]
    Serve(Box<ServeArguments>),
    /// Print shell completions
    #[command(
        after_help = "Example:\n  sixfold completions bash > ~/.local/share/bash-completion/completions/sixfold"
    )]
    Completions(CompletionsArguments),
}
