//! Regions of interest: squares of a fixed metric size around points of the scene, seen as by a camera that faces them directly
//! (dissertation, section 5.2.4).
//!
//! The *ROI frame* has its origin at the centre and its z axis along the ray through it, so that a template matches wherever in the
//! image its object is.

use sixfold_align::DepthRegion;
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{OptionError, Pose, Vec2, Vec3};

/// Cells along a side of a region; chosen by hand, not swept.
pub const GRID: usize = 20;

/// A region. Its centre need not be a measured point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Roi {
    /// Centre in the camera frame, metres.
    pub centre: Vec3,
}

/// One cell of a region: depth along the region's axis relative to its centre (metres) and the normal in the region's frame.
pub type Cell = [f32; 4];

/// A cell in which nothing was measured, or which is left out: like an occluder, it neither agrees nor contradicts. A thousand
/// kilometres in front is nearer than any scene.
pub const UNKNOWN: Cell = [-1e6, 0.0, 0.0, 0.0];

/// The rotation camera from ROI: takes z to the ray through `point` by the smallest rotation.
pub(crate) fn ray_rotation(point: &Vec3) -> UnitQuaternion<f64> {
    UnitQuaternion::rotation_between(&Vec3::z(), point).unwrap_or_else(UnitQuaternion::identity)
}

impl Roi {
    /// From the region's frame to the camera's.
    pub fn camera_from_roi(&self) -> Pose {
        Pose::new(ray_rotation(&self.centre), self.centre)
    }

    /// The cells, row by row. `size` is the region's side in metres; pixels (by their number in the image) for which `seen` is
    /// false are unknown.
    pub fn cells(&self, scene: &DepthRegion, size: f64, seen: impl Fn(usize) -> bool) -> Vec<Cell> {
        self.cells_on_grid(scene, size, GRID, seen)
    }

    /// The same on a grid of `grid x grid` cells.
    pub fn cells_on_grid(
        &self,
        scene: &DepthRegion,
        size: f64,
        grid: usize,
        seen: impl Fn(usize) -> bool,
    ) -> Vec<Cell> {
        let camera = scene.camera();
        let rotation = ray_rotation(&self.centre);
        let (axis, back) = (self.centre.normalize(), rotation.inverse().to_rotation_matrix().cast::<f32>());
        let distance = self.centre.norm();
        let (right, down) = (rotation * Vec3::x(), rotation * Vec3::y());
        let step = size / grid as f64;
        let first = -0.5 * (grid as f64 - 1.0);
        (0..grid * grid)
            .map(|i| {
                let (u, v) = (first + (i % grid) as f64, first + (i / grid) as f64);
                let point = self.centre + right * (u * step) + down * (v * step);
                let Some(pixel) = camera.project(&point) else { return UNKNOWN };
                let (x, y) = (pixel.x.round(), pixel.y.round());
                if !(x >= 0.0 && y >= 0.0 && x < camera.width as f64 && y < camera.height as f64) {
                    return UNKNOWN;
                }
                let (x, y) = (x as usize, y as usize);
                let (z, n) = (scene.depth()[(x, y)], scene.normals()[(x, y)]);
                if z <= 0.0 || !seen(y * camera.width + x) {
                    return UNKNOWN;
                }
                let p = camera.unproject(&Vec2::new(x as f64, y as f64), f64::from(z));
                let n = back * sixfold_geometry::nalgebra::Vector3::from(n);
                [(axis.dot(&p) - distance) as f32, n.x, n.y, n.z]
            })
            .collect()
    }
}

/// How regions are sampled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProposalOptions {
    /// Distance between centres as a fraction of the object's diameter (dissertation: 20 pixels for all objects).
    pub step: f64,
    /// Depths further apart than this fraction of the diameter get separate centres.
    pub layer: f64,
    /// Largest number of regions; if there would be more, the step grows.
    pub most: usize,
}

/// [`ProposalOptions::step`]; chosen by hand, not swept.
const STEP_OF_DIAMETER: f64 = 0.12;
/// [`ProposalOptions::layer`]; chosen by hand, not swept.
const LAYER: f64 = 0.15;
/// [`ProposalOptions::most`]; chosen by hand for the run time of the matching, not swept.
const MOST: usize = 4000;
/// The grid is fine enough for objects at this quantile of the points' distances: a few points further away may be outliers. Chosen
/// by hand; not swept.
const FAR: f64 = 0.95;
/// Smallest distance of centres, pixels; chosen by hand, not swept.
const MIN_STEP: f64 = 3.0;
/// Smallest factor by which the step grows while there are too many regions, so that the loop ends.
const GROWTH: f64 = 1.05;
/// Fewest points of a layer that becomes a region's centre; chosen by hand, not swept.
const MIN_POINTS: usize = 4;

impl Default for ProposalOptions {
    fn default() -> Self {
        ProposalOptions { step: STEP_OF_DIAMETER, layer: LAYER, most: MOST }
    }
}

impl ProposalOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        let expected = "a fraction of the diameter above 0";
        OptionError::unless_positive("proposals.step", self.step, expected)?;
        OptionError::unless_positive("proposals.layer", self.layer, expected)?;
        OptionError::unless_some("proposals.most", self.most)
    }
}

