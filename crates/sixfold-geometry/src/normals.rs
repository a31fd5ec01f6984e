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
    let radius = options.radius.max(1) as isize;
    normals.as_mut_slice().par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        for (x, normal) in row.iter_mut().enumerate() {
            let z = depth[(x, y)];
            if !(z > 0.0 && z.is_finite()) {
                continue;
            }
            let limit = (options.max_relative_step * f64::from(z)) as f32;
            // Sums for the plane dz = gx dx + gy dy + c, where c absorbs the noise of the centre pixel.
            let (mut n, mut sx, mut sy, mut sz) = (0f32, 0f32, 0f32, 0f32);
            let (mut xx, mut xy, mut yy, mut xz, mut yz) = (0f32, 0f32, 0f32, 0f32, 0f32);
            let y_low = (y as isize - radius).max(0);
            let y_high = (y as isize + radius).min(height as isize - 1);
            let x_low = (x as isize - radius).max(0);
            let x_high = (x as isize + radius).min(width as isize - 1);
            for v in y_low..=y_high {
                let line = &depth.row(v as usize)[x_low as usize..=x_high as usize];
                let dy = (v - y as isize) as f32;
                for (dx, &d) in (x_low - x as isize..).zip(line) {
                    let dz = d - z;
                    if !(d > 0.0 && dz.abs() < limit) {
                        continue;
                    }
                    let dx = dx as f32;
                    n += 1.0;
                    sx += dx;
                    sy += dy;
                    sz += dz;
                    xx += dx * dx;
                    xy += dx * dy;
                    yy += dy * dy;
                    xz += dx * dz;
                    yz += dy * dz;
                }
            }
            if n < 7.0 {
                continue;
            }
            let (xx, xy, yy) = (xx - sx * sx / n, xy - sx * sy / n, yy - sy * sy / n);
            let (xz, yz) = (xz - sx * sz / n, yz - sy * sz / n);
            let det = xx * yy - xy * xy;
            if det < 1.0 {
                continue;
            }
            let gx = f64::from((xz * yy - yz * xy) / det);
            let gy = f64::from((yz * xx - xz * xy) / det);
            let z = f64::from(z);
            let (u, v) = ((x as f64 - camera.cx) / camera.fx, (y as f64 - camera.cy) / camera.fy);
            let tx = Vec3::new(z / camera.fx + u * gx, v * gx, gx);
            let ty = Vec3::new(u * gy, z / camera.fy + v * gy, gy);
            // ty x tx points to the camera.
            if let Some(unit) = ty.cross(&tx).try_normalize(1e-30) {
                let towards = if unit.dot(&Vec3::new(u, v, 1.0)) > 0.0 { -unit } else { unit };
                *normal = [towards.x as f32, towards.y as f32, towards.z as f32];
            }
        }
    });
    normals
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
