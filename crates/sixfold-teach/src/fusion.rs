//! Depth of several views in one field of signed distances (Curless and Levoy 1996), within the visual hull.

use rayon::prelude::*;
use sixfold_geometry::{DepthImage, Vec3};

use crate::grid::Grid;
use crate::view::View;

/// Standard deviation of that smoothing, voxels.
const SMOOTH: f64 = 1.2;

/// Cuts away from a hull what depth shows to be empty. `reach` is how far behind a measurement it still counts, metres, and
/// `least` how many views have to say so.
pub(crate) fn carved(hull: &Grid, views: &[View], depths: &[DepthImage], reach: f64, least: f32) -> Grid {
    let mut carved = hull.clone();
    carved.values.par_iter_mut().enumerate().for_each(|(index, value)| {
        // Far outside already.
        if f64::from(*value) > reach {
            return;
        }
        if let Some(distance) = distance(&hull.point(hull.place(index)), views, depths, reach, least) {
            *value = value.max(distance);
        }
    });
    // A single wrong depth drills a hole of one voxel, a hollow is wide: what was cut is smoothed, the hull is not.
    let cut = carved.values.iter().zip(&hull.values).map(|(c, h)| c - h).collect();
    let cut = Grid { values: cut, ..carved }.smoothed(SMOOTH);
    let values = cut.values.iter().zip(&hull.values).map(|(c, h)| c + h).collect();
    Grid { values, ..cut }
}

/// How far a point is before the measured surface, metres, at most `reach` either way; `None` where too few views say.
fn distance(point: &Vec3, views: &[View], depths: &[DepthImage], reach: f64, least: f32) -> Option<f32> {
    let (mut sum, mut weight) = (0.0, 0.0);
    for (view, depth) in views.iter().zip(depths) {
        let Some((pixel, z)) = view.project(point) else { continue };
        let measured = f64::from(depth[(pixel.x.round() as usize, pixel.y.round() as usize)]);
        if measured <= 0.0 || measured - z < -reach {
            continue;
        }
        sum += (measured - z).min(reach) as f32;
        weight += 1.0;
    }
    (weight >= least).then(|| sum / weight)
}
