//! The parts that the programs `sixfold` and `sixfold-experiments` share: exit status and errors, output and progress,
//! images, and the arguments, stores and scenes that both take.

#![warn(unreachable_pub, unnameable_types)]

// This module comes first: its macros replace the standard ones in all modules that follow.
#[macro_use]
pub mod screen;

pub mod board;
pub mod companion;
pub mod datasets;
pub mod demo;
pub mod depth_views;
pub mod detected;
#[cfg(feature = "networks")]
pub mod detectors;
pub mod folder;
pub mod found;
pub mod frames;
pub mod grasp;
pub mod idle;
pub mod image_templates;
mod labels;
pub mod meshes;
#[cfg(feature = "networks")]
pub mod new_views;
#[cfg(feature = "networks")]
pub mod object_training;
pub mod objects;
pub mod output;
pub mod overlay;
pub mod pictures;
pub mod processor;
pub mod progress;
pub mod ranges;
#[cfg(feature = "physics")]
pub mod scenes;
pub mod sheets;
pub mod shipped;
pub mod symmetries;
#[cfg(feature = "networks")]
pub mod teachings;
#[cfg(feature = "networks")]
pub mod training;

use std::process::ExitCode;

/// The error message of a program built without the feature `networks`.
pub const WITHOUT_NETWORKS: &str =
    "this program was built without the feature networks: cargo install --locked --path crates/sixfold-cli";

/// The exit status of a command that ran without an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Exit status 0.
    Found,
    /// Exit status 1: everything worked, but nothing was found.
    NothingFound,
    /// Exit status 2, after the reasons were already printed: part of a batch was skipped.
    Incomplete,
}

/// The exit status of a command. The reason of an error goes to standard error and, if JSON was requested, as JSON to
/// standard output.
pub fn exit_code(result: &anyhow::Result<Outcome>) -> ExitCode {
    screen::finish(match result {
        Ok(Outcome::Found) => 0,
        Ok(Outcome::NothingFound) => 1,
        Ok(Outcome::Incomplete) => 2,
        Err(error) => {
            let stopped = progress::was_interrupted();
            let failure = if stopped { screen::Failure::Interrupt } else { screen::Failure::Command };
            screen::fail(&describe(error), failure);
            2
        }
    })
}

/// The whole chain of causes in one line, without repeating a cause that its parent already prints.
pub fn describe(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let part = cause.to_string();
        if !text.contains(&part) {
            if !text.is_empty() {
                text.push_str(": ");
            }
            text.push_str(&part);
        }
    }
    text
}

/// The largest image that either program reads.
#[derive(Debug, clap::Args)]
pub struct PixelLimit {
    /// Read images of at most this many pixels (default: 100000000)
    #[arg(long, global = true, value_name = "N")]
    pub max_pixels: Option<std::num::NonZeroU64>,
}

impl PixelLimit {
    /// Sets it for this process.
    pub fn set(&self) {
        if let Some(pixels) = self.max_pixels {
            sixfold_io::set_max_pixels(pixels.get());
        }
    }
}
