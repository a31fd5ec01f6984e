//! Makes the poses of photographs better by what they show (dissertation, section 4.2.3).
//!
//! [`refine_scene`] is the default: robust Gauss-Newton on SE(3) over the difference between what one photograph shows
//! on the surface and what the others show there, with the outline as a second measurement, and one camera for all objects of
//! an image that stood still between some of the photographs. `published_rule` is the dissertation's gradient step over the same
//! difference.

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

pub(crate) use appearance::{Common, Light, Shown, look};
pub use gauss_newton::{PosedSource, refine_poses, refine_scene};
pub use options::{PoseRefinementOptions, Refinement, SceneKind, SourceReport};
pub use published::PublishedRuleOptions;
pub use published_rule_poses::published_rule_poses;
