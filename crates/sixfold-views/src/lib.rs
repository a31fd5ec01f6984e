//! Poses of known objects from one colour image, without training for the object: the mesh is rendered from all sides, and local
//! features of these views are matched with those of a region of the image.
//!
//! Without a region, a detector of any object proposes some, and the templates choose among them (`search`), also by features trained on
//! ImageNet (`recognition`).
//!
//! Objects with something printed on them are also found without a region by keypoints (`sift`, `printed`).
//!
//! A region is resampled as seen by a camera aimed at its centre (`crop`). Its features (`features`) are compared with those of all
//! `templates`; the best of these give correspondences, the correspondences give poses by PnP, and each pose is rendered, compared
//! and moved (`estimate`). The best are refined in a crop of higher resolution (`close`), where
//! the render itself is aligned with the image (`direct`). The network (`network`) is XFeat's backbone (Potje et al. 2024), trained further on synthetic objects
//! (`training`).

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

mod choice;
mod close;
mod colour;
mod crop;
pub mod detector;
mod direct;
mod distinction;
mod error;
mod estimate;
pub mod estimator;
mod features;
mod file;
mod matching;
mod network;
mod pose_refiner;
mod printed;
pub mod recipe;
mod recognition;
pub mod refiner;
mod samples;
mod search;
mod sift;
mod templates;
mod training;

pub use error::ViewsError;
pub use estimate::ViewsOptions;
pub use features::{Extractor, FeatureMap};
pub use network::ViewNetwork;
pub use pose_refiner::ViewsRefiner;
pub use recognition::Recogniser;
pub use templates::TemplateOptions;
pub use training::{Batch, ViewsTraining, ViewsTrainingOptions};
