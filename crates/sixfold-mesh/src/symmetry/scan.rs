//! Candidate axes: all directions are scored on the distance field, and the local optima are refined.
//!
//! An axis of order n also has the order of each prime factor of n, so primes are enough. The axis of a rotation that maps a
//! body onto itself runs through its centroid, and is a principal axis of inertia or lies in a space of equal moments
//! (Martinet et al. 2006, section 3): principal axes are always among the candidates.

use std::f64::consts::TAU;

use sixfold_geometry::{KdTree, Vec3, sphere_directions};

use super::axis::{Axis, angles_of_order, refine};
use super::body::Body;

/// Prime orders that are searched.
const PRIMES: [u32; 4] = [2, 3, 5, 7];
/// Directions on the sphere: three degrees apart.
const DIRECTIONS: usize = 4000;
/// Points with which a direction is scored.
const POINTS: usize = 160;
/// Number of best directions per prime order that are refined.
const REFINED: usize = 16;
/// Steps of their refinement on the field.
const STEPS: usize = 8;
/// Axes of one order closer than this are the same, radians.
pub(super) const SAME_AXIS: f64 = 0.07;
/// Mean distance from the field, as a fraction of the diameter, above which an axis is rejected.
pub(super) const WORST_MEAN: f64 = 0.035;

/// Axes that may be symmetries, the most promising of each order first. Orders above 2 come before order 2, because they are
/// rarer.
pub(super) fn candidates(body: &Body) -> Vec<Axis> {
    let half: Vec<Vec3> = sphere_directions(DIRECTIONS).into_iter().filter(|d| d.z > 0.0).collect();
    let both: Vec<Vec3> = half.iter().copied().chain(half.iter().map(|d| -d)).collect();
    let tree = KdTree::new(&both);
    // The area of a circle that holds a direction and its eight neighbours.
    let radius = (4.0 * 9.0 / DIRECTIONS as f64).sqrt();
    let neighbours: Vec<Vec<usize>> =
        half.iter().map(|d| tree.within(d, radius).iter().map(|n| n.index % half.len()).collect()).collect();
    let mut found: Vec<Axis> = vec![];
    for prime in PRIMES.into_iter().rev() {
        let through_centre = |direction: &Vec3| Axis { direction: *direction, point: body.centre };
        let first_turn = [TAU / f64::from(prime)];
        let scores: Vec<f64> =
            half.iter().map(|d| body.field_mean(&through_centre(d), &first_turn, POINTS)).collect();
        let mut minima: Vec<usize> = (0..half.len())
            .filter(|&i| neighbours[i].iter().all(|&j| (scores[i], i) <= (scores[j], j)))
            .collect();
        minima.sort_by(|a, b| scores[*a].total_cmp(&scores[*b]).then(a.cmp(b)));
        minima.truncate(REFINED);
        let starts = body.principal_axes.iter().copied().chain(minima.into_iter().map(|i| half[i]));
        let angles = angles_of_order(prime);
        let mut refined: Vec<(f64, Axis)> = starts
            .map(|direction| {
                let points = &body.points[..POINTS.min(body.points.len())];
                let start = through_centre(&direction);
                let axis = refine(&start, &angles, points, body.robust_scale(), STEPS, |p| body.field.at(p));
                (body.field_mean(&axis, &angles, POINTS), axis)
            })
            .filter(|(mean, _)| *mean <= WORST_MEAN * body.diameter + body.noise)
            .collect();
        refined.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (_, axis) in refined {
            if found.iter().all(|f| f.angle_to(&axis) > SAME_AXIS) {
                found.push(axis);
            }
        }
    }
    found
}
