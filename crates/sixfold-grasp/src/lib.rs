//! Grasps of a parallel-jaw gripper: the gripper, collision tests, and planners.
//!
//! The gripper's frame, everywhere in Sixfold: the origin is midway between the two finger tips, `z` is the approach direction
//! (from the palm to the tips and on to the object), `x` the closing direction (from one finger to the other), `y = z × x` is
//! across the fingers. The gripper is symmetric under half a turn about `z`. Lengths are in metres, forces in newtons.
//!
//! A depth image is converted to a [`GraspView`] (the object's cloud, obstacles, the table). [`antipodal_grasps`] proposes grasps
//! on it from geometry alone, [`cluster_grasps`] merges proposals of about the same grasp, and [`draw_grasps`] draws them.
//!
//! ```
//! use sixfold_grasp::Gripper;
//! let gripper = Gripper::built_in("jaws-85").unwrap();
//! assert_eq!(gripper.max_opening, 0.085);
//! assert!(gripper.check("jaws-85").is_ok());
//! ```

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

mod antipodal;
mod cluster;
mod collision;
mod completion;
mod describe;
mod draw;
mod fit;
mod grasp;
mod grasp_file;
mod gripper;
mod gripper_file;
pub mod learned;
mod view;

pub use antipodal::{AntipodalOptions, OptionsError, antipodal_grasps};
pub use cluster::{ClusterOptions, GraspCluster, cluster_grasps};
pub use collision::{CollisionScene, Hit};
pub use completion::{CompletedObject, CompletionOptions, complete_by_mirrors};
pub use describe::GraspDescription;
pub use draw::{DrawnGrasp, draw_grasps};
pub use fit::GraspFitter;
pub use grasp::{AntipodalQuality, Grasp, centre_between_pads, gripper_pose};
pub use grasp_file::{GraspFileError, TriedGrasp, read_grasp, read_tried_grasp};
pub use gripper::{Gripper, GripperBox};
pub use gripper_file::{GripperError, parse_gripper, read_gripper};
pub use view::{GraspView, ViewError, ViewOptions, find_objects, find_table};
