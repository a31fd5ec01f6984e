//! Surface normals of a depth image by depth gradients, and in-painting of missing depth.
//!
//! The gradient at a pixel is the least-squares plane through the depth differences to its neighbours,
//! leaving out neighbours on the other side of a depth edge (Hinterstoisser et al. 2012, section 3.3;
//! dissertation reference [139]).

use rayon::prelude::*;

use crate::{Camera, DepthImage, Image, NormalImage, OptionError, Vec3};

/// Options of the computation of normals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NormalOptions {
    /// Half width of the window in pixels.
    pub radius: usize,
    /// A neighbour counts when its depth differs by less than this fraction of the depth.
    pub max_relative_step: f64,
}

impl Default for NormalOptions {
    fn default() -> Self {
        NormalOptions { radius: 3, max_relative_step: 0.02 }
    }
}

impl NormalOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_within("normals.radius", self.radius, 1..=100, "1 to 100 pixels")?;
        let step = self.max_relative_step;
        OptionError::unless_positive("normals.max_relative_step", step, "a fraction of the depth above 0")
    }
}

/// Unit normals in the camera frame, pointing to the camera; zero where depth is missing or fewer than six
/// neighbours lie on the same surface.
///
/// # Panics
/// When depth and camera differ in size.
pub fn normals_from_depth(depth: &DepthImage, camera: &Camera, options: &NormalOptions) -> NormalImage {
    assert_eq!(depth.size(), (camera.width, camera.height), "depth of another size than the camera");
    let (width, height) = depth.size();
    let mut normals = Image::filled(width, height, [0.0f32; 3]);
    let radius = options.radius.max(1);
    let padded = Padded::new(depth, radius);
    normals.as_mut_slice().par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        let window = y.saturating_sub(radius)..=(y + radius).min(height - 1);
        for (block, normals) in row.chunks_mut(LANES).enumerate() {
            let first = block * LANES;
            let z: [f32; LANES] = std::array::from_fn(|i| padded.row(y)[first + i + radius]);
            let limit = z.map(|z| (options.max_relative_step * f64::from(z)) as f32);
            let mut sums = Sums::default();
            for v in window.clone() {
                sums.add_row(&padded.row(v)[first..], v as f32 - y as f32, &z, &limit, radius);
            }
            for (i, normal) in normals.iter_mut().enumerate() {
                if let Some(gradient) = sums.gradient(i) {
                    *normal = normal_of(gradient, f64::from(z[i]), first + i, y, camera).unwrap_or(*normal);
                }
            }
        }
    });
    normals
}

/// Pixels that are computed together.
const LANES: usize = 8;

/// Depth with zeros on the left, on the right and where it is missing.
struct Padded {
    values: Vec<f32>,
    width: usize,
}

impl Padded {
    fn new(depth: &DepthImage, radius: usize) -> Padded {
        let (columns, rows) = depth.size();
        // Blocks of LANES pixels may begin at any column.
        let width = columns.next_multiple_of(LANES) + 2 * radius;
        let mut values = vec![0.0; width * rows];
        for (y, line) in values.chunks_exact_mut(width.max(1)).enumerate() {
            for (to, &z) in line[radius..].iter_mut().zip(depth.row(y)) {
                *to = if z > 0.0 && z.is_finite() { z } else { 0.0 };
            }
        }
        Padded { values, width }
    }

    fn row(&self, y: usize) -> &[f32] {
        &self.values[y * self.width..][..self.width]
    }
}

type Lanes = [f32; LANES];

/// Sums for the plane `dz = gx dx + gy dy + c` around each pixel of a block; `c` absorbs the noise of the centre pixel.
#[derive(Default)]
struct Sums {
    n: Lanes,
    x: Lanes,
    y: Lanes,
    z: Lanes,
    xx: Lanes,
    xy: Lanes,
    yy: Lanes,
    xz: Lanes,
    yz: Lanes,
}

