//! Geometry for learned planners: candidates and their descriptions. This crate has no networks.
//!
//! Two published planners with which the dissertation compares (section 6.3.2): GPD (Ten Pas et al. 2017, "Grasp pose detection in
//! point clouds") and HAF (Fischinger, Weiss and Vincze 2015, "Learning grasps with topographic features"). Their training data and
//! GPD's network are in `sixfold-planners`.

mod approach_grid;
mod closing_region;
mod haf;
mod haf_file;
mod heights;
mod local_frames;
mod push;
mod scored;

pub use approach_grid::{ApproachGridOptions, approach_grid_grasps};
pub use closing_region::{CHANNELS, ClosingRegion, SIDE};
pub use haf::{HafModel, HafOptions, haf_grasps};
pub use haf_file::{HafError, parse_haf, read_haf, write_haf};
pub use heights::{CELLS, HeightFeature, HeightGrid, Region};
pub use local_frames::{LocalFrameOptions, local_frame_grasps};
pub use scored::{ScoredGrasp, best_of_clusters, cluster_scored};
