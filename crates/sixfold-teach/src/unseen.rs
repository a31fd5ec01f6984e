//! The surface that no photograph shows. The visual hull is too large there: between the cones of the masks it has wedges. They are
//! removed by motion by mean curvature (Merriman, Bence and Osher 1992: blur and threshold in turn), while what a photograph shows stays
//! where it is, so that every mask stays covered (a minimal surface that agrees with the silhouettes, as in Kolev and Cremers 2008).

use rayon::prelude::*;
use sixfold_geometry::Vec3;
use sixfold_render::render_depth;

use crate::distance::signed_distances;
use crate::grid::Grid;
use crate::surface::surface;
use crate::view::View;

/// Number of times that the shape is blurred and thresholded, and the standard deviation of the blur, voxels. Chosen on the cat, the
/// driller and the duck of LM-O from 16 and from 6 photographs (mean distance of the cat to its mesh: 4.57 mm without, 3.86 with 8 rounds,
/// 3.61 with 20; with 20 rounds driller and duck from 6 photographs become worse by 0.02 mm).
const ROUNDS: usize = 12;
const DEVIATION: f64 = 4.0;
/// A voxel this deep below a visible surface stays, voxels.
const KEPT: f64 = 3.0;
/// Minimum cosine between the outward direction and the viewing ray for a surface to count as visible. It is small, because the border of a
/// mask is visible at a right angle only.
const FLATTEST: f64 = 0.05;
/// Limit for the cosine when a distance along the surface's normal becomes one along a viewing ray.
const STEEPEST: f64 = 0.2;
/// Standard deviation of the final smoothing of what was removed, voxels.
const SMOOTH: f64 = 1.2;

/// The shape with its unseen surface rounded; it only becomes smaller. With the direction upwards, what stands on the lowest plane stays
/// vertical there.
pub(crate) fn rounded(shape: Grid, views: &[View], up: Option<Vec3>) -> Grid {
    let seen = seen(&shape, views);
    let filled: Vec<bool> = shape.values.iter().map(|v| *v < 0.0).collect();
    let mirror = up.map(|up| mirror(&shape, &filled, &up));
    let grid = |values| Grid { low: shape.low, step: shape.step, size: shape.size, values };
    let mut inside = filled.clone();
    for _ in 0..ROUNDS {
        let source = |i: usize| mirror.as_ref().map_or(i, |mirror| mirror[i]);
        let values = (0..inside.len()).map(|i| f32::from(inside[source(i)])).collect();
        let blurred = grid(values).smoothed(DEVIATION);
        for (i, inside) in inside.iter_mut().enumerate() {
            *inside = filled[i] && (seen[i] || blurred.values[i] > 0.5);
        }
    }
    let signed = signed_distances(shape.size, &inside).into_iter();
    let left = grid(signed.map(|distance| shape.step as f32 * distance).collect()).smoothed(SMOOTH);
    let values = shape.values.iter().zip(&left.values).zip(&seen);
    let values = values.map(|((before, left), seen)| if *seen { *before } else { before.max(*left) });
    Grid { values: values.collect(), ..left }
}

/// The voxels just below a surface that a photograph shows.
fn seen(shape: &Grid, views: &[View]) -> Vec<bool> {
    let Some(mesh) = surface(shape) else { return vec![false; shape.values.len()] };
    let fronts: Vec<_> =
        views.par_iter().map(|v| render_depth(&mesh, &v.camera_from_world, &v.camera)).collect();
    let is_seen = |index: usize| {
        let value = f64::from(shape.values[index]);
        if value > 0.0 || value < -KEPT * shape.step {
            return false;
        }
        let point = shape.point(shape.place(index));
        let Some(outwards) = shape.gradient(index).try_normalize(1e-9) else { return false };
        views.iter().zip(&fronts).any(|(view, front)| {
            let Some((pixel, z)) = view.project(&point) else { return false };
            let at = (pixel.x.round() as usize, pixel.y.round() as usize);
            let cosine = (view.eye - point).normalize().dot(&outwards);
            let reach = (KEPT + 1.0) * shape.step / cosine.max(STEEPEST);
            let front = f64::from(front[at]);
            cosine > FLATTEST && front > 0.0 && z < front + reach && !view.is_hidden(at)
        })
    };
    (0..shape.values.len()).into_par_iter().map(is_seen).collect()
}