impl Sums {
    /// Adds a row of neighbours, `dy` rows below the block; `line` starts `radius` pixels left of the block's first pixel.
    #[inline(always)]
    fn add_row(&mut self, line: &[f32], dy: f32, z: &Lanes, limit: &Lanes, radius: usize) {
        // Sums of small whole numbers are exact in any order; those with depth are added pixel by pixel.
        let (mut n, mut x, mut xx) = ([0f32; LANES], [0f32; LANES], [0f32; LANES]);
        for (k, neighbours) in line.windows(LANES).take(2 * radius + 1).enumerate() {
            let dx = k as f32 - radius as f32;
            for i in 0..LANES {
                let d = neighbours[i];
                let dz = d - z[i];
                let counts = (d > 0.0) & (dz.abs() < limit[i]);
                let (one, dz) = if counts { (1.0, dz) } else { (0.0, 0.0) };
                n[i] += one;
                x[i] += dx * one;
                xx[i] += dx * dx * one;
                self.z[i] += dz;
                self.xz[i] += dx * dz;
                self.yz[i] += dy * dz;
            }
        }
        for i in 0..LANES {
            self.n[i] += n[i];
            self.x[i] += x[i];
            self.y[i] += dy * n[i];
            self.xx[i] += xx[i];
            self.xy[i] += dy * x[i];
            self.yy[i] += dy * dy * n[i];
        }
    }

    /// The plane's gradients along x and y at a pixel of the block; `None` with fewer than six neighbours on its surface.
    fn gradient(&self, i: usize) -> Option<[f64; 2]> {
        let (n, x, y, z) = (self.n[i], self.x[i], self.y[i], self.z[i]);
        if n < 7.0 {
            return None;
        }
        let (xx, xy, yy) = (self.xx[i] - x * x / n, self.xy[i] - x * y / n, self.yy[i] - y * y / n);
        let (xz, yz) = (self.xz[i] - x * z / n, self.yz[i] - y * z / n);
        let det = xx * yy - xy * xy;
        (det >= 1.0).then(|| [f64::from((xz * yy - yz * xy) / det), f64::from((yz * xx - xz * xy) / det)])
    }
}

/// The unit normal, pointing to the camera, of the plane with these depth gradients at pixel `(x, y)` with depth `z`.
fn normal_of([gx, gy]: [f64; 2], z: f64, x: usize, y: usize, camera: &Camera) -> Option<[f32; 3]> {
    let (u, v) = ((x as f64 - camera.cx) / camera.fx, (y as f64 - camera.cy) / camera.fy);
    let tx = Vec3::new(z / camera.fx + u * gx, v * gx, gx);
    let ty = Vec3::new(u * gy, z / camera.fy + v * gy, gy);
    // ty x tx points to the camera.
    let unit = ty.cross(&tx).try_normalize(1e-30)?;
    let towards = if unit.dot(&Vec3::new(u, v, 1.0)) > 0.0 { -unit } else { unit };
    Some([towards.x as f32, towards.y as f32, towards.z as f32])
}

