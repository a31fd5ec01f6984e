//! Everything that is made by a procedure: household objects and toys ([`shapes`]), solids that look as rendered objects do
//! ([`distractors`]), simple closed shapes of known sizes ([`primitives`]), textures, backgrounds, occluders and image
//! augmentation ([`augment`]).
//!
//! Everything random takes the caller's generator, so that a sample is a function of seed and number alone, whatever thread
//! draws it. Metres, except where a shape is of size one.

#![warn(unreachable_pub, unnameable_types)]

pub mod augment;
mod colors;
pub mod distractors;
pub mod primitives;
mod profiles;
pub mod shapes;

pub use colors::{randomly_colored, with_own_color};
