//! The part of an image that shows an object.

use sixfold_geometry::{Camera, Pose, Vec2};
use sixfold_mesh::Mesh;
use sixfold_synth::augment::Window;

/// A square around the mesh at a pose, `room` times as wide as the longer side of its bounding box in the image; `None` if a vertex
/// is behind the camera.
pub(crate) fn object_window(camera: &Camera, mesh: &Mesh, pose: &Pose, room: f64) -> Option<Window> {
    let mut low = Vec2::repeat(f64::INFINITY);
    let mut high = Vec2::repeat(f64::NEG_INFINITY);
    for v in mesh.vertices() {
        let p = camera.project(&pose.transform_point(v))?;
        low = low.inf(&p);
        high = high.sup(&p);
    }
    // A distant object of a few pixels still gets a crop.
    Some(Window { centre: (low + high) * 0.5, side: (high - low).amax().max(4.0) * room })
}
