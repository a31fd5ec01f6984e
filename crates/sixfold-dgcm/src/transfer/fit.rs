//! Measures how well an experience's object, moved and scaled, explains the current view, and vice versa. Both are single views:
//! parts hidden from one camera are no evidence against the other view.

use sixfold_geometry::nalgebra::Rotation3;
use sixfold_geometry::{Pose, Vec3};

use sixfold_experience::Crop;

/// Side of a cell, metres.
const CELL: f64 = 0.005;
/// Distance at which a point counts `exp(-1/2)`, metres.
const NEAR: f64 = 0.005;
/// Largest distance at which a point counts, in cells.
const REACH: i64 = 2;
/// Score of a point in a hidden cell.
const HIDDEN: f32 = 0.45;
/// Points of a view that are compared.
const POINTS: usize = 260;

/// One view of an object in a frame whose z axis is normal to the table, if that is known, with a grid of the visible and hidden
/// space around it.
pub(super) struct Shape {
    /// Takes points of the camera to the table; the x axis points away from the camera. The camera's own frame if the table is
    /// unknown.
    pub table_from_camera: Pose,
    /// Whether the table is known.
    pub stands: bool,
    /// Some of the object's points.
    pub points: Vec<Vec3>,
    /// Height of the object, without outliers.
    pub height: f64,
    low: Vec3,
    size: [usize; 3],
    cells: Vec<f32>,
}

impl Shape {
    /// The shape of a view.
    pub(crate) fn new(crop: &Crop) -> Shape {
        let table_from_camera = table_frame(crop);
        let all: Vec<Vec3> =
            crop.pixels().map(|i| table_from_camera.transform_point(&crop.point(i))).collect();
        let stride = all.len().div_ceil(POINTS).max(1);
        let mut heights: Vec<f64> = all.iter().map(|p| p.z).collect();
        heights.sort_by(f64::total_cmp);
        let margin = Vec3::repeat(CELL * (REACH + 1) as f64);
        let low = all.iter().fold(Vec3::repeat(f64::MAX), |a, p| a.inf(p)) - margin;
        let high = all.iter().fold(Vec3::repeat(f64::MIN), |a, p| a.sup(p)) + margin;
        let size = [0, 1, 2].map(|k| (((high[k] - low[k]) / CELL).ceil().clamp(1.0, 160.0)) as usize);
        let mut shape = Shape {
            table_from_camera,
            stands: crop.table.is_some(),
            points: all.iter().step_by(stride).copied().collect(),
            height: heights.get(heights.len() * 98 / 100).copied().unwrap_or(0.0),
            low,
            size,
            cells: vec![0.0; size.iter().product()],
        };
        shape.hide(crop);
        shape.mark(&all);
        shape
    }

    /// Marks cells behind visible surfaces.
    fn hide(&mut self, crop: &Crop) {
        // The depth in a neighbourhood of each pixel, because edges are often not measured.
        let side = crop.side as i64;
        let depth = |u: i64, v: i64| {
            let mut nearest = f64::INFINITY;
            for (x, y) in (v - 1..=v + 1).flat_map(|y| (u - 1..=u + 1).map(move |x| (x, y))) {
                if x >= 0 && y >= 0 && x < side && y < side && crop.mask[(y * side + x) as usize] {
                    nearest = nearest.min(f64::from(crop.points[(y * side + x) as usize][2]));
                }
            }
            nearest
        };
        let depths: Vec<f64> = (0..side * side).map(|i| depth(i % side, i / side)).collect();
        let camera_from_table = self.table_from_camera.inverse();
        let mut at = 0;
        for z in 0..self.size[2] {
            for y in 0..self.size[1] {
                for x in 0..self.size[0] {
                    let p = self.low + (Vec3::new(x as f64, y as f64, z as f64) + Vec3::repeat(0.5)) * CELL;
                    let p = camera_from_table.transform_point(&p);
                    if let Some(pixel) = crop.camera.project(&p).map(|v| v.map(|c| c.round() as i64))
                        && (0..side).contains(&pixel.x)
                        && (0..side).contains(&pixel.y)
                        && p.z > depths[(pixel.y * side + pixel.x) as usize]
                    {
                        self.cells[at] = HIDDEN;
                    }
                    at += 1;
                }
            }
        }
    }

    /// Marks cells near visible points.
    fn mark(&mut self, points: &[Vec3]) {
        for p in points {
            let cell = ((p - self.low) / CELL).map(|v| v.floor() as i64);
            for dz in -REACH..=REACH {
                for dy in -REACH..=REACH {
                    for dx in -REACH..=REACH {
                        let there = [cell.x + dx, cell.y + dy, cell.z + dz];
                        let Some(at) = self.index(there) else { continue };
                        let centre = self.low
                            + Vec3::new(there[0] as f64 + 0.5, there[1] as f64 + 0.5, there[2] as f64 + 0.5)
                                * CELL;
                        let far = (centre - p).norm_squared() / (NEAR * NEAR);
                        self.cells[at] = self.cells[at].max((-0.5 * far).exp() as f32);
                    }
                }
            }
        }
    }

    fn index(&self, cell: [i64; 3]) -> Option<usize> {
        let inside = (0..3).all(|k| cell[k] >= 0 && cell[k] < self.size[k] as i64);
        inside.then(|| (cell[2] as usize * self.size[1] + cell[1] as usize) * self.size[0] + cell[0] as usize)
    }

    /// Score of a point: 1 on a visible surface, less near it, [`HIDDEN`] in hidden space, 0 in empty space.
    pub(crate) fn at(&self, p: &Vec3) -> f64 {
        let cell = (p - self.low) * (1.0 / CELL);
        // There are no cells below the first; a comparison is cheaper than rounding down.
        if cell.x < 0.0 || cell.y < 0.0 || cell.z < 0.0 {
            return 0.0;
        }
        self.index([cell.x as i64, cell.y as i64, cell.z as i64]).map_or(0.0, |i| f64::from(self.cells[i]))
    }

    /// The centre of the bounding box of points, seen from above.
    pub(crate) fn centre(points: impl IntoIterator<Item = Vec3>) -> Vec3 {
        let (mut low, mut high) = (Vec3::repeat(f64::MAX), Vec3::repeat(f64::MIN));
        for p in points {
            low = low.inf(&p);
            high = high.sup(&p);
        }
        let centre = 0.5 * (low + high);
        Vec3::new(centre.x, centre.y, 0.0)
    }
}

/// z up from the table, x away from the camera, the origin on the table.
fn table_frame(crop: &Crop) -> Pose {
    let Some(table) = &crop.table else { return Pose::identity() };
    let up = table.normal;
    let away = Vec3::z() - up * up.z;
    let Some(away) = away.try_normalize(1e-6).or_else(|| (Vec3::y() - up * up.y).try_normalize(1e-6)) else {
        return Pose::identity();
    };
    let side = up.cross(&away);
    let rotation = Rotation3::from_basis_unchecked(&[away, side, up]).inverse();
    Pose::new(
        sixfold_geometry::nalgebra::UnitQuaternion::from_rotation_matrix(&rotation),
        -Vec3::z() * table.offset,
    )
}
