//! Transfer by the shapes of upright objects, in addition to the network: the counterparts of held parts, and grasps there.

use std::sync::Arc;

use rayon::prelude::*;
use sixfold_experience::{Match, StoreError, Stored};
use sixfold_geometry::Vec3;
use sixfold_grasp::{Grasp, GraspFitter, centre_between_pads};

use super::Memory;
use super::align::{AlignmentHypothesis, Transferred};
use super::fit::Shape;
use super::propose::{FEWEST_HELD, Proposal, Proposals, Source, between_pads, place};
use super::upright::upright;

/// Number of experiences that are compared.
const EXPERIENCES: usize = 10;
/// A fit that is worse than the best by this has the weight `1/e`.
const FIT: f64 = 0.03;
/// Counterparts whose fit is worse than the best by more than this multiple of [`FIT`] are dropped.
const WORST: f64 = 3.0;
/// Pixels within this distance of the counterpart of a held point count as held, metres.
const AROUND: f64 = 0.008;
/// Number of held points that are compared.
const HELD: usize = 60;

/// One experience, located at one place on the current object.
struct Counterpart {
    from: Match,
    fit: f64,
    /// The experience, and the transfer of its grasp.
    stored: Arc<Stored>,
    transferred: Transferred,
    /// The held points, in the current camera's frame.
    held: Vec<Vec3>,
    /// The centre between the pads, in the current camera's frame.
    centre: Vec3,
}

impl Counterpart {
    /// The grasp, the distance by which it was moved, and whether it is firm; `None` if the gripper is nowhere free.
    fn place(&self, fitter: &GraspFitter<'_>) -> Option<(Grasp, f64, bool)> {
        let e = &self.stored.experience;
        let source =
            Source { copy: &e.crop, grasp: &e.camera_from_gripper, opening: e.opening, width: e.width };
        place(fitter, fitter.gripper(), &source, &self.transferred)
    }
}

impl Proposals {
    /// Adds grasps of those experiences of `nearest` whose table is known. If there are any, only they determine
    /// [`Proposals::held_before`]: shapes locate thin parts that the network's coordinates miss.
    pub(super) fn add_shapes(
        &mut self,
        fitter: &GraspFitter<'_>,
        memory: &mut Memory,
        nearest: &[Match],
    ) -> Result<(), StoreError> {
        if self.crop.table.is_none() {
            return Ok(());
        }
        let here = Shape::new(&self.crop);
        let mut experiences: Vec<(Match, Arc<Stored>)> = vec![];
        for m in nearest {
            if experiences.len() == EXPERIENCES || experiences.iter().any(|e| e.0.experience == m.experience)
            {
                continue;
            }
            if let Some(stored) = memory.get(m.experience)?
                && stored.experience.crop.table.is_some()
            {
                experiences.push((*m, stored));
            }
        }
        let found: Vec<Vec<Counterpart>> =
            experiences.par_iter().map(|(m, stored)| counterparts(&here, *m, stored)).collect();
        let mut found: Vec<Counterpart> = found.into_iter().flatten().collect();
        let best = found.iter().map(|c| c.fit).fold(f64::MIN, f64::max);
        found.retain(|c| c.fit > best - WORST * FIT);
        let placed: Vec<_> = found.par_iter().map(|c| c.place(fitter)).collect();
        let mut held_before = vec![0.0; self.held_before.len()];
        let mut weights = 0.0;
        for (c, placed) in found.into_iter().zip(placed) {
            let weight = ((c.fit - best) / FIT).exp();
            self.grasp_centres.push((c.centre, weight));
            if c.held.len() >= FEWEST_HELD {
                weights += weight;
                for i in self.crop.pixels() {
                    let p = self.crop.point(i);
                    if c.held.iter().any(|h| (h - p).norm_squared() < AROUND * AROUND) {
                        held_before[i] += weight;
                    }
                }
            }
            if let Some((grasp, moved, firm)) = placed {
                let score = (-c.from.distance).exp() * weight;
                let hypothesis = AlignmentHypothesis::Upright;
                self.proposals.push(Proposal { grasp, score, from: c.from, hypothesis, moved, firm });
            }
        }
        if weights > 0.0 {
            self.held_before = held_before.iter().map(|h| h / weights).collect();
        }
        Ok(())
    }
}

/// The places at which one experience is located.
fn counterparts(here: &Shape, from: Match, stored: &Arc<Stored>) -> Vec<Counterpart> {
    let e = &stored.experience;
    let there = Shape::new(&e.crop);
    let held = between_pads(&e.crop, &e.camera_from_gripper, e.opening, &e.gripper);
    let stride = held.len().div_ceil(HELD).max(1);
    let held: Vec<Vec3> = held.iter().step_by(stride).map(|&i| e.crop.point(i)).collect();
    let on_table: Vec<Vec3> = held.iter().map(|p| there.table_from_camera.transform_point(p)).collect();
    let tips = centre_between_pads(&e.camera_from_gripper);
    // The centre of the points to be held again.
    let centre = if held.is_empty() { tips } else { held.iter().sum::<Vec3>() / held.len() as f64 };
    upright(here, &there, &on_table)
        .into_iter()
        .map(|u| {
            let rotation = u.rotation(&there, here);
            let to = u.map_camera(&centre, &there, here);
            let transferred = Transferred {
                camera_from_experience: rotation.with_translation(to - rotation.transform_point(&centre)),
                hypothesis: AlignmentHypothesis::Upright,
                pixels: held.len(),
                rms: None,
                scale: Vec3::repeat(u.stretch[0]),
            };
            Counterpart {
                from,
                fit: u.fit,
                stored: stored.clone(),
                transferred,
                held: held.iter().map(|p| u.map_camera(p, &there, here)).collect(),
                centre: u.map_camera(&tips, &there, here),
            }
        })
        .collect()
}
