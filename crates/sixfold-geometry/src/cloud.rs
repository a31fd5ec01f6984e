//! Point clouds: made from depth images, downsampled on a voxel grid.

use std::collections::HashMap;

use crate::{Camera, DepthImage, NormalImage, Pose, Vec2, Vec3};

/// Points in metres, with one unit normal per point or none at all.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PointCloud {
    /// Points in metres.
    pub points: Vec<Vec3>,
    /// Unit normals, one per point, or empty.
    pub normals: Vec<Vec3>,
}

impl PointCloud {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The points of a depth image in the camera frame, one per valid pixel; with `normals`, only where these
    /// are known.
    ///
    /// # Panics
    /// When depth, normals and camera differ in size.
    pub fn from_depth(depth: &DepthImage, normals: Option<&NormalImage>, camera: &Camera) -> PointCloud {
        assert_eq!(depth.size(), (camera.width, camera.height), "depth of another size than the camera");
        let mut cloud = PointCloud::default();
        if let Some(n) = normals {
            assert_eq!(n.size(), depth.size(), "normals of another size than the depth");
        }
        for y in 0..depth.height() {
            for (x, &z) in depth.row(y).iter().enumerate() {
                if !(z > 0.0 && z.is_finite()) {
                    continue;
                }
                if let Some(normals) = normals {
                    let n = normals[(x, y)];
                    if n == [0.0; 3] {
                        continue;
                    }
                    cloud.normals.push(Vec3::from(n.map(f64::from)));
                }
                cloud.points.push(camera.unproject(&Vec2::new(x as f64, y as f64), f64::from(z)));
            }
        }
        cloud
    }

    /// The cloud moved by a pose.
    pub fn transformed(&self, pose: &Pose) -> PointCloud {
        PointCloud {
            points: self.points.iter().map(|p| pose.transform_point(p)).collect(),
            normals: self.normals.iter().map(|n| pose.transform_direction(n)).collect(),
        }
    }

    /// The arithmetic mean of the points; `None` when there is none.
    pub fn centroid(&self) -> Option<Vec3> {
        (!self.is_empty()).then(|| self.points.iter().sum::<Vec3>() / self.len() as f64)
    }

    /// One point per voxel of edge `size` metres and per group of similar normals in it (within
    /// `max_angle` radians of the group's first), as Vidal et al. (2018), section 3.1: thin walls and sharp edges
    /// keep both their sides. Points and normals of a group are averaged; groups come in the order of
    /// their first point.
    pub fn voxel_downsample(&self, size: f64, max_angle: f64) -> PointCloud {
        struct Group {
            point: Vec3,
            normal: Vec3,
            first_normal: Vec3,
            count: f64,
            next: usize,
        }
        const END: usize = usize::MAX;
        let cosine = max_angle.cos();
        let with_normals = !self.normals.is_empty();
        let mut groups: Vec<Group> = Vec::new();
        let mut first_of: HashMap<[i64; 3], usize, BuildMix> = HashMap::default();
        for (i, p) in self.points.iter().enumerate() {
            let n = if with_normals { self.normals[i] } else { Vec3::zeros() };
            let key = [p.x, p.y, p.z].map(|c| (c / size).floor() as i64);
            let head = first_of.entry(key).or_insert(END);
            let mut at = *head;
            while at != END {
                let group = &mut groups[at];
                let alike = || group.first_normal.dot(&n) >= cosine;
                // Unknown normals count as similar; otherwise each of them would start a group of its own.
                let unknown = || !(n.norm_squared() > 0.0 || group.first_normal.norm_squared() > 0.0);
                if !with_normals || alike() || unknown() {
                    group.point += p;
                    group.normal += n;
                    group.count += 1.0;
                    break;
                }
                at = group.next;
            }
            if at == END {
                groups.push(Group { point: *p, normal: n, first_normal: n, count: 1.0, next: *head });
                *head = groups.len() - 1;
            }
        }
        PointCloud {
            points: groups.iter().map(|g| g.point / g.count).collect(),
            normals: if with_normals {
                groups.iter().map(|g| g.normal.try_normalize(1e-12).unwrap_or(g.first_normal)).collect()
            } else {
                vec![]
            },
        }
    }
}

/// `n` evenly spread unit directions: a Fibonacci sphere (Gonzalez 2010).
pub fn sphere_directions(n: usize) -> Vec<Vec3> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..n)
        .map(|i| {
            let z = 1.0 - (2.0 * i as f64 + 1.0) / n as f64;
            let r = (1.0 - z * z).sqrt();
            let a = golden * i as f64;
            Vec3::new(r * a.cos(), r * a.sin(), z)
        })
        .collect()
}

/// A small, fast, seedless hasher: voxel keys come from our own data, so it needs no protection against attacks, and
/// the same input always gives the same order of processing.
#[derive(Default, Clone, Copy)]
struct Mix(u64);
type BuildMix = std::hash::BuildHasherDefault<Mix>;

impl std::hash::Hasher for Mix {
    fn finish(&self) -> u64 {
        self.0
    }
    fn write(&mut self, bytes: &[u8]) {
        for &b in bytes {
            self.write_u64(u64::from(b));
        }
    }
    fn write_u64(&mut self, v: u64) {
        self.0 = (self.0 ^ v).wrapping_mul(0x9E37_79B9_7F4A_7C15).rotate_left(29);
    }
    fn write_i64(&mut self, v: i64) {
        self.write_u64(v as u64);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_sides_of_a_thin_wall_survive() {
        let mut cloud = PointCloud::default();
        for i in 0..100 {
            let (x, y) = (f64::from(i % 10) * 0.001, f64::from(i / 10) * 0.001);
            for side in [1.0, -1.0] {
                cloud.points.push(Vec3::new(x + 0.0001, y + 0.0001, 0.005 + 0.0002 * side));
                cloud.normals.push(Vec3::new(0.0, 0.0, side));
            }
        }
        let thin = cloud.voxel_downsample(0.02, 30f64.to_radians());
        assert_eq!(thin.len(), 2);
        assert!((thin.points[0] - Vec3::new(0.0046, 0.0046, 0.0052)).norm() < 1e-9);
        assert!((thin.normals[1] + Vec3::z()).norm() < 1e-9);
    }

    #[test]
    fn a_hundred_thousand_points_without_a_normal_are_one() {
        let n = 100_000;
        for normal in [Vec3::zeros(), Vec3::repeat(f64::NAN)] {
            let cloud = PointCloud { points: vec![Vec3::repeat(0.1); n], normals: vec![normal; n] };
            assert_eq!(cloud.voxel_downsample(0.02, 0.5).len(), 1);
        }
    }

    #[test]
    fn depth_pixels_become_points_on_their_rays() {
        let camera = Camera::new(100.0, 100.0, 1.0, 1.0, 3, 3).unwrap();
        let mut depth = DepthImage::filled(3, 3, 0.0);
        depth[(2, 1)] = 2.0;
        depth[(0, 0)] = f32::NAN;
        let cloud = PointCloud::from_depth(&depth, None, &camera);
        assert_eq!(cloud.points, vec![Vec3::new(0.02, 0.0, 2.0)]);
    }
}
