//! One example for each main task. All of them are tests; those that need no weight file run in seconds.
//!
//! - [`geometry`]: poses, rendering, PnP, ICP, simulated depth cameras.
//! - [`files`]: meshes, images, camera files, named objects.
//! - [`estimation`]: poses from depth, verification, your own method.
//! - [`datasets`]: BOP datasets, result files, scores, detections.
//! - `learned` (feature `networks`): Pix2Pose, the detector, template matching, views by NOL.
//! - `grasps` (features `grasp` and `experience`): grasps from depth, trials in a physics engine, the store of experiences.

pub mod datasets;
pub mod estimation;
pub mod files;
pub mod geometry;
#[cfg(feature = "grasp")]
pub mod grasps;
#[cfg(feature = "networks")]
pub mod learned;
