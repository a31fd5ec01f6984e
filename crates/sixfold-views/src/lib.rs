//! Poses of known objects from one colour image, without training for the object: the mesh is rendered from all around, and local features
//! of these views are matched with those of a region of the image.
//!
//! A region is cut out as a camera sees it that looks at its middle ([`crop`]). Its features ([`features`]) are compared with those of all
//! [`templates`]; the best of these give correspondences, these poses by PnP, and each pose is rendered, compared and moved
//! ([`estimate`]). The network ([`network`]) is XFeat's backbone (Potje et al. 2024), trained further on synthetic objects ([`training`]).

#![deny(clippy::print_stdout, clippy::print_stderr)]

pub mod crop;
mod error;
pub mod estimate;
pub mod estimator;
pub mod features;
mod file;
mod matching;
pub mod network;
pub mod recipe;
pub mod refiner;
mod samples;
pub mod templates;
pub mod training;

pub use error::ViewsError;
