//! `sixfold grasp compare` and `sixfold grasp measure`: repeated trials of grasps in simulation.

pub(crate) mod compare;
mod measure;
pub(crate) mod ways;

use anyhow::Result;
use clap::{Args, Subcommand};
use sixfold_shell::Outcome;

#[derive(Debug, Args)]
pub(crate) struct GraspArguments {
    #[command(subcommand)]
    pub command: GraspCommand,
}

#[derive(Debug, Subcommand)]
pub(crate) enum GraspCommand {
    /// Measure the planner: objects on a table, simulated depth views, proposals tried in a physics engine
    #[command(after_help = "Examples:\n  \
        sixfold grasp measure --object can.ply mug.ply --unit mm --trials 20\n  \
        sixfold grasp measure --list benches/grasp-objects.json --meshes DIR --out out/grasps")]
    Measure(Box<measure::MeasureArguments>),
    /// Compare geometry, experience and both on the same simulated scenes
    #[command(after_help = "Example:\n  \
        sixfold grasp compare --experiences experience.db --list benches/grasp-objects.json --meshes DIR --hard --out out/compare\n\n\
        After a stop, the same command resumes.")]
    Compare(Box<compare::CompareArguments>),
}

pub(crate) fn run(a: &GraspArguments) -> Result<Outcome> {
    match &a.command {
        GraspCommand::Measure(a) => measure::run(a),
        GraspCommand::Compare(a) => compare::run(a),
    }
}
