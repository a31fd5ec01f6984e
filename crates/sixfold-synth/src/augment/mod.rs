//! Image augmentation, occluders, procedural backgrounds and textures for training networks on few images.
//!
//! The functions work on small patches of colour ([`Patch`], planar `f32` in 0..1) and of one channel
//! ([`Coverage`]), of the size of a network's input. All random functions take the caller's generator
//! ([`stream`](sixfold_geometry::random::stream) makes one per sample), so that a sample depends only on the seed
//! and its number, on any thread.
//!
//! Colour augmentation follows K. Park, dissertation, table 3.2; occluders follow table 3.3.

#![deny(clippy::print_stdout, clippy::print_stderr)]

mod backgrounds;
mod blur;
mod color;
mod coverage;
mod cutout;
mod error;
mod noise;
mod patch;
mod shapes;
mod texture;
mod window;

pub use backgrounds::{Backgrounds, PhotographOptions};
pub use color::ColorAugmentation;
pub use coverage::Coverage;
pub use cutout::Cutout;
pub use error::AugmentError;
pub use patch::{AffineMap, Patch};
pub use shapes::{Shape, occluder_of_fraction};
pub use texture::procedural_texture;
pub use window::Window;
