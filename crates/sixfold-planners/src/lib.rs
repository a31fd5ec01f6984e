//! Learned grasp planners: GPD's network, and the trainings of GPD and HAF.
//!
//! Candidates and their descriptions are in `sixfold_grasp::learned`, and so is HAF's classifier, which needs no network. Here a
//! network scores GPD's candidates ([`GpdModel`], [`gpd_grasps`]). With the feature `recipe` both are trained (`recipe`) on the
//! same trials: grasps on synthetic objects, tried in a physics engine (`trials`).

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

mod gpd;
#[cfg(feature = "recipe")]
pub mod gpd_training;
#[cfg(feature = "recipe")]
mod haf_features;
#[cfg(feature = "recipe")]
pub mod haf_training;
mod model;
mod network;
#[cfg(feature = "recipe")]
pub mod quality;
#[cfg(feature = "recipe")]
pub mod recipe;
#[cfg(feature = "recipe")]
pub mod samples;
#[cfg(feature = "recipe")]
mod trial_file;
#[cfg(feature = "recipe")]
pub mod trials;

pub use gpd::gpd_grasps;
pub use model::GpdModel;
