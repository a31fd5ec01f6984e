//! The parts that grasp commands share: the gripper, simulated trials, their objects, experience, and learning from
//! attempts.

#[cfg(feature = "experience")]
pub mod experience;
pub mod gripper;
pub mod input;
#[cfg(all(feature = "physics", feature = "experience"))]
pub mod journal;
#[cfg(all(feature = "physics", feature = "experience"))]
pub mod learn;
#[cfg(feature = "physics")]
pub mod object_list;
pub mod planner;
pub mod proposals;
#[cfg(feature = "experience")]
pub mod store;
#[cfg(feature = "physics")]
pub mod trial;
