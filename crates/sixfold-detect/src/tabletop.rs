//! Synthetic photographs of tabletops: objects that stand, lie and occlude one another on a table full of printed sheets, all under
//! the same lamps, with their shadows. Pasted objects (`samples`) have sharp borders and their own light, which a detector of any
//! object would learn instead of what an object is.

use rand::RngExt;
use sixfold_data::random_material;
use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion};
use sixfold_geometry::random::{Random, uniform};
use sixfold_geometry::{Camera, Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{Light, RenderOptions, SceneObject, ShadowMap, VisibilityBuffer, shade_in_shadows};
use sixfold_synth::augment::{Backgrounds, Patch, procedural_texture};
use sixfold_synth::distractors::random_rotation;

/// Range of the number of objects on a table.
const OBJECTS: [u32; 2] = [2, 28];
/// Range of the size of a mean object, pixels.
const PIXELS: [f32; 2] = [35.0, 150.0];
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
/// Range of the part of the visible table on which objects are placed: from a pile to the whole.
const SPREAD: [f32; 2] = [0.35, 1.1];
/// Maximum number of sheets of paper on a table; they do not count as objects.
const SHEETS: u32 = 10;
/// Side of textures, pixels.
const TEXTURE: usize = 192;
/// Ambient light.
const AMBIENT: [f32; 2] = [0.08, 0.3];
/// Light of the ceiling and of the walls, from several directions.
const CEILING: [f32; 2] = [0.2, 0.6];
/// Number of these directions.
const CEILING_DIRECTIONS: usize = 3;
/// Light of a lamp.
const LAMP: [f32; 2] = [0.0, 0.6];
/// Number of directions from which it comes; their spread makes its shadows soft.
const LAMP_DIRECTIONS: usize = 2;
/// Half the lamp's size, radians.
const LAMP_SIZE: [f32; 2] = [0.01, 0.12];
/// Side of a shadow map, pixels.
const SHADOW_MAP: usize = 256;

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
        0..=2 => RgbImage::filled(8, 8, natural_color(random)),
        3 => procedural_texture(TEXTURE, TEXTURE, random).to_rgb(),
        _ => textures.patch(TEXTURE, TEXTURE, random).to_rgb(),
    }
}

/// A printed page: a photograph or plain paper with pictures, bars, lines of text and the black squares of markers.
fn page(textures: &Backgrounds, random: &mut Random) -> RgbImage {
    let mut page = match random.random_range(0..10u32) {
        0..=3 => texture(textures, random),
        _ => RgbImage::filled(8, 8, std::array::from_fn(|_| random.random_range(215..=255))),
    };
    if page.width() != TEXTURE {
        page = RgbImage::filled(TEXTURE, TEXTURE, page[(0, 0)]);
    }
    let mut fill = |[x0, y0, x1, y1]: [usize; 4], color: [u8; 3]| {
        for y in y0.min(TEXTURE)..y1.min(TEXTURE) {
            page.as_mut_slice()[y * TEXTURE..][x0.min(TEXTURE)..x1.min(TEXTURE)].fill(color);
        }
    };
    match random.random_range(0..4u32) {
        // Lines of text in words, with a title.
        0 => {
            let ink = natural_color(random).map(|c| c / 2);
            let height = random.random_range(2..=14usize);
            let mut y = random.random_range(4..30usize);
            while y + height < TEXTURE {
                let mut x = random.random_range(4..20usize);
                while x < TEXTURE - 8 {
                    let word = height + random.random_range(0..4 * height);
                    // A letter is a block with a gap; a stroke less than half its width.
                    for letter in (x..(x + word).min(TEXTURE - 6)).step_by(height.max(3)) {
                        fill([letter, y, letter + height.max(3) * 2 / 3, y + height], ink);
                    }
                    x += word + height;
                }
                y += 2 * height + random.random_range(0..3usize);
            }
        }
        // A grid of markers: black squares with a few white cells.
        1 => {
            let cell = random.random_range(24..=64usize);
            for top in (cell / 8..TEXTURE).step_by(cell) {
                for left in (cell / 8..TEXTURE).step_by(cell) {
                    let side = cell * 3 / 4;
                    fill([left, top, left + side, top + side], [20; 3]);
                    let unit = (side / 6).max(1);
                    for _ in 0..random.random_range(1..8usize) {
                        let [x, y] = [left, top].map(|at| at + unit * random.random_range(1..5usize));
                        fill([x, y, x + unit, y + unit], [240; 3]);
                    }
                }
            }
        }
        // Bars and boxes.
        2 => {
            for _ in 0..random.random_range(1..8usize) {
                let [x, y] = [0; 2].map(|_| random.random_range(0..TEXTURE));
                let [w, h] = [0; 2].map(|_| random.random_range(4..TEXTURE / 2));
                fill([x, y, x + w, y + h], natural_color(random));
            }
        }
        _ => {}
    }
    page
}

