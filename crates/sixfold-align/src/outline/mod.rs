//! Aligns a mesh's outline with the object's border in a colour image: region-based tracking (Prisacariu and Reid 2012) with
//! the sparse lines of Stoiber et al. 2020. Needs no colours of the mesh.
//!
//! [`log_odds`] estimates the object's pixels, [`Outline::lines`] finds its border on lines across the rendered outline, and
//! [`add_lines`] adds these to the normal equations of the pose.

#![deny(clippy::print_stdout, clippy::print_stderr)]

mod alignment;
mod lines;
mod odds;

pub use alignment::{AlignedOutline, Alignment, AlignmentOptions};
pub use lines::{Line, MIN_LINES, Outline, add_lines, motion, outline_mesh, projected_box, sample, tukey};
pub use odds::{color_odds, log_odds};
