//! One file per command.

pub(crate) mod boxes;
pub(crate) mod completions;
pub(crate) mod demo;
pub(crate) mod detect;
pub(crate) mod estimate;
pub(crate) mod estimate_dataset;
pub(crate) mod estimate_rgb;
pub(crate) mod eval;
pub(crate) mod frames;
pub(crate) mod grasp;
pub(crate) mod material;
pub(crate) mod mttm;
pub(crate) mod object;
pub(crate) mod pix2pose;
pub(crate) mod render;
pub(crate) mod reproduce;
pub(crate) mod simulate;
#[cfg(feature = "physics")]
pub(crate) mod simulate_scenes;
pub(crate) mod synthesize;
pub(crate) mod train;
