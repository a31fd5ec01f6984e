//! A simulated robot: a parallel-jaw gripper that tries grasps in a physics engine.
//!
//! The gripper moves along its approach direction, closes with a limited force, lifts, and shakes. Only Coulomb friction holds the
//! object: it is never attached to a finger, and no finger is driven with unlimited force. A trial is a deterministic function of
//! its arguments, with the same result on every machine.
//!
//! The world's frame: `z` up, the table's top at `z = 0`. Metres, kilograms, newtons, seconds. The engine (Rapier) computes in
//! `f32`; inputs and results are `f64`.
//!
//! ```
//! use sixfold_geometry::{Pose, Vec3};
//! use sixfold_grasp::{Gripper, gripper_pose};
//! use sixfold_simulation::{ConvexParts, Outcome, TrialOptions, try_grasp};
//! let cube = ConvexParts::of_convex(&sixfold_synth::primitives::cuboid(Vec3::repeat(0.05)).unwrap())?;
//! let world_from_object = Pose::from_translation(Vec3::new(0.0, 0.0, 0.025));
//! let gripper = Gripper::built_in("jaws-85").unwrap();
//! let grasp = gripper_pose(&Vec3::new(0.0, 0.0, 0.01), &-Vec3::z(), &Vec3::x()).unwrap();
//! let report = try_grasp(&cube, &world_from_object, &gripper, &grasp, 0.07, &TrialOptions::default())?;
//! assert_eq!(report.outcome, Outcome::Held);
//! # Ok::<(), sixfold_simulation::SimulationError>(())
//! ```

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

mod attempt;
mod error;
mod hardness;
mod parts;
mod pile;
mod settle;
mod statistics;
mod tabletop;
mod trial;
mod view;
mod world;

pub use attempt::{Attempt, AttemptOptions, AttemptOutcome, Scene, attempt, scene, scene_at};
pub use error::SimulationError;
pub use hardness::Hardness;
pub use parts::{ConvexParts, PartsOptions};
pub use pile::{PileOptions, drop_objects};
pub use settle::settle_at_centre;
pub use statistics::{wilson_interval, wilson_interval_of_fraction};
pub use tabletop::{Tabletop, TabletopImage, TabletopOptions};
pub use trial::{Outcome, TrialOptions, TrialReport, try_grasp};
pub use view::{SimulatedView, ViewPoint, simulate_view};
