//! Shadows of lamps that are far away (Williams 1978, "Casting curved shadows on curved surfaces"): the scene's depth seen from the
//! lamp. A comparison is interpolated between four pixels of that map (Reeves et al. 1987, "Rendering antialiased shadows with depth
//! maps"). A soft shadow takes several lamps in slightly different directions.

use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Camera, Pose, Vec3};

use crate::raster::{RenderOptions, SceneObject, VisibilityBuffer};

/// Distance of the map's camera from the scene, in radii: rays are parallel to within half a degree.
const FAR: f64 = 100.0;
/// Surfaces up to this far behind the nearest one are lit, in pixels of the map: a surface must not shade itself.
const TOLERANCE: f64 = 2.0;

/// Which points of a scene a directional light reaches.
#[derive(Debug, Clone)]
pub struct ShadowMap {
    camera: Camera,
    inverse_depth: Vec<f32>,
    map_from_camera: Pose,
    tolerance: f64,
}

impl ShadowMap {
    /// The shadows of `objects` in light that travels along `direction`, within `radius` metres of `centre`, all in the camera frame.
    /// The map has `side` x `side` pixels. Everything further away is lit. `None` for a direction without length.
    pub fn new(
        objects: &[SceneObject<'_>],
        direction: &Vec3,
        centre: &Vec3,
        radius: f64,
        side: usize,
    ) -> Option<ShadowMap> {
        let forward = direction.try_normalize(1e-12)?;
        // Any vector that is not parallel to the direction.
        let across = if forward.x.abs() < 0.7 { Vec3::x() } else { Vec3::y() };
        let camera_from_map = UnitQuaternion::face_towards(&forward, &across);
        let distance = FAR * radius;
        let map_from_camera = Pose::new(camera_from_map, centre - forward * distance).inverse();
        let focal = 0.5 * side as f64 * distance / radius;
        let middle = 0.5 * (side as f64 - 1.0);
        let camera = Camera {
            fx: focal,
            fy: focal,
            cx: middle,
            cy: middle,
            width: side,
            height: side,
            distortion: None,
        };
        let seen: Vec<SceneObject<'_>> = objects
            .iter()
            .map(|object| SceneObject {
                mesh: object.mesh,
                camera_from_object: map_from_camera * object.camera_from_object,
            })
            .collect();
        let mut buffer = VisibilityBuffer::new(&camera);
        buffer.render(&seen, &RenderOptions::default());
        let inverse_depth = buffer.inverse_depth().to_vec();
        let tolerance = TOLERANCE * 2.0 * radius / side as f64;
        Some(ShadowMap { camera, inverse_depth, map_from_camera, tolerance })
    }

    /// Fraction of the light that reaches a point in the camera frame, 0..1.
    pub fn visible(&self, point: &Vec3) -> f32 {
        let Camera { fx, cx, cy, width: side, .. } = self.camera;
        let p = self.map_from_camera.transform_point(point);
        let (x, y) = (fx * p.x / p.z + cx, fx * p.y / p.z + cy);
        let inside = |at: f64| at >= 0.0 && at < side as f64 - 1.0;
        if p.z <= self.tolerance || !inside(x) || !inside(y) {
            return 1.0;
        }
        let (column, row) = (x as usize, y as usize);
        let (right, below) = ((x - column as f64) as f32, (y - row as f64) as f32);
        // Lit if nothing in the map is nearer to the lamp.
        let nearest = 1.0 / (p.z - self.tolerance);
        let lit = |column: usize, row: usize| {
            f32::from(u8::from(f64::from(self.inverse_depth[row * side + column]) <= nearest))
        };
        let line = |row: usize| lit(column, row) * (1.0 - right) + lit(column + 1, row) * right;
        line(row) * (1.0 - below) + line(row + 1) * below
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shade::{Light, Material, shade_in_shadows};
    use sixfold_mesh::Mesh;

    /// A square of side `2 half` across the optical axis.
    fn square(half: f64) -> Mesh {
        let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
        let vertices = corners.map(|[x, y]| Vec3::new(x * half, y * half, 0.0)).to_vec();
        Mesh::new(vertices, vec![[0, 2, 1], [0, 3, 2]]).unwrap()
    }

    #[test]
    fn a_square_shades_what_is_behind_it_along_the_light() {
        let (wall, plate) = (square(1.0), square(0.1));
        let at =
            |mesh, z: f64| SceneObject { mesh, camera_from_object: Pose::from_translation(Vec3::z() * z) };
        let objects = [at(&wall, 2.0), at(&plate, 1.8)];
        // 0.2 m further back the shadow is 0.1 m further to the right.
        let direction = Vec3::new(0.5, 0.0, 1.0);
        let centre = Vec3::new(0.0, 0.0, 2.0);
        let map = ShadowMap::new(&objects, &direction, &centre, 0.5, 256).unwrap();
        let on_wall = |x: f64, y: f64| map.visible(&Vec3::new(x, y, 2.0));
        for (x, y, expected) in [
            (0.1, 0.0, 0.0),
            (0.02, 0.08, 0.0),
            (0.18, -0.08, 0.0),
            (-0.02, 0.0, 1.0),
            (0.22, 0.0, 1.0),
            (0.1, 0.12, 1.0),
            // Outside the map.
            (0.9, 0.0, 1.0),
        ] {
            assert_eq!(on_wall(x, y), expected, "{x} {y}");
        }
        // The plate itself is lit on the side of the lamp.
        assert_eq!(map.visible(&Vec3::new(0.05, 0.05, 1.8)), 1.0);
        assert!(ShadowMap::new(&objects, &Vec3::zeros(), &centre, 0.5, 64).is_none());

        // Seen by a camera from beside the lamp: the shadow is as dark as the ambient light.
        let camera = Camera::new(100.0, 100.0, 49.5, 49.5, 100, 100).unwrap();
        let mut frame = VisibilityBuffer::new(&camera);
        frame.render(&objects, &RenderOptions::default());
        let ambient = Light::Ambient { color: [0.2; 3] };
        let lights = [ambient, Light::Directional { direction, color: [0.5; 3] }];
        let lit = |number: usize, point: &Vec3| {
            assert_eq!(number, 1);
            map.visible(point)
        };
        let image = shade_in_shadows(&frame, &objects, &lights, &lit, &Material::default(), None);
        let dark = shade_in_shadows(&frame, &objects, &[ambient], &|_, _| 1.0, &Material::default(), None);
        let pixel = |x: f64, y: f64| ((50.0 * x + 49.5).round() as usize, (50.0 * y + 49.5).round() as usize);
        assert_eq!(image[pixel(0.16, 0.0)], dark[pixel(0.16, 0.0)]);
        assert!(image[pixel(0.3, 0.0)][0] > dark[pixel(0.3, 0.0)][0] + 30);
    }
}
