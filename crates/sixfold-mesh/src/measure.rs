//! Bounding box, area and normals of a mesh.

use std::collections::HashMap;

use sixfold_geometry::{Pose, Vec3, sphere_directions};

use crate::Mesh;

impl Mesh {
    /// The minimum and maximum corners of the axis-aligned bounding box, in metres.
    pub fn bounding_box(&self) -> (Vec3, Vec3) {
        let first = self.vertices()[0];
        self.vertices().iter().fold((first, first), |(low, high), v| (low.inf(v), high.sup(v)))
    }

    /// The eight corners of this box; bit `k` of the index is set where coordinate `k` is the maximum.
    pub fn box_corners(&self) -> [Vec3; 8] {
        let (low, high) = self.bounding_box();
        std::array::from_fn(|i| Vec3::from_fn(|k, _| if i >> k & 1 == 1 { high[k] } else { low[k] }))
    }

    /// The vertices that are outermost in one of `directions` directions spread over the sphere, in metres. They suffice
    /// to compute the object's box in an image.
    pub fn extremes(&self, directions: usize) -> Vec<Vec3> {
        let vertices = self.vertices();
        let mut outermost: Vec<usize> = sphere_directions(directions)
            .iter()
            .filter_map(|d| {
                (0..vertices.len()).max_by(|&a, &b| d.dot(&vertices[a]).total_cmp(&d.dot(&vertices[b])))
            })
            .collect();
        outermost.sort_unstable();
        outermost.dedup();
        outermost.into_iter().map(|i| vertices[i]).collect()
    }

    /// The corners of a face, in metres.
    ///
    /// # Panics
    /// When there is no such face.
    pub fn triangle(&self, face: usize) -> [Vec3; 3] {
        self.faces()[face].map(|i| self.vertices()[i as usize])
    }

    /// The area of all faces, in square metres.
    pub fn surface_area(&self) -> f64 {
        (0..self.faces().len()).map(|face| triangle_area(&self.triangle(face))).sum()
    }

    /// A unit normal for every vertex: those given with the mesh, or computed from the faces, each weighted
    /// by its angle at the vertex (Thürmer & Wüthrich 1998), which does not depend on the triangulation of flat areas.
    /// Zero where no face with an area meets the vertex.
    pub fn vertex_normals(&self) -> Vec<Vec3> {
        match self.normals() {
            Some(normals) => normals.to_vec(),
            None => computed_normals(self.vertices(), self.faces()),
        }
    }

    /// The mesh transformed by a pose.
    pub fn transformed(&self, pose: &Pose) -> Mesh {
        self.map_geometry(|v| pose.transform_point(v), |n| pose.transform_direction(n))
    }

    /// The mesh with every length multiplied by `factor`, which must be finite and positive.
    ///
    /// # Panics
    /// When `factor` is not finite and positive, which is a programming error.
    pub fn scaled(&self, factor: f64) -> Mesh {
        assert!(factor.is_finite() && factor > 0.0, "scale factor {factor} is not finite and positive");
        self.map_geometry(|v| v * factor, |n| *n)
    }
}

/// The area of a triangle.
pub(crate) fn triangle_area([a, b, c]: &[Vec3; 3]) -> f64 {
    0.5 * (b - a).cross(&(c - a)).norm()
}

/// A key that is the same for the same place.
pub(crate) fn position_key(point: &Vec3) -> [u64; 3] {
    // Adding zero turns -0 into 0.
    [point.x, point.y, point.z].map(|c| (c + 0.0).to_bits())
}

