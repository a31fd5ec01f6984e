//! One file per command.

pub(crate) mod completions;
pub(crate) mod demo;
pub(crate) mod detect;
pub(crate) mod detect_arguments;
pub(crate) mod estimate;
pub(crate) mod estimate_arguments;
pub(crate) mod estimate_dataset;
pub(crate) mod estimate_rgb;
pub(crate) mod eval;
pub(crate) mod experiments;
pub(crate) mod grasp;
pub(crate) mod mttm;
pub(crate) mod object;
pub(crate) mod object_arguments;
pub(crate) mod render;
pub(crate) mod simulate;
#[cfg(feature = "physics")]
pub(crate) mod simulate_scenes;
pub(crate) mod synthesize;
pub(crate) mod train;
pub(crate) mod train_detector;
#[cfg(feature = "experience")]
pub(crate) mod train_dgcm;
#[cfg(feature = "physics")]
pub(crate) mod train_mttm;
pub(crate) mod train_nol;

use sixfold_shell::{boxes, frames, pix2pose, training as material};
