//! All grasps for a view, from experience and from geometry, in one ranking.

use sixfold_grasp::learned::ScoredGrasp;
use sixfold_grasp::{
    AntipodalOptions, ClusterOptions, GraspFitter, GraspView, Gripper, OptionsError, antipodal_grasps,
};
use thiserror::Error;

use super::{
    Memory, Proposals, ProposeError, ProposeOptions, Ranked, propose, rank_as_published, rank_by_outcome,
    rank_experience_as_published, rank_on_part,
};
use crate::model::DgcmModel;

/// Errors of the ranking.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum GraspsError {
    /// The planner's options.
    #[error(transparent)]
    Options(#[from] OptionsError),
    /// The proposals from experience.
    #[error(transparent)]
    Propose(#[from] ProposeError),
}

/// Grasps of both kinds.
#[derive(Debug, Clone)]
pub struct RankedGrasps {
    /// The proposals from experience.
    pub found: Proposals,
    /// The grasps, the best first.
    pub ranked: Vec<Ranked>,
}

/// Grasps from experience and from geometry, by the success probability that the attempts with this gripper predict. With the name
/// of a part: only experiences on such parts, and only grasps on the same part.
///
/// # Errors
/// [`GraspsError`].
pub fn grasps_from_experience(
    view: &GraspView,
    gripper: &Gripper,
    planner: &AntipodalOptions,
    network: &DgcmModel,
    memory: &mut Memory,
    part: Option<&str>,
) -> Result<RankedGrasps, GraspsError> {
    let options = ProposeOptions { part: part.map(str::to_owned), ..ProposeOptions::default() };
    let fitter = GraspFitter::new(view, gripper, planner)?;
    let found = propose(&fitter, network, memory, &options)?;
    let geometry = antipodal_grasps(view, gripper, planner)?;
    let outcomes = memory.outcomes(&gripper.name);
    let clusters = ClusterOptions::default();
    let ranked = match part {
        None => rank_by_outcome(&geometry, &found.proposals, &clusters, &fitter, &outcomes),
        Some(_) => rank_on_part(&geometry, &found, &clusters, &fitter, &outcomes),
    };
    Ok(RankedGrasps { found, ranked })
}

/// As [`grasps_from_experience`], in the dissertation's form (sections 6.2.3 and 6.3.2): only transfers by the network, with
/// clusters ranked by their summed scores; or the grasps `planned` by a planner, whose scores are averaged with those of nearby
/// experience.
///
/// # Errors
/// [`GraspsError`].
pub fn grasps_as_published(
    view: &GraspView,
    gripper: &Gripper,
    planner: &AntipodalOptions,
    network: &DgcmModel,
    memory: &mut Memory,
    part: Option<&str>,
    planned: Option<&[ScoredGrasp]>,
) -> Result<RankedGrasps, GraspsError> {
    let options = ProposeOptions { part: part.map(str::to_owned), ..ProposeOptions::published() };
    let fitter = GraspFitter::new(view, gripper, planner)?;
    let found = propose(&fitter, network, memory, &options)?;
    let clusters = ClusterOptions::default();
    let ranked = match planned {
        Some(planned) => rank_as_published(planned, &found.proposals, &clusters),
        None => rank_experience_as_published(&found.proposals, &clusters),
    };
    Ok(RankedGrasps { found, ranked })
}
