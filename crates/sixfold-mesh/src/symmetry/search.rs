//! The orders of an axis, and the other axes that follow from those found: the symmetries of a body form a group.

use std::f64::consts::TAU;

use nalgebra::{Unit as UnitVector, UnitQuaternion};
use sixfold_geometry::Vec3;

use super::axis::{Axis, angles_of_order};
use super::body::Body;
use super::scan::{SAME_AXIS, WORST_MEAN, candidates};
use super::{Deviation, FoundSymmetry, Verdict, color_verdict, shape_verdict};

/// Highest order that is searched: nuts have 6, twelve-sided knobs 12.
const MAX_ORDER: u32 = 12;
/// Rotations at which a continuous symmetry is tested: multiples of the golden angle are not close to the rotations of any
/// order.
const ANGLES: usize = 16;
/// Points with which an axis can be rejected before all points are tested.
const FEW: usize = 250;
/// Points with which an axis is refined on the surface, and steps of the refinement: at first, and when it is accepted.
const FIRST: (usize, usize) = (250, 5);
const ALL: (usize, usize) = (1000, 2);
/// Maximum number of axes: an icosahedron has 31.
const MAX_AXES: usize = 31;
/// Largest difference between the angle of a product of two rotations and an angle of an order, radians.
const ANGLE_TOLERANCE: f64 = 0.06;
/// Number of half turns perpendicular to a continuous axis that are tried to find the one that preserves the colours.
const FLIPS: usize = 36;

/// Some rotations about an axis are listed besides all rotations only if their difference in colour or shape is at most this
/// fraction of the other's: fewer angles always fit a little better.
const CLEARER: f64 = 0.5;

/// One order of one axis, with its evidence.
#[derive(Debug, Clone, Copy)]
struct Tested {
    axis: Axis,
    order: Option<u32>,
    deviation: Deviation,
    verdict: Verdict,
}

/// The search of one body.
#[derive(Debug)]
pub(super) struct Search<'a> {
    body: &'a Body,
    found: Vec<Tested>,
    /// Axes that were tested, with or without success.
    seen: Vec<Axis>,
}

