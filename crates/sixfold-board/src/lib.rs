//! A board of AprilTags (Olson 2011): the sheet to print, detection of its tags in photographs, and camera calibration.
//!
//! An object stands on the printed [`Board`] and is photographed from all sides. [`detect_tags`] finds the visible tags,
//! [`calibrate`] the camera from several photographs, and [`board_pose`] the camera's pose in each.
//!
//! The board's frame: origin at the centre of the tags, x to the right, y up the sheet, z out of it; metres.
//!
//! ```
//! use sixfold_board::{Board, Paper, board_pose, detect_tags, simulation};
//! use sixfold_geometry::{Camera, Pose, Vec3, nalgebra::UnitQuaternion};
//!
//! let board = Board::new(Paper::A4);
//! let camera = Camera::new(900.0, 900.0, 399.5, 299.5, 800, 600)?;
//! let facing = UnitQuaternion::from_axis_angle(&Vec3::x_axis(), 2.6);
//! let truth = Pose::new(facing, Vec3::new(0.0, 0.0, 0.5));
//! let photograph = simulation::photograph(&board, &camera, &truth, &simulation::Conditions::default(), 1);
//! let found = board_pose(&board.corners(&detect_tags(&photograph).tags), &camera)?;
//! assert!(found.camera_from_board.distance_to(&truth) < 1e-3);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#![deny(clippy::print_stdout, clippy::print_stderr)]

mod board;
mod bundle;
mod calibration;
mod detector;
mod error;
mod family;
mod pdf;
mod pose;
mod quad;
pub mod simulation;

pub use board::{Board, Corner, Paper};
pub use calibration::{Calibration, CalibrationOptions, View, calibrate};
pub use detector::{Detections, Tag, detect_tags};
pub use error::BoardError;
pub use pose::{BoardPose, board_pose};
