//! The planner that proposes grasps from geometry: the antipodal planner or a trained one.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use sixfold_grasp::learned::{
    HafModel, HafOptions, ScoredGrasp, best_of_clusters, cluster_scored, haf_grasps, read_haf,
};
use sixfold_grasp::{AntipodalOptions, ClusterOptions, GraspCluster, GraspView, Gripper, antipodal_grasps};

/// A planner by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PlannerKind {
    /// Pairs of contacts that face away from each other, ranked by their quality
    Antipodal,
    /// Candidates around local frames, ranked by a network (Ten Pas et al. 2017), trained on synthetic objects
    #[cfg(feature = "networks")]
    Gpd,
    /// Candidates on a grid, ranked by a linear classifier of heights (Fischinger et al. 2015), trained on synthetic objects
    Haf,
}

/// Which planner proposes.
#[derive(Debug, Args)]
pub struct PlannerArguments {
    /// Planner that proposes grasps from geometry
    #[arg(long, value_name = "NAME", value_enum, default_value = "antipodal")]
    pub planner: PlannerKind,
    /// Trained planner: a file that `sixfold train planner` wrote (default: the one that comes with Sixfold)
    #[arg(long, value_name = "FILE")]
    pub planner_weights: Option<PathBuf>,
}

/// A planner that is ready for use.
pub enum Planner {
    /// The antipodal planner.
    Antipodal,
    /// GPD.
    #[cfg(feature = "networks")]
    Gpd(Box<sixfold_planners::GpdModel>),
    /// HAF.
    Haf(HafModel),
}

impl Planner {
    /// The planner that the command line selects.
    ///
    /// # Errors
    /// When the file holds no such planner.
    pub fn new(a: &PlannerArguments) -> Result<Planner> {
        match a.planner {
            PlannerKind::Antipodal if a.planner_weights.is_some() => {
                bail!("--planner-weights: the antipodal planner has none; give --planner gpd or haf as well")
            }
            PlannerKind::Antipodal => Ok(Planner::Antipodal),
            #[cfg(feature = "networks")]
            PlannerKind::Gpd => Planner::gpd(a.planner_weights.as_deref()).context("--planner-weights"),
            PlannerKind::Haf => Planner::haf(a.planner_weights.as_deref()).context("--planner-weights"),
        }
    }

    /// GPD, from a file or as it comes with Sixfold.
    ///
    /// # Errors
    /// When the file holds no such planner.
    #[cfg(feature = "networks")]
    pub fn gpd(file: Option<&std::path::Path>) -> Result<Planner> {
        let model = match file {
            Some(file) => sixfold_planners::GpdModel::load(file)?,
            None => sixfold_planners::GpdModel::shipped(),
        };
        Ok(Planner::Gpd(Box::new(model)))
    }

    /// HAF, from a file or as it comes with Sixfold.
    ///
    /// # Errors
    /// When the file holds no such planner.
    pub fn haf(file: Option<&std::path::Path>) -> Result<Planner> {
        Ok(Planner::Haf(file.map_or_else(|| Ok(HafModel::shipped()), read_haf)?))
    }

    /// Its name.
    pub fn name(&self) -> &'static str {
        match self {
            Planner::Antipodal => "antipodal",
            #[cfg(feature = "networks")]
            Planner::Gpd(_) => "gpd",
            Planner::Haf(_) => "haf",
        }
    }

    /// A hash of its trained parameters, on which its results depend besides the options; empty for the antipodal planner.
    pub fn fingerprint(&self) -> String {
        let hash =
            |value: &serde_json::Value| format!("{:016x}", sixfold_io::fnv1a(value.to_string().as_bytes()));
        match self {
            Planner::Antipodal => String::new(),
            #[cfg(feature = "networks")]
            Planner::Gpd(model) => hash(&serde_json::to_value(model.card()).unwrap_or_default()),
            Planner::Haf(model) => hash(&model.card),
        }
    }

    /// Grasps on the object of a view with their scores, 0 to 1. `options` are those of the antipodal planner; the others use
    /// only the seed.
    ///
    /// # Errors
    /// For options out of range.
    pub fn grasps(
        &self,
        view: &GraspView,
        gripper: &Gripper,
        options: &AntipodalOptions,
    ) -> Result<Vec<ScoredGrasp>> {
        Ok(match self {
            Planner::Antipodal => {
                let scored =
                    |grasp: sixfold_grasp::Grasp| ScoredGrasp { grasp, score: grasp.quality.total() };
                antipodal_grasps(view, gripper, options)?.into_iter().map(scored).collect()
            }
            #[cfg(feature = "networks")]
            Planner::Gpd(model) => {
                let options = sixfold_grasp::learned::LocalFrameOptions {
                    seed: options.seed,
                    ..sixfold_grasp::learned::LocalFrameOptions::default()
                };
                sixfold_planners::gpd_grasps(view, gripper, &options, model)
            }
            Planner::Haf(model) => haf_grasps(view, gripper, &HafOptions::default(), model),
        })
    }

    /// Its grasps without experience, in the order in which they would be tried: clusters by their summed scores, HAF's grasps by
    /// their own scores (dissertation, section 6.3.2).
    pub fn ranked(&self, grasps: &[ScoredGrasp]) -> Vec<GraspCluster> {
        match self {
            Planner::Haf(_) => best_of_clusters(grasps, &ClusterOptions::default()),
            _ => cluster_scored(grasps, &ClusterOptions::default()),
        }
    }
}