/// Regions whose centres are on a grid of the image, near points above the table. An object's centre may be hidden by another
/// object: each grid position has a centre for every depth that occurs around it, not only for the depth measured there.
pub fn propose(scene: &DepthRegion, diameter: f64, options: &ProposalOptions) -> Vec<Roi> {
    let camera = scene.camera();
    let focal = 0.5 * (camera.fx + camera.fy);
    let mut depths: Vec<f64> = scene.cloud().points.iter().map(|p| p.z).collect();
    if depths.is_empty() {
        return vec![];
    }
    // The grid is fine enough for far points; for near ones only some of its positions are used.
    let far = (FAR * (depths.len() - 1) as f64) as usize;
    let far = *depths.select_nth_unstable_by(far, f64::total_cmp).1;
    let mut fraction = options.step;
    loop {
        let step = (fraction * diameter * focal / far).max(MIN_STEP);
        let rois = sample(scene, step, fraction * diameter * focal, options.layer * diameter);
        if rois.len() <= options.most {
            return rois;
        }
        fraction *= (rois.len() as f64 / options.most as f64).sqrt().max(GROWTH);
    }
}

/// Centres every `step` pixels; for near layers every `wanted / depth` pixels.
fn sample(scene: &DepthRegion, step: f64, wanted: f64, layer: f64) -> Vec<Roi> {
    let camera = scene.camera();
    let columns = (camera.width as f64 / step).ceil() as usize;
    let rows = (camera.height as f64 / step).ceil() as usize;
    // Distances along the rays of the points in every cell.
    let mut cells: Vec<Vec<f64>> = vec![vec![]; columns * rows];
    for p in &scene.cloud().points {
        if let Some(pixel) = camera.project(p) {
            let (i, j) = ((pixel.x / step).max(0.0) as usize, (pixel.y / step).max(0.0) as usize);
            if i < columns && j < rows {
                cells[j * columns + i].push(p.norm());
            }
        }
    }
    let mut rois = vec![];
    for j in 0..rows {
        for i in 0..columns {
            let mut near: Vec<f64> = vec![];
            for v in j.saturating_sub(1)..=(j + 1).min(rows - 1) {
                for u in i.saturating_sub(1)..=(i + 1).min(columns - 1) {
                    near.extend(&cells[v * columns + u]);
                }
            }
            near.sort_by(f64::total_cmp);
            let pixel = Vec2::new((i as f64 + 0.5) * step - 0.5, (j as f64 + 0.5) * step - 0.5);
            let ray = camera.unproject(&pixel, 1.0).normalize();
            // Layers: runs of distances none of which is further from the first than `layer`.
            let mut start = 0;
            for end in 1..=near.len() {
                if end == near.len() || near[end] - near[start] > layer {
                    let distance = near[(start + end) / 2];
                    let every = (wanted / distance / step).round().max(1.0) as usize;
                    if end - start >= MIN_POINTS && i % every == 0 && j % every == 0 {
                        rois.push(Roi { centre: ray * distance });
                    }
                    start = end;
                }
            }
        }
    }
    rois
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_align::DepthOptions;
    use sixfold_geometry::{Camera, DepthImage};

    /// A tilted table with a near and a far box on it that face the camera, 640x480.
    fn scene() -> DepthRegion {
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let depth = DepthImage::from_fn(640, 480, |x, y| match (x, y) {
            (100..200, 300..380) => 0.6,
            (400..450, 100..150) => 1.0,
            _ => 0.5 / (0.3 + 0.001 * y as f32),
        });
        DepthRegion::from_depth(&depth, &camera, None, &DepthOptions::default()).unwrap()
    }

    #[test]
    fn every_place_of_an_object_has_a_centre_nearby() {
        let scene = scene();
        let options = ProposalOptions::default();
        let rois = propose(&scene, 0.1, &options);
        assert!(!rois.is_empty() && rois.len() <= options.most, "{}", rois.len());
        for (pixel, z) in [(Vec2::new(150.0, 340.0), 0.6), (Vec2::new(425.0, 125.0), 1.0)] {
            let p = scene.camera().unproject(&pixel, z);
            let nearest = rois.iter().map(|r| (r.centre - p).norm()).fold(f64::INFINITY, f64::min);
            assert!(nearest < 0.1 * options.step * 1.2, "{nearest}");
        }
    }

    #[test]
    fn a_region_describes_its_surroundings_relative_to_its_centre() {
        let scene = scene();
        let centre = scene.camera().unproject(&Vec2::new(150.0, 340.0), 0.6);
        let cells = Roi { centre }.cells(&scene, 0.06, |_| true);
        let at = |column: usize, row: usize| cells[row * GRID + column];
        let central = at(GRID / 2, GRID / 2);
        assert!(central[0].abs() < 0.003, "{central:?}");
        // The box faces the camera's axis; the region's axis is a ray 20 degrees from it.
        let axis = centre.normalize();
        assert!((f64::from(central[3]) + axis.z).abs() < 0.01, "{central:?}");
        let nothing = Roi { centre }.cells(&scene, 0.06, |_| false);
        assert!(nothing.iter().all(|c| *c == UNKNOWN));
    }

    #[test]
    fn a_rotation_to_a_ray_is_minimal() {
        for p in [Vec3::z(), Vec3::new(0.3, -0.2, 0.9), Vec3::new(-0.5, 0.0, 0.5)] {
            let r = ray_rotation(&p);
            assert!((r * Vec3::z() - p.normalize()).norm() < 1e-12);
            assert!((r.angle() - p.normalize().z.acos()).abs() < 1e-9);
        }
    }
}
