//! `sixfold grasp`: grasps of a parallel-jaw gripper.

pub(crate) mod arguments;
#[cfg(all(feature = "physics", feature = "experience"))]
mod learn;
mod propose;
#[cfg(feature = "experience")]
mod store;
#[cfg(feature = "physics")]
mod try_one;

use anyhow::Result;
use sixfold_shell::Outcome;

use self::arguments::{GraspArguments, GraspCommand};

pub(crate) fn run(a: &GraspArguments) -> Result<Outcome> {
    match &a.command {
        GraspCommand::Propose(a) => propose::run(a),
        #[cfg(feature = "physics")]
        GraspCommand::Try(a) => try_one::run(a),
        GraspCommand::Measure(_) => super::experiments::run(),
        #[cfg(all(feature = "physics", feature = "experience"))]
        GraspCommand::Learn(a) => learn::run(a),
        GraspCommand::Compare(_) => super::experiments::run(),
        #[cfg(feature = "experience")]
        GraspCommand::Store(a) => store::run(a),
    }
}
