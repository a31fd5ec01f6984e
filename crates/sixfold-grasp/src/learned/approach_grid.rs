//! HAF's candidates (Fischinger, Weiss and Vincze 2015): a few approach directions, rotations of the hand about each, and a grid of
//! positions over the points visible along it.

use std::f64::consts::PI;

use rayon::prelude::*;
use sixfold_geometry::Vec3;

use super::push::Pusher;
use crate::{Grasp, GraspView, Gripper};

/// Which positions are tried.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ApproachGridOptions {
    /// Rotations of the hand about the approach direction, over 180 degrees; the original has one every 15 degrees.
    pub rolls: usize,
    /// Distance of the positions, metres; the cells of the original measure 1 cm.
    pub step: f64,
}

impl Default for ApproachGridOptions {
    fn default() -> Self {
        ApproachGridOptions { rolls: 12, step: 0.01 }
    }
}

/// Tilt of the approaches from straight down, away from the camera, radians: from the top, slanted and nearly from the front
/// (dissertation, section 6.3.2: "top-down and forward-facing grasps"). Chosen by hand; not swept.
const TILTS: [f64; 3] = [0.0, 0.25 * PI, 0.45 * PI];

/// Candidates on the object of a view, in the order of approach, roll and position.
pub fn approach_grid_grasps(
    view: &GraspView,
    gripper: &Gripper,
    options: &ApproachGridOptions,
) -> Vec<Grasp> {
    let pusher = Pusher::new(view, gripper);
    let hands: Vec<(Vec3, Vec3)> = TILTS
        .iter()
        .flat_map(|&tilt| {
            let (approach, across) = approach(&pusher.down(), tilt);
            let side = approach.cross(&across);
            (0..options.rolls).map(move |roll| {
                let angle = PI * roll as f64 / options.rolls as f64;
                (approach, across * angle.cos() + side * angle.sin())
            })
        })
        .collect();
    let found: Vec<Vec<Grasp>> = hands
        .into_par_iter()
        .map(|(approach, closing)| over_the_object(&pusher, &approach, &closing, options.step))
        .collect();
    found.into_iter().flatten().collect()
}

/// The approach tilted from straight down towards the viewing direction, and a horizontal direction perpendicular to it.
fn approach(down: &Vec3, tilt: f64) -> (Vec3, Vec3) {
    let level = |v: Vec3| (v - down * v.dot(down)).try_normalize(1e-3);
    // For a camera that looks straight down, any horizontal direction is away from the camera.
    let away = level(Vec3::z()).or_else(|| level(Vec3::y())).unwrap_or_else(Vec3::x);
    let approach = down * tilt.cos() + away * tilt.sin();
    (approach, down.cross(&away))
}

/// Candidates for one orientation of the hand over a grid of positions: each starts above the first point between the pads.
fn over_the_object(pusher: &Pusher<'_>, approach: &Vec3, closing: &Vec3, step: f64) -> Vec<Grasp> {
    let points = &pusher.view.object.points;
    let across = approach.cross(closing);
    let flat: Vec<[f64; 3]> =
        points.iter().map(|p| [p.dot(closing), p.dot(&across), p.dot(approach)]).collect();
    let range = |k: usize| {
        flat.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), p| (low.min(p[k]), high.max(p[k])))
    };
    if flat.is_empty() {
        return vec![];
    }
    let ((x0, x1), (y0, y1)) = (range(0), range(1));
    let opening = pusher.gripper.max_opening;
    let (half_opening, half_width) = (0.5 * opening, 0.5 * pusher.gripper.finger_width);
    let count = |low: f64, high: f64| ((high - low) / step) as usize + 1;
    let mut grasps = vec![];
    for (i, j) in (0..count(x0, x1)).flat_map(|i| (0..count(y0, y1)).map(move |j| (i, j))) {
        let (x, y) = (x0 + step * i as f64, y0 + step * j as f64);
        let inside = flat.iter().filter(|p| (p[0] - x).abs() < half_opening && (p[1] - y).abs() < half_width);
        let first = inside.map(|p| p[2]).fold(f64::INFINITY, f64::min);
        if first.is_finite() {
            let contact = closing * x + across * y + approach * first;
            grasps.extend(pusher.push(&contact, approach, closing, opening));
        }
    }
    grasps
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use sixfold_geometry::PointCloud;

    use super::*;

    #[test]
    fn approaches_point_downwards_and_hands_are_level_or_rolled() {
        for tilt in TILTS {
            let down = Vec3::new(0.0, 0.6, 0.8);
            let (approach, across) = approach(&down, tilt);
            assert!((approach.norm() - 1.0).abs() < 1e-12 && approach.dot(&across).abs() < 1e-12);
            assert!((approach.dot(&down) - tilt.cos()).abs() < 1e-12 && tilt < FRAC_PI_2);
            // Away from the camera, not towards it.
            assert!(approach.z >= down.z * tilt.cos() - 1e-12);
        }
    }

    #[test]
    fn a_block_gets_candidates_from_above_whose_tips_are_below_its_top() {
        let mut object = PointCloud::default();
        for i in 0..=12 {
            for k in 0..=12 {
                object.points.push(Vec3::new(
                    0.003 * f64::from(i) - 0.018,
                    0.003 * f64::from(k) - 0.018,
                    0.55,
                ));
                object.normals.push(-Vec3::z());
            }
        }
        let view = GraspView::from_above(object, 0.6, 0.003);
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let grasps = approach_grid_grasps(&view, &gripper, &ApproachGridOptions::default());
        let above: Vec<&Grasp> = grasps.iter().filter(|g| g.approach().z > 0.99).collect();
        assert!(above.len() > 50, "{}", above.len());
        assert!(above.iter().all(|g| g.camera_from_gripper.translation().z > 0.559));
    }
}