/// Angle-weighted vertex normals; zero where no face with an area meets the vertex. Vertices at the same place (split at a
/// seam of the texture) share a normal, unless their faces cancel out (the two sides of a sheet).
pub(crate) fn computed_normals(vertices: &[Vec3], faces: &[[u32; 3]]) -> Vec<Vec3> {
    let mut own = vec![Vec3::zeros(); vertices.len()];
    for face in faces {
        let corners = face.map(|i| vertices[i as usize]);
        let cross = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]));
        let Some(normal) = cross.try_normalize(0.0).filter(|n| n.x.is_finite()) else { continue };
        for k in 0..3 {
            let a = corners[(k + 1) % 3] - corners[k];
            let b = corners[(k + 2) % 3] - corners[k];
            let angle = a.cross(&b).norm().atan2(a.dot(&b));
            own[face[k] as usize] += normal * angle;
        }
    }
    let mut places: HashMap<[u64; 3], Vec3> = HashMap::with_capacity(vertices.len());
    for (vertex, normal) in vertices.iter().zip(&own) {
        *places.entry(position_key(vertex)).or_insert_with(Vec3::zeros) += normal;
    }
    let unit = |v: Vec3| v.try_normalize(1e-6);
    vertices
        .iter()
        .zip(own)
        .map(|(vertex, own)| unit(places[&position_key(vertex)]).or_else(|| unit(own)).unwrap_or_default())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cube of side 2 about the origin; `split` gives every face of the cube its own vertices.
    fn cube(split: bool) -> Mesh {
        let corner = |i: usize| Vec3::from([0, 1, 2].map(|k| if i >> k & 1 == 1 { 1.0 } else { -1.0 }));
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        if split {
            let vertices = quads.as_flattened().iter().map(|&i| corner(i)).collect();
            let faces = (0..6).flat_map(|q| [[4 * q, 4 * q + 1, 4 * q + 2], [4 * q, 4 * q + 2, 4 * q + 3]]);
            return Mesh::new(vertices, faces.collect()).unwrap();
        }
        let faces = quads.iter().flat_map(|q| {
            let q = q.map(|i| i as u32);
            [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]
        });
        Mesh::new((0..8).map(corner).collect(), faces.collect()).unwrap()
    }

    #[test]
    fn a_cube_by_hand() {
        for split in [false, true] {
            let cube = cube(split);
            assert!((cube.surface_area() - 24.0).abs() < 1e-12);
            assert!((cube.diameter() - 12f64.sqrt()).abs() < 1e-12);
            assert_eq!(cube.bounding_box(), (Vec3::repeat(-1.0), Vec3::repeat(1.0)));
            let [first, second, .., last] = cube.box_corners();
            assert_eq!([first, second, last], [[-1.0; 3], [1.0, -1.0, -1.0], [1.0; 3]].map(Vec3::from));
            // Angle weighting gives the diagonal for any triangulation of the sides.
            for (v, n) in cube.vertices().iter().zip(cube.vertex_normals()) {
                assert!((n - v.normalize()).norm() < 1e-12, "{v} {n}");
            }
        }
    }

    #[test]
    fn the_sides_of_a_sheet_keep_their_normals() {
        let corners = [Vec3::zeros(), Vec3::x(), Vec3::y()];
        let sheet = Mesh::new([corners, corners].concat(), vec![[0, 1, 2], [3, 5, 4]]).unwrap();
        let normals = sheet.vertex_normals();
        assert!(
            normals[..3].iter().all(|n| *n == Vec3::z()) && normals[3..].iter().all(|n| *n == -Vec3::z())
        );
        let loose = Mesh::new(vec![Vec3::x()], vec![]).unwrap();
        assert_eq!(loose.vertex_normals(), [Vec3::zeros()]);
    }

    #[test]
    fn moved_scaled_and_merged() {
        let cube = cube(false).with_normals(cube(false).vertex_normals()).unwrap();
        let pose = Pose::exp(&[0.3, 0.0, 1.0, 0.0, 0.4, 0.2].into());
        let moved = cube.transformed(&pose);
        assert!((moved.vertices()[3] - pose.transform_point(&cube.vertices()[3])).norm() < 1e-12);
        assert!(
            (moved.normals().unwrap()[3] - pose.transform_direction(&cube.normals().unwrap()[3])).norm()
                < 1e-12
        );
        assert!((cube.scaled(0.5).surface_area() - 6.0).abs() < 1e-12);
        let plain = self::cube(true).with_colors(vec![[1, 2, 3]; 24]).unwrap();
        let both = Mesh::merged(&[moved, plain]).unwrap();
        assert_eq!((both.vertices().len(), both.faces().len()), (32, 24));
        assert!((both.surface_area() - 48.0).abs() < 1e-9);
        assert_eq!(both.normals().unwrap().len(), 32);
        assert_eq!((both.colors().unwrap()[0], both.colors().unwrap()[8]), ([128; 3], [1, 2, 3]));
        assert_eq!(Mesh::merged(&[]), Err(crate::MeshError::Empty));
    }
}
