//! Aligns poses from colour with a depth image, if there is one: [`sixfold_align::align_to_depth`] on the pixels that the network
//! predicts for the object.

use std::sync::Arc;

use crate::estimate::Found;
use sixfold_align::{AlignedToDepth, DepthOptions, PreparedDepth, PreparedDepthError, align_to_depth};
use sixfold_geometry::{Camera, DepthImage, IcpError, Mask, NormalOptions, Pose};
use sixfold_mesh::Mesh;

/// A visible pixel has at least this probability.
const VISIBLE: f32 = 0.5;

/// Prepares a pinhole depth image (metres, 0 where nothing was measured) for [`align`]: normals only, no plane.
///
/// # Errors
/// [`PreparedDepthError`].
pub fn prepare(depth: &DepthImage, camera: &Camera) -> Result<Arc<PreparedDepth>, PreparedDepthError> {
    let options =
        DepthOptions { normals: NormalOptions::default(), remove_plane: false, ..DepthOptions::default() };
    PreparedDepth::new(depth, camera, &options)
}

/// Aligns a pose of the object in `found`; `diameter` in metres. `mask`, of the image's size, marks the pixels that may belong to
/// the object; without one the network's prediction is used.
///
/// # Panics
/// If the mask has another size.
///
/// # Errors
/// [`IcpError`] if too little depth is measured on the object, or its surface does not constrain the pose.
pub fn align(
    image: &PreparedDepth,
    mesh: &Mesh,
    diameter: f64,
    start: &Pose,
    found: &Found,
    mask: Option<&Mask>,
) -> Result<AlignedToDepth, IcpError> {
    assert!(mask.is_none_or(|m| m.size() == image.depth().size()), "mask of another size than the depth");
    let visible = |x: usize, y: usize| visible(found, x, y) && mask.is_none_or(|m| m[(x, y)]);
    align_to_depth(image, mesh, diameter, start, &visible)
}

/// Whether the network predicts the object at a pixel of the image.
fn visible(found: &Found, x: usize, y: usize) -> bool {
    let (window, prediction) = (&found.view.window, &found.view.prediction);
    let at = |value: usize, start: f64, size: f64| (value as f64 - start) / size * prediction.side as f64;
    let (u, v) = (at(x, window.x, window.width), at(y, window.y, window.height));
    let side = prediction.side as f64;
    u >= 0.0
        && v >= 0.0
        && u < side
        && v < side
        && prediction.visible[v as usize * prediction.side + u as usize] > VISIBLE
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::{ThresholdHypothesis, View};
    use crate::model::Prediction;
    use sixfold_geometry::nalgebra::UnitQuaternion;
    use sixfold_geometry::{Rect, RgbImage, Vec3};
    use sixfold_render::render_depth;

    /// A box of unequal sides with one corner cut off.
    fn part() -> Mesh {
        let vertices = [
            [0.0, 0.0, 0.0],
            [0.1, 0.0, 0.0],
            [0.1, 0.07, 0.0],
            [0.0, 0.07, 0.0],
            [0.0, 0.0, 0.05],
            [0.1, 0.0, 0.02],
            [0.1, 0.07, 0.02],
            [0.0, 0.07, 0.05],
        ];
        let sides = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]];
        let faces = sides.iter().flat_map(|s| [[s[0], s[1], s[2]], [s[0], s[2], s[3]]]).collect();
        Mesh::new(vertices.map(Vec3::from).to_vec(), faces).unwrap()
    }

    #[test]
    fn a_pose_five_centimetres_too_far_away_comes_back() {
        let mesh = part();
        let camera = Camera::new(500.0, 500.0, 159.5, 119.5, 320, 240).unwrap();
        let rotation = UnitQuaternion::from_euler_angles(2.5, 0.4, 0.3);
        let truth = Pose::new(rotation, Vec3::new(-0.03, 0.01, 0.7));
        let scene = prepare(&render_depth(&mesh, &truth, &camera), &camera).unwrap();
        let off = UnitQuaternion::from_euler_angles(0.03, -0.03, 0.02) * rotation;
        let start = Pose::new(off, truth.translation() * (0.75 / 0.7));
        let side = 16;
        let view = View {
            window: Rect { x: 0.0, y: -40.0, width: 320.0, height: 320.0 },
            input: RgbImage::filled(1, 1, [0; 3]),
            prediction: Prediction {
                side,
                coordinates: vec![[0.0; 3]; side * side],
                error: vec![0.0; side * side],
                visible: vec![1.0; side * side],
            },
        };
        let found = Found {
            hypotheses: vec![ThresholdHypothesis {
                camera_from_object: start,
                threshold: 0.3,
                inliers: 1,
                score: 1.0,
            }],
            open_view: view.clone(),
            first_view: view.clone(),
            view,
            object_points: vec![],
            image_points: vec![],
        };
        let aligned = align(&scene, &mesh, mesh.diameter(), &start, &found, None).unwrap();
        assert!(start.distance_to(&truth) > 0.04);
        assert!(aligned.camera_from_object.distance_to(&truth) < 0.002, "{aligned:?}");
        assert!(aligned.camera_from_object.rotation_angle_to(&truth) < 0.02, "{aligned:?}");
        // Nothing was measured on the object.
        let corner = DepthImage::from_fn(320, 240, |x, y| if x < 4 && y < 4 { 0.7 } else { 0.0 });
        let empty = prepare(&corner, &camera).unwrap();
        assert!(align(&empty, &mesh, mesh.diameter(), &start, &found, None).is_err());
        // An occluder in front of most of the object, which the network did not detect but the mask excludes.
        let mut half = render_depth(&mesh, &truth, &camera);
        let at = |i: usize| (i % 320, i / 320);
        let covered = half.as_slice().iter().enumerate().filter(|(_, z)| **z > 0.0);
        let mut columns: Vec<usize> = covered.map(|(i, _)| at(i).0).collect();
        columns.sort_unstable();
        let edge = columns[columns.len() * 7 / 10];
        let mask = Mask::from_fn(320, 240, |x, _| x >= edge);
        for i in (0..320 * 240).filter(|i| at(*i).0 < edge) {
            half[at(i)] = 0.65;
        }
        let scene = prepare(&half, &camera).unwrap();
        let error = |mask: Option<&Mask>| {
            let aligned = align(&scene, &mesh, mesh.diameter(), &start, &found, mask);
            aligned.map_or(f64::INFINITY, |a| a.camera_from_object.distance_to(&truth))
        };
        assert!(error(Some(&mask)) < 0.003 && error(None) > 0.01, "{} {}", error(Some(&mask)), error(None));
    }
}
