//! Evidence for and against a pose, as numbers: depth, normals and outline of one rendering compared with the depth image, outline
//! and colours with the colour image. Combining these numbers is up to the caller.

mod color;

use sixfold_geometry::{Camera, Mat3, Pose, RgbImage, Vec2, Vec3};
use sixfold_mesh::Mesh;

pub use color::{ColorEvidence, ColorGradients};

use crate::prepared::PreparedDepth;
use crate::verification::{VerificationOptions, VerificationScore, Verifier};

/// Agreement of a pose with the depth image.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct DepthEvidence {
    /// Verification by rendering.
    pub score: VerificationScore,
    /// Variation of the normals over the pixels that agree, 0 to 1: 0 for a plane, which fits any other plane.
    pub relief: f64,
    /// Fraction of the agreeing pixels that are on the table plane, which explains them as well.
    pub on_plane: f64,
}

/// Agreement of a pose with an image.
#[derive(Debug, Clone, PartialEq)]
pub struct Evidence {
    /// Agreement with the depth image, if there is one.
    pub depth: Option<DepthEvidence>,
    /// Agreement with the colour image, if there is one.
    pub color: Option<ColorEvidence>,
    /// The pixels (numbers `y * width + x`) that agree in depth; without depth those that the object covers.
    pub pixels: Vec<u32>,
}

/// The images with which poses are compared.
pub struct Scene<'a> {
    /// Its camera, without lens distortion.
    pub camera: &'a Camera,
    /// The depth image.
    pub depth: Option<&'a PreparedDepth>,
    /// The colour image and its gradients.
    pub color: Option<(&'a RgbImage, &'a ColorGradients)>,
}

/// An object whose poses are compared with images.
pub struct Shape<'a> {
    /// Its mesh; it should come from [`crate::verification_mesh`].
    pub mesh: &'a Mesh,
    /// The mesh with its colours.
    pub colored: &'a Mesh,
    /// Depth inlier threshold, metres.
    pub threshold: f64,
}

/// Compares poses of objects with images; reuses its buffers.
#[derive(Debug, Default)]
pub struct EvidenceCollector {
    verifier: Verifier,
}

impl EvidenceCollector {
    /// Compares an object's pose with an image.
    pub fn collect(
        &mut self,
        scene: &Scene<'_>,
        shape: &Shape<'_>,
        pose: &Pose,
        options: &VerificationOptions,
    ) -> Evidence {
        let mut pixels = vec![];
        let depth = scene.depth.map(|image| {
            let score = self.verifier.score(image, shape.mesh, pose, shape.threshold, options);
            pixels = self.verifier.explained_pixels(image, shape.mesh, pose, shape.threshold);
            DepthEvidence { score, relief: relief(image, &pixels), on_plane: on_plane(image, &pixels) }
        });
        let color = scene.color.and_then(|(image, gradients)| {
            let seen = color::ColorImage { camera: scene.camera, image, gradients, depth: scene.depth };
            let (evidence, covered) = color::evidence_of(&seen, shape, pose)?;
            if scene.depth.is_none() {
                pixels = covered;
            }
            Some(evidence)
        });
        Evidence { depth, color, pixels }
    }
}

/// One minus the largest eigenvalue of the normals' second moments, scaled to its range: 0 if all are parallel, 1 if they are
/// uniformly distributed.
fn relief(image: &PreparedDepth, pixels: &[u32]) -> f64 {
    let normals = image.normals().as_slice();
    let mut moments = Mat3::zeros();
    let mut count = 0.0f64;
    for &pixel in pixels {
        let n = normals[pixel as usize];
        if n != [0.0; 3] {
            let n = Vec3::from(n.map(f64::from));
            moments += n * n.transpose();
            count += 1.0;
        }
    }
    if count == 0.0 {
        return 0.0;
    }
    let largest = (moments / count).symmetric_eigenvalues().max();
    (1.5 * (1.0 - largest)).clamp(0.0, 1.0)
}

