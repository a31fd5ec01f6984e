#![doc = include_str!("../README.md")]
#![deny(clippy::print_stdout, clippy::print_stderr)]

pub use sixfold_align as align;
pub use sixfold_board as board;
pub use sixfold_bop as bop;
pub use sixfold_estimator as estimator;
pub use sixfold_geometry as geometry;
pub use sixfold_io as io;
pub use sixfold_mesh as mesh;
pub use sixfold_ppf as ppf;
pub use sixfold_render as render;
pub use sixfold_runner as runner;
pub use sixfold_synth as synth;

#[cfg(feature = "networks")]
pub use sixfold_auto as auto;
#[cfg(feature = "networks")]
pub use sixfold_data as data;
#[cfg(feature = "networks")]
pub use sixfold_detect as detect;
#[cfg(feature = "networks")]
pub use sixfold_mttm as mttm;
#[cfg(feature = "networks")]
pub use sixfold_nn as nn;
#[cfg(feature = "networks")]
pub use sixfold_nol as nol;
#[cfg(feature = "networks")]
pub use sixfold_pix2pose as pix2pose;
#[cfg(feature = "networks")]
pub use sixfold_teach as teach;
#[cfg(feature = "networks")]
pub use sixfold_views as views;

#[cfg(feature = "grasp")]
pub use sixfold_grasp as grasp;
#[cfg(feature = "grasp")]
pub use sixfold_simulation as simulation;

#[cfg(feature = "experience")]
pub use sixfold_dgcm as dgcm;
#[cfg(feature = "experience")]
pub use sixfold_experience as experience;
#[cfg(feature = "experience")]
pub use sixfold_planners as planners;

pub mod guide;
pub mod prelude;