/// A colour as things have it: often grey, white or black, seldom saturated.
pub(crate) fn natural_color(random: &mut Random) -> [u8; 3] {
    let value = uniform(random, [0.06, 0.97]);
    let saturation = if random.random::<f32>() < 0.35 {
        uniform(random, [0.0, 0.12])
    } else {
        uniform(random, [0.3, 1.0])
    };
    let hue = uniform(random, [0.0, std::f32::consts::TAU]);
    std::array::from_fn(|c| {
        let wave = 0.5 + 0.5 * (hue + c as f32 * std::f32::consts::TAU / 3.0).cos();
        (255.0 * value * (1.0 - saturation * (1.0 - wave))).round() as u8
    })
}

/// Ambient light, light from the ceiling and walls, and a lamp, all in the camera frame.
fn lights(camera_from_table: &Pose, random: &mut Random) -> Vec<Light> {
    let tint = |strength: f32, random: &mut Random| -> [f32; 3] {
        std::array::from_fn(|_| strength * uniform(random, [0.92, 1.08]))
    };
    let down = |elevation: f64, azimuth: f64| {
        camera_from_table.transform_direction(&Vec3::new(
            elevation.cos() * azimuth.cos(),
            elevation.cos() * azimuth.sin(),
            -elevation.sin(),
        ))
    };
    let ambient = uniform(random, AMBIENT);
    let mut lights = vec![Light::Ambient { color: tint(ambient, random) }];
    let ceiling = uniform(random, CEILING);
    let color = tint(ceiling / CEILING_DIRECTIONS as f32, random);
    for _ in 0..CEILING_DIRECTIONS {
        let direction = down(between(random, 0.3, 1.5), between(random, -3.1, 3.1));
        lights.push(Light::Directional { direction, color });
    }
    let lamp = uniform(random, LAMP);
    let color = tint(lamp / LAMP_DIRECTIONS as f32, random);
    let (elevation, azimuth) = (between(random, 0.5, 1.4), between(random, -3.1, 3.1));
    let size = f64::from(uniform(random, LAMP_SIZE));
    for _ in 0..LAMP_DIRECTIONS {
        let [up, around] = [0; 2].map(|_| between(random, -size, size));
        lights.push(Light::Directional { direction: down(elevation + up, azimuth + around), color });
    }
    lights
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
        let radius = between(random, 0.3, 0.45) * size.x.max(size.y);
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

/// The shadows of objects in each light that has a direction.
fn shadows(
    objects: &[SceneObject<'_>],
    lights: &[Light],
    centre: &Vec3,
    radius: f64,
) -> Vec<Option<ShadowMap>> {
    let of = |light: &Light| match light {
        Light::Directional { direction, .. } => {
            ShadowMap::new(objects, direction, centre, radius, SHADOW_MAP)
        }
        _ => None,
    };
    lights.iter().map(of).collect()
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
    let spread = f64::from(uniform(random, SPREAD.map(f32::ln)).exp());
    let placed = placed(meshes, reach * spread, random);
    let half = [between(random, 0.7, 3.0) * reach, between(random, 0.7, 3.0) * reach];
    let turn = between(random, -0.8, 0.8);
    let mut flat: Vec<Mesh> =
        sheet([0.0; 2], half, turn, 0.0, texture(textures, random)).into_iter().collect();
    for number in 0..random.random_range(0..=SHEETS) {
        let at = [between(random, -reach, reach), between(random, -reach, reach)];
        let size = [between(random, 0.04, 0.25), between(random, 0.04, 0.25)];
        let z = 0.0005 * f64::from(number + 1);
        flat.extend(sheet(at, size, between(random, -3.1, 3.1), z, page(textures, random)));
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
    let lights = lights(&camera_from_table, random);
    let centre = camera_from_table.translation();
    // Sheets and table have no shadow of their own.
    let shadows = shadows(&objects[..count], &lights, &centre, 2.0 * reach);
    let lit = |light: usize, point: &Vec3| shadows[light].as_ref().map_or(1.0, |s| s.visible(point));
    let material = random_material(random);
    let image = shade_in_shadows(&frame, &objects, &lights, &lit, &material, Some(&background));
    Tabletop { image: Patch::from_rgb(&image), labels, whole }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::random::stream;

    #[test]
    fn light_travels_down_onto_the_table() {
        let mut random = stream(0, 1);
        for _ in 0..20 {
            let camera_from_table = looking_down(1.0, &mut random);
            let mut sum = 0.0;
            for light in lights(&camera_from_table, &mut random) {
                match light {
                    Light::Ambient { color } => sum += color[1],
                    Light::Directional { direction, color } => {
                        let in_table = camera_from_table.inverse().transform_direction(&direction);
                        assert!(in_table.z < -0.2 && (in_table.norm() - 1.0).abs() < 1e-9, "{in_table}");
                        sum += color[1];
                    }
                    Light::Point { .. } => panic!("no light is near"),
                }
            }
            assert!((0.25..1.65).contains(&sum), "{sum}");
        }
    }

    #[test]
    fn pages_are_printed_and_colors_are_often_grey() {
        let mut random = stream(0, 2);
        let textures = Backgrounds::procedural();
        let several = (0..60)
            .filter(|_| {
                let page = page(&textures, &mut random);
                assert_eq!(page.size(), (TEXTURE, TEXTURE));
                page.as_slice().iter().any(|color| *color != page[(0, 0)])
            })
            .count();
        assert!((40..60).contains(&several), "{several}");
        let spread = |[r, g, b]: [u8; 3]| r.max(g).max(b) - r.min(g).min(b);
        let spreads: Vec<u8> = (0..1000).map(|_| spread(natural_color(&mut random))).collect();
        let grey = spreads.iter().filter(|s| **s < 32).count();
        let bright = spreads.iter().filter(|s| **s > 120).count();
        assert!((350..650).contains(&grey) && (80..400).contains(&bright), "{grey} {bright}");
    }

    #[test]
    fn objects_on_the_table_have_labels_where_they_are_visible() {
        let tower = sixfold_synth::shapes::toy(&mut stream(3, 0)).unwrap();
        let textures = Backgrounds::procedural();
        let mut seen = 0;
        for number in 0..12 {
            let Tabletop { image, labels, whole } =
                tabletop(&[&tower], &textures, 96, &mut stream(5, number));
            assert_eq!(image.data.len(), 3 * labels.len());
            for (number, (_, pixels)) in (1u8..).zip(&whole) {
                let visible = labels.iter().filter(|label| **label == number).count();
                assert!(visible as f32 <= *pixels, "{visible} of {pixels}");
                seen += usize::from(visible > 0);
            }
            assert!(labels.iter().all(|label| usize::from(*label) <= whole.len()));
        }
        assert!(seen > 20, "{seen}");
    }

    #[test]
    fn an_object_shades_the_table_below_it() {
        let mut random = stream(0, 7);
        let toy = sixfold_synth::shapes::toy(&mut random).unwrap();
        let camera_from_table = looking_down(1.0, &mut random);
        let objects = [SceneObject { mesh: &toy, camera_from_object: camera_from_table }];
        let lights = lights(&camera_from_table, &mut random);
        let shadows = shadows(&objects, &lights, &camera_from_table.translation(), 0.6);
        assert_eq!(shadows.len(), lights.len());
        // Points of the table, every centimetre, and how many of them each lamp does not reach.
        let points: Vec<Vec3> = (0..80 * 80)
            .map(|i| Vec3::new(0.01 * f64::from(i % 80) - 0.4, 0.01 * f64::from(i / 80) - 0.4, 0.0))
            .map(|point| camera_from_table.transform_point(&point))
            .collect();
        let dark = |map: &ShadowMap| points.iter().filter(|point| map.visible(point) < 0.5).count();
        // Ambient light has no shadow. That of a lamp is at least about as large as the toy's base, and not the whole table.
        assert!(shadows[0].is_none());
        for map in &shadows[1..] {
            let dark = dark(map.as_ref().unwrap());
            assert!((5..3000).contains(&dark), "{dark}");
        }
    }
}
