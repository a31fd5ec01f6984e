//! Objects never trained on, found in depth images by their templates (dissertation, chapter 5).
//!
//! An object is a set of [`ObjectTemplates`]: depth patches of a fixed metric size, rendered from a mesh (`from_mesh`) or cut out
//! of real depth images (`from_depth`). Adding an object needs no training. In a scene, patches around sampled pixels ([`roi`]) are
//! matched with all templates ([`matching`]). The best ones get masks ([`mask`]); masks of one object are merged and matched again
//! without their background. The nearest templates are then aligned with the scene, which gives poses ([`align`]). [`estimate()`]
//! runs all steps; [`judge`] measures how well a pose agrees with the image when there is no mesh.
//!
//! Without the feature `network` (default) templates are matched point by point only, and Burn is not compiled.

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

pub mod align;
#[cfg(feature = "network")]
mod by_network;
#[cfg(feature = "network")]
mod descriptor_file;
mod error;
mod estimate;
mod estimator;
mod from_depth;
mod from_mesh;
pub mod judge;
#[cfg(feature = "network")]
pub mod learned;
#[cfg(feature = "network")]
mod loss;
pub mod mask;
pub mod mask_check;
pub mod matching;
#[cfg(feature = "network")]
pub mod model;
#[cfg(feature = "network")]
pub mod network;
pub mod patch;
#[cfg(feature = "network")]
mod pose_distance;
#[cfg(feature = "network")]
mod published;
#[cfg(feature = "network")]
pub mod quality;
#[cfg(all(feature = "network", feature = "recipe"))]
pub mod recipe;
#[cfg(feature = "network")]
mod regions;
pub mod roi;
#[cfg(feature = "network")]
mod samples;
#[cfg(feature = "network")]
mod segmentation;
mod store;
mod template;
#[cfg(feature = "network")]
mod training;
mod views;
#[cfg(not(feature = "network"))]
mod without_network;
#[cfg(not(feature = "network"))]
use without_network::{
    self as by_network, self as learned, self as published, self as regions, self as segmentation,
};

pub use error::{StoreError, TemplateError};
pub use estimate::{KnownObject, MaskSource, MatchedBy, MttmEstimate, MttmOptions, Search, Stages, estimate};
pub use estimator::{MttmEstimator, MttmObject, TEMPLATES_FILE};
pub use from_depth::DepthView;
#[cfg(feature = "network")]
pub use samples::{Anchor, AnchorOptions, Augmentation, Batch, DepthPoolOptions, PairBatchOptions, Pool};
pub use template::{ObjectTemplates, SIDE, Source, Template, TemplateOptions};
#[cfg(feature = "network")]
pub use training::{MttmTraining, MttmTrainingOptions};
pub use views::{ViewCoverage, view_directions, view_rotation};
