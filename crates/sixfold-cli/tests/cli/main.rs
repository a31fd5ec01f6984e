//! The program as a user runs it: the real binary, in a temporary folder, on inputs made by the tests themselves.

#[cfg(feature = "networks")]
mod auto;
mod bad_input;
mod calibrate;
mod dataset;
#[cfg(feature = "networks")]
mod detect;
mod eval;
#[cfg(all(feature = "experience", feature = "physics"))]
mod experience;
#[cfg(unix)]
mod experiments;
mod folders;
mod formats;
mod grasp;
mod hostile_meshes;
mod image;
#[cfg(feature = "networks")]
mod mttm;
mod objects;
#[cfg(feature = "networks")]
mod pix2pose;
mod printing;
#[cfg(feature = "networks")]
mod published;
mod serve;
#[cfg(feature = "networks")]
mod shipped;
mod simulate;
#[cfg(feature = "physics")]
mod simulate_scenes;
mod support;
#[cfg(feature = "networks")]
mod synthesize;
#[cfg(feature = "networks")]
mod teach;
#[cfg(feature = "networks")]
mod teach_and_train;
#[cfg(feature = "networks")]
mod teach_without_board;
#[cfg(feature = "networks")]
mod trainings;
#[cfg(not(feature = "networks"))]
mod without_networks;

/// The program under test.
const PROGRAM: &str = env!("CARGO_BIN_EXE_sixfold");
