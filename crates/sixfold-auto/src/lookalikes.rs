//! Rotations that an object's shape hardly shows and its colours do: a box with print, a can with a label. A method on depth takes
//! one of them by chance; with a colour image the pool takes the one whose colours agree.

use std::f64::consts::TAU;

use rayon::prelude::*;
use sixfold_align::evidence::{EvidenceCollector, Scene, Shape};
use sixfold_align::{Evidence, VerificationOptions};
use sixfold_geometry::Pose;
use sixfold_mesh::{ContinuousSymmetry, Mesh, SymmetryOptions, find_symmetries};

use crate::hypotheses::{moved_to_depth, ranking};

/// Noise of the mesh's surface as a fraction of its diameter: what is alike for depth need not be a symmetry. Chosen by hand; not
/// swept.
const NOISE: f64 = 0.005;
/// A rotation that is off a known symmetry by less is that symmetry, radians; chosen by hand, not swept.
const KNOWN: f64 = 0.1;
/// Most discrete rotations that are tried.
const MOST: usize = 24;
/// Steps of a full turn about a continuous axis; chosen by hand, not swept.
const STEPS: usize = 16;
/// Halvings of that step around the best one.
const HALVINGS: usize = 4;
/// By how much colours have to agree better; chosen by hand, not swept.
const BETTER: f64 = 0.03;
/// Depth has to agree nearly as well; chosen by hand, not swept.
const NEARLY: f64 = 0.9;

/// The rotations of an object, in its frame.
#[derive(Debug, Default)]
pub(crate) struct LookAlikes {
    /// The identity first.
    discrete: Vec<Pose>,
    axes: Vec<ContinuousSymmetry>,
}

impl LookAlikes {
    /// Those of a mesh that are not among its known symmetries. None for a mesh without colours.
    pub(crate) fn of(mesh: &Mesh, diameter: f64, symmetries: &[Pose]) -> LookAlikes {
        if mesh.colors().is_none() && mesh.texture().is_none() {
            return LookAlikes::default();
        }
        let options = SymmetryOptions { noise: NOISE * diameter, ..SymmetryOptions::default() };
        // An object of no size, or of several metres, has none.
        let found = find_symmetries(mesh, &options).unwrap_or_default();
        let is_new = |pose: &Pose| symmetries.iter().all(|known| known.rotation_angle_to(pose) > KNOWN);
        let mut discrete = vec![Pose::identity()];
        for pose in found.iter().flat_map(|s| s.poses()).filter(is_new) {
            if discrete.iter().all(|d| d.rotation_angle_to(&pose) > KNOWN) {
                discrete.push(pose);
            }
        }
        discrete.truncate(MOST);
        let axes: Vec<ContinuousSymmetry> = found
            .iter()
            .filter_map(|s| s.continuous())
            // A quarter turn and one more: a known symmetry of order 4 is not all rotations.
            .filter(|axis| is_new(&axis.rotation(0.25 * TAU)) || is_new(&axis.rotation(0.15 * TAU)))
            .collect();
        LookAlikes { discrete, axes }
    }

    /// The pose among its look-alikes whose colours agree best with the image, if another than this one.
    pub(crate) fn best(
        &self,
        scene: &Scene<'_>,
        shape: &Shape<'_>,
        diameter: f64,
        (pose, evidence): (&Pose, &Evidence),
    ) -> Option<(Pose, Evidence)> {
        if self.discrete.len() <= 1 && self.axes.is_empty() {
            return None;
        }
        let options = VerificationOptions::default();
        let judge = |pose: Pose| {
            let evidence = EvidenceCollector::default().collect(scene, shape, &pose, &options);
            (agreement(&evidence), pose, evidence)
        };
        let mut best = (agreement(evidence)?, *pose, evidence.clone());
        let needed = best.0 + BETTER;
        let tried: Vec<(Option<f64>, Pose, Evidence)> = self
            .discrete
            .par_iter()
            .flat_map_iter(|discrete| self.around(discrete))
            .map(|rotation| judge(*pose * rotation))
            .collect();
        let better = |a: &(f64, Pose, Evidence), b: &(Option<f64>, Pose, Evidence)| {
            b.0.is_some_and(|agreement| agreement > a.0)
        };
        let mut take = |candidate: (Option<f64>, Pose, Evidence)| {
            if better(&best, &candidate)
                && let (Some(agreement), pose, evidence) = candidate
            {
                best = (agreement, pose, evidence);
            }
            best.1
        };
        for candidate in tried {
            take(candidate);
        }
        for axis in &self.axes {
            let mut step = TAU / STEPS as f64;
            for _ in 0..HALVINGS {
                step *= 0.5;
                let from = take((None, *pose, evidence.clone()));
                for angle in [-step, step] {
                    take(judge(from * axis.rotation(angle)));
                }
            }
        }
        if best.0 < needed {
            return None;
        }
        // A look-alike differs a little: depth moves it to its place.
        if let Some(moved) = moved_to_depth(scene, shape, diameter, &best.1) {
            let (agreement, moved, after) = judge(moved);
            if agreement.is_some_and(|agreement| agreement >= needed) && ranking(&after) > ranking(&best.2) {
                best = (best.0, moved, after);
            }
        }
        (ranking(&best.2) >= NEARLY * ranking(evidence)).then_some((best.1, best.2))
    }

    /// A discrete rotation, and with it all steps about every axis.
    fn around(&self, discrete: &Pose) -> Vec<Pose> {
        let steps = (1..STEPS).map(|k| TAU * k as f64 / STEPS as f64);
        let turned = self.axes.iter().flat_map(|axis| steps.clone().map(|angle| axis.rotation(angle)));
        std::iter::once(*discrete).chain(turned.map(|rotation| *discrete * rotation)).collect()
    }
}

/// How well the colours of a pose agree with the image.
fn agreement(evidence: &Evidence) -> Option<f64> {
    let color = evidence.color.as_ref()?;
    Some(color.correlation - color.tint.unwrap_or(0.0))
}
