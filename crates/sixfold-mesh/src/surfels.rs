//! A surface for a model that is only points: one small disk (surfel, Pfister et al. 2000) per point, perpendicular to the
//! normal of its neighbourhood.
//!
//! Disks need no orientation and no topology, so thin walls and open shapes (mugs, pitchers) work; the renderer shows both
//! sides. The sparser the points, the rougher the surface.

use std::collections::HashSet;
use std::f64::consts::TAU;

use sixfold_geometry::{KdTree, Neighbour, Vec3, fit_plane};

use crate::measure::position_key;
use crate::{Mesh, MeshError};

/// Corners of a disk.
const CORNERS: u32 = 6;

impl Mesh {
    /// A mesh of disks through this mesh's vertices; faces, colours and textures are dropped. The disks are wide enough to
    /// close the surface: 0.8 times the distance to the sixth neighbour.
    ///
    /// # Errors
    /// [`MeshError::Empty`] when there are fewer than four points or all lie on one line.
    pub fn surfels(&self) -> Result<Mesh, MeshError> {
        let points = self.vertices();
        let tree = KdTree::new(points);
        let typical = spacing(points, &tree);
        let mut vertices = Vec::with_capacity(points.len() * CORNERS as usize);
        let mut faces = Vec::with_capacity(points.len() * (CORNERS as usize - 2));
        for p in points {
            let mut near = tree.nearest_several(p, 12);
            // The neighbourhood grows until it holds enough points for a plane.
            let squared = |n: &Neighbour| (points[n.index] - p).norm_squared();
            let enough = near.get(7).or(near.last()).map_or(0.0, squared);
            let mut reach = 2.0 * typical;
            while reach * reach < enough {
                reach *= 1.5;
            }
            near.retain(|n| squared(n) <= reach * reach);
            let neighbours: Vec<Vec3> = near.iter().map(|n| points[n.index]).collect();
            let Some(plane) = fit_plane(&neighbours) else { continue };
            let radius = 0.8 * near[near.len().min(7) - 1].distance;
            let any = if plane.normal.x.abs() < 0.8 { Vec3::x() } else { Vec3::y() };
            let u = plane.normal.cross(&any).normalize();
            let v = plane.normal.cross(&u);
            let first = vertices.len() as u32;
            for k in 0..CORNERS {
                let a = TAU * f64::from(k) / f64::from(CORNERS);
                vertices.push(p + (u * a.cos() + v * a.sin()) * radius);
            }
            faces.extend((1..CORNERS - 1).map(|k| [first, first + k, first + k + 1]));
        }
        Mesh::new(vertices, faces)
    }
}

/// The median distance from a point to the nearest one elsewhere.
fn spacing(points: &[Vec3], tree: &KdTree) -> f64 {
    let extent = points.iter().fold(0f64, |m, p| m.max((p - points[0]).norm()));
    // Remove duplicates: otherwise all points at a place would be visited for each of them.
    let mut places = HashSet::with_capacity(points.len());
    let unique: Vec<Vec3> = points.iter().filter(|p| places.insert(position_key(p))).copied().collect();
    let of_unique;
    let tree = if unique.len() == points.len() {
        tree
    } else {
        of_unique = KdTree::new(&unique);
        &of_unique
    };
    let stride = points.len().div_ceil(500).max(1);
    let elsewhere = |p: &Vec3| tree.nearest_several(p, 2).iter().map(|n| n.distance).find(|d| *d > 0.0);
    let mut distances: Vec<f64> = points.iter().step_by(stride).filter_map(elsewhere).collect();
    distances.sort_by(f64::total_cmp);
    distances.get(distances.len() / 2).copied().unwrap_or(extent.max(f64::MIN_POSITIVE))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn disks_lie_on_the_sphere_they_came_from() {
        let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
        let points = (0..1500)
            .map(|i| {
                let z = 1.0 - (2.0 * f64::from(i) + 1.0) / 1500.0;
                let r = (1.0 - z * z).sqrt();
                Vec3::new(r * (golden * f64::from(i)).cos(), r * (golden * f64::from(i)).sin(), z) * 0.1
            })
            .collect();
        let surface = Mesh::new(points, vec![]).unwrap().surfels().unwrap();
        assert_eq!(surface.faces().len(), 1500 * 4);
        for v in surface.vertices() {
            assert!((v.norm() - 0.1).abs() < 0.001, "{}", v.norm());
        }
        for face in 0..surface.faces().len() {
            let [a, b, c] = surface.faces()[face].map(|i| surface.vertices()[i as usize]);
            let n = (b - a).cross(&(c - a)).normalize();
            assert!(n.dot(&a.normalize()).abs() > 0.98);
        }
        // Overlapping: the disks together are larger than the sphere.
        assert!(surface.surface_area() > 4.0 * std::f64::consts::PI * 0.01);
    }

    #[test]
    fn forty_thousand_equal_points_take_no_time() {
        let start = std::time::Instant::now();
        let equal = vec![Vec3::new(0.1, 0.2, 0.3); 40_000];
        assert_eq!(Mesh::new(equal.clone(), vec![]).unwrap().surfels(), Err(MeshError::Empty));
        // Half of them at one place, the others around: the surface is that of the others.
        let around =
            (0..20_000).map(|k| Vec3::new(f64::from(k % 141) * 1e-3, f64::from(k / 141) * 1e-3, 0.0));
        let mixed = Mesh::new(equal[..20_000].iter().copied().chain(around).collect(), vec![]).unwrap();
        assert_eq!(mixed.surfels().unwrap().faces().len(), 20_000 * 4);
        assert!(start.elapsed().as_secs() < 15, "{:?}", start.elapsed());
    }

    #[test]
    fn a_line_and_a_single_point_have_no_surface() {
        let line = (0..50).map(|i| Vec3::new(f64::from(i) * 0.01, 0.0, 0.0)).collect();
        assert_eq!(Mesh::new(line, vec![]).unwrap().surfels(), Err(MeshError::Empty));
        assert_eq!(Mesh::new(vec![Vec3::zeros()], vec![]).unwrap().surfels(), Err(MeshError::Empty));
    }
}
