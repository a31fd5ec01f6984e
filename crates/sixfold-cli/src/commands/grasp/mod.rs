//! `sixfold grasp`: grasps of a parallel-jaw gripper.

pub(crate) mod arguments;
#[cfg(feature = "physics")]
mod measure;
mod propose;
#[cfg(feature = "physics")]
mod try_one;

use std::path::Path;

use anyhow::{Context, Result, anyhow};
use sixfold_grasp::{Gripper, read_gripper};

use crate::Outcome;
use arguments::{GraspArguments, GraspCommand};

pub(crate) fn run(a: &GraspArguments) -> Result<Outcome> {
    match &a.command {
        GraspCommand::Propose(a) => propose::run(a),
        #[cfg(feature = "physics")]
        GraspCommand::Try(a) => try_one::run(a),
        #[cfg(feature = "physics")]
        GraspCommand::Measure(a) => measure::run(a),
    }
}

/// A gripper by its built-in name, or from a file.
fn gripper(name_or_file: &str) -> Result<Gripper> {
    if let Some(gripper) = Gripper::built_in(name_or_file) {
        return Ok(gripper);
    }
    if !Path::new(name_or_file).exists() {
        return Err(anyhow!(
            "--gripper: {name_or_file} is neither a file nor one of {}",
            Gripper::BUILT_IN.join(", ")
        ));
    }
    read_gripper(name_or_file).context("--gripper")
}
