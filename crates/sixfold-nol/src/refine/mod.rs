//! Refines the poses of photographs by comparing their contents (dissertation, section 4.2.3).
//!
//! [`refine_scene`] is the default: robust Gauss-Newton on SE(3) over the difference between the colours of one photograph on the
//! surface and those of the others, with the outline as a second measurement, and with one camera for all objects of an image that
//! stood still between some of the photographs. `published_rule` is the dissertation's gradient descent on the same difference.

mod alignment;
mod appearance;
mod arrangement;
mod common_error;
mod gauss_newton;
mod measure;
mod options;
mod published;
mod published_rule_poses;
mod stillness;
#[cfg(test)]
pub(crate) mod tests;

pub(crate) use appearance::{Common, Light, PointSamples, sample_points};
pub use gauss_newton::{PosedSource, refine_poses, refine_scene};
pub use options::{PoseRefinementOptions, Refinement, SceneKind, SourceReport};
pub use published::PublishedRuleOptions;
pub use published_rule_poses::published_rule_poses;
