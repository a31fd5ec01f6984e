//! The plane on which an object stands, where up is known and the plane is not.
//!
//! No photograph is taken from below, so the hull continues under the object as a wedge. Whatever the object stands on, it touches: the
//! plane is moved up as far as the masks allow. A pixel that shows the object allows it as far as the highest point of the hull on its
//! ray.

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

/// How far up a mask allows the plane; `None` where it shows nothing.
fn allowed_by(hull: &Grid, view: &View, mask: &Mask, up: &Vec3) -> Option<f64> {
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
