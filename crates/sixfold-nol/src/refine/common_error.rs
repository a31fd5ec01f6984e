//! The error that is common to all poses of an object.
//!
//! When every photograph is compared with the others, a motion of the object that is the same in all of them has no gradient: the
//! common colours move over the surface with it. The fit is nevertheless worse, because points off the true surface appear in front
//! of different backgrounds in different photographs (parallax). The common motion is therefore searched separately: the
//! disagreement of all photographs, with recomputed common colours, is approximated by a parabola along each of six axes and
//! combined with the terms of outlines and given poses.

use rayon::prelude::*;
use sixfold_geometry::nalgebra::{Matrix6, Vector6};
use sixfold_geometry::{Pose, Vec3};

use super::appearance::{Common, PointSamples, sample_points_at};
use super::measure::Working;
use super::options::PoseRefinementOptions;
use crate::maps::Maps;

/// One object's photographs during the search for their common motion.
pub(super) struct Shared<'a, 'b> {
    pub working: Vec<&'a Working<'b>>,
    pub maps: Vec<&'a Maps>,
    pub points: &'a [Vec3],
    pub normals: &'a [Vec3],
    /// The object's centre, about which it moves.
    pub centre: Vec3,
    /// Step along each axis for the parabola: metres and radians.
    pub reach: [f64; 2],
    /// Terms of outlines and given poses: normal equations of a twist about the centre in each camera's frame.
    pub anchors: Vec<(Matrix6<f64>, Vector6<f64>)>,
}

impl Shared<'_, '_> {
    /// The object's motion in its own frame, about its centre.
    fn motion(&self, twist: &Vector6<f64>) -> Pose {
        let about = Pose::from_translation(self.centre);
        about * Pose::exp(twist) * about.inverse()
    }

    fn shown(&self, twist: &Vector6<f64>) -> Vec<PointSamples> {
        let motion = self.motion(twist);
        self.working
            .par_iter()
            .zip(&self.maps)
            .map(|(w, maps)| {
                let pose = w.pose * motion;
                let mut shown = sample_points_at(&w.view, &pose, maps, &w.allowed, self.points, self.normals);
                w.light.apply(&mut shown.values);
                shown
            })
            .collect()
    }

    /// Weighted mean of the squared differences of all photographs to the others; robust, in units of `noise`. Returned with the
    /// noise, which is estimated if `None`.
    fn disagreement(&self, twist: &Vector6<f64>, noise: Option<f64>) -> (f64, f64) {
        let shown = self.shown(twist);
        let common = Common::new(&shown, 3);
        let rows: Vec<Vec<(f64, f64)>> = shown
            .par_iter()
            .enumerate()
            .map(|(k, shown)| {
                let (target, known) = common.without(k, shown);
                let mut rows = Vec::with_capacity(known.len());
                for (i, known) in known.iter().enumerate() {
                    let weight = f64::from(shown.weights[i]) * f64::from(known.min(1.0));
                    if weight > 0.0 {
                        let pairs = shown.values[3 * i..3 * i + 3].iter().zip(&target[3 * i..3 * i + 3]);
                        let square: f64 = pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / 3.0;
                        rows.push((square, weight));
                    }
                }
                rows
            })
            .collect();
        let noise = noise.unwrap_or_else(|| {
            let mut squares: Vec<f64> = rows.iter().flatten().map(|r| r.0).collect();
            if squares.is_empty() {
                return 1.0;
            }
            let half = squares.len() / 2;
            (*squares.select_nth_unstable_by(half, f64::total_cmp).1).sqrt().max(0.01)
        });
        let (mut sum, mut weight) = (0.0, 0.0);
        for (square, w) in rows.iter().flatten() {
            let r = square / (noise * noise);
            // Geman and McClure's function: differences far above the noise come from other objects.
            sum += w * r / (1.0 + r / 9.0);
            weight += w;
        }
        (if weight > 0.0 { sum / weight } else { 0.0 }, noise)
    }

    /// The motion with the smallest disagreement; `None` if the photographs do not determine it.
    pub(crate) fn solve(&self, options: &PoseRefinementOptions) -> Option<Pose> {
        let scale = options.colors * self.working.len() as f64;
        let (here, noise) = self.disagreement(&Vector6::zeros(), None);
        let mut h = Matrix6::zeros();
        let mut g = Vector6::zeros();
        for axis in 0..6 {
            let step = self.reach[axis / 3];
            let at = |sign: f64| {
                let mut twist = Vector6::zeros();
                twist[axis] = sign * step;
                self.disagreement(&twist, Some(noise)).0
            };
            let (before, after) = (at(-1.0), at(1.0));
            h[(axis, axis)] = scale * ((after - 2.0 * here + before) / (step * step)).max(0.0);
            g[axis] = scale * (after - before) / (2.0 * step);
        }
        for (w, (anchor_h, anchor_g)) in self.working.iter().zip(&self.anchors) {
            let rotation = w.pose.rotation_matrix();
            let mut turn = Matrix6::zeros();
            turn.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
            turn.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
            h += turn.transpose() * anchor_h * turn;
            g += turn.transpose() * anchor_g;
        }
        let mut step = h.cholesky()?.solve(&-g);
        // The motion is limited to the range in which the parabolas were sampled.
        for axis in 0..6 {
            let most = 1.5 * self.reach[axis / 3];
            step[axis] = step[axis].clamp(-most, most);
        }
        step.iter().all(|v| v.is_finite()).then(|| self.motion(&step))
    }
}