/// Fraction of the pixels within the table plane's margin.
fn on_plane(image: &PreparedDepth, pixels: &[u32]) -> f64 {
    let Some(plane) = image.plane().filter(|_| !pixels.is_empty()) else { return 0.0 };
    let camera = image.camera();
    let near = |pixel: &&u32| {
        let index = **pixel as usize;
        let at = Vec2::new((index % camera.width) as f64, (index / camera.width) as f64);
        let point = camera.unproject(&at, f64::from(image.depth().as_slice()[index]));
        plane.distance(&point).abs() < image.plane_margin()
    };
    pixels.iter().filter(near).count() as f64 / pixels.len() as f64
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::{DepthImage, Image};
    use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer, render_depth, shade};

    use super::*;
    use crate::DepthOptions;

    fn camera() -> Camera {
        Camera::new(500.0, 500.0, 159.5, 119.5, 320, 240).unwrap()
    }

    /// A box of 12 x 8 x 6 cm with differently coloured corners.
    fn cuboid() -> Mesh {
        let vertices: Vec<Vec3> = (0..8)
            .map(|k| {
                let side = |axis: usize, half: f64| if k >> axis & 1 == 0 { -half } else { half };
                Vec3::new(side(0, 0.06), side(1, 0.04), side(2, 0.03))
            })
            .collect();
        let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let faces = sides.iter().flat_map(|s| [[s[0], s[1], s[2]], [s[0], s[2], s[3]]]).collect();
        let colors =
            (0..8u8).map(|k| [40 + 25 * k, 230 - 25 * k, if k % 2 == 0 { 60 } else { 200 }]).collect();
        Mesh::new(vertices, faces).unwrap().with_colors(colors).unwrap()
    }

    fn pose() -> Pose {
        let turn = Pose::exp(&nalgebra(0.5, 0.7, 0.3));
        Pose::new(turn.rotation(), Vec3::new(0.01, 0.0, 0.6))
    }

    fn nalgebra(x: f64, y: f64, z: f64) -> sixfold_geometry::nalgebra::Vector6<f64> {
        sixfold_geometry::nalgebra::Vector6::new(0.0, 0.0, 0.0, x, y, z)
    }

    /// The box in front of a wall 0.9 m away, and its colours on grey.
    fn images() -> (DepthImage, RgbImage) {
        let (mesh, camera) = (cuboid(), camera());
        let depth = render_depth(&mesh, &pose(), &camera).map(|z| if *z > 0.0 { *z } else { 0.9 });
        let mut frame = VisibilityBuffer::new(&camera);
        let objects = [SceneObject { mesh: &mesh, camera_from_object: pose() }];
        frame.render(&objects, &RenderOptions::default());
        let grey: RgbImage = Image::filled(320, 240, [120; 3]);
        let lights = sixfold_render::Light::default_set();
        let rgb = shade(&frame, &objects, &lights, &sixfold_render::Material::default(), Some(&grey));
        (depth, rgb)
    }

    fn asked(pose: &Pose) -> Evidence {
        let (depth, rgb) = images();
        let (camera, mesh) = (camera(), cuboid());
        let options = DepthOptions { remove_plane: false, ..DepthOptions::default() };
        let prepared = PreparedDepth::new(&depth, &camera, &options).unwrap();
        let gradients = ColorGradients::new(&rgb);
        let scene = Scene { camera: &camera, depth: Some(&prepared), color: Some((&rgb, &gradients)) };
        let shape = Shape { mesh: &mesh, colored: &mesh, threshold: 0.008 };
        EvidenceCollector::default().collect(&scene, &shape, pose, &VerificationOptions::default())
    }

    #[test]
    fn the_right_pose_agrees_in_all_and_a_shifted_one_does_not() {
        let right = asked(&pose());
        let (depth, color) = (right.depth.unwrap(), right.color.unwrap());
        assert!(depth.score.total > 0.8, "{depth:?}");
        assert!(color.edges > color.background_edges + 0.4, "{color:?}");
        assert!(color.correlation > 0.9, "{color:?}");
        assert!(color.tint.unwrap() < 0.02, "{color:?}");
        assert_eq!(right.pixels.len(), depth.score.inliers);

        let shifted = asked(&pose().with_translation(Vec3::new(0.05, 0.02, 0.6)));
        let (worse, color_there) = (shifted.depth.unwrap(), shifted.color.unwrap());
        assert!(worse.score.total < 0.5 * depth.score.total, "{worse:?}");
        assert!(color_there.edges < color.edges - 0.3, "{color_there:?}");
        assert!(color_there.correlation < color.correlation - 0.1, "{color_there:?}");
    }

    #[test]
    fn a_single_visible_side_has_no_relief() {
        // Three sides of the box are visible; one if it faces the camera.
        let rotated = asked(&pose()).depth.unwrap().relief;
        assert!(rotated > 0.2, "{rotated}");
        let (camera, mesh) = (camera(), cuboid());
        let facing = Pose::from_translation(Vec3::new(0.0, 0.0, 0.6));
        let depth = render_depth(&mesh, &facing, &camera).map(|z| if *z > 0.0 { *z } else { 0.9 });
        let options = DepthOptions { remove_plane: false, ..DepthOptions::default() };
        let prepared = PreparedDepth::new(&depth, &camera, &options).unwrap();
        let scene = Scene { camera: &camera, depth: Some(&prepared), color: None };
        let shape = Shape { mesh: &mesh, colored: &mesh, threshold: 0.008 };
        let flat =
            EvidenceCollector::default().collect(&scene, &shape, &facing, &VerificationOptions::default());
        assert!(flat.depth.unwrap().relief < 0.1, "{:?}", flat.depth);
        assert_eq!(flat.color, None);
    }

    #[test]
    fn a_pose_beside_the_image_has_no_evidence() {
        let outside = asked(&Pose::from_translation(Vec3::new(5.0, 0.0, 0.6)));
        assert_eq!(outside.color, None);
        assert_eq!(outside.depth.unwrap().score.rendered, 0);
        assert!(outside.pixels.is_empty());
    }
}
