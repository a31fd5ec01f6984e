//! What a network is to find: the object's coordinates and silhouette.

use sixfold_geometry::{Camera, Pose};
use sixfold_mesh::Mesh;
use sixfold_render::{BoundingBoxScale, RenderOptions, SceneObject, VisibilityBuffer};
use sixfold_synth::augment::Coverage;

/// Coordinates (3 planes, normalised, 0 outside) and silhouette (0 or 1) of the whole object.
pub(super) fn targets(
    mesh: &Mesh,
    scale: &BoundingBoxScale,
    camera: &Camera,
    camera_from_object: &Pose,
) -> (Vec<f32>, Coverage) {
    let objects = [SceneObject { mesh, camera_from_object: *camera_from_object }];
    let mut frame = VisibilityBuffer::new(camera);
    frame.render(&objects, &RenderOptions::default());
    let points = frame.object_coordinates(&objects);
    let pixels = camera.width * camera.height;
    let mut coordinates = vec![0.0; 3 * pixels];
    let mut silhouette = Coverage::filled(camera.width, camera.height, 0.0);
    let centre = scale.centre.map(|c| c as f32);
    let inverse = scale.half_size.map(|h| (1.0 / h) as f32);
    for (i, p) in points.as_slice().iter().enumerate() {
        if p[0].is_nan() {
            continue;
        }
        silhouette.data[i] = 1.0;
        for c in 0..3 {
            coordinates[c * pixels + i] = ((p[c] - centre[c]) * inverse[c]).clamp(-1.0, 1.0);
        }
    }
    (coordinates, silhouette)
}
