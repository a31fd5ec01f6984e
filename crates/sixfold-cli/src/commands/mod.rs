//! One file per command.

pub(crate) mod completions;
pub(crate) mod demo;
pub(crate) mod detect;
pub(crate) mod detect_arguments;
pub(crate) mod estimate;
pub(crate) mod eval;
pub(crate) mod experiments;
pub(crate) mod grasp;
pub(crate) mod object;
pub(crate) mod render;
pub(crate) mod simulate;
#[cfg(feature = "physics")]
pub(crate) mod simulate_scenes;
pub(crate) mod synthesize;
pub(crate) mod train;
