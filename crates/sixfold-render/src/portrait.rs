//! A portrait of a single object: a camera and a pose in which it fills the image.

use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion, Vector3};
use sixfold_geometry::{Camera, Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;

use crate::raster::{RenderOptions, SceneObject, VisibilityBuffer};
use crate::shade::{Light, Material, shade};

/// A camera with a field of view of 60 degrees.
pub fn portrait_camera(width: usize, height: usize) -> Camera {
    let f = width as f64 / 2.0 / 30f64.to_radians().tan();
    Camera {
        fx: f,
        fy: f,
        cx: (width as f64 - 1.0) / 2.0,
        cy: (height as f64 - 1.0) / 2.0,
        width,
        height,
        distortion: None,
    }
}

/// `camera_from_object` from above and in front, so near that the object fills most of the image.
pub fn portrait_pose(mesh: &Mesh, camera: &Camera) -> Pose {
    let (low, high) = mesh.bounding_box();
    let radius = (high - low).norm() / 2.0;
    let narrow = (camera.width as f64 / camera.fx).min(camera.height as f64 / camera.fy) / 2.0;
    let distance = radius * (1.0 + 1.0 / narrow);
    let tilt = Rotation3::from_axis_angle(&Vector3::x_axis(), 120f64.to_radians());
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), 30f64.to_radians());
    let rotation = UnitQuaternion::from_rotation_matrix(&(tilt * turn));
    let centre = (low + high) * 0.5;
    Pose::new(rotation, Vec3::new(0.0, 0.0, distance) - rotation * centre)
}

/// An image of 480x480 pixels of the object alone, on white.
pub fn portrait(mesh: &Mesh) -> RgbImage {
    let camera = portrait_camera(480, 480);
    let objects = [SceneObject { mesh, camera_from_object: portrait_pose(mesh, &camera) }];
    let mut frame = VisibilityBuffer::new(&camera);
    frame.render(&objects, &RenderOptions::default());
    let white = RgbImage::filled(480, 480, [255; 3]);
    shade(&frame, &objects, &Light::default_set(), &Material::default(), Some(&white))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_whole_object_is_visible_and_fills_most_of_the_image() {
        let corners: Vec<Vec3> = (0..8)
            .map(|i| Vec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2)) * 0.1)
            .collect();
        let faces =
            vec![[0, 1, 2], [1, 3, 2], [4, 6, 5], [5, 6, 7], [0, 4, 1], [1, 4, 5], [2, 3, 6], [3, 7, 6]];
        let mesh = Mesh::new(corners, faces).unwrap();
        let image = portrait(&mesh);
        let shown = |x: usize, y: usize| image[(x, y)] != [255; 3];
        let columns: Vec<usize> = (0..480).filter(|x| (0..480).any(|y| shown(*x, y))).collect();
        assert!(columns[0] > 0 && columns[columns.len() - 1] < 479 && columns.len() > 240, "{columns:?}");
        assert!((0..480).all(|x| !shown(x, 0) && !shown(x, 479)));
    }
}
