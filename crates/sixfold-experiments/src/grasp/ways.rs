//! Eleven ways to choose the grasp: the planner alone; experience alone (equation 6.6); the network alone and joined with the planner,
//! both as published (section 6.3.2); the planner's grasps by quality and by the fraction of experience that agrees; the planner's
//! grasps by the outcomes of earlier attempts; the grasps of both kinds by these outcomes; and the planners GPD and HAF, each alone
//! and joined with the network as published.

use std::time::Instant;

use anyhow::Result;
use sixfold_dgcm::model::DgcmModel;
use sixfold_dgcm::transfer::{
    Memory, ProposeOptions, Ranked, propose, rank, rank_as_published, rank_by_agreement, rank_by_outcome,
    rank_experience_as_published,
};
use sixfold_grasp::learned::ScoredGrasp;
use sixfold_grasp::{
    AntipodalOptions, ClusterOptions, Grasp, GraspFitter, GraspView, Gripper, antipodal_grasps,
};
use sixfold_shell::grasp::planner::Planner;

/// The methods, in the order of the table.
pub(crate) const METHODS: [&str; 11] = [
    "geometry",
    "experience",
    "network",
    "published",
    "agreement",
    "outcomes",
    "both",
    "gpd",
    "haf",
    "gpd published",
    "haf published",
];

/// DGCM-Net in the published form with a rule replaced.
pub(crate) struct Rule {
    pub name: &'static str,
    options: fn() -> ProposeOptions,
    /// Whether a cluster is represented by its best grasp, as ours, instead of its mean.
    best: bool,
}

/// The published form, the same with one of its rules replaced by ours, with all of them, and with other distances of the gripper
/// from the surface (`--published-rules`).
pub(crate) const RULES: [Rule; 11] = [
    replaced("network", published),
    replaced("all hypotheses", || ProposeOptions { align: ours().align, ..published() }),
    replaced("shapes too", || ProposeOptions { shapes: ours().shapes, ..published() }),
    replaced("free place", || ProposeOptions { reach: ours().reach, ..published() }),
    replaced("fit counts", || ProposeOptions { fit_scale: ours().fit_scale, ..published() }),
    Rule { name: "best of a cluster", options: published, best: true },
    Rule { name: "experience", options: ours, best: true },
    replaced("1 cm over it", || ProposeOptions { reach: Some(0.01), ..published() }),
    replaced("2 cm over it", || ProposeOptions { reach: Some(0.02), ..published() }),
    replaced("4 cm over it", || ProposeOptions { reach: Some(0.04), ..published() }),
    replaced("5 cm over it", || ProposeOptions { reach: Some(0.05), ..published() }),
];

const fn replaced(name: &'static str, options: fn() -> ProposeOptions) -> Rule {
    Rule { name, options, best: false }
}

fn ours() -> ProposeOptions {
    ProposeOptions::default()
}

fn published() -> ProposeOptions {
    ProposeOptions::published()
}

/// The data that the methods use.
pub(super) struct Ways<'a> {
    /// The nominal gripper.
    pub gripper: &'a Gripper,
    pub network: &'a DgcmModel,
    /// GPD and HAF.
    pub planners: &'a [Planner; 2],
}

/// The results of all methods on one view.
pub(super) struct Answers {
    /// Each method's grasps, the best first, and the seconds that it took.
    pub ranked: Vec<(Vec<Ranked>, f64)>,
    /// Distance of the nearest experience's feature.
    pub nearest: Option<f64>,
    /// Number of candidates from geometry and from experience.
    pub candidates: (usize, usize),
}

/// The result of `make` and the seconds it took.
fn timed<T, E>(make: impl FnOnce() -> Result<T, E>) -> Result<(T, f64), E> {
    let began = Instant::now();
    Ok((make()?, began.elapsed().as_secs_f64()))
}

impl Ways<'_> {
    pub(super) fn answers(
        &self,
        view: &GraspView,
        options: &AntipodalOptions,
        memory: &mut Memory,
    ) -> Result<Answers> {
        let gripper = self.gripper;
        let (geometry, of_geometry) = timed(|| antipodal_grasps(view, gripper, options))?;
        let (fitter, of_fitter) = timed(|| GraspFitter::new(view, gripper, options))?;
        let (found, seconds) = timed(|| propose(&fitter, self.network, memory, &ProposeOptions::default()))?;
        let of_experience = of_fitter + seconds;
        let (alone, seconds) =
            timed(|| propose(&fitter, self.network, memory, &ProposeOptions::published()))?;
        let of_network = of_fitter + seconds;
        let clusters = ClusterOptions::default();
        let began = Instant::now();
        let outcomes = memory.outcomes(&gripper.name);
        let by_outcome = |proposals| rank_by_outcome(&geometry, proposals, &clusters, &fitter, &outcomes);
        let both = by_outcome(&found.proposals);
        let of_outcomes = began.elapsed().as_secs_f64();
        let planned = |planner: &Planner| timed(|| planner.grasps(view, gripper, options));
        let ((gpd, of_gpd), (haf, of_haf)) = (planned(&self.planners[0])?, planned(&self.planners[1])?);
        let quality = |&grasp: &Grasp| ScoredGrasp { grasp, score: grasp.quality.total() };
        let scored: Vec<ScoredGrasp> = geometry.iter().map(quality).collect();
        let published = |planned: &[ScoredGrasp]| rank_as_published(planned, &alone.proposals, &clusters);
        let ranked = vec![
            (rank(&geometry, &[], &clusters), of_geometry),
            (rank(&[], &found.proposals, &clusters), of_experience),
            (rank_experience_as_published(&alone.proposals, &clusters), of_network),
            (published(&scored), of_geometry + of_network),
            (rank_by_agreement(&geometry, &found.proposals, &clusters), of_geometry + of_experience),
            (by_outcome(&[]), of_geometry + of_fitter + of_outcomes),
            (both, of_geometry + of_experience + of_outcomes),
            (in_own_order(&self.planners[0], &gpd), of_gpd),
            (in_own_order(&self.planners[1], &haf), of_haf),
            (published(&gpd), of_gpd + of_network),
            (published(&haf), of_haf + of_network),
        ];
        let nearest = found.nearest.first().map(|m| m.distance);
        Ok(Answers { ranked, nearest, candidates: (geometry.len(), found.proposals.len()) })
    }

    /// The results of the published form with other rules ([`RULES`]) on one view.
    pub(super) fn answers_by_rules(
        &self,
        view: &GraspView,
        options: &AntipodalOptions,
        memory: &mut Memory,
    ) -> Result<Answers> {
        let (fitter, of_fitter) = timed(|| GraspFitter::new(view, self.gripper, options))?;
        let clusters = ClusterOptions::default();
        let (mut ranked, mut nearest, mut candidates) = (vec![], None, 0);
        for rule in &RULES {
            let (found, seconds) = timed(|| propose(&fitter, self.network, memory, &(rule.options)()))?;
            // The neighbours are the same for all rules; the most candidates of any are reported.
            nearest = found.nearest.first().map(|m| m.distance);
            candidates = candidates.max(found.proposals.len());
            let order = if rule.best {
                rank(&[], &found.proposals, &clusters)
            } else {
                rank_experience_as_published(&found.proposals, &clusters)
            };
            ranked.push((order, of_fitter + seconds));
        }
        Ok(Answers { ranked, nearest, candidates: (0, candidates) })
    }
}

/// The grasps of a trained planner alone.
fn in_own_order(planner: &Planner, grasps: &[ScoredGrasp]) -> Vec<Ranked> {
    planner.ranked(grasps).into_iter().map(Ranked::of_planner).collect()
}
