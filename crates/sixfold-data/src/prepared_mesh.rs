//! A mesh prepared to be rendered thousands of times: few faces, normals, and the vertices that determine its box in an image.

use sixfold_geometry::{Camera, Pose, Vec2, Vec3};
use sixfold_mesh::{Mesh, simplify};

/// The prepared mesh of a training object.
#[derive(Debug, Clone)]
pub struct PreparedMesh {
    /// The simplified mesh with its normals; simplification removes the texture.
    pub mesh: Mesh,
    /// Whether the original mesh has faces with colours or a texture.
    pub colored: bool,
    /// Centre of its box, object frame, metres.
    pub centre: Vec3,
    /// Vertices that determine the object's box from any side.
    extremes: Vec<Vec3>,
}

/// Whether a mesh has a texture and texture coordinates.
pub fn is_textured(mesh: &Mesh) -> bool {
    mesh.texture().is_some() && mesh.texcoords().is_some()
}

impl PreparedMesh {
    /// Simplifies a mesh of more than `faces` faces; `extremes` directions determine its box in images.
    pub fn new(mesh: &Mesh, faces: usize, extremes: usize) -> Self {
        let (low, high) = mesh.bounding_box();
        let colored = (is_textured(mesh) || mesh.colors().is_some()) && !mesh.faces().is_empty();
        let extremes = mesh.extremes(extremes);
        let small = if mesh.faces().len() > faces { simplify(mesh, faces) } else { mesh.clone() };
        // Normals looked up per sample would be recomputed every time.
        let normals = small.vertex_normals();
        let mesh = small.clone().with_normals(normals).unwrap_or(small);
        PreparedMesh { mesh, colored, centre: (low + high) * 0.5, extremes }
    }

    /// Smallest and largest pixel coordinates of the whole object in an image; `None` where a part of it is behind the camera.
    pub fn pixel_box(&self, camera: &Camera, camera_from_object: &Pose) -> Option<(Vec2, Vec2)> {
        let mut pixels = self.extremes.iter().map(|v| camera.project(&camera_from_object.transform_point(v)));
        let first = pixels.next()??;
        pixels.try_fold((first, first), |(low, high), pixel| pixel.map(|p| (low.inf(&p), high.sup(&p))))
    }
}
