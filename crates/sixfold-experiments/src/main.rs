//! The program `sixfold-experiments`: methods measured as in their papers, and repeated trials of grasps in simulation. The
//! program `sixfold` runs it for `sixfold reproduce`, `sixfold grasp compare` and `sixfold grasp measure`.
//!
//! Exit status: 0 found, 1 nothing found, 2 error.

// All output goes through `sixfold_shell::screen`, whose macros replace the standard ones.
#[macro_use]
extern crate sixfold_shell;

mod charts;
mod grasp;
mod reproduce;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use sixfold_shell::idle::{Idle, When};
use sixfold_shell::meshes::MeshArguments;
use sixfold_shell::processor::ProcessorArguments;
use sixfold_shell::screen::parse;
use sixfold_shell::{PixelLimit, exit_code, progress};

/// Options that would have no effect in combination with others, and are refused.
const IDLE: &[Idle] = &[
    Idle { command: "grasp measure", options: &["unit", "store"], when: &[When::Without("objects")] },
    Idle { command: "grasp compare", options: &["unit", "store"], when: &[When::Without("objects")] },
    Idle { command: "grasp compare", options: &["gpd", "haf"], when: &[When::With("published_rules")] },
];

/// Experiments of Sixfold: methods measured as their papers do, grasps tried in simulation.
#[derive(Debug, Parser)]
#[command(
    name = "sixfold-experiments",
    version,
    after_help = "The program sixfold runs these commands too, where it finds this one.\n\n\
        Exit status: 0 found, 1 nothing found, 2 error."
)]
struct Arguments {
    #[command(flatten)]
    processor: ProcessorArguments,
    #[command(flatten)]
    images: PixelLimit,
    #[command(flatten)]
    meshes: MeshArguments,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Measure a method on a dataset as its paper does, with its ablations: one table from one command
    #[command(
        after_help = "Example:\n  sixfold reproduce pix2pose --dataset lmo --frames frames.json --weights model.safetensors --out out/reproduce"
    )]
    Reproduce(reproduce::ReproduceArguments),
    /// Grasps of a parallel-jaw gripper, measured in simulation
    Grasp(grasp::GraspArguments),
    /// Write the charts of the documentation from the result files, or check them
    #[command(after_help = "Example:\n  sixfold-experiments charts --check")]
    Charts(charts::ChartsArguments),
}

fn main() -> ExitCode {
    let arguments = match parse::<Arguments>(IDLE) {
        Ok(arguments) => arguments,
        Err(code) => return code,
    };
    progress::catch_interrupts();
    arguments.images.set();
    arguments.meshes.apply();
    exit_code(&arguments.processor.prepare().and_then(|()| match &arguments.command {
        Command::Reproduce(a) => reproduce::run(a),
        Command::Grasp(a) => grasp::run(a),
        Command::Charts(a) => charts::run(a),
    }))
}
