//! Bounding box, area and normals of a mesh.

use sixfold_geometry::{Pose, Vec3};

use crate::Mesh;

impl Mesh {
    /// The corners of the axis-parallel bounding box, smallest and largest, in metres.
    pub fn bounding_box(&self) -> (Vec3, Vec3) {
        let first = self.vertices()[0];
        self.vertices().iter().fold((first, first), |(low, high), v| (low.inf(v), high.sup(v)))
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
    /// by its angle at the vertex (Thürmer & Wüthrich 1998), which does not depend on how flat areas were cut
    /// into triangles. Zero where no face of any area meets the vertex.
    pub fn vertex_normals(&self) -> Vec<Vec3> {
        match self.normals() {
            Some(normals) => normals.to_vec(),
            None => computed_normals(self.vertices(), self.faces()),
        }
    }

    /// The mesh moved by a pose.
    pub fn transformed(&self, pose: &Pose) -> Mesh {
        self.map_geometry(|v| pose.transform_point(v), |n| pose.transform_direction(n))
    }

    /// The mesh with every length multiplied by `factor`, which must be finite and positive.
    ///
    /// # Panics
    /// When `factor` is not finite and positive: that is a mistake in the program.
    pub fn scaled(&self, factor: f64) -> Mesh {
        assert!(factor.is_finite() && factor > 0.0, "scale factor {factor} is not finite and positive");
        self.map_geometry(|v| v * factor, |n| *n)
    }
}

/// The area of a triangle.
pub(crate) fn triangle_area([a, b, c]: &[Vec3; 3]) -> f64 {
    0.5 * (b - a).cross(&(c - a)).norm()
}

/// Angle-weighted vertex normals; zero where no face of any area meets the vertex.
pub(crate) fn computed_normals(vertices: &[Vec3], faces: &[[u32; 3]]) -> Vec<Vec3> {
    let mut normals = vec![Vec3::zeros(); vertices.len()];
    for face in faces {
        let corners = face.map(|i| vertices[i as usize]);
        let cross = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]));
        let Some(normal) = cross.try_normalize(0.0).filter(|n| n.x.is_finite()) else { continue };
        for k in 0..3 {
            let a = corners[(k + 1) % 3] - corners[k];
            let b = corners[(k + 2) % 3] - corners[k];
            let angle = a.cross(&b).norm().atan2(a.dot(&b));
            normals[face[k] as usize] += normal * angle;
        }
    }
    for normal in &mut normals {
        *normal = normal.try_normalize(1e-9).unwrap_or_default();
    }
    normals
}
