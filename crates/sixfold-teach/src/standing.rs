//! The plane on which an object stands, if only the up direction is known.
//!
//! No photograph is taken from below, so the hull continues under the object as a wedge. The object touches the plane that it
//! stands on, so the plane is moved up as far as the masks allow. A pixel that shows the object allows heights up to the highest
//! point of the hull on its ray.

use sixfold_geometry::{Image, Mask, Plane, Vec3};

use crate::grid::Grid;
use crate::view::View;

/// Fraction of a mask's pixels that may be wrong. Chosen by hand; not swept.
const WRONG: f64 = 0.005;

/// The hull above the highest plane that the masks allow.
pub(crate) fn standing(hull: Grid, views: &[View], masks: &[Mask], up: &Vec3) -> Grid {
    let allowed = views.iter().zip(masks).filter_map(|(view, mask)| allowed_by(&hull, view, mask, up));
    let offset = allowed.fold(f64::INFINITY, f64::min) - hull.step;
    if !offset.is_finite() {
        return hull;
    }
    let plane = Plane { normal: *up, offset };
    let mut cut = hull;
    for index in 0..cut.values.len() {
        let below = -plane.distance(&cut.point(cut.place(index)));
        cut.values[index] = cut.values[index].max(below as f32);
    }
    cut
}

/// The largest height of the plane that a mask allows; `None` if the mask shows nothing.
pub(crate) fn allowed_by(hull: &Grid, view: &View, mask: &Mask, up: &Vec3) -> Option<f64> {
    let (width, height) = view.image.size();
    let mut highest = Image::filled(width, height, f64::NEG_INFINITY);
    for index in (0..hull.values.len()).filter(|i| hull.values[*i] < 0.0) {
        let point = hull.point(hull.place(index));
        let Some((pixel, depth)) = view.project(&point) else { continue };
        let radius = 0.5 * hull.step * view.camera.fx / depth;
        let span = |p: f64, length: usize| {
            let low = (p - radius).round().max(0.0) as usize;
            low..((p + radius).round() as usize + 1).min(length)
        };
        let level = up.dot(&point);
        for y in span(pixel.y, height) {
            for x in span(pixel.x, width) {
                highest[(x, y)] = level.max(highest[(x, y)]);
            }
        }
    }
    let shown = |i: &usize| mask.as_slice()[*i] && !view.is_hidden((i % width, i / width));
    let mut levels: Vec<f64> =
        (0..width * height).filter(shown).map(|i| highest.as_slice()[i]).filter(|l| l.is_finite()).collect();
    levels.sort_by(f64::total_cmp);
    levels.get((WRONG * levels.len() as f64) as usize).copied()
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::Camera;
    use sixfold_mesh::Mesh;

    use super::*;
    use crate::hull::{Outlined, hull};
    use crate::simulation::looking_at;
    use crate::view::Volume;

    /// A block of 60 mm that stands at `z = 0`.
    fn block() -> Mesh {
        let corner = |i: usize| {
            let side = |bit: usize| if (i >> bit) & 1 == 0 { -0.03 } else { 0.03 };
            Vec3::new(side(0), side(1), side(2) + 0.03)
        };
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let faces = quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        Mesh::new((0..8).map(corner).collect(), faces).unwrap()
    }

    /// Heights of the lowest and highest inside points.
    fn heights(grid: &Grid) -> [f64; 2] {
        let inside = (0..grid.values.len()).filter(|i| grid.values[*i] < 0.0);
        let z = inside.map(|i| grid.point(grid.place(i)).z);
        z.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], z| [low.min(z), high.max(z)])
    }

    #[test]
    fn the_wedge_under_an_object_goes_and_the_object_stays() {
        let camera =
            Camera { fx: 500.0, fy: 500.0, cx: 119.5, cy: 119.5, width: 240, height: 240, distortion: None };
        // All from one half, so that the wedge is hardly limited.
        let poses = [-60.0, -20.0, 20.0, 60.0].into_iter().enumerate().map(|(i, azimuth)| {
            looking_at(&Vec3::new(0.0, 0.0, 0.03), azimuth, 35.0 + 5.0 * i as f64, 0.5, 0.0)
        });
        let (views, masks): (Vec<View>, Vec<Mask>) = poses
            .map(|pose| {
                let mask = sixfold_render::render_depth(&block(), &pose, &camera).map(|d| *d > 0.0);
                let image = Image::filled(240, 240, [0; 3]);
                let eye = pose.inverse().translation();
                let view = View {
                    image,
                    camera,
                    camera_from_world: pose,
                    eye,
                    depth: None,
                    mask: None,
                    hidden: None,
                };
                (view, mask)
            })
            .unzip();
        let outlined: Vec<Outlined<'_>> =
            views.iter().zip(&masks).map(|(v, m)| Outlined::new(v, m)).collect();
        let half = Vec3::repeat(0.1);
        let hull = hull(&outlined, &Volume { low: -half, high: half }, 80, None);
        let [low, high] = heights(&hull);
        assert!(low < -0.012, "no wedge: {low}");
        let [stands, top] = heights(&standing(hull, &views, &masks, &Vec3::z()));
        assert!(stands.abs() < 0.006 && top == high, "{stands} {top} {high}");
    }
}
