//! Fusion of the depth of several views into one field of signed distances (Curless and Levoy 1996), within the visual
//! hull.

use rayon::prelude::*;
use sixfold_geometry::{DepthImage, Vec3};

use crate::grid::Grid;
use crate::view::View;

/// Standard deviation of that smoothing, voxels.
const SMOOTH: f64 = 1.2;

/// Carves from a hull the space that depth shows to be empty. A measurement counts up to `reach` metres behind the measured
/// surface; at least `minimum` views have to agree.
pub(crate) fn carved(hull: &Grid, views: &[View], depths: &[DepthImage], reach: f64, minimum: f32) -> Grid {
    let mut carved = hull.clone();
    carved.values.par_iter_mut().enumerate().for_each(|(index, value)| {
        // This point is far outside already.
        if f64::from(*value) > reach {
            return;
        }
        if let Some(distance) = distance(&hull.point(hull.place(index)), views, depths, reach, minimum) {
            *value = value.max(distance);
        }
    });
    // A single wrong depth makes a hole of one voxel, while a real hollow is wide: smooth the carved part, but not the
    // hull.
    let cut = carved.values.iter().zip(&hull.values).map(|(c, h)| c - h).collect();
    let cut = Grid { values: cut, ..carved }.smoothed(SMOOTH);
    let values = cut.values.iter().zip(&hull.values).map(|(c, h)| c + h).collect();
    Grid { values, ..cut }
}

/// How far a point is in front of the measured surface, metres, limited to `reach` in both directions; `None` if too few
/// views have a measurement.
fn distance(point: &Vec3, views: &[View], depths: &[DepthImage], reach: f64, minimum: f32) -> Option<f32> {
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
    (weight >= minimum).then(|| sum / weight)
}
