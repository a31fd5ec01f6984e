//! The visual hull: what no photograph shows to be empty (Laurentini 1994), as a signed distance.

use sixfold_geometry::{Image, Mask, Plane, Vec3};

use crate::distance::signed_distance;
use crate::grid::Grid;
use crate::silhouette::without_holes;
use crate::view::{View, Volume, bilinear};

/// From this many photographs on, a hole has to be in more than one mask.
const ONE_MAY_BE_WRONG: usize = 12;

/// A view with the signed distance to its mask's border.
pub(crate) struct Outlined<'a> {
    view: &'a View,
    /// Signed distance to the outer border: holes count as inside.
    outer: Image<f32>,
    /// Signed distance to any border; `None` if the mask has no hole.
    any: Option<Image<f32>>,
}

impl<'a> Outlined<'a> {
    pub fn new(view: &'a View, mask: &Mask) -> Outlined<'a> {
        let filled = without_holes(mask);
        let any = (filled != *mask).then(|| signed_distance(mask));
        Outlined { view, outer: signed_distance(&filled), any }
    }

    /// How far a point is outside the cones of the outer border and of the mask, metres; `None` if it is not in the view.
    pub fn outside(&self, point: &Vec3) -> Option<[f32; 2]> {
        let (pixel, depth) = self.view.project(point)?;
        let scale = (depth / self.view.camera.fx) as f32;
        let outer = bilinear(&self.outer, pixel.x, pixel.y) * scale;
        let any = self.any.as_ref().map_or(outer, |any| bilinear(any, pixel.x, pixel.y) * scale);
        Some([outer, any])
    }
}

/// The signed distance to the hull on a grid, metres, below zero inside; points that no view shows are outside. `floor` is the
/// plane on which the object stands: everything below is outside.
pub(crate) fn hull(views: &[Outlined<'_>], volume: &Volume, cells: usize, floor: Option<Plane>) -> Grid {
    let ignored = usize::from(views.len() >= ONE_MAY_BE_WRONG);
    Grid::new(volume, cells, |point| {
        // A point beyond the outer border of one mask is outside. A hole has to be in two masks, so that one wrong mask does not
        // make a hole.
        let outside: Vec<[f32; 2]> = views.iter().filter_map(|view| view.outside(point)).collect();
        let outer = outside.iter().map(|o| o[0]).fold(f32::NEG_INFINITY, f32::max);
        let largest = two_largest(outside.iter().map(|o| o[1]));
        let distance = outer.max(largest[ignored]);
        let distance = if distance.is_finite() { distance } else { volume.size().max() as f32 };
        floor.map_or(distance, |floor| distance.max(-floor.distance(point) as f32))
    })
}

/// The two largest values, largest first; minus infinity where there are fewer.
pub(crate) fn two_largest(values: impl Iterator<Item = f32>) -> [f32; 2] {
    values.fold([f32::NEG_INFINITY; 2], |[first, second], value| {
        if value > first { [value, first] } else { [first, second.max(value)] }
    })
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::{Camera, Pose};

    use super::*;

    /// A view along z from half a metre, whose mask is a square of 40 pixels (40 mm) or narrower, with or without a hole.
    fn view() -> View {
        let camera =
            Camera { fx: 500.0, fy: 500.0, cx: 39.5, cy: 39.5, width: 80, height: 80, distortion: None };
        let pose = Pose::from_translation(Vec3::new(0.0, 0.0, 0.5));
        let eye = pose.inverse().translation();
        let image = Image::filled(80, 80, [0; 3]);
        View { image, camera, camera_from_world: pose, eye, depth: None, mask: None, hidden: None }
    }

    fn square(half: f64, hole: bool) -> Mask {
        Image::from_fn(80, 80, |x, y| {
            let far = (x as f64 - 39.5).abs().max((y as f64 - 39.5).abs());
            far < half && !(hole && far < 6.0)
        })
    }

    fn at(masks: &[Mask], point: Vec3) -> f32 {
        let view = view();
        let outlined: Vec<Outlined<'_>> = masks.iter().map(|mask| Outlined::new(&view, mask)).collect();
        let volume = Volume { low: point, high: point + Vec3::repeat(1e-3) };
        hull(&outlined, &volume, 1, None).values[0]
    }

    #[test]
    fn one_narrow_mask_cuts_and_one_hole_alone_does_not() {
        let mut masks = vec![square(20.0, false); ONE_MAY_BE_WRONG];
        let (beside, centre) = (Vec3::new(0.015, 0.0, 0.0), Vec3::zeros());
        assert!(at(&masks, beside) < -0.003 && at(&masks, centre) < -0.015);
        masks[3] = square(10.0, false);
        assert!(at(&masks, beside) > 0.003, "15 mm from the centre is 5 mm outside the narrow mask");
        masks[3] = square(20.0, true);
        assert!(at(&masks, centre) < -0.015, "a hole in one mask is none");
        masks[7] = square(20.0, true);
        assert!(at(&masks, centre) > 0.003, "a hole in two masks is one");
    }
}
