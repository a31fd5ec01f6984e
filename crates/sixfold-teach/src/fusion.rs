//! Fusion of the depth of several views into one field of signed distances (Curless and Levoy 1996), within the visual
//! hull. Near the hull's surface the mean of n depths has to exceed its standard deviation, `sqrt(sum(s^2)) / n` with `s` that of a depth z,
//! which grows with z^2 (Khoshelham and Elberink 2012); this use of it is ours.

use rayon::prelude::*;
use sixfold_geometry::{DepthImage, Vec3};

use crate::grid::Grid;
use crate::view::View;

/// Standard deviation of that smoothing, voxels.
const SMOOTH: f64 = 1.2;
/// Cosine of the angle between the outward direction and the direction to a camera below which the camera sees a wall from inside. Chosen
/// by hand, not swept: views along a wall have to count, they made the hull.
const INSIDE: f64 = -0.25;
/// Depth of [`Carving::noise`], metres.
const NOISE_DEPTH: f64 = 0.5;

/// What may be carved from a hull.
pub(crate) struct Carving {
    /// How far behind a measured surface a measurement counts, metres.
    pub reach: f64,
    /// Minimum number of views that have to agree.
    pub minimum: f32,
    /// Thickness of a wall, metres: what is nearer to the hull's surface is carved only by views from outside. Else noise in the depth of
    /// a bowl's inside makes holes in the bowl.
    pub wall: f64,
    /// Standard deviation of a depth of half a metre, metres; it grows with the square of the depth, as that of stereo cameras. As near as
    /// `wall` to the hull's surface, which is more precise, depth carves only what it shows to be empty by more than the standard
    /// deviation of its mean.
    pub noise: f64,
}

/// Carves from a hull the space that depth shows to be empty.
pub(crate) fn carved(hull: &Grid, views: &[View], depths: &[DepthImage], carving: &Carving) -> Grid {
    let mut carved = hull.clone();
    carved.values.par_iter_mut().enumerate().for_each(|(index, value)| {
        // This point is far outside already.
        if f64::from(*value) > carving.reach {
            return;
        }
        let point = hull.point(hull.place(index));
        let outwards =
            (carving.wall > 0.0 && f64::from(*value) > -carving.wall).then(|| hull.gradient(index));
        if let Some(distance) = distance(&point, outwards, views, depths, carving) {
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

/// How far a point is in front of the measured surface, metres, limited to the reach in both directions; `None` if too few views have a
/// measurement. With a direction outwards, views from inside do not count.
fn distance(
    point: &Vec3,
    outwards: Option<Vec3>,
    views: &[View],
    depths: &[DepthImage],
    Carving { reach, minimum, noise, .. }: &Carving,
) -> Option<f32> {
    let outwards = outwards.and_then(|o| o.try_normalize(1e-9));
    let (mut sum, mut weight, mut variance) = (0.0f32, 0.0f32, 0.0f64);
    for (view, depth) in views.iter().zip(depths) {
        if outwards.is_some_and(|o| o.dot(&(view.eye - point).normalize()) < INSIDE) {
            continue;
        }
        let Some((pixel, z)) = view.project(point) else { continue };
        let measured = f64::from(depth[(pixel.x.round() as usize, pixel.y.round() as usize)]);
        if measured <= 0.0 || measured - z < -*reach {
            continue;
        }
        sum += (measured - z).min(*reach) as f32;
        weight += 1.0;
        variance += (noise * (z / NOISE_DEPTH).powi(2)).powi(2);
    }
    let margin = if outwards.is_some() { variance.sqrt() as f32 } else { 0.0 };
    (weight >= *minimum).then(|| (sum - margin) / weight)
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::{Camera, Image, Pose};

    use super::*;
    use crate::view::Volume;

    /// Whether a point on the z axis is left of a wall of 10 mm across z, of which one camera half a metre before it measures the depth.
    fn left(measured: f32, carving: &Carving, z: f64) -> bool {
        let volume = Volume { low: Vec3::repeat(-0.01), high: Vec3::repeat(0.01) };
        let wall = Grid::new(&volume, 20, |p| (p.z.abs() - 0.005) as f32);
        let camera =
            Camera { fx: 500.0, fy: 500.0, cx: 39.5, cy: 39.5, width: 80, height: 80, distortion: None };
        let pose = Pose::from_translation(Vec3::new(0.0, 0.0, 0.5));
        let eye = pose.inverse().translation();
        let image = Image::filled(80, 80, [0; 3]);
        let view =
            View { image, camera, camera_from_world: pose, eye, depth: None, mask: None, hidden: None };
        let depth = Image::filled(80, 80, measured);
        let left = carved(&wall, std::slice::from_ref(&view), std::slice::from_ref(&depth), carving);
        left.at(&Vec3::new(0.0, 0.0, z)).unwrap() < 0.0
    }

    #[test]
    fn the_far_side_of_a_wall_is_not_carved_by_wrong_depth_of_its_near_side() {
        // The camera measures 8 mm behind the wall.
        let inside = |thickness: f64, z: f64| {
            left(0.513, &Carving { reach: 0.02, minimum: 1.0, wall: thickness, noise: 0.0 }, z)
        };
        assert!(!inside(0.0, 0.004) && !inside(0.0, -0.004), "without a thickness all is carved");
        assert!(inside(0.004, 0.0035), "the far side stays");
        assert!(!inside(0.004, -0.0035), "the near side is carved, the camera is outside");
    }

    #[test]
    fn the_surface_is_carved_only_where_depth_is_further_behind_than_its_noise() {
        let inside = |measured: f32, noise: f64| {
            left(measured, &Carving { reach: 0.02, minimum: 1.0, wall: 0.004, noise }, -0.0035)
        };
        // 1.5 mm behind that point, 3 mm behind the surface.
        assert!(!inside(0.498, 0.0));
        assert!(!inside(0.498, 0.001));
        assert!(inside(0.498, 0.002));
        assert!(!inside(0.502, 0.002));
    }
}
