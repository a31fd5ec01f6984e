//! Synthetic photographs of tabletops: objects that stand, lie and occlude one another on a table in front of a background, all
//! under one light. Pasted objects (`samples`) have sharp borders and their own light, which a detector of any object would learn
//! instead of what an object is.

use rand::RngExt;
use sixfold_data::{random_lights, random_material};
use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion};
use sixfold_geometry::random::{Random, uniform};
use sixfold_geometry::{Camera, Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer, shade};
use sixfold_synth::augment::{Backgrounds, Patch, procedural_texture};
use sixfold_synth::distractors::random_rotation;

/// Range of the number of objects on a table.
const OBJECTS: [u32; 2] = [2, 16];
/// Range of the size of a mean object, pixels.
const PIXELS: [f32; 2] = [35.0, 130.0];
/// Mean diameter of the objects, metres.
const DIAMETER: f64 = 0.17;
/// Field of view, radians.
const FIELD: [f32; 2] = [0.5, 1.1];
/// The camera's elevation above the table, radians.
const ELEVATION: [f32; 2] = [0.2, 1.4];
/// Fraction of objects that stand upright; the others lie in a random orientation.
const STANDING: f32 = 0.5;
/// Fraction of objects that may be placed on others.
const STACKED: f32 = 0.2;
/// Maximum number of sheets of paper on a table; they do not count as objects.
const SHEETS: u32 = 3;
/// Side of textures, pixels.
const TEXTURE: usize = 192;

/// An image with the number of the object that each pixel shows, from 1, and 0 elsewhere.
pub(crate) struct Tabletop {
    pub(crate) image: Patch,
    pub(crate) labels: Vec<u8>,
    /// For each object the index of its mesh, and its number of unoccluded pixels.
    pub(crate) whole: Vec<(usize, f32)>,
}

fn between(random: &mut Random, low: f64, high: f64) -> f64 {
    low + (high - low) * random.random::<f64>()
}

/// A flat rectangle around `centre` at the height z, with a texture.
fn sheet(centre: [f64; 2], half: [f64; 2], turn: f64, z: f64, texture: RgbImage) -> Option<Mesh> {
    let (s, c) = turn.sin_cos();
    let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
    let vertices = corners.map(|[u, v]| {
        let (x, y) = (u * half[0], v * half[1]);
        Vec3::new(centre[0] + c * x - s * y, centre[1] + s * x + c * y, z)
    });
    let texcoords = vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    Mesh::new(vertices.to_vec(), vec![[0, 1, 2], [0, 2, 3]]).ok()?.with_texture(texcoords, texture).ok()
}

fn texture(textures: &Backgrounds, random: &mut Random) -> RgbImage {
    match random.random_range(0..10u32) {
        0..=3 => Patch::filled(8, 8, std::array::from_fn(|_| uniform(random, [0.1, 0.95]))).to_rgb(),
        4..=5 => procedural_texture(TEXTURE, TEXTURE, random).to_rgb(),
        _ => textures.patch(TEXTURE, TEXTURE, random).to_rgb(),
    }
}

/// A camera aimed at the table's centre from `distance` metres.
fn looking_down(distance: f64, random: &mut Random) -> Pose {
    let elevation = f64::from(uniform(random, ELEVATION));
    // In the table's frame z is up; in the camera's frame z is forward and y down.
    let forward = Vec3::new(0.0, elevation.cos(), -elevation.sin());
    let down = Vec3::new(0.0, -elevation.sin(), -elevation.cos());
    let right = down.cross(&forward);
    let rotation = Rotation3::from_matrix_unchecked(sixfold_geometry::nalgebra::Matrix3::from_rows(&[
        right.transpose(),
        down.transpose(),
        forward.transpose(),
    ]));
    let roll = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), between(random, -0.15, 0.15));
    Pose::new(roll * UnitQuaternion::from_rotation_matrix(&rotation), Vec3::new(0.0, 0.0, distance))
}

