//! The dominant plane of a cloud (a table, a floor, the bottom of a bin) by seeded RANSAC
//! (Fischler and Bolles 1981) and a least-squares fit to its inliers.

use std::f64::consts::FRAC_PI_2;

use nalgebra::SymmetricEigen;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::{Mat3, OptionError, PointCloud, Vec3};

/// All points `p` with `normal . p = offset`; lengths in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// Unit normal.
    pub normal: Vec3,
    /// Signed distance of the plane from the origin along the normal.
    pub offset: f64,
}

impl Plane {
    /// Signed distance of a point, positive on the side the normal points to.
    pub fn distance(&self, p: &Vec3) -> f64 {
        self.normal.dot(p) - self.offset
    }

    /// The mirror image of a point.
    #[must_use]
    pub fn mirrored(&self, p: &Vec3) -> Vec3 {
        p - self.normal * (2.0 * self.distance(p))
    }

    /// The same plane with its normal on the side of `point`.
    pub fn facing(self, point: &Vec3) -> Plane {
        if self.distance(point) < 0.0 { Plane { normal: -self.normal, offset: -self.offset } } else { self }
    }
}

/// Options of the search for a plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneOptions {
    /// A point within this distance belongs to the plane, metres.
    pub threshold: f64,
    /// Number of random samples.
    pub iterations: usize,
    /// Minimum fraction of the points on the plane.
    pub min_fraction: f64,
    /// Normals, where the cloud has them, must agree within this angle, radians.
    pub max_angle: f64,
}

impl Default for PlaneOptions {
    fn default() -> Self {
        PlaneOptions { threshold: 0.01, iterations: 300, min_fraction: 0.15, max_angle: 30f64.to_radians() }
    }
}

impl PlaneOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_positive("plane.threshold", self.threshold, "metres above 0")?;
        OptionError::unless_some("plane.iterations", self.iterations)?;
        OptionError::unless_fraction("plane.min_fraction", self.min_fraction)?;
        let angle = "radians above 0, at most a quarter of a turn";
        OptionError::unless_positive("plane.max_angle", self.max_angle, angle)?;
        OptionError::unless_within("plane.max_angle", self.max_angle, ..=FRAC_PI_2, angle)
    }
}

/// The plane with the most points of the cloud, its normal pointing to the origin (the camera); `None` when
/// no plane has the required fraction.
pub fn dominant_plane(cloud: &PointCloud, options: &PlaneOptions, seed: u64) -> Option<Plane> {
    let n = cloud.len();
    if n < 3 {
        return None;
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    // Every n-th point is enough to choose a plane; the final fit uses all points.
    let stride = (n / 4000).max(1);
    let belongs = |plane: &Plane, i: usize| {
        plane.distance(&cloud.points[i]).abs() < options.threshold
            && cloud
                .normals
                .get(i)
                .is_none_or(|normal| normal.dot(&plane.normal).abs() > options.max_angle.cos())
    };
    let count = |plane: &Plane| (0..n).step_by(stride).filter(|&i| belongs(plane, i)).count();
    let mut best: Option<(usize, Plane)> = None;
    for _ in 0..options.iterations {
        let [a, b, c] = std::array::from_fn(|_| cloud.points[random.random_range(0..n)]);
        let Some(normal) = (b - a).cross(&(c - a)).try_normalize(1e-9) else { continue };
        let plane = Plane { normal, offset: normal.dot(&a) };
        let support = count(&plane);
        if best.is_none_or(|(most, _)| support > most) {
            best = Some((support, plane));
        }
    }
    let mut plane = best?.1;
    for _ in 0..3 {
        let inliers: Vec<Vec3> = (0..n).filter(|&i| belongs(&plane, i)).map(|i| cloud.points[i]).collect();
        plane = fit_plane(&inliers)?;
    }
    let support = (0..n).filter(|&i| belongs(&plane, i)).count();
    (support as f64 >= options.min_fraction * n as f64).then(|| plane.facing(&Vec3::zeros()))
}

/// The least-squares plane through at least three points that are not on one line.
pub fn fit_plane(points: &[Vec3]) -> Option<Plane> {
    if points.len() < 3 {
        return None;
    }
    let mean = points.iter().sum::<Vec3>() / points.len() as f64;
    let mut covariance = Mat3::zeros();
    for p in points {
        let d = p - mean;
        covariance += d * d.transpose();
    }
    let eigen = SymmetricEigen::new(covariance);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    if !(eigen.eigenvalues[order[1]] > 1e-12 * eigen.eigenvalues[order[2]].max(1e-300)) {
        return None;
    }
    let normal: Vec3 = eigen.eigenvectors.column(order[0]).into_owned().normalize();
    Some(Plane { normal, offset: normal.dot(&mean) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_under_clutter_is_found() {
        let truth = Plane { normal: Vec3::new(0.1, -0.8, -0.6).normalize(), offset: -0.7 };
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut cloud = PointCloud::default();
        let u = truth.normal.cross(&Vec3::x()).normalize();
        let v = truth.normal.cross(&u);
        for i in 0..3000 {
            let (a, b, c) = (
                random.random_range(-0.5..0.5),
                random.random_range(-0.5..0.5),
                random.random_range(-0.002..0.002),
            );
            let mut p = truth.normal * truth.offset + u * a + v * b + truth.normal * c;
            if i % 2 == 0 {
                p += truth.normal * random.random_range(0.02..0.3);
            }
            cloud.points.push(p);
        }
        let found = dominant_plane(&cloud, &PlaneOptions::default(), 7).unwrap();
        assert!(found.normal.dot(&truth.normal) > 0.9999, "{found:?}");
        assert!((found.offset - truth.offset).abs() < 0.001);
        assert_eq!(Some(found), dominant_plane(&cloud, &PlaneOptions::default(), 7));
    }

    #[test]
    fn a_cloud_without_a_plane_gives_none() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let points =
            (0..2000).map(|_| Vec3::from(std::array::from_fn(|_| random.random_range(-0.5..0.5)))).collect();
        let cloud = PointCloud { points, normals: vec![] };
        assert!(dominant_plane(&cloud, &PlaneOptions::default(), 0).is_none());
        assert!(dominant_plane(&PointCloud::default(), &PlaneOptions::default(), 0).is_none());
        assert!(fit_plane(&[Vec3::zeros(), Vec3::x(), Vec3::x() * 2.0]).is_none());
    }
}
