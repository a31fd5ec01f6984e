//! Poses, cameras, images, absolute orientation, PnP and registration.
//!
//! Conventions of all crates: lengths in metres, angles in radians, poses in `f64` and named by their spaces
//! (`camera_from_object`), the OpenCV camera frame (x right, y down, z forward), pixel centres at whole
//! numbers (the centre of the top left pixel is `(0, 0)`).

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

mod camera;
mod cloud;
mod depth_check;
mod frame_id;
pub mod homography;
mod icp;
mod image;
mod kabsch;
mod nearest;
mod normals;
mod option_error;
mod plane;
mod pnp;
mod pose;
mod progress;
pub mod random;
mod solver;
pub mod srgb;
pub mod stats;
mod undistort;

pub use camera::{BrownConrady, Camera, CameraError};
pub use cloud::{PointCloud, sphere_directions};
pub use depth_check::{DepthImageError, usable_depth};
pub use frame_id::FrameId;
pub use icp::{
    CorrespondenceSource, DepthTarget, IcpError, IcpLevel, IcpOptions, IcpReport, IndexedCloud, icp,
};
pub use image::{DepthImage, Image, ImageError, Mask, NormalImage, PointImage, Rect, RgbImage};
pub use kabsch::{AlignmentError, Similarity, kabsch, umeyama};
pub use nearest::{KdTree, Neighbour};
pub use normals::{NormalOptions, inpaint_depth, normals_from_depth};
pub use option_error::OptionError;
pub use plane::{Plane, PlaneOptions, dominant_plane, fit_plane};
pub use pnp::{
    PnpError, PnpOptions, PnpReport, PnpSolver, RefineOptions, RefineReport, Trust, epnp, p3p, pnp_ransac,
    refine_pose, refine_trusted,
};
pub use pose::{Pose, PoseError};
pub use progress::Progress;
pub use solver::NormalEquations;
pub use undistort::{undistort_box, undistort_depth, undistort_rgb};

/// The linear algebra types in this crate's public signatures.
pub use nalgebra;
/// A point, direction or translation in three dimensions; metres where it has a length.
pub type Vec3 = nalgebra::Vector3<f64>;
/// A point in an image, in pixels (x to the right, y down).
pub type Vec2 = nalgebra::Vector2<f64>;
/// A 3x3 matrix, used for rotations and intrinsics.
pub type Mat3 = nalgebra::Matrix3<f64>;