impl<'a> Search<'a> {
    pub fn new(body: &'a Body) -> Search<'a> {
        Search { body, found: vec![], seen: vec![] }
    }

    pub fn run(mut self) -> Vec<FoundSymmetry> {
        for axis in candidates(self.body) {
            self.test(&axis);
            if self.round().is_some() {
                break;
            }
        }
        if self.round().is_none() {
            self.complete_group();
        }
        if let Some(round) = self.round() {
            self.finish_round(&round);
        } else {
            self.leave_out_repetitions();
            self.leave_out_what_follows();
        }
        self.report()
    }

    /// The sure continuous axis, if there is one.
    fn round(&self) -> Option<Tested> {
        self.found.iter().find(|t| t.order.is_none() && t.verdict == Verdict::Sure).copied()
    }

    /// A body with a sure continuous axis is a sphere, or has half turns perpendicular to the axis, or neither.
    fn finish_round(&mut self, round: &Tested) {
        let axis = &round.axis;
        self.found = vec![*round];
        let across = axis.direction.cross(&Vec3::ith(axis.direction.iamin(), 1.0)).normalize();
        let across = Axis { direction: across, point: self.body.centre };
        if let Some(second) = self.tested(&across, None).filter(|t| t.verdict == Verdict::Sure) {
            let third =
                Axis { direction: axis.direction.cross(&second.axis.direction).normalize(), ..second.axis };
            self.found.push(second);
            self.found.extend(self.tested(&third, None));
            return;
        }
        // Of all half turns perpendicular to the axis, the one that preserves the colours best.
        let Some(flip) = self.tested(&across, Some(2)) else { return };
        let rotated = |k: usize| {
            let turn = axis.rotation(k as f64 * std::f64::consts::PI / FLIPS as f64);
            Axis { direction: turn.transform_direction(&flip.axis.direction), ..flip.axis }
        };
        let colors =
            |axis: &Axis| self.body.color_difference(axis, &angles_of_order(2)).map_or(0.0, |c| c.p95);
        let best = (0..FLIPS).map(rotated).min_by(|a, b| colors(a).total_cmp(&colors(b)));
        let best = best.and_then(|axis| self.tested(&axis, Some(2)));
        self.found.push(best.unwrap_or(flip));
    }

    /// Tests an axis for any angle and for every order, unless it was tested already.
    fn test(&mut self, axis: &Axis) {
        if self.seen.iter().any(|s| s.angle_to(axis) < SAME_AXIS) {
            return;
        }
        self.seen.push(*axis);
        let continuous = self.tested(axis, None);
        self.found.extend(continuous);
        if continuous.is_some_and(|t| t.verdict == Verdict::Sure) {
            return;
        }
        let orders: Vec<Tested> =
            (2..=MAX_ORDER).filter_map(|order| self.tested(axis, Some(order))).collect();
        let sure = orders.iter().filter(|t| t.verdict == Verdict::Sure).max_by_key(|t| t.order);
        let likely = orders.iter().filter(|t| t.verdict == Verdict::Likely).max_by_key(|t| t.order);
        self.found.extend(sure);
        let more = likely.filter(|l| continuous.is_none() && sure.is_none_or(|s| l.order > s.order));
        self.found.extend(more);
    }

    /// The refined axis with its evidence; `None` if it is not a symmetry.
    fn tested(&self, axis: &Axis, order: Option<u32>) -> Option<Tested> {
        let body = self.body;
        let angles = order.map_or_else(any_angles, angles_of_order);
        if body.field_mean(axis, &angles, FEW) > WORST_MEAN * body.diameter + body.noise {
            return None;
        }
        // A few of the angles are enough to refine an axis.
        let step = angles.len().div_ceil(4);
        let few: Vec<f64> = angles.iter().copied().step_by(step).collect();
        let refined = body.refined(axis, &few, FIRST).tidy(&body.centre);
        let verdict = |d: &Deviation| shape_verdict(d, body.diameter, body.noise);
        if verdict(&body.deviation(&refined, &angles, FEW)) == Verdict::None {
            return None;
        }
        let refined = body.refined(&refined, &few, ALL).tidy(&body.centre);
        let deviation = body.deviation(&refined, &angles, usize::MAX);
        let verdict = verdict(&deviation);
        (verdict > Verdict::None).then_some(Tested { axis: refined, order, deviation, verdict })
    }

    /// Tests the axes of all products of two rotations that are sure, until there are no new ones.
    fn complete_group(&mut self) {
        let mut done = 0;
        loop {
            let sure: Vec<Tested> = self
                .found
                .iter()
                .filter(|t| t.verdict == Verdict::Sure && t.order.is_some())
                .copied()
                .collect();
            if sure.len() == done || sure.len() >= MAX_AXES {
                return;
            }
            done = sure.len();
            for (i, a) in sure.iter().enumerate() {
                for b in sure.iter().skip(i + 1) {
                    for axis in self.products(a, b) {
                        self.test(&axis);
                    }
                }
            }
        }
    }

    /// The axis of the product of `a` and `b`, and the axes to which each rotates the other's axis.
    fn products(&self, a: &Tested, b: &Tested) -> Vec<Axis> {
        let turn = |t: &Tested| {
            let direction = UnitVector::new_unchecked(t.axis.direction);
            UnitQuaternion::from_axis_angle(&direction, TAU / f64::from(t.order.unwrap_or(1)))
        };
        let (ra, rb) = (turn(a), turn(b));
        let of_product = (rb * ra).axis_angle().and_then(|(direction, angle)| {
            let of_order = |n: u32| {
                let steps = angle * f64::from(n) / TAU;
                (steps - steps.round()).abs() * TAU / f64::from(n) < ANGLE_TOLERANCE
            };
            (angle > ANGLE_TOLERANCE && (2..=MAX_ORDER).any(of_order)).then(|| direction.into_inner())
        });
        let directions = [Some(ra * b.axis.direction), Some(rb * a.axis.direction), of_product];
        let through = |direction: Vec3| Axis { direction, point: (a.axis.point + b.axis.point) * 0.5 };
        directions.into_iter().flatten().map(through).collect()
    }

    /// Removes repeated axes, since refined axes may have become the same. An entry of an axis is removed if another entry with
    /// a verdict at least as sure implies it; of equal entries, the one that fits best stays.
    fn leave_out_repetitions(&mut self) {
        let all = std::mem::take(&mut self.found);
        let says = |a: &Tested, b: &Tested| match (a.order, b.order) {
            (None, _) => true,
            (Some(a), Some(b)) => a.is_multiple_of(b),
            (Some(_), None) => false,
        };
        let error = |t: &Tested| t.deviation.p95 + t.deviation.max;
        let is_repeated = |i: usize| {
            let t = &all[i];
            all.iter().enumerate().any(|(j, other)| {
                let first = (error(other), j) < (error(t), i);
                i != j
                    && other.axis.angle_to(&t.axis) < SAME_AXIS
                    && other.verdict >= t.verdict
                    && says(other, t)
                    && (first || other.verdict > t.verdict || !says(t, other))
            })
        };
        self.found = (0..all.len()).filter(|i| !is_repeated(*i)).map(|i| all[i]).collect();
    }

    /// Removes symmetries that follow from a continuous axis. A discrete symmetry that fits clearly better is kept: a prism of
    /// twelve sides has its own. Otherwise all half turns perpendicular to the axis are equally likely, and one is kept. For a
    /// body that may be a sphere, three axes are kept.
    fn leave_out_what_follows(&mut self) {
        let round: Vec<Tested> = self.found.iter().filter(|t| t.order.is_none()).copied().collect();
        let Some(best) = round.iter().map(|t| t.deviation.p95).reduce(f64::min) else { return };
        let is_clear = |t: &Tested| t.verdict == Verdict::Sure && t.deviation.p95 <= CLEARER * best;
        let any_clear = self.found.iter().any(|t| t.order == Some(2) && is_clear(t));
        let across = |t: &Tested| t.order == Some(2) && round[0].axis.angle_to(&t.axis) > 1.0;
        let mut flip: Vec<Tested> = self.found.iter().filter(|t| across(t)).copied().collect();
        flip.sort_by(|a, b| a.deviation.p95.total_cmp(&b.deviation.p95));
        flip.truncate(usize::from(round.len() == 1 && !any_clear));
        for t in &mut flip {
            t.verdict = t.verdict.min(Verdict::Likely);
        }
        self.found.retain(|t| t.order.is_some() && is_clear(t));
        self.found.extend(round.into_iter().take(3));
        self.found.extend(flip);
    }

    /// The symmetries found, with their colour differences and the orders that the colours allow.
    fn report(self) -> Vec<FoundSymmetry> {
        let mut report: Vec<FoundSymmetry> = vec![];
        for tested in &self.found {
            let whole = self.with_color(tested);
            report.push(whole);
            report.extend(self.part_by_color(tested, &whole));
        }
        let key = |s: &FoundSymmetry| (s.order.map_or(0, |n| MAX_ORDER + 1 - n), s.by_shape != Verdict::Sure);
        report.sort_by_key(key);
        report
    }

    /// The largest order below that of an axis that preserves the colours clearly better, unless it is listed for its shape.
    fn part_by_color(&self, tested: &Tested, whole: &FoundSymmetry) -> Option<FoundSymmetry> {
        let whole_color = whole.color.filter(|_| whole.by_shape_and_color < whole.by_shape)?;
        let is_part = |n: &u32| tested.order.is_none_or(|order| n < &order && order.is_multiple_of(*n));
        let is_clearer = |order: &u32| {
            let color = self.body.color_difference(&tested.axis, &angles_of_order(*order));
            color.is_some_and(|c| {
                c.p95 <= CLEARER * whole_color.p95 && color_verdict(&c) > whole.by_shape_and_color
            })
        };
        let order = (2..=MAX_ORDER).rev().filter(is_part).find(is_clearer)?;
        let is_listed = |t: &Tested| t.order == Some(order) && t.axis.angle_to(&tested.axis) < SAME_AXIS;
        if self.found.iter().any(is_listed) {
            return None;
        }
        let part = Tested { order: Some(order), ..*tested };
        let deviation = self.body.deviation(&part.axis, &angles_of_order(order), usize::MAX);
        let verdict = shape_verdict(&deviation, self.body.diameter, self.body.noise);
        (verdict > Verdict::None).then(|| self.with_color(&Tested { deviation, verdict, ..part }))
    }

    fn with_color(&self, t: &Tested) -> FoundSymmetry {
        let angles = t.order.map_or_else(any_angles, angles_of_order);
        let color = self.body.color_difference(&t.axis, &angles);
        FoundSymmetry {
            axis: t.axis.direction,
            point: t.axis.point,
            order: t.order,
            deviation: t.deviation,
            color,
            diameter: self.body.diameter,
            by_shape: t.verdict,
            by_shape_and_color: color.map_or(t.verdict, |c| t.verdict.min(color_verdict(&c))),
        }
    }
}

/// Angles that represent all rotations of a continuous symmetry.
fn any_angles() -> Vec<f64> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (1..=ANGLES).map(|k| (k as f64 * golden).rem_euclid(TAU)).collect()
}
