//! The visual hull: what no photograph shows to be empty (Laurentini 1994), as a signed distance.

use sixfold_geometry::{Image, Mask, Vec3};

use crate::distance::signed_distance;
use crate::grid::Grid;
use crate::view::{View, Volume, bilinear};

/// From this many photographs on, one of them may be wrong anywhere.
const ONE_MAY_BE_WRONG: usize = 12;

/// A view with the signed distance to its mask's border.
pub(crate) struct Outlined<'a> {
    pub view: &'a View,
    pub distance: Image<f32>,
}

impl<'a> Outlined<'a> {
    pub fn new(view: &'a View, mask: &Mask) -> Outlined<'a> {
        Outlined { view, distance: signed_distance(mask) }
    }

    /// How far a point is outside the cone of the mask, metres; `None` where the view does not show it.
    fn outside(&self, point: &Vec3) -> Option<f32> {
        let (pixel, depth) = self.view.project(point)?;
        Some(bilinear(&self.distance, pixel.x, pixel.y) * (depth / self.view.camera.fx) as f32)
    }
}

/// The signed distance to the hull on a grid, metres, below zero inside; points that no view shows are outside. `floor` is where
/// the object stands: what is below is outside.
pub(crate) fn hull(views: &[Outlined<'_>], volume: &Volume, cells: usize, floor: Option<f64>) -> Grid {
    let ignored = usize::from(views.len() >= ONE_MAY_BE_WRONG);
    Grid::new(volume, cells, |point| {
        // The two largest distances.
        let mut largest = [f32::NEG_INFINITY; 2];
        for distance in views.iter().filter_map(|view| view.outside(point)) {
            if distance > largest[0] {
                largest = [distance, largest[0]];
            } else if distance > largest[1] {
                largest[1] = distance;
            }
        }
        let distance = if largest[ignored].is_finite() { largest[ignored] } else { largest[0] };
        let distance = if distance.is_finite() { distance } else { volume.size().max() as f32 };
        floor.map_or(distance, |floor| distance.max((floor - point.z) as f32))
    })
}
