//! The surface points in the pixels of a new view, and their pixels in the photographs (dissertation, section 4.2.1: UV coordinates
//! in the source, rendered in the target pose; here per pixel instead of per vertex, so that perspective is exact).

use sixfold_geometry::{Camera, Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

/// The surface points that a new view shows.
#[derive(Debug, Clone)]
pub struct TargetSurface {
    /// The view's camera.
    pub camera: Camera,
    /// The view's pose.
    pub camera_from_object: Pose,
    /// Numbers of the covered pixels, row by row.
    pub pixels: Vec<u32>,
    /// Surface points of these pixels, object frame, metres.
    pub points: Vec<Vec3>,
    /// Unit normals there, object frame, on the visible side.
    pub normals: Vec<Vec3>,
}

impl TargetSurface {
    /// Renders the mesh at a pose.
    pub fn new(mesh: &Mesh, camera: &Camera, camera_from_object: &Pose) -> Self {
        let mut frame = VisibilityBuffer::new(camera);
        let objects = [SceneObject { mesh, camera_from_object: *camera_from_object }];
        frame.render(&objects, &RenderOptions::default());
        let coordinates = frame.object_coordinates(&objects);
        let normals = frame.normals(&objects);
        let back = camera_from_object.inverse();
        let mut surface = TargetSurface {
            camera: camera.without_distortion(),
            camera_from_object: *camera_from_object,
            pixels: vec![],
            points: vec![],
            normals: vec![],
        };
        for (i, (point, normal)) in coordinates.as_slice().iter().zip(normals.as_slice()).enumerate() {
            let normal = Vec3::from(normal.map(f64::from));
            if point[0].is_nan() || normal == Vec3::zeros() {
                continue;
            }
            surface.pixels.push(i as u32);
            surface.points.push(Vec3::from(point.map(f64::from)));
            surface.normals.push(back.transform_direction(&normal));
        }
        surface
    }
}

/// The pixels of one photograph that show the points of a [`TargetSurface`], in its order.
#[derive(Debug, Clone, PartialEq)]
pub struct Projection {
    /// Pixel of the crop.
    pub pixels: Vec<[f32; 2]>,
    /// Cosine of the angle between normal and line of sight; 0 where the point is not visible.
    pub cosines: Vec<f32>,
}
