//! 2D detection of known objects in colour images: boxes, confidences and masks.
//!
//! Start with [`model::DetectorModel::load`], [`model::DetectorModel::detect`].

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

pub mod anchored;
mod card;
pub mod detect;
pub mod detector;
mod loss;
pub mod model;
pub mod network;
pub mod proposals;
pub mod recipe;
pub mod samples;
mod tabletop;
mod targets;
pub mod torchvision;
pub mod training;

pub use targets::{Annotation, Instance};