/// For each voxel the one whose content it has while the shape is blurred: itself, but below the lowest point of the shape its mirror image
/// above. Else the blur would see nothing there and round the lower edges.
fn mirror(shape: &Grid, filled: &[bool], up: &Vec3) -> Vec<usize> {
    let height = |index: usize| up.dot(&shape.point(shape.place(index)));
    let lowest = (0..filled.len()).filter(|i| filled[*i]).map(height).fold(f64::INFINITY, f64::min);
    let mirrored = |index: usize| {
        let below = lowest - 0.5 * shape.step - height(index);
        if !(below > 0.0) {
            return index;
        }
        let place = (shape.point(shape.place(index)) + up * (2.0 * below) - shape.low) / shape.step;
        let nearest = |k: usize| (place[k].round().max(0.0) as usize).min(shape.size[k] - 1);
        shape.index(std::array::from_fn(nearest))
    };
    (0..filled.len()).into_par_iter().map(mirrored).collect()
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::{Camera, Image, Mat3, Pose};

    use super::*;
    use crate::view::Volume;

    /// A box of 40 mm on the plane z = 0 with a wedge of 40 mm on its far side, as a hull has behind an object.
    fn wedge() -> Grid {
        let volume = Volume { low: Vec3::new(-0.03, -0.03, -0.006), high: Vec3::new(0.03, 0.07, 0.046) };
        Grid::new(&volume, 100, |p| {
            let half = if p.y < 0.02 { 0.02 } else { 0.5 * (0.06 - p.y) };
            let sides = (p.x.abs() - half).max(-0.02 - p.y).max(p.y - 0.06);
            (sides.max(-p.z).max(p.z - 0.04)) as f32
        })
    }

    /// A camera at half a metre in front of the box, which sees its near side only.
    fn view() -> View {
        let camera =
            Camera { fx: 500.0, fy: 500.0, cx: 99.5, cy: 99.5, width: 200, height: 200, distortion: None };
        let along_y = Mat3::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
        let pose = Pose::from_parts(&along_y, Vec3::new(0.0, 0.02, 0.5)).unwrap();
        let eye = pose.inverse().translation();
        let image = Image::filled(200, 200, [0; 3]);
        View { image, camera, camera_from_world: pose, eye, depth: None, mask: None, hidden: None }
    }

    #[test]
    fn a_wedge_behind_an_object_is_removed_and_what_is_seen_stays() {
        let before = wedge();
        let after = rounded(before.clone(), &[view()], Some(Vec3::z()));
        let inside = |p: [f64; 3]| after.at(&Vec3::from(p)).is_some_and(|v| v < 0.0);
        assert!(!inside([0.0, 0.055, 0.02]), "the wedge's tip");
        assert!(inside([0.0, 0.02, 0.02]) && inside([0.0, 0.035, 0.02]), "most of the body");
        for x in [-0.019, 0.0, 0.019] {
            for z in [0.001, 0.02, 0.039] {
                assert!(inside([x, -0.019, z]), "the near side at {x}, {z}");
            }
        }
        assert!(after.values.iter().zip(&before.values).all(|(a, b)| a >= b), "nothing grows");
    }

    #[test]
    fn what_stands_on_the_floor_keeps_its_lower_edge() {
        // How far the near side moves, which no photograph shows here, at half its height and 4 mm above the floor.
        let moved = |up: Option<Vec3>| {
            let after = rounded(wedge(), &[], up);
            [0.02, 0.004].map(|z| {
                let is_inside = |mm: &i32| {
                    after.at(&Vec3::new(0.0, -0.02 + 1e-3 * f64::from(*mm), z)).is_some_and(|v| v < 0.0)
                };
                (0..40).find(is_inside).unwrap()
            })
        };
        let ([half, low], [half_without, low_without]) = (moved(Some(Vec3::z())), moved(None));
        assert!(half <= 5 && half_without <= 5, "{half} and {half_without} mm");
        assert!(low <= 5 && low_without > 10, "{low} and {low_without} mm");
    }
}
