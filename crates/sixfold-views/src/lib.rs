//! Poses of known objects from colour, without training.

#![deny(clippy::print_stdout, clippy::print_stderr)]

pub mod crop;
mod error;
pub mod estimate;
pub mod estimator;
pub mod features;
mod file;
pub mod matching;
pub mod network;
pub mod recipe;
pub mod samples;
pub mod templates;
pub mod training;

pub use error::ViewsError;
