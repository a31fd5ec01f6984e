//! Height accumulated features (Fischinger, Weiss and Vincze 2015): a grid of heights under the hand, and weighted sums of mean
//! heights over rectangles of it.

use sixfold_geometry::Vec3;

use crate::{Grasp, GraspView};

/// Cells along each side of the grid, as in the original.
pub const CELLS: usize = 14;
/// Size of a cell, metres, as in the original.
const CELL: f64 = 0.01;
/// Heights are clipped to this distance from the tips, metres: about the length of a finger. Chosen by hand; not swept.
const MAX_HEIGHT: f64 = 0.06;

/// Heights above the plane of the finger tips, towards the palm, metres: a grid around the tips, along the closing direction and
/// across it.
#[derive(Debug, Clone, PartialEq)]
pub struct HeightGrid {
    heights: [[f32; CELLS]; CELLS],
    /// Integral image: for each cell the sum of all cells in earlier rows and columns.
    sums: [[f32; CELLS + 1]; CELLS + 1],
}

/// A rectangle of cells with a weight for its mean height.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// First column and row.
    pub low: [usize; 2],
    /// The column and row after the last: above `low`, at most [`CELLS`].
    pub high: [usize; 2],
    /// Weight of the mean height.
    pub weight: f32,
}

/// A feature: the weighted sum of the mean heights of one to four rectangles.
#[derive(Debug, Clone, PartialEq)]
pub struct HeightFeature {
    /// The rectangles.
    pub regions: Vec<Region>,
}

impl HeightGrid {
    /// The grid under a grasp's hand: the highest point of each cell; if there is none, the height of the table, or the lowest
    /// height.
    pub fn new(view: &GraspView, grasp: &Grasp) -> HeightGrid {
        let gripper_from_camera = grasp.camera_from_gripper.inverse();
        let half = 0.5 * CELL * CELLS as f64;
        let limit = |h: f64| h.clamp(-MAX_HEIGHT, MAX_HEIGHT) as f32;
        let mut heights = [[f32::NEG_INFINITY; CELLS]; CELLS];
        for p in view.object.points.iter().chain(&view.obstacles.points) {
            let q = gripper_from_camera.transform_point(p);
            let (x, y) = ((q.x + half) / CELL, (q.y + half) / CELL);
            let side = CELLS as f64;
            if (0.0..side).contains(&x) && (0.0..side).contains(&y) {
                let cell = &mut heights[y as usize][x as usize];
                *cell = cell.max(limit(-q.z));
            }
        }
        let table = |x: usize, y: usize| {
            let table = view.table?;
            let [x, y] = [x, y].map(|k| (k as f64 + 0.5) * CELL - half);
            let p = grasp.camera_from_gripper.transform_point(&Vec3::new(x, y, 0.0));
            // Distance of the table from the plane of the tips along the approach.
            let slope = table.normal.dot(&grasp.approach());
            (slope < -1e-3).then(|| limit(table.distance(&p) / slope))
        };
        for (y, row) in heights.iter_mut().enumerate() {
            for (x, cell) in row.iter_mut().enumerate() {
                if *cell == f32::NEG_INFINITY {
                    *cell = table(x, y).unwrap_or(-MAX_HEIGHT as f32);
                }
            }
        }
        HeightGrid::from_heights(heights)
    }

    /// A grid of these heights, metres, row by row.
    pub fn from_heights(heights: [[f32; CELLS]; CELLS]) -> HeightGrid {
        let mut sums = [[0.0; CELLS + 1]; CELLS + 1];
        for y in 0..CELLS {
            for x in 0..CELLS {
                sums[y + 1][x + 1] = heights[y][x] + sums[y][x + 1] + sums[y + 1][x] - sums[y][x];
            }
        }
        HeightGrid { heights, sums }
    }

    /// The heights, row by row.
    pub fn heights(&self) -> &[[f32; CELLS]; CELLS] {
        &self.heights
    }

    /// The grid of the scene mirrored along the closing direction, across it, or both: these grasps are equally good.
    pub fn mirrored(&self, closing: bool, across: bool) -> HeightGrid {
        let mut heights = self.heights;
        if across {
            heights.reverse();
        }
        if closing {
            heights.iter_mut().for_each(|row| row.reverse());
        }
        HeightGrid::from_heights(heights)
    }

    /// Mean height of a rectangle, metres.
    fn mean(&self, region: &Region) -> f32 {
        let ([x0, y0], [x1, y1]) = (region.low, region.high);
        let sum = self.sums[y1][x1] + self.sums[y0][x0] - self.sums[y0][x1] - self.sums[y1][x0];
        sum / ((x1 - x0) * (y1 - y0)) as f32
    }
}

impl HeightFeature {
    /// Its value for a grid, metres.
    pub fn value(&self, grid: &HeightGrid) -> f32 {
        self.regions.iter().map(|r| r.weight * grid.mean(r)).sum()
    }
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::PointCloud;

    use super::*;
    use crate::{AntipodalQuality, gripper_pose};

    #[test]
    fn a_ridge_under_the_hand() {
        // A ridge 3 cm above the tips along a line across the fingers at x = 2.5 cm, with the table 2 cm below the tips.
        let ridge: Vec<Vec3> =
            (-13..=13).map(|k| Vec3::new(0.025, 0.005 * f64::from(k) + 0.0001, 0.47)).collect();
        let view = GraspView::from_above(PointCloud { points: ridge, normals: vec![] }, 0.52, 0.003);
        let pose = gripper_pose(&Vec3::new(0.0, 0.0, 0.5), &Vec3::z(), &Vec3::x()).unwrap();
        let quality = AntipodalQuality { alignment: 0.0, support: 0.0, centring: 0.5, observed: 1.0 };
        let grasp = Grasp { camera_from_gripper: pose, opening: 0.1, width: 0.01, quality };
        let grid = HeightGrid::new(&view, &grasp);
        assert!((grid.heights()[7][9] - 0.03).abs() < 1e-5 && (grid.heights()[7][4] + 0.02).abs() < 1e-5);
        let mean = |low: [usize; 2], high: [usize; 2], weight: f32| Region { low, high, weight };
        let one = HeightFeature { regions: vec![mean([8, 3], [10, 5], 1.0)] };
        assert!((one.value(&grid) - 0.005).abs() < 1e-5, "half ridge, half table");
        let sides =
            HeightFeature { regions: vec![mean([9, 0], [10, CELLS], 1.0), mean([4, 0], [5, CELLS], -1.0)] };
        assert!((sides.value(&grid) - 0.05).abs() < 1e-5);
        assert!((sides.value(&grid.mirrored(true, false)) + 0.05).abs() < 1e-5);
        assert_eq!(grid.mirrored(true, true).mirrored(true, true), grid);
    }
}
