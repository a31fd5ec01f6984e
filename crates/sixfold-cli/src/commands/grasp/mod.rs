//! `sixfold grasp`: grasps of a parallel-jaw gripper.

pub(crate) mod arguments;
#[cfg(all(feature = "physics", feature = "experience"))]
mod compare;
#[cfg(feature = "experience")]
mod experience;
mod input;
#[cfg(all(feature = "physics", feature = "experience"))]
mod journal;
#[cfg(all(feature = "physics", feature = "experience"))]
mod learn;
#[cfg(feature = "physics")]
mod measure;
#[cfg(feature = "physics")]
mod object_list;
mod propose;
#[cfg(all(feature = "physics", feature = "experience"))]
pub(crate) mod reproduce;
#[cfg(feature = "experience")]
mod store;
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
        #[cfg(all(feature = "physics", feature = "experience"))]
        GraspCommand::Learn(a) => learn::run(a),
        #[cfg(all(feature = "physics", feature = "experience"))]
        GraspCommand::Compare(a) => compare::run(a),
        #[cfg(feature = "experience")]
        GraspCommand::Store(a) => store::run(a),
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
