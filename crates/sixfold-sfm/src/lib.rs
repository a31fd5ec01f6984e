//! Structure from motion: the camera poses of photographs of one static scene, and points of the scene, from features alone.
//!
//! [`matched`] pairs features that are mutual nearest neighbours, [`reconstruct`] finds poses and points: epipolar geometry of
//! every pair ([`two_views`]; Nistér 2004, Stewénius et al. 2006), tracks over all photographs, photographs added one by one by
//! PnP and triangulation (Schönberger and Frahm 2016), and a robust bundle adjustment (Triggs et al. 2000). The features can
//! come from any detector.
//!
//! The scale is unknown: the unit of length is the median distance of a photograph from its points. The same input and seed give
//! the same poses, for any number of threads.

#![deny(clippy::print_stdout, clippy::print_stderr)]

mod bundle;
mod error;
mod five_point;
mod homography;
mod incremental;
mod lens;
mod matching;
mod options;
mod reconstruct;
mod relative;
mod tracks;
mod triangulate;
mod two_view;

pub use error::{LeftOut, SfmError};
pub use five_point::essential_matrices;
pub use matching::{Features, PairMatches, matched};
pub use options::SfmOptions;
pub use reconstruct::{Reconstruction, ScenePoint, reconstruct};
pub use triangulate::triangulated;
pub use two_view::{TwoViews, two_views};
