//! Training samples for Pix2Pose: crops of few posed images and renders, augmented, with the coordinates, the
//! silhouette and the visible part of the object (dissertation, section 3.4.1, tables 3.2 and 3.3).
//!
//! [`SampleSource`] generates the samples. Each is a function of seed, object and number alone, so that the training run does not
//! depend on the number of threads.

mod composition;
mod error;
mod options;
pub(crate) mod second_stage;
mod source;
pub(crate) mod symmetry;
pub(crate) mod targets;
#[cfg(test)]
mod tests;
pub(crate) mod window;

pub use error::SampleError;
pub use options::SampleOptions;
pub use source::{Sample, SampleSource};
