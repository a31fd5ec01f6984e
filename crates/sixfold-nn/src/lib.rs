//! Backbones, fast convolutions, weight files and the training loop on Burn.

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

pub mod kernels;
pub mod layers;
pub mod lite0;
pub mod ops;
pub mod recurrent;

pub mod batch_norm;
mod checkpoint;
pub mod choice;
pub mod conv_norm;
pub mod conv_transpose;
pub mod critic;
pub mod dense;
pub mod densenet;
pub mod device;
mod discriminator;
mod display;
mod enlarge;
mod files;
pub mod fingerprint;
pub mod keypoints;
pub mod learner;
pub mod options;
pub mod parameters;
pub mod portable;
pub mod pretrained;
pub mod recipe;
pub mod resnet;
pub mod roi_align;
pub mod salient;
pub mod schedule;
pub mod train_error;
pub mod training;
pub mod training_log;
mod vectorised;
pub mod weights;
pub mod xfeat;

pub use checkpoint::{Checkpoint, CheckpointError, CheckpointWriter};
pub use discriminator::Discriminator;
