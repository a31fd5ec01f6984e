//! Images of grasps: the gripper's boxes over the image, with their outlines, hidden parts fainter.

use sixfold_geometry::{Camera, DepthImage, Pose, RgbImage};
use sixfold_mesh::MeshError;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

use crate::Gripper;

/// One gripper to draw.
#[derive(Debug, Clone, Copy)]
pub struct DrawnGrasp {
    /// Its pose.
    pub camera_from_gripper: Pose,
    /// Distance of its pads, metres.
    pub opening: f64,
    /// Its colour.
    pub color: [u8; 3],
}

/// Draws grippers over an image of the camera's size, the last one on top. Where `depth` (metres) measured something in
/// front of a gripper, the gripper is fainter.
///
/// # Errors
/// [`MeshError`] for a gripper whose sizes are not finite.
///
/// # Panics
/// If image or depth have another size than the camera, which is a programming error.
pub fn draw_grasps(
    image: &RgbImage,
    depth: Option<&DepthImage>,
    camera: &Camera,
    gripper: &Gripper,
    grasps: &[DrawnGrasp],
) -> Result<RgbImage, MeshError> {
    assert_eq!(image.size(), (camera.width, camera.height), "image of another size than the camera");
    let mut out = image.clone();
    let mut frame = VisibilityBuffer::new(camera);
    for grasp in grasps {
        let mesh = gripper.mesh(grasp.opening)?;
        let objects = [SceneObject { mesh: &mesh, camera_from_object: grasp.camera_from_gripper }];
        frame.render(&objects, &RenderOptions::default());
        let rendered = frame.depth();
        let normals = frame.normals(&objects);
        let faces = frame.surfaces(&objects);
        // Two triangles per side of a box: edges are drawn where the side changes.
        let side = |x: usize, y: usize| faces.get(x, y).copied().flatten().map(|s| s.face / 2);
        for (x, y) in (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y))) {
            let here = side(x, y);
            if here.is_none() {
                continue;
            }
            let edge = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)]
                .into_iter()
                .any(|(u, v)| side(u, v) != here);
            let hidden = depth.is_some_and(|d| d[(x, y)] > 0.0 && d[(x, y)] < rendered[(x, y)] - 0.005);
            let strength = match (edge, hidden) {
                (true, false) => 1.0,
                (true, true) => 0.6,
                (false, false) => 0.6,
                (false, true) => 0.12,
            };
            let shade = if edge { 1.0 } else { 0.5 + 0.5 * normals[(x, y)][2].abs() };
            for (channel, color) in out[(x, y)].iter_mut().zip(grasp.color) {
                let mixed = (1.0 - strength) * f32::from(*channel) + strength * shade * f32::from(color);
                *channel = mixed.clamp(0.0, 255.0) as u8;
            }
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gripper_pose;
    use sixfold_geometry::{Image, Vec3};

    #[test]
    fn the_gripper_is_drawn_at_its_pose_and_fainter_where_hidden() {
        let camera = Camera::new(500.0, 500.0, 79.5, 59.5, 160, 120).unwrap();
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let pose = gripper_pose(&Vec3::new(0.0, 0.0, 0.6), &Vec3::y(), &Vec3::x()).unwrap();
        let grasp = DrawnGrasp { camera_from_gripper: pose, opening: 0.06, color: [255, 0, 0] };
        let image = RgbImage::filled(160, 120, [0; 3]);
        let drawn = draw_grasps(&image, None, &camera, &gripper, &[grasp]).unwrap();
        let red = |image: &RgbImage| image.as_slice().iter().map(|p| u64::from(p[0])).sum::<u64>();
        assert!(red(&drawn) > 50_000);
        assert_eq!(drawn[(79, 40)], [0; 3], "between the fingers");
        let wall = Image::filled(160, 120, 0.3f32);
        let behind = draw_grasps(&image, Some(&wall), &camera, &gripper, &[grasp]).unwrap();
        assert!(red(&behind) * 2 < red(&drawn));
    }
}
