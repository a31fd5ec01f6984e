//! Procedural content: household objects and toys ([`shapes`]), solids that look like rendered objects ([`distractors`]),
//! simple closed shapes of known sizes ([`primitives`]), textures, backgrounds, occluders and image augmentation
//! ([`augment`]).
//!
//! All random functions take the caller's generator, so that a sample depends only on the seed and its number, on any
//! thread. Lengths are in metres, except for shapes of size one.

#![warn(unreachable_pub, unnameable_types)]

pub mod augment;
mod colors;
pub mod distractors;
pub mod primitives;
mod profiles;
pub mod shapes;

pub use colors::{randomly_colored, with_own_color};
