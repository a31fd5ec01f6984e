//! Simulated depth images of an object on the table.

use sixfold_geometry::{Camera, CameraError, DepthImage, Mat3, Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{DepthSensor, RenderOptions, SceneObject, VisibilityBuffer, simulate_depth};

/// The viewpoint of a camera that is aimed at a target on the table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewPoint {
    /// Angle about the world's z axis, radians.
    pub azimuth: f64,
    /// Angle above the table, radians.
    pub elevation: f64,
    /// Distance from the target, metres.
    pub distance: f64,
    /// The point at which the camera is aimed, world frame, metres.
    pub target: Vec3,
}

impl ViewPoint {
    /// The camera's pose: x to the right and horizontal, y down, z to the target. x is horizontal also when the camera looks
    /// straight down.
    pub fn world_from_camera(&self) -> Pose {
        let (azimuth, elevation) = (self.azimuth, self.elevation);
        let back =
            Vec3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin());
        let right = Vec3::new(-azimuth.sin(), azimuth.cos(), 0.0);
        let z = -back;
        let down = z.cross(&right);
        let position = self.target + back * self.distance;
        // Orthonormal by construction.
        Pose::from_parts(&Mat3::from_columns(&[right, down, z]), position)
            .unwrap_or_else(|_| Pose::from_translation(position))
    }
}

/// A simulated depth image of an object on the table.
#[derive(Debug, Clone)]
pub struct SimulatedView {
    /// The camera.
    pub camera: Camera,
    /// Measured depth, metres.
    pub depth: DepthImage,
    /// The camera's pose.
    pub world_from_camera: Pose,
}

/// A depth image of an object on a table of 1.6 m, of 640x480 pixels and a focal length of 575 pixels, with the noise of
/// `sensor`, or none.
///
/// # Errors
/// [`CameraError`]: never with these values.
pub fn simulate_view(
    mesh: &Mesh,
    world_from_object: &Pose,
    view: &ViewPoint,
    sensor: Option<&DepthSensor>,
    seed: u64,
) -> Result<SimulatedView, CameraError> {
    let camera = Camera::new(575.0, 575.0, 319.5, 239.5, 640, 480)?;
    let world_from_camera = view.world_from_camera();
    let camera_from_world = world_from_camera.inverse();
    let corners = [(-0.8, -0.8), (0.8, -0.8), (0.8, 0.8), (-0.8, 0.8)];
    let corners = corners.map(|(x, y)| Vec3::new(x, y, 0.0)).to_vec();
    let table = Mesh::new(corners, vec![[0, 1, 2], [0, 2, 3]]).ok();
    let mut objects = vec![SceneObject { mesh, camera_from_object: camera_from_world * *world_from_object }];
    objects.extend(table.as_ref().map(|mesh| SceneObject { mesh, camera_from_object: camera_from_world }));
    let mut frame = VisibilityBuffer::new(&camera);
    frame.render(&objects, &RenderOptions::default());
    let ideal = frame.depth();
    let depth = match sensor {
        None => ideal,
        Some(sensor) => simulate_depth(&ideal, &frame.normals(&objects), sensor, seed),
    };
    Ok(SimulatedView { camera, depth, world_from_camera })
}
