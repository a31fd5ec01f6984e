//! Rendering of an object: its colours under random light.

use rand::RngExt;
use sixfold_geometry::random::{Random, uniform};
use sixfold_geometry::{Camera, Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};
use sixfold_synth::augment::{Coverage, Patch};

/// The object's colours and silhouette.
pub fn colors(
    mesh: &Mesh,
    camera: &Camera,
    camera_from_object: &Pose,
    lights: &[Light],
    material: &Material,
) -> (RgbImage, Coverage) {
    let objects = [SceneObject { mesh, camera_from_object: *camera_from_object }];
    let mut frame = VisibilityBuffer::new(camera);
    frame.render(&objects, &RenderOptions::default());
    let image = shade(&frame, &objects, lights, material, None);
    let data = frame.inverse_depth().iter().map(|z| f32::from(*z > 0.0)).collect();
    (image, Coverage { width: camera.width, height: camera.height, data })
}

/// The object's colours under random light, in planes, and its silhouette.
pub fn color_patch(
    mesh: &Mesh,
    camera: &Camera,
    camera_from_object: &Pose,
    random: &mut Random,
) -> (Patch, Coverage) {
    let lights = random_lights(random);
    let material = random_material(random);
    let (image, silhouette) = colors(mesh, camera, camera_from_object, &lights, &material);
    (Patch::from_rgb(&image), silhouette)
}

/// Ambient light and one to three lamps on the camera's side.
pub fn random_lights(random: &mut Random) -> Vec<Light> {
    let tint = |strength: f32, random: &mut Random| -> [f32; 3] {
        std::array::from_fn(|_| strength * uniform(random, [0.9, 1.1]))
    };
    let ambient = uniform(random, [0.25, 0.8]);
    let mut lights = vec![Light::Ambient { color: tint(ambient, random) }];
    let lamps = random.random_range(1..4u32);
    for _ in 0..lamps {
        let strength = uniform(random, [0.1, 0.9]) / lamps as f32;
        // The light travels away from the camera and usually down.
        let direction = Vec3::new(
            f64::from(uniform(random, [-1.0, 1.0])),
            f64::from(uniform(random, [-0.5, 1.3])),
            f64::from(uniform(random, [0.1, 1.0])),
        );
        lights.push(Light::Directional { direction, color: tint(strength, random) });
    }
    lights
}

/// A surface that is matt more often than shiny; its colour is random if the mesh has none.
pub fn random_material(random: &mut Random) -> Material {
    let shiny = random.random::<f32>() < 0.4;
    Material {
        specular: if shiny { uniform(random, [0.05, 0.5]) } else { 0.0 },
        shininess: uniform(random, [5.0, 60.0]),
        plain: std::array::from_fn(|_| random.random_range(20..=235u8)),
    }
}
