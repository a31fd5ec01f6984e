//! The program as a user runs it: the real binary, in a temporary folder, on inputs made by the tests themselves.

mod bad_input;
mod dataset;
mod detect;
mod eval;
#[cfg(all(feature = "experience", feature = "physics"))]
mod experience;
#[cfg(unix)]
mod experiments;
mod grasp;
mod image;
mod mttm;
mod objects;
mod pix2pose;
mod simulate;
#[cfg(feature = "physics")]
mod simulate_scenes;
mod support;
mod synthesize;

/// What is tested.
const PROGRAM: &str = env!("CARGO_BIN_EXE_sixfold");
