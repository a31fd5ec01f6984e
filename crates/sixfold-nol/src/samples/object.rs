//! A synthetic object with random textures, and its image under a lamp.

use rand::RngExt;
use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};
use sixfold_geometry::random::Random;
use sixfold_geometry::{Camera, Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};
use sixfold_synth::augment::{Backgrounds, Coverage, Patch, procedural_texture};
use sixfold_synth::shapes::{Family, member};

/// Pixels along a texture's side.
const TEXTURE: usize = 160;

/// A distant lamp, and ambient light.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lamp {
    /// Unit vector to the lamp, object frame.
    pub towards: Vec3,
    /// Ambient light; 1 shows colours unchanged.
    pub ambient: f32,
    /// Light of the lamp on a surface that faces it.
    pub diffuse: f32,
    /// Strength of the highlight (Blinn's model).
    pub specular: f32,
    /// Its sharpness.
    pub shininess: f32,
}

/// A mesh whose colour is a function of position and normal: each of the six sides of its bounding box has a texture (so the
/// colours do not depend on the resolution of the mesh).
#[derive(Debug, Clone)]
pub struct PaintedObject {
    /// The surface, metres, its bounding box centred on the origin.
    pub mesh: Mesh,
    /// Textures of the sides +x, -x, +y, -y, +z, -z.
    textures: Vec<Patch>,
    /// Texture pixels per metre.
    scale: f64,
}

pub(super) fn between(random: &mut Random, low: f64, high: f64) -> f64 {
    low + (high - low) * random.random::<f64>()
}

/// A uniformly random rotation.
fn random_rotation(random: &mut Random) -> UnitQuaternion<f64> {
    let axis = random_direction(random);
    let turn =
        UnitQuaternion::from_axis_angle(&Vector3::z_axis(), between(random, 0.0, std::f64::consts::TAU));
    UnitQuaternion::rotation_between(&Vec3::z(), &axis)
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI))
        * turn
}

/// A uniformly random unit vector.
pub(super) fn random_direction(random: &mut Random) -> Vec3 {
    let z = between(random, -1.0, 1.0);
    let angle = between(random, 0.0, std::f64::consts::TAU);
    let r = (1.0 - z * z).max(0.0).sqrt();
    Vec3::new(r * angle.cos(), r * angle.sin(), z)
}

fn random_member(random: &mut Random) -> Mesh {
    let family = Family::ALL[random.random_range(0..Family::ALL.len())];
    match member(family, random) {
        Ok(member) => member.mesh,
        Err(error) => unreachable!("a member of a family: {error}"),
    }
}

impl PaintedObject {
    /// Generates an object: a household shape, or two of them combined, its longest side between these lengths (metres), with
    /// textures from `textures`.
    pub fn random(textures: &Backgrounds, size: [f64; 2], random: &mut Random) -> Self {
        let mut mesh = random_member(random);
        if random.random::<f32>() < 0.25 {
            let (low, high) = mesh.bounding_box();
            let shift = (high - low) * between(random, -0.3, 0.3);
            let other = random_member(random).transformed(&Pose::new(random_rotation(random), shift));
            if let Ok(both) = Mesh::merged(&[mesh.clone(), other]) {
                mesh = both;
            }
        }
        let (low, high) = mesh.bounding_box();
        let mesh = mesh.transformed(&Pose::from_translation(-(low + high) * 0.5));
        let longest = between(random, size[0], size[1]);
        let mesh = mesh.scaled(longest / (high - low).max().max(1e-6));
        // Few objects have six different sides.
        let different = random.random_range(1..=6usize);
        let printed: Vec<Patch> = (0..different).map(|_| texture(textures, random)).collect();
        let textures = (0..6).map(|side| printed[side % different].clone()).collect();
        let scale = TEXTURE as f64 / longest * between(random, 0.5, 1.3);
        PaintedObject { mesh, textures, scale }
    }

    /// Colour at a surface point with this normal, object frame.
    fn colour(&self, point: &Vec3, normal: &Vec3) -> [f32; 3] {
        let axis = normal.iamax();
        let side = 2 * axis + usize::from(normal[axis] < 0.0);
        let (u, v) = (point[(axis + 1) % 3] * self.scale, point[(axis + 2) % 3] * self.scale);
        let texture = &self.textures[side];
        let half = 0.5 * TEXTURE as f64;
        sample_mirrored(texture, (u + half) as f32, (v + half) as f32)
    }

    /// Renders the object under a lamp in front of `background`; returns the image and the object's coverage.
    pub(super) fn draw(
        &self,
        camera: &Camera,
        camera_from_object: &Pose,
        lamp: &Lamp,
        background: Patch,
    ) -> (Patch, Coverage) {
        let mut frame = VisibilityBuffer::new(camera);
        let objects = [SceneObject { mesh: &self.mesh, camera_from_object: *camera_from_object }];
        frame.render(&objects, &RenderOptions::default());
        let (points, normals) = (frame.object_coordinates(&objects), frame.normals(&objects));
        let back = camera_from_object.inverse();
        let eye = back.translation();
        let mut patch = background;
        let pixels = camera.width * camera.height;
        let mut seen = Coverage::filled(camera.width, camera.height, 0.0);
        for (i, (point, normal)) in points.as_slice().iter().zip(normals.as_slice()).enumerate() {
            if point[0].is_nan() {
                continue;
            }
            let point = Vec3::from(point.map(f64::from));
            let normal = back.transform_direction(&Vec3::from(normal.map(f64::from)));
            let view = (eye - point).try_normalize(1e-9).unwrap_or(normal);
            let half = (view + lamp.towards).try_normalize(1e-9).unwrap_or(normal);
            let light = lamp.ambient + lamp.diffuse * normal.dot(&lamp.towards).max(0.0) as f32;
            let highlight = lamp.specular * (normal.dot(&half).max(0.0) as f32).powf(lamp.shininess);
            for (c, value) in self.colour(&point, &normal).into_iter().enumerate() {
                patch.data[c * pixels + i] = (value * light + highlight).clamp(0.0, 1.0);
            }
            seen.data[i] = 1.0;
        }
        (patch, seen)
    }
}

fn texture(textures: &Backgrounds, random: &mut Random) -> Patch {
    match random.random_range(0..10u32) {
        0 => Patch::filled(TEXTURE, TEXTURE, std::array::from_fn(|_| random.random_range(0.1..0.9f32))),
        1..=4 => procedural_texture(TEXTURE, TEXTURE, random),
        _ => textures.patch(TEXTURE, TEXTURE, random),
    }
}

/// Bilinear sampling; beyond its border the texture is mirrored.
fn sample_mirrored(texture: &Patch, x: f32, y: f32) -> [f32; 3] {
    let fold = |v: f32, n: usize| {
        let n = n as f32;
        let v = v.rem_euclid(2.0 * n);
        (if v < n { v } else { 2.0 * n - v }).clamp(0.0, n - 1.001)
    };
    let (x, y) = (fold(x, texture.width), fold(y, texture.height));
    let (x0, y0) = (x as usize, y as usize);
    let (fx, fy) = (x - x0 as f32, y - y0 as f32);
    let pixels = texture.width * texture.height;
    std::array::from_fn(|c| {
        let at = |x: usize, y: usize| texture.data[c * pixels + y * texture.width + x];
        let top = at(x0, y0) * (1.0 - fx) + at(x0 + 1, y0) * fx;
        let bottom = at(x0, y0 + 1) * (1.0 - fx) + at(x0 + 1, y0 + 1) * fx;
        top * (1.0 - fy) + bottom * fy
    })
}
