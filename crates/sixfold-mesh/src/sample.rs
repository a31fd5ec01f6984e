//! Random points on the surface of a mesh, uniform by area.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_geometry::Vec3;

use crate::Mesh;
use crate::measure::triangle_area;

/// Points on a surface; the three arrays have the same length.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SurfaceSamples {
    /// The points, in metres.
    pub points: Vec<Vec3>,
    /// The unit normal of the face at each point.
    pub normals: Vec<Vec3>,
    /// The face on which each point lies.
    pub faces: Vec<u32>,
}

impl Mesh {
    /// `n` points spread over the surface with equal probability by area; faces without area get none.
    /// The same mesh and seed give the same points. Empty when the mesh has no face with an area (a point
    /// model).
    ///
    /// Points in a triangle follow Osada et al. 2002, equation 1.
    pub fn sample_surface(&self, n: usize, seed: u64) -> SurfaceSamples {
        let mut samples = SurfaceSamples::default();
        let mut total = 0.0;
        // The cumulative sum of the areas, for faces with an area.
        let mut areas: Vec<(f64, u32)> = Vec::with_capacity(self.faces().len());
        for face in 0..self.faces().len() {
            let area = triangle_area(&self.triangle(face));
            if area.is_finite() && total + area > total {
                total += area;
                areas.push((total, face as u32));
            }
        }
        if areas.is_empty() {
            return samples;
        }
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        samples.points.reserve_exact(n);
        samples.normals.reserve_exact(n);
        samples.faces.reserve_exact(n);
        for _ in 0..n {
            let at = random.random::<f64>() * total;
            let index = areas.partition_point(|(sum, _)| *sum <= at).min(areas.len() - 1);
            let face = areas[index].1;
            let [a, b, c] = self.triangle(face as usize);
            let (r1, r2) = (random.random::<f64>().sqrt(), random.random::<f64>());
            samples.points.push((1.0 - r1) * a + r1 * (1.0 - r2) * b + r1 * r2 * c);
            let cross = (b - a).cross(&(c - a));
            samples.normals.push(cross / cross.norm());
            samples.faces.push(face);
        }
        samples
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two squares in the plane z = 0 (area 1 and 9), and a face without area.
    fn two_squares() -> Mesh {
        let square =
            |x: f64, s: f64| [[x, 0.0], [x + s, 0.0], [x + s, s], [x, s]].map(|[x, y]| Vec3::new(x, y, 0.0));
        let vertices = [square(0.0, 1.0), square(5.0, 3.0)].concat();
        let faces = vec![[0, 1, 2], [0, 2, 3], [1, 1, 5], [4, 5, 6], [4, 6, 7]];
        Mesh::new(vertices, faces).unwrap()
    }

    #[test]
    fn points_lie_on_their_faces_and_follow_the_area() {
        let samples = two_squares().sample_surface(20_000, 7);
        assert_eq!((samples.points.len(), samples.faces.len()), (20_000, 20_000));
        let small = samples.faces.iter().filter(|&&f| f < 2).count() as f64 / 20_000.0;
        // Standard deviation 0.002.
        assert!((small - 0.1).abs() < 0.01, "{small}");
        assert!(!samples.faces.contains(&2));
        let mut mean = Vec3::zeros();
        for ((p, n), &f) in samples.points.iter().zip(&samples.normals).zip(&samples.faces) {
            assert_eq!(*n, Vec3::z());
            assert!(p.z == 0.0 && if f < 2 { p.x <= 1.0 } else { (5.0..=8.0).contains(&p.x) });
            if f >= 2 {
                mean += p / samples.faces.iter().filter(|&&f| f >= 2).count() as f64;
            }
        }
        assert!((mean - Vec3::new(6.5, 1.5, 0.0)).norm() < 0.03, "{mean}");
    }

    #[test]
    fn seeds_decide() {
        let mesh = two_squares();
        assert_eq!(mesh.sample_surface(50, 1), mesh.sample_surface(50, 1));
        assert_ne!(mesh.sample_surface(50, 1), mesh.sample_surface(50, 2));
    }

    #[test]
    fn a_point_model_has_no_surface() {
        let mesh = Mesh::new(vec![Vec3::x(), Vec3::y()], vec![]).unwrap();
        assert!(mesh.sample_surface(10, 0).points.is_empty());
    }
}
