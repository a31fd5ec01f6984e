//! Poses from colour brought to a depth image, where there is one: the distance first, then point-to-plane ICP.
//!
//! Coordinates place an object well across the image and badly along the view axis, too far off for ICP to start from.
//! The median difference of measured and rendered depth over the object's pixels puts that right (as the author's BOP
//! entry with ICP does); then the visible surface is rendered and aligned with the image, three times.

use crate::estimate::Found;
use sixfold_geometry::{
    Camera, DepthImage, DepthTarget, IcpError, IcpLevel, IcpOptions, Mask, NormalImage, NormalOptions,
    PointCloud, Pose, icp, inpaint_depth, normals_from_depth,
};
use sixfold_mesh::Mesh;
use sixfold_render::{Frame, RenderOptions, SceneObject};

/// A depth image with its normals, for as many objects as are in it.
#[derive(Debug, Clone)]
pub struct DepthScene {
    depth: DepthImage,
    normals: NormalImage,
    camera: Camera,
}

/// A pose after alignment with depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignedToDepth {
    /// The pose, metres.
    pub camera_from_object: Pose,
    /// Rendered points that found a measured partner at the end.
    pub inliers: usize,
    /// Root mean square of their distances to the surface, metres.
    pub rms: f64,
}

/// Fewer pixels with depth say nothing of the distance.
const LEAST_PIXELS: usize = 20;
/// A visible pixel has at least this probability.
const VISIBLE: f32 = 0.5;

impl DepthScene {
    /// Prepares a pinhole depth image in metres (0 where nothing was measured).
    ///
    /// # Panics
    /// If image and camera differ in size; check it before.
    pub fn new(depth: &DepthImage, camera: &Camera) -> Self {
        assert_eq!(depth.size(), (camera.width, camera.height), "depth of another size than the camera");
        let normals = normals_from_depth(&inpaint_depth(depth, 2), camera, &NormalOptions::default());
        Self { depth: depth.clone(), normals, camera: *camera }
    }

    /// Aligns a pose of the object that `found` saw; `diameter` in metres. `mask`, of the image's size, holds the pixels
    /// that may be the object's; without one the network's word is taken.
    ///
    /// # Panics
    /// If the mask is of another size.
    ///
    /// # Errors
    /// [`IcpError`] where too little depth is measured on the object or its surface can slide.
    pub fn align(
        &self,
        mesh: &Mesh,
        diameter: f64,
        start: &Pose,
        found: &Found,
        mask: Option<&Mask>,
    ) -> Result<AlignedToDepth, IcpError> {
        assert!(mask.is_none_or(|m| m.size() == self.depth.size()), "mask of another size than the depth");
        let visible = |x: usize, y: usize| visible(found, x, y) && mask.is_none_or(|m| m[(x, y)]);
        let mut frame = Frame::new(&self.camera);
        let mut pose = self.at_measured_distance(&mut frame, mesh, diameter, start, &visible)?;
        let target = DepthTarget { depth: &self.depth, normals: &self.normals, camera: &self.camera };
        let (mut inliers, mut rms) = (0, 0.0);
        for share in [0.15, 0.08, 0.04] {
            let objects = [SceneObject { mesh, camera_from_object: pose }];
            frame.render(&objects, &RenderOptions::default());
            let normals = frame.normals(&objects);
            let mut seen = frame.depth();
            for y in 0..seen.height() {
                for x in 0..seen.width() {
                    if !visible(x, y) {
                        seen[(x, y)] = 0.0;
                    }
                }
            }
            let source =
                PointCloud::from_depth(&seen, Some(&normals), &self.camera).transformed(&pose.inverse());
            let stride = (source.len() / 1000).max(1);
            let options = IcpOptions {
                levels: vec![IcpLevel { rejection_distance: share * diameter, iterations: 8, stride }],
                max_angle: 45f64.to_radians(),
                convergence: 1e-5,
                min_correspondences: LEAST_PIXELS,
            };
            let report = icp(&source, &target, &pose, &options)?;
            (pose, inliers, rms) = (report.target_from_source, report.inliers, report.rms);
        }
        Ok(AlignedToDepth { camera_from_object: pose, inliers, rms })
    }

    /// The pose moved along the ray of its centre by the median difference of measured and rendered depth.
    fn at_measured_distance(
        &self,
        frame: &mut Frame,
        mesh: &Mesh,
        diameter: f64,
        start: &Pose,
        visible: &dyn Fn(usize, usize) -> bool,
    ) -> Result<Pose, IcpError> {
        frame.render(&[SceneObject { mesh, camera_from_object: *start }], &RenderOptions::default());
        let rendered = frame.depth();
        let mut differences = Vec::new();
        for y in 0..rendered.height() {
            for x in 0..rendered.width() {
                let (expected, measured) = (rendered[(x, y)], self.depth[(x, y)]);
                if expected > 0.0 && measured > 0.0 && measured.is_finite() && visible(x, y) {
                    differences.push(f64::from(measured) - f64::from(expected));
                }
            }
        }
        if differences.len() < LEAST_PIXELS {
            let (found, distance) = (differences.len(), diameter);
            return Err(IcpError::TooFewCorrespondences {
                found,
                points: found,
                distance,
                needed: LEAST_PIXELS,
            });
        }
        differences.sort_by(f64::total_cmp);
        let shift = differences[differences.len() / 2];
        let translation = start.translation();
        let share = 1.0 + shift / translation.z;
        // Something else than the object was measured.
        if !(share > 0.5 && share < 2.0) {
            return Ok(*start);
        }
        Ok(Pose::new(start.rotation(), translation * share))
    }
}

/// Whether the network saw the object at a pixel of the image.
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
    use crate::estimate::{Hypothesis, View};
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
        let scene = DepthScene::new(&render_depth(&mesh, &truth, &camera), &camera);
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
            hypotheses: vec![Hypothesis {
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
        let aligned = scene.align(&mesh, mesh.diameter(), &start, &found, None).unwrap();
        assert!(start.distance_to(&truth) > 0.04);
        assert!(aligned.camera_from_object.distance_to(&truth) < 0.002, "{aligned:?}");
        assert!(aligned.camera_from_object.rotation_angle_to(&truth) < 0.02, "{aligned:?}");
        // Nothing was measured on the object.
        let empty = DepthScene::new(&DepthImage::filled(320, 240, 0.0), &camera);
        assert!(empty.align(&mesh, mesh.diameter(), &start, &found, None).is_err());
        // Something stands before most of the object, which the network did not notice and a mask knows of.
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
        let scene = DepthScene::new(&half, &camera);
        let error = |mask: Option<&Mask>| {
            let aligned = scene.align(&mesh, mesh.diameter(), &start, &found, mask);
            aligned.map_or(f64::INFINITY, |a| a.camera_from_object.distance_to(&truth))
        };
        assert!(error(Some(&mask)) < 0.003 && error(None) > 0.01, "{} {}", error(Some(&mask)), error(None));
    }
}
