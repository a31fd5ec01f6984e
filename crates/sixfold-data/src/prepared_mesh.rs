//! A mesh made ready to be rendered thousands of times: few faces, normals at hand, and what its box in an image needs.

use sixfold_geometry::{Camera, Pose, Vec2, Vec3};
use sixfold_mesh::{Mesh, simplify};

/// A training object's mesh made ready.
#[derive(Debug, Clone)]
pub struct PreparedMesh {
    /// The simplified mesh with its normals; a simplified mesh has lost its texture.
    pub mesh: Mesh,
    /// Whether the mesh that was given has faces with colours or texture of their own.
    pub colored: bool,
    /// Centre of its box, object frame, metres.
    pub centre: Vec3,
    /// Vertices that decide about the object's box from any side.
    extremes: Vec<Vec3>,
}

/// Whether a mesh has a texture and says where on it.
pub fn is_textured(mesh: &Mesh) -> bool {
    mesh.texture().is_some() && mesh.texcoords().is_some()
}

impl PreparedMesh {
    /// Simplifies a mesh of more than `faces` faces; `extremes` directions decide about its box in images.
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
