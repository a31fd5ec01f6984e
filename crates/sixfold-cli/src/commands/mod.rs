//! One file per command.

pub(crate) mod board;
pub(crate) mod calibrate;
pub(crate) mod completions;
pub(crate) mod demo;
#[cfg(feature = "networks")]
pub(crate) mod detect;
#[cfg(feature = "networks")]
pub(crate) mod detect_arguments;
pub(crate) mod estimate;
pub(crate) mod eval;
pub(crate) mod experiments;
pub(crate) mod grasp;
pub(crate) mod import;
pub(crate) mod object;
pub(crate) mod render;
pub(crate) mod serve;
pub(crate) mod simulate;
#[cfg(feature = "physics")]
pub(crate) mod simulate_scenes;
#[cfg(feature = "networks")]
pub(crate) mod synthesize;
#[cfg(feature = "networks")]
pub(crate) mod teach;
#[cfg(feature = "networks")]
pub(crate) mod train;
#[cfg(not(feature = "networks"))]
pub(crate) mod without_networks;
#[cfg(not(feature = "networks"))]
pub(crate) use self::{
    without_networks as detect, without_networks as detect_arguments, without_networks as synthesize,
    without_networks as teach, without_networks as train,
};

/// Whether commands that need a network are built in. Otherwise they print a message, and help does not list them.
pub(crate) const NETWORKS: bool = cfg!(feature = "networks");
