//! Objects never trained on, found in depth images by their templates: what chapter 5 of the dissertation is about.
//!
//! An object is a set of [`ObjectTemplates`]: depth patches of a fixed metric size, rendered from a mesh ([`from_mesh`])
//! or cut out of real depth images ([`from_depth`]). Adding an object is all there is to do: nothing is trained.
//! In a scene, patches around sampled pixels ([`roi`]) are matched with all templates ([`matching`]), the best ones get
//! masks ([`mask`]), masks of one object are merged, matched again without their background, and the nearest
//! templates become poses by their geometry ([`align`]); [`mod@estimate`] puts it together, and [`judge`] says how well a pose
//! agrees with the image when there is no mesh.

// `!(x > 0.0)` refuses NaN, `x <= 0.0` does not: that is what the checks here mean.
#![allow(clippy::neg_cmp_op_on_partial_ord)]

pub mod align;
mod by_network;
mod descriptor_file;
mod error;
pub mod estimate;
mod estimator;
pub mod from_depth;
pub mod from_mesh;
pub mod judge;
pub mod learned;
pub mod loss;
pub mod mask;
pub mod matching;
pub mod model;
pub mod network;
pub mod patch;
pub mod pose_distance;
pub mod quality;
#[cfg(feature = "recipe")]
pub mod recipe;
mod regions;
pub mod roi;
pub mod samples;
mod store;
mod template;
pub mod training;
mod views;

pub use error::{StoreError, TemplateError};
pub use estimate::{MttmEstimate, MttmOptions, KnownObject, MatchedBy, Search, Stages, estimate};
pub use estimator::{MttmEstimator, MttmObject, TEMPLATES_FILE};
pub use from_depth::DepthView;
pub use template::{ObjectTemplates, SIDE, Source, Template, TemplateOptions};
pub use views::{Coverage, view_directions, view_rotation};
