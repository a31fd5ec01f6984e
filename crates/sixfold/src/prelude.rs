//! The twenty most needed types: `use sixfold::prelude::*;`.

pub use sixfold_align::PreparedDepth;
pub use sixfold_bop::{BopDataset, Estimate, EvalOptions};
pub use sixfold_estimator::{
    Cache, Object, ObjectStore, PoseEstimate, PoseEstimator, PreparedObject, Query, Region,
};
pub use sixfold_geometry::{Camera, DepthImage, Mask, Pose, RgbImage, Vec3};
pub use sixfold_mesh::{Mesh, Unit};
pub use sixfold_ppf::PpfEstimator;
