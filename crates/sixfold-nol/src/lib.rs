//! Neural Object Learning: renders an object in new poses from few cluttered photographs with rough poses and an untextured mesh,
//! and refines those poses (K. Park, *6D Pose Estimation of Objects Using Limited Training Data*, TU Wien 2020, chapter 4).
//!
//! A [`PosedImage`](sixfold_data::PosedImage) is cropped to the object ([`SourceView`]). The surface points that a new view shows
//! ([`TargetSurface`]) are projected into every photograph that shows the same points ([`SourceView::project`]).

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

pub mod agreement;
mod coordinates;
mod error;
mod features;
pub mod loss;
mod maps;
pub mod model;
pub mod network;
mod outlines;
pub mod pose_file;
mod preview;
mod projection;
pub mod quality;
pub mod recipe;
pub mod refine;
pub mod samples;
pub mod select;
pub mod similarity;
mod source;
mod surface;
pub mod synthesis;
pub mod training;
pub mod view_grid;
mod view_split;
mod window;

pub use error::NolError;
pub use features::SourceFeatures;
pub use maps::Maps;
pub use projection::{Projection, TargetSurface};
pub use source::SourceView;
pub use view_split::{ViewSplit, ViewSplitError, WrittenViews};
