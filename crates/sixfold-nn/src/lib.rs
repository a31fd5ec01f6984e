//! Backbones, fast convolutions, weight files and the training loop on Burn.

pub mod kernels;
pub mod layers;
pub mod lite0;
pub mod ops;

pub mod batch_norm;
pub mod checkpoint;
mod files;
pub mod schedule;
pub mod training_log;
pub mod weights;
