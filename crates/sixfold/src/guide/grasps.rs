//! Grasps from depth, trials in a physics engine, the store of experiences.
//!
//! # Grasps from one depth image
//!
//! A can on a table, seen from above at 45 degrees.
//!
//! ```
//! use sixfold::grasp::{
//!     AntipodalOptions, ClusterOptions, GraspView, Gripper, ViewOptions, antipodal_grasps, cluster_grasps,
//!     find_objects,
//! };
//! use sixfold::prelude::*;
//! use sixfold::simulation::{ViewPoint, simulate_view};
//! use sixfold::synth::primitives::cylinder;
//!
//! let eye = ViewPoint { azimuth: 0.3, elevation: 0.8, distance: 0.7, target: Vec3::new(0.0, 0.0, 0.05) };
//! let seen = simulate_view(&cylinder(0.03, 0.1)?, &Pose::identity(), &eye, None, 0)?;
//! let options = ViewOptions::default();
//! let masks = find_objects(&seen.depth, &seen.camera, &options)?; // what stands on the table
//! let view = GraspView::new(&seen.depth, &seen.camera, &masks[0], &options)?;
//! let gripper = Gripper::built_in("jaws-85").expect("it is built in");
//! let grasps = antipodal_grasps(&view, &gripper, &AntipodalOptions::default())?;
//! let best = cluster_grasps(&grasps, &ClusterOptions::default())[0].best;
//! assert!((best.width - 0.06).abs() < 0.01); // across the can
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # A grasp tried in a physics engine
//!
//! ```
//! use sixfold::grasp::{Gripper, gripper_pose};
//! use sixfold::prelude::*;
//! use sixfold::simulation::{ConvexParts, Outcome, TrialOptions, try_grasp};
//! use sixfold::synth::primitives::cuboid;
//!
//! let cube = ConvexParts::of_convex(&cuboid(Vec3::repeat(0.05))?)?;
//! let world_from_object = Pose::from_translation(Vec3::new(0.0, 0.0, 0.025)); // on the table
//! let gripper = Gripper::built_in("jaws-85").expect("it is built in");
//! let from_above = gripper_pose(&Vec3::new(0.0, 0.0, 0.01), &-Vec3::z(), &Vec3::x()).expect("two directions");
//! let options = TrialOptions::default();
//! let report = try_grasp(&cube, &world_from_object, &gripper, &from_above, 0.07, &options)?;
//! assert_eq!(report.outcome, Outcome::Held);
//!
//! let beside = from_above.with_translation(Vec3::new(0.0, 0.2, 0.01));
//! let report = try_grasp(&cube, &world_from_object, &gripper, &beside, 0.07, &options)?;
//! assert_eq!(report.outcome, Outcome::Missed);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![cfg_attr(feature = "experience", doc = include_str!("experience.md"))]
