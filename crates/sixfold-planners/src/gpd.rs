//! GPD as a planner: its candidates, each with the success probability from the network.

use rayon::prelude::*;
use sixfold_grasp::learned::{ClosingRegion, LocalFrameOptions, ScoredGrasp, local_frame_grasps};
use sixfold_grasp::{GraspView, Gripper};

use crate::GpdModel;

/// Candidates on the object of a view with their success probability, the best first. The same seed gives the same result at any
/// number of threads.
pub fn gpd_grasps(
    view: &GraspView,
    gripper: &Gripper,
    options: &LocalFrameOptions,
    model: &GpdModel,
) -> Vec<ScoredGrasp> {
    let grasps = local_frame_grasps(view, gripper, options);
    let regions: Vec<ClosingRegion> =
        grasps.par_iter().map(|grasp| ClosingRegion::new(view, gripper, grasp)).collect();
    let scores = model.scores(&regions);
    let mut scored: Vec<ScoredGrasp> =
        grasps.into_iter().zip(scores).map(|(grasp, score)| ScoredGrasp { grasp, score }).collect();
    // A stable sort: ties keep the order of their samples.
    scored.sort_by(|a, b| b.score.total_cmp(&a.score));
    scored
}
