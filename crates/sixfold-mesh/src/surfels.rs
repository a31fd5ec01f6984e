//! A surface for a model that is only points: one small disk (surfel, Pfister et al. 2000) per point, across the normal of
//! its neighbourhood.
//!
//! Disks need no orientation and no topology, so thin walls and open shapes (mugs, pitchers) are no trouble; the renderer
//! shows both sides. The surface is as rough as the points are sparse.

use std::f64::consts::TAU;

use sixfold_geometry::{KdTree, Vec3, fit_plane};

use crate::{Mesh, MeshError};

/// Corners of a disk.
const CORNERS: u32 = 6;

impl Mesh {
    /// A mesh of disks through this mesh's vertices; faces, colours and textures are left behind. The disks are wide
    /// enough to close the surface: 0.8 times the distance to the sixth neighbour.
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
            // The neighbourhood grows until it holds enough points for a plane.
            let mut reach = 2.0 * typical;
            let mut near = tree.within(p, reach);
            while near.len() < 8 && near.len() < points.len() {
                reach *= 1.5;
                near = tree.within(p, reach);
            }
            near.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.index.cmp(&b.index)));
            near.truncate(12);
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

/// The median distance from a point to its nearest other point.
fn spacing(points: &[Vec3], tree: &KdTree) -> f64 {
    let stride = points.len().div_ceil(500).max(1);
    let extent = points.iter().fold(0f64, |m, p| m.max((p - points[0]).norm()));
    let mut distances: Vec<f64> = points
        .iter()
        .enumerate()
        .step_by(stride)
        .filter_map(|(i, p)| {
            let mut reach = 0.01 * extent;
            while reach > 0.0 && reach < 2.0 * extent {
                let nearest = tree
                    .within(p, reach)
                    .iter()
                    .filter(|n| n.index != i && n.distance > 0.0)
                    .map(|n| n.distance)
                    .fold(f64::INFINITY, f64::min);
                if nearest.is_finite() {
                    return Some(nearest);
                }
                reach *= 2.0;
            }
            None
        })
        .collect();
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
    fn a_line_and_a_single_point_have_no_surface() {
        let line = (0..50).map(|i| Vec3::new(f64::from(i) * 0.01, 0.0, 0.0)).collect();
        assert_eq!(Mesh::new(line, vec![]).unwrap().surfels(), Err(MeshError::Empty));
        assert_eq!(Mesh::new(vec![Vec3::zeros()], vec![]).unwrap().surfels(), Err(MeshError::Empty));
    }
}