/// Places the objects on the table, next to the others or on them.
fn placed(meshes: &[&Mesh], reach: f64, random: &mut Random) -> Vec<(usize, Pose)> {
    // Centre, radius and height of the objects placed so far.
    let mut taken: Vec<([f64; 2], f64, f64)> = vec![];
    let mut out = vec![];
    for _ in 0..random.random_range(OBJECTS[0]..=OBJECTS[1]) {
        let index = random.random_range(0..meshes.len());
        let about_z = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), between(random, -3.1, 3.1));
        let standing = random.random::<f32>() < STANDING;
        let turn =
            about_z * if standing { UnitQuaternion::identity() } else { random_rotation(random).rotation() };
        let rotated = meshes[index].transformed(&Pose::new(turn, Vec3::zeros()));
        let (low, high) = rotated.bounding_box();
        let size = high - low;
        let radius = 0.4 * size.x.max(size.y);
        let stacked = random.random::<f32>() < STACKED;
        for _ in 0..8 {
            let at = [between(random, -reach, reach), between(random, -reach, reach)];
            let near = |t: &&([f64; 2], f64, f64)| (at[0] - t.0[0]).hypot(at[1] - t.0[1]) < radius + t.1;
            let below = taken.iter().filter(near).map(|t| t.2).fold(0.0, f64::max);
            if below > 0.0 && !stacked {
                continue;
            }
            let shift =
                Vec3::new(at[0] - 0.5 * (low.x + high.x), at[1] - 0.5 * (low.y + high.y), below - low.z);
            taken.push((at, radius, below + size.z));
            out.push((index, Pose::new(turn, shift)));
            break;
        }
    }
    out
}

/// Renders an image of `side` pixels of a table with some of `meshes`, which stand on z = 0 or are centred on the origin.
pub(crate) fn tabletop(
    meshes: &[&Mesh],
    textures: &Backgrounds,
    side: usize,
    random: &mut Random,
) -> Tabletop {
    let field = f64::from(uniform(random, FIELD));
    let focal = 0.5 * side as f64 / (0.5 * field).tan();
    let principal = 0.5 * (side as f64 - 1.0);
    let pixels = f64::from(uniform(random, PIXELS.map(f32::ln)).exp());
    let distance = focal * DIAMETER / pixels;
    let camera = Camera {
        fx: focal,
        fy: focal,
        cx: principal,
        cy: principal,
        width: side,
        height: side,
        distortion: None,
    };
    let camera_from_table = looking_down(distance, random);
    let reach = 0.45 * side as f64 * distance / focal;
    let placed = placed(meshes, reach, random);
    let half = [between(random, 0.7, 3.0) * reach, between(random, 0.7, 3.0) * reach];
    let turn = between(random, -0.8, 0.8);
    let mut flat: Vec<Mesh> =
        sheet([0.0; 2], half, turn, 0.0, texture(textures, random)).into_iter().collect();
    for number in 0..random.random_range(0..=SHEETS) {
        let at = [between(random, -reach, reach), between(random, -reach, reach)];
        let size = [between(random, 0.04, 0.25), between(random, 0.04, 0.25)];
        let z = 0.001 * f64::from(number + 1);
        flat.extend(sheet(at, size, between(random, -3.1, 3.1), z, texture(textures, random)));
    }
    let mut objects: Vec<SceneObject<'_>> = placed
        .iter()
        .map(|(index, pose)| SceneObject {
            mesh: meshes[*index],
            camera_from_object: camera_from_table * *pose,
        })
        .collect();
    let count = objects.len();
    objects.extend(flat.iter().map(|mesh| SceneObject { mesh, camera_from_object: camera_from_table }));
    let mut frame = VisibilityBuffer::new(&camera);
    let mut pixels = |object: &SceneObject<'_>| {
        frame.render(std::slice::from_ref(object), &RenderOptions::default());
        frame.inverse_depth().iter().filter(|z| **z > 0.0).count() as f32
    };
    let whole = placed.iter().zip(&objects).map(|((index, _), object)| (*index, pixels(object))).collect();
    frame.render(&objects, &RenderOptions::default());
    let labels = (0..side * side)
        .map(|i| match frame.surface_at(i) {
            Some((object, _)) if object < count => (object + 1) as u8,
            _ => 0,
        })
        .collect();
    let background = textures.patch(side, side, random).to_rgb();
    let image = shade(&frame, &objects, &random_lights(random), &random_material(random), Some(&background));
    Tabletop { image: Patch::from_rgb(&image), labels, whole }
}
