//! The convex hull of a mesh's vertices by quickhull (Barber, Dobkin and Huhdanpaa 1996).
//!
//! The faces that see a new point are found by testing all of them: hulls of objects have few thousand faces at most.

use std::collections::{HashMap, HashSet};

use sixfold_geometry::Vec3;

use crate::mesh::{Mesh, MeshError};

/// Points nearer to a face than this share of the size lie on it.
const TOLERANCE: f64 = 1e-7;

/// A face with what lies outside of it.
struct Face {
    corners: [usize; 3],
    normal: Vec3,
    offset: f64,
    outside: Vec<usize>,
}

impl Face {
    fn new(points: &[Vec3], corners: [usize; 3]) -> Face {
        let [a, b, c] = corners.map(|i| points[i]);
        let normal = (b - a).cross(&(c - a)).try_normalize(0.0).unwrap_or_else(Vec3::zeros);
        Face { corners, normal, offset: normal.dot(&a), outside: vec![] }
    }

    fn distance(&self, point: &Vec3) -> f64 {
        self.normal.dot(point) - self.offset
    }

    fn edges(&self) -> [(usize, usize); 3] {
        let [a, b, c] = self.corners;
        [(a, b), (b, c), (c, a)]
    }
}

impl Mesh {
    /// The smallest convex body around the vertices, without colours; faces look outwards.
    ///
    /// # Errors
    /// [`MeshError`] for a mesh whose vertices lie in a plane, on a line or in a point: its hull has no faces.
    pub fn convex_hull(&self) -> Result<Mesh, MeshError> {
        let points = self.vertices();
        let (low, high) = self.bounding_box();
        let tolerance = TOLERANCE * (high - low).amax();
        let mut faces = first_faces(points, tolerance);
        let all: Vec<usize> = (0..points.len()).collect();
        hand_out(points, &all, &mut faces, tolerance);
        while let Some(at) = faces.iter().position(|f| !f.outside.is_empty()) {
            let face = &faces[at];
            let far = |i: &usize| face.distance(&points[*i]);
            let Some(apex) = face.outside.iter().copied().max_by(|a, b| far(a).total_cmp(&far(b))) else {
                break;
            };
            let (seen, kept): (Vec<Face>, Vec<Face>) =
                faces.into_iter().partition(|f| f.distance(&points[apex]) > tolerance);
            let edges: HashSet<(usize, usize)> = seen.iter().flat_map(Face::edges).collect();
            let orphans: Vec<usize> =
                seen.iter().flat_map(|f| f.outside.iter().copied()).filter(|i| *i != apex).collect();
            // In the order of the faces, so that the same mesh always gets the same hull.
            let mut new: Vec<Face> = seen
                .iter()
                .flat_map(Face::edges)
                .filter(|(a, b)| !edges.contains(&(*b, *a)))
                .map(|(a, b)| Face::new(points, [a, b, apex]))
                .collect();
            hand_out(points, &orphans, &mut new, tolerance);
            faces = kept;
            faces.append(&mut new);
        }
        let (mut numbers, mut vertices) = (HashMap::new(), vec![]);
        let corners = faces
            .iter()
            .map(|f| {
                f.corners.map(|i| {
                    *numbers.entry(i).or_insert_with(|| {
                        vertices.push(points[i]);
                        vertices.len() as u32 - 1
                    })
                })
            })
            .collect();
        Mesh::new(vertices, corners)
    }
}

/// Four faces of a tetrahedron of far points, none where there is no such.
fn first_faces(points: &[Vec3], tolerance: f64) -> Vec<Face> {
    let furthest = |distance: &dyn Fn(&Vec3) -> f64| {
        let best = (0..points.len()).max_by(|a, b| distance(&points[*a]).total_cmp(&distance(&points[*b])));
        best.filter(|i| distance(&points[*i]) > tolerance)
    };
    let Some(origin) = points.first() else { return vec![] };
    let Some(a) = furthest(&|p| (p - origin).norm()) else { return vec![] };
    let Some(b) = furthest(&|p| (p - points[a]).norm()) else { return vec![] };
    let along = (points[b] - points[a]).normalize();
    let Some(c) = furthest(&|p| (p - points[a]).cross(&along).norm()) else { return vec![] };
    let plane = Face::new(points, [a, b, c]);
    let Some(d) = furthest(&|p| plane.distance(p).abs()) else { return vec![] };
    let (b, c) = if plane.distance(&points[d]) > 0.0 { (c, b) } else { (b, c) };
    [[a, b, c], [a, c, d], [c, b, d], [b, a, d]].map(|corners| Face::new(points, corners)).into()
}

/// Gives every point that lies outside to a face that sees it.
fn hand_out(points: &[Vec3], indices: &[usize], faces: &mut [Face], tolerance: f64) {
    for &i in indices {
        if let Some(face) = faces.iter_mut().find(|f| f.distance(&points[i]) > tolerance) {
            face.outside.push(i);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn volume(mesh: &Mesh) -> f64 {
        let corner = |f: &[u32; 3], k: usize| mesh.vertices()[f[k] as usize];
        mesh.faces().iter().map(|f| corner(f, 0).dot(&corner(f, 1).cross(&corner(f, 2))) / 6.0).sum()
    }

    fn check(mesh: &Mesh) -> Mesh {
        let hull = mesh.convex_hull().unwrap();
        let edges: HashSet<(u32, u32)> =
            hull.faces().iter().flat_map(|f| [(f[0], f[1]), (f[1], f[2]), (f[2], f[0])]).collect();
        assert_eq!(edges.len(), 3 * hull.faces().len(), "an edge belongs to two faces the same way round");
        assert!(edges.iter().all(|(a, b)| edges.contains(&(*b, *a))), "the hull is not closed");
        for f in hull.faces() {
            let face = Face::new(hull.vertices(), f.map(|i| i as usize));
            for p in mesh.vertices() {
                assert!(face.distance(p) < 1e-6, "{p} lies {} m outside", face.distance(p));
            }
        }
        hull
    }

    #[test]
    fn a_cube_with_points_inside_and_on_its_sides_is_a_cube() {
        let steps: Vec<f64> = (0..=4).map(|i| 0.025 * f64::from(i)).collect();
        let mut points = vec![];
        for x in &steps {
            for y in &steps {
                for z in &steps {
                    points.push(Vec3::new(*x, *y, *z));
                }
            }
        }
        let hull = check(&Mesh::new(points, vec![]).unwrap());
        assert!((volume(&hull) - 0.001).abs() < 1e-9, "{}", volume(&hull));
    }

    #[test]
    fn a_sphere_keeps_its_points_and_a_dent_is_filled() {
        let mut points = sixfold_geometry::sphere_directions(500);
        for p in &mut points {
            *p *= if p.z > 0.8 { 0.03 } else { 0.05 };
        }
        let hull = check(&Mesh::new(points.clone(), vec![]).unwrap());
        let around = points.iter().filter(|p| p.norm() > 0.04).count();
        assert_eq!(hull.vertices().len(), around);
        let whole = 4.0 / 3.0 * std::f64::consts::PI * 0.05f64.powi(3);
        assert!(volume(&hull) > 0.85 * whole && volume(&hull) < whole, "{}", volume(&hull) / whole);
    }

    #[test]
    fn flat_meshes_have_no_hull() {
        let flat = vec![Vec3::zeros(), Vec3::x(), Vec3::y(), Vec3::new(1.0, 1.0, 0.0)];
        let hull = Mesh::new(flat, vec![[0, 1, 2]]).unwrap().convex_hull();
        assert!(hull.is_err(), "{hull:?}");
    }
}
