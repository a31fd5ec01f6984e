//! Distances to a surface on a grid, interpolated: thousands of axes are scored by lookup instead of search.

use sixfold_geometry::{KdTree, Vec3};

/// Grid points along each side: a cell is a twentieth of the object's radius.
const SIDE: usize = 40;

/// Distances to points of a surface, within a cube about a centre.
#[derive(Debug)]
pub(super) struct DistanceField {
    corner: Vec3,
    cell: f64,
    values: Vec<f32>,
}

impl DistanceField {
    /// The field in the cube that holds the sphere of `radius` about `centre`.
    pub fn new(points: &[Vec3], centre: &Vec3, radius: f64) -> DistanceField {
        let tree = KdTree::new(points);
        let half = 1.05 * radius;
        let corner = centre.add_scalar(-half);
        let cell = 2.0 * half / (SIDE - 1) as f64;
        let value = |i: usize| {
            let at = Vec3::new((i % SIDE) as f64, (i / SIDE % SIDE) as f64, (i / SIDE / SIDE) as f64);
            tree.nearest(&(corner + at * cell)).map_or(f32::MAX, |n| n.distance as f32)
        };
        DistanceField { corner, cell, values: (0..SIDE * SIDE * SIDE).map(value).collect() }
    }

    /// Distance and its gradient at a point; outside the cube, those at its border.
    pub fn at(&self, p: &Vec3) -> (f64, Vec3) {
        let last = (SIDE - 1) as f64 - 1e-9;
        let place = ((p - self.corner) / self.cell).map(|c| c.clamp(0.0, last));
        let low = place.map(|c| c as usize);
        let f = place - low.map(|c| c as f64);
        let first = low.x + SIDE * (low.y + SIDE * low.z);
        let value = |x: usize, y: usize, z: usize| f64::from(self.values[first + x + SIDE * (y + SIDE * z)]);
        let along_x = |y, z| {
            let (a, b) = (value(0, y, z), value(1, y, z));
            (a + (b - a) * f.x, b - a)
        };
        let [(v00, g00), (v10, g10), (v01, g01), (v11, g11)] =
            [along_x(0, 0), along_x(1, 0), along_x(0, 1), along_x(1, 1)];
        let (v0, v1) = (v00 + (v10 - v00) * f.y, v01 + (v11 - v01) * f.y);
        let (gx0, gx1) = (g00 + (g10 - g00) * f.y, g01 + (g11 - g01) * f.y);
        let (gy0, gy1) = (v10 - v00, v11 - v01);
        let gradient = Vec3::new(gx0 + (gx1 - gx0) * f.z, gy0 + (gy1 - gy0) * f.z, v1 - v0) / self.cell;
        (v0 + (v1 - v0) * f.z, gradient)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_to_a_sphere() {
        let points: Vec<Vec3> = sixfold_geometry::sphere_directions(4000);
        let field = DistanceField::new(&points, &Vec3::zeros(), 1.0);
        for direction in sixfold_geometry::sphere_directions(50) {
            for radius in [0.6, 0.8] {
                let (distance, gradient) = field.at(&(direction * radius));
                assert!((distance - (1.0 - radius)).abs() < 0.02, "{radius}: {distance}");
                assert!((gradient + direction).norm() < 0.15, "{radius}: {gradient}");
            }
        }
    }
}
