//! Targets of a network: the object's coordinates and silhouette.

use sixfold_geometry::{Camera, Pose};
use sixfold_mesh::Mesh;
use sixfold_render::{BoundingBoxScale, RenderOptions, SceneObject, VisibilityBuffer};
use sixfold_synth::augment::Coverage;

/// Coordinates (3 planes, normalised, 0 outside) and silhouette (0 or 1) of the whole object.
pub(crate) fn targets(
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

/// Removes everything outside the mask of the photograph from coordinates and silhouette (section 3.4.4): CAD models and convex
/// hulls cover pixels that the object does not.
pub(super) fn synchronise(coordinates: &mut [f32], silhouette: &mut Coverage, seen: &Coverage) {
    let pixels = silhouette.data.len();
    for pixel in (0..pixels).filter(|pixel| seen.data[*pixel] <= 0.4) {
        silhouette.data[pixel] = 0.0;
        (0..3).for_each(|c| coordinates[c * pixels + pixel] = 0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_end_where_the_photographs_mask_ends() {
        let mut silhouette = Coverage { width: 2, height: 2, data: vec![1.0, 1.0, 1.0, 0.0] };
        let mut coordinates: Vec<f32> = (1..=12).map(|n| n as f32).collect();
        let seen = Coverage { width: 2, height: 2, data: vec![1.0, 0.0, 0.5, 1.0] };
        synchronise(&mut coordinates, &mut silhouette, &seen);
        assert_eq!(silhouette.data, [1.0, 0.0, 1.0, 0.0]);
        assert_eq!(coordinates, [1.0, 0.0, 3.0, 4.0, 5.0, 0.0, 7.0, 8.0, 9.0, 0.0, 11.0, 12.0]);
    }
}
