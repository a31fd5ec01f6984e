//! HAF as a planner: a linear classifier of height accumulated features, and the candidates that it ranks.
//!
//! The original trains a support vector machine (Fischinger, Weiss and Vincze 2015); ours is linear, and its margin is converted to
//! a success probability with a logistic curve (Platt 1999).

use rayon::prelude::*;

use super::heights::{HeightFeature, HeightGrid};
use super::{ApproachGridOptions, ScoredGrasp, approach_grid_grasps};
use crate::{GraspView, Gripper};

/// Options of HAF's candidates.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct HafOptions {
    /// The candidates.
    pub grid: ApproachGridOptions,
}

/// A linear classifier of height accumulated features.
#[derive(Debug, Clone, PartialEq)]
pub struct HafModel {
    /// Features with their weights, 1/m.
    pub features: Vec<(HeightFeature, f32)>,
    /// The margin of a grid whose features are all 0.
    pub bias: f32,
    /// Slope and offset of the logistic curve over the margin.
    pub probability: [f32; 2],
    /// Information about the training for people: a JSON object.
    pub card: serde_json::Value,
}

impl HafModel {
    /// The shipped model; `haf.md` next to its file describes its training.
    ///
    /// # Panics
    /// Never: a test reads it.
    pub fn shipped() -> HafModel {
        super::parse_haf(include_str!("../../planners/haf.json"), "haf.json")
            .unwrap_or_else(|error| unreachable!("the shipped planner: {error}"))
    }

    /// The classifier's margin: positive for grasps predicted to hold, without a physical unit.
    pub fn margin(&self, grid: &HeightGrid) -> f32 {
        self.features.iter().map(|(feature, weight)| weight * feature.value(grid)).sum::<f32>() + self.bias
    }

    /// The success probability of a grasp.
    pub fn score(&self, grid: &HeightGrid) -> f64 {
        let [slope, offset] = self.probability.map(f64::from);
        1.0 / (1.0 + (-(slope * f64::from(self.margin(grid)) + offset)).exp())
    }
}

/// Candidates on the object of a view with their success probability, the best first.
pub fn haf_grasps(
    view: &GraspView,
    gripper: &Gripper,
    options: &HafOptions,
    model: &HafModel,
) -> Vec<ScoredGrasp> {
    let grasps = approach_grid_grasps(view, gripper, &options.grid);
    let mut scored: Vec<ScoredGrasp> = grasps
        .into_par_iter()
        .map(|grasp| ScoredGrasp { score: model.score(&HeightGrid::new(view, &grasp)), grasp })
        .collect();
    // A stable sort: ties keep the order of the grid.
    scored.sort_by(|a, b| b.score.total_cmp(&a.score));
    scored
}