/// Fills missing depth from surrounding pixels: in each round every missing pixel with valid neighbours
/// (8-neighbourhood) takes their mean, for at most `rounds` rounds, so holes up to `2 * rounds` pixels wide
/// are closed (dissertation, section 5.3.1).
pub fn inpaint_depth(depth: &DepthImage, rounds: usize) -> DepthImage {
    let (width, height) = depth.size();
    let mut current = depth.map(|&z| if z > 0.0 && z.is_finite() { z } else { 0.0 });
    let mut missing: Vec<usize> =
        current.as_slice().iter().enumerate().filter(|(_, z)| **z == 0.0).map(|(i, _)| i).collect();
    for _ in 0..rounds {
        let filled: Vec<(usize, f32)> = missing
            .iter()
            .filter_map(|&i| {
                let (x, y) = (i % width, i / width);
                let (mut sum, mut count) = (0.0f64, 0u32);
                for v in y.saturating_sub(1)..=(y + 1).min(height - 1) {
                    for u in x.saturating_sub(1)..=(x + 1).min(width - 1) {
                        let z = current[(u, v)];
                        if z > 0.0 {
                            sum += f64::from(z);
                            count += 1;
                        }
                    }
                }
                (count > 0).then(|| (i, (sum / f64::from(count)) as f32))
            })
            .collect();
        if filled.is_empty() {
            break;
        }
        for &(i, z) in &filled {
            current.as_mut_slice()[i] = z;
        }
        missing.retain(|&i| current.as_slice()[i] == 0.0);
    }
    current
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Vec2;

    fn camera() -> Camera {
        Camera::new(570.0, 575.0, 40.0, 30.0, 80, 60).unwrap()
    }

    fn plane(normal: Vec3, distance: f64) -> DepthImage {
        let c = camera();
        DepthImage::from_fn(80, 60, |x, y| {
            let ray = c.unproject(&Vec2::new(x as f64, y as f64), 1.0);
            (distance / normal.dot(&ray)) as f32
        })
    }

    #[test]
    fn the_normal_of_a_tilted_plane() {
        let truth = Vec3::new(0.5, -0.3, -1.0).normalize();
        let normals = normals_from_depth(&plane(truth, -0.8), &camera(), &NormalOptions::default());
        for (x, y) in [(40, 30), (5, 5), (75, 50), (0, 0), (79, 59)] {
            let n = Vec3::from(normals[(x, y)].map(f64::from));
            assert!(n.dot(&truth) > 0.9999, "({x}, {y}): {n:?}");
        }
    }

    /// The gradients of the plane through the neighbours of one pixel, added one after another.
    fn gradient(depth: &DepthImage, x: usize, y: usize, options: &NormalOptions) -> Option<[f64; 2]> {
        let z = depth[(x, y)];
        if !(z > 0.0 && z.is_finite()) {
            return None;
        }
        let limit = (options.max_relative_step * f64::from(z)) as f32;
        let radius = options.radius;
        let mut sums = Sums::default();
        for v in y.saturating_sub(radius)..=(y + radius).min(depth.height() - 1) {
            for u in x.saturating_sub(radius)..=(x + radius).min(depth.width() - 1) {
                let d = depth[(u, v)];
                let (dx, dy, dz) = (u as f32 - x as f32, v as f32 - y as f32, d - z);
                if d > 0.0 && dz.abs() < limit {
                    sums.n[0] += 1.0;
                    sums.x[0] += dx;
                    sums.y[0] += dy;
                    sums.z[0] += dz;
                    sums.xx[0] += dx * dx;
                    sums.xy[0] += dx * dy;
                    sums.yy[0] += dy * dy;
                    sums.xz[0] += dx * dz;
                    sums.yz[0] += dy * dz;
                }
            }
        }
        sums.gradient(0)
    }

    #[test]
    fn pixels_computed_together_equal_pixels_computed_alone() {
        // 43 columns: the last block has three pixels.
        let mut state = 1u32;
        let depth = DepthImage::from_fn(43, 31, |x, y| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let noise = (state >> 8) as f32 / (1 << 24) as f32;
            match state >> 28 {
                0 => 0.0,
                1 => f32::NAN,
                2 if x > 30 => f32::INFINITY,
                3 if y > 20 => -1.0,
                _ => 0.8 + 0.003 * x as f32 + 0.03 * noise + if x > y { 0.05 } else { 0.0 },
            }
        });
        let camera = Camera::new(50.0, 52.0, 20.0, 15.0, 43, 31).unwrap();
        for radius in [1, 3, 5] {
            let options = NormalOptions { radius, ..NormalOptions::default() };
            let normals = normals_from_depth(&depth, &camera, &options);
            let mut found = 0;
            for (x, y) in (0..31).flat_map(|y| (0..43).map(move |x| (x, y))) {
                let alone = gradient(&depth, x, y, &options)
                    .and_then(|g| normal_of(g, f64::from(depth[(x, y)]), x, y, &camera));
                found += usize::from(alone.is_some());
                assert_eq!(normals[(x, y)], alone.unwrap_or_default(), "({x}, {y}), radius {radius}");
            }
            assert!(found > 300, "radius {radius}: {found}");
        }
    }

    #[test]
    fn a_depth_edge_does_not_bend_the_normals() {
        let near = plane(-Vec3::z(), -0.6);
        let far = plane(-Vec3::z(), -1.0);
        let step = DepthImage::from_fn(80, 60, |x, y| if x < 40 { near[(x, y)] } else { far[(x, y)] });
        let normals = normals_from_depth(&step, &camera(), &NormalOptions::default());
        assert!(normals.as_slice().iter().all(|n| n[2] < -0.9999));
    }

    #[test]
    fn missing_depth_has_no_normal_and_holes_close() {
        let mut depth = plane(-Vec3::z(), -1.0);
        for y in 20..26 {
            for x in 20..26 {
                depth[(x, y)] = 0.0;
            }
        }
        depth[(50, 30)] = f32::NAN;
        let normals = normals_from_depth(&depth, &camera(), &NormalOptions::default());
        assert_eq!(normals[(22, 22)], [0.0; 3]);
        assert_eq!(normals[(50, 30)], [0.0; 3]);
        let two = inpaint_depth(&depth, 2);
        assert_eq!(two[(22, 22)], 0.0);
        assert!((two[(50, 30)] - 1.0).abs() < 1e-6);
        let three = inpaint_depth(&depth, 3);
        assert!(three.as_slice().iter().all(|&z| (z - 1.0).abs() < 1e-6));
        let nothing = inpaint_depth(&DepthImage::filled(4, 4, 0.0), 9);
        assert!(nothing.as_slice().iter().all(|&z| z == 0.0));
    }
}
