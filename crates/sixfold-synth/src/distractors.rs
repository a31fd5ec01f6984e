//! Distractors that look like rendered objects: cans, cups, bowls, bottles, boxes and combinations of them, in plain colours
//! or with textures, lit by the same lamps. Without them a network takes every object on a table for one of its own, because
//! its training images show no others (like the distractor objects of Hinterstoisser et al. 2019, but procedural).

use std::f64::consts::{PI, TAU};

use rand::RngExt;
use sixfold_geometry::random::Random;
use sixfold_geometry::{Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;

use crate::augment::{Backgrounds, procedural_texture};
use crate::{profiles, randomly_colored};

/// Corners around a lathed solid.
const AROUND: u32 = 24;
/// Side of a texture, pixels.
const TEXTURE: usize = 96;

/// A random solid about the origin with a bounding box whose longest side is 1. Half of the plain ones have a colour from
/// `palette`, which holds the colours of the objects: colour alone must not identify an object.
pub fn random_solid(textures: &Backgrounds, palette: &[[u8; 3]], random: &mut Random) -> Mesh {
    let parts = if random.random::<f32>() < 0.25 { random.random_range(2..=3u32) } else { 1 };
    let parts: Vec<Mesh> = (0..parts)
        .map(|number| {
            let mesh = if random.random::<f32>() < 0.3 { cuboid(random) } else { household(random) };
            if number == 0 {
                return mesh;
            }
            let shift = Vec3::from_fn(|_, _| between(random, -0.4, 0.4));
            mesh.transformed(&Pose::new(random_rotation(random).rotation(), shift))
                .scaled(between(random, 0.4, 1.0))
        })
        .collect();
    let shape = merged(&parts);
    let (low, high) = shape.bounding_box();
    let centred = shape.transformed(&Pose::from_translation(-(low + high) * 0.5));
    let shape = centred.scaled(1.0 / (high - low).max().max(1e-6));
    dressed(shape, &parts, textures, palette, random)
}

/// A uniformly distributed rotation (Shoemake 1992).
pub fn random_rotation(random: &mut Random) -> Pose {
    let [u, v, w] = [0; 3].map(|_| between(random, 0.0, 1.0));
    let about = |angle: f64, axis: Vec3| {
        Pose::exp(&[0.0, 0.0, 0.0, angle * axis.x, angle * axis.y, angle * axis.z].into())
    };
    let turn = about(TAU * u, Vec3::z());
    let tilt = about((1.0 - 2.0 * v).clamp(-1.0, 1.0).acos(), Vec3::y());
    turn * tilt * about(TAU * w, Vec3::z())
}

fn between(random: &mut Random, low: f64, high: f64) -> f64 {
    low + (high - low) * random.random::<f64>()
}

/// Colours for a shape that is made of `parts`.
fn dressed(
    shape: Mesh,
    parts: &[Mesh],
    textures: &Backgrounds,
    palette: &[[u8; 3]],
    random: &mut Random,
) -> Mesh {
    let kind = random.random::<f32>();
    if kind < 0.1 {
        return randomly_colored(&without_texture(&shape), random);
    }
    if kind < 0.6 {
        let colors = parts.iter().flat_map(|part| {
            let color = plain(palette, random);
            std::iter::repeat_n(color, part.vertices().len())
        });
        return given(without_texture(&shape).with_colors(colors.collect()));
    }
    let texture = if random.random::<f32>() < 0.5 {
        procedural_texture(TEXTURE, TEXTURE, random)
    } else {
        textures.patch(TEXTURE, TEXTURE, random)
    };
    let at = shape.texcoords().unwrap_or_default().to_vec();
    given(shape.with_texture(at, texture.to_rgb()))
}

fn plain(palette: &[[u8; 3]], random: &mut Random) -> [u8; 3] {
    if palette.is_empty() || random.random::<bool>() {
        return std::array::from_fn(|_| random.random_range(15..=240));
    }
    palette[random.random_range(0..palette.len())]
}

fn without_texture(mesh: &Mesh) -> Mesh {
    let bare = given(Mesh::new(mesh.vertices().to_vec(), mesh.faces().to_vec()));
    given(bare.with_normals(mesh.vertex_normals()))
}

/// The meshes made here always have as many attributes as vertices.
fn given<E: std::fmt::Debug>(mesh: Result<Mesh, E>) -> Mesh {
    mesh.unwrap_or_else(|error| unreachable!("a solid of our own making: {error:?}"))
}

/// The parts as one mesh. All have normals and texture coordinates, which are kept because all share a texture.
fn merged(parts: &[Mesh]) -> Mesh {
    given(Mesh::merged(parts))
}

/// A placeholder for the texture that is set later.
fn one_texel() -> RgbImage {
    RgbImage::filled(1, 1, [128; 3])
}

/// A box, each side with the whole texture.
fn cuboid(random: &mut Random) -> Mesh {
    let size = Vec3::new(1.0, between(random, 0.3, 1.0), between(random, 0.1, 0.8));
    let (mut vertices, mut normals, mut texcoords, mut faces) = (vec![], vec![], vec![], vec![]);
    for axis in 0..3 {
        for sign in [-1.0, 1.0] {
            let first = vertices.len() as u32;
            let (a, b) = ((axis + 1) % 3, (axis + 2) % 3);
            for [u, v] in [[0.0f32, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]] {
                let mut corner = Vec3::zeros();
                corner[axis] = 0.5 * sign;
                corner[a] = f64::from(u) - 0.5;
                corner[b] = (f64::from(v) - 0.5) * sign;
                vertices.push(corner.component_mul(&size));
                let mut normal = Vec3::zeros();
                normal[axis] = sign;
                normals.push(normal);
                texcoords.push([u, v]);
            }
            faces.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
        }
    }
    given(given(given(Mesh::new(vertices, faces)).with_normals(normals)).with_texture(texcoords, one_texel()))
}

/// A solid of revolution: can, cup, bowl, bottle or pebble; some cups have a handle.
fn household(random: &mut Random) -> Mesh {
    let radius = between(random, 0.2, 0.55);
    let wall = 0.04;
    match random.random_range(0..5u32) {
        0 => lathed(&profiles::cylinder(radius, 1.0)),
        1 => {
            let foot = radius * between(random, 0.6, 1.0);
            let cup = lathed(&profiles::cup(foot, radius, 1.0, wall, wall));
            if random.random::<bool>() { merged(&[cup, handle(0.5 * (foot + radius), random)]) } else { cup }
        }
        2 => {
            let height = between(random, 0.4, 1.0) * radius;
            let curve = |shrink: f64| {
                (0..=6).map(move |i| {
                    let angle = 0.5 * PI * f64::from(i) / 6.0;
                    ((radius - shrink) * angle.sin(), shrink + (height - shrink) * (1.0 - angle.cos()))
                })
            };
            let mut profile: Vec<(f64, f64)> = curve(0.0).collect();
            profile.extend(curve(wall).collect::<Vec<_>>().into_iter().rev());
            lathed(&profile)
        }
        3 => {
            let (shoulder, neck) = (between(random, 0.45, 0.75), radius * between(random, 0.25, 0.6));
            let throat = shoulder + between(random, 0.05, 0.2);
            lathed(&[
                (0.0, 0.0),
                (radius * 0.95, 0.0),
                (radius, 0.03),
                (radius, shoulder),
                (neck, throat),
                (neck, 0.97),
                (0.0, 1.0),
            ])
        }
        _ => {
            let bumps = [0; 3].map(|_| between(random, -0.25, 0.25));
            let profile: Vec<(f64, f64)> = (0..=12)
                .map(|i| {
                    let angle = PI * f64::from(i) / 12.0;
                    let bump: f64 = (2..).zip(bumps).map(|(k, b)| b * (f64::from(k) * angle).cos()).sum();
                    (radius * angle.sin() * (1.0 + bump), 0.5 - 0.5 * angle.cos())
                })
                .collect();
            lathed(&profile)
        }
    }
}

/// A profile of (radius, height) from the axis back to the axis, rotated about z. Each band has its own normals, so that
/// edges, such as those of cans, are sharp.
fn lathed(profile: &[(f64, f64)]) -> Mesh {
    let (mut vertices, mut normals, mut texcoords, mut faces) = (vec![], vec![], vec![], vec![]);
    let lengths: Vec<f64> = profile.windows(2).map(|w| (w[1].0 - w[0].0).hypot(w[1].1 - w[0].1)).collect();
    let whole = lengths.iter().sum::<f64>().max(1e-9);
    let mut done = 0.0;
    for (band, length) in profile.windows(2).zip(lengths) {
        let first = vertices.len() as u32;
        let (along, up) = (band[1].0 - band[0].0, band[1].1 - band[0].1);
        let ends = [done / whole, (done + length) / whole];
        done += length;
        for step in 0..=AROUND {
            let fraction = f64::from(step) / f64::from(AROUND);
            let (s, c) = (TAU * fraction).sin_cos();
            let normal = Vec3::new(up * c, up * s, -along);
            let normal = normal.try_normalize(1e-12).unwrap_or_else(Vec3::zeros);
            for (end, (r, z)) in ends.iter().zip(band) {
                vertices.push(Vec3::new(r * c, r * s, *z));
                normals.push(normal);
                texcoords.push([fraction as f32, *end as f32]);
            }
        }
        for step in 0..AROUND {
            let a = first + 2 * step;
            faces.extend([[a, a + 2, a + 1], [a + 1, a + 2, a + 3]]);
        }
    }
    given(given(given(Mesh::new(vertices, faces)).with_normals(normals)).with_texture(texcoords, one_texel()))
}

/// Half a ring at the side of a cup of this radius.
fn handle(radius: f64, random: &mut Random) -> Mesh {
    const BENDS: u32 = 10;
    const SIDES: u32 = 8;
    let (reach, tall) = (between(random, 0.15, 0.3), between(random, 0.2, 0.35));
    let thick = between(random, 0.03, 0.06);
    let (mut vertices, mut normals, mut texcoords, mut faces) = (vec![], vec![], vec![], vec![]);
    for bend in 0..=BENDS {
        let fraction = f64::from(bend) / f64::from(BENDS);
        let (s, c) = (PI * (fraction - 0.5)).sin_cos();
        let centre = Vec3::new(radius * 0.95 + reach * c, 0.0, 0.5 + tall * s);
        let outward = Vec3::new(c, 0.0, s);
        for side in 0..=SIDES {
            let turn = f64::from(side) / f64::from(SIDES);
            let (s, c) = (TAU * turn).sin_cos();
            let normal = outward * c + Vec3::y() * s;
            vertices.push(centre + normal * thick);
            normals.push(normal);
            texcoords.push([fraction as f32, turn as f32]);
        }
    }
    for bend in 0..BENDS {
        for side in 0..SIDES {
            let a = bend * (SIDES + 1) + side;
            let b = a + SIDES + 1;
            faces.extend([[a, a + 1, b], [a + 1, b + 1, b]]);
        }
    }
    given(given(given(Mesh::new(vertices, faces)).with_normals(normals)).with_texture(texcoords, one_texel()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::random::stream;

    /// Six times the volume that the faces enclose: positive if they face outwards.
    fn volume(mesh: &Mesh) -> f64 {
        mesh.faces()
            .iter()
            .map(|f| f.map(|i| mesh.vertices()[i as usize]))
            .map(|[a, b, c]| a.dot(&b.cross(&c)))
            .sum()
    }

    #[test]
    fn faces_and_normals_look_outwards() {
        let mut random = stream(3, 0);
        for _ in 0..40 {
            for mesh in [cuboid(&mut random), household(&mut random), handle(0.3, &mut random)] {
                let outward = mesh.faces().iter().enumerate().all(|(i, face)| {
                    let [a, b, c] = mesh.triangle(i);
                    let across = (b - a).cross(&(c - a));
                    let normal: Vec3 = face.iter().map(|i| mesh.normals().unwrap()[*i as usize]).sum();
                    across.norm() < 1e-9 || across.dot(&normal) > 0.0
                });
                assert!(outward);
            }
            assert!(volume(&cuboid(&mut random)) > 0.0 && volume(&household(&mut random)) > 0.0);
        }
    }

    #[test]
    fn solids_are_of_size_one_about_the_origin_and_differ() {
        let textures = Backgrounds::procedural();
        let palette = [[3, 250, 7]];
        let of = |number| random_solid(&textures, &palette, &mut stream(1, number));
        let (mut kinds, mut known) = ([0; 2], 0);
        for number in 0..60 {
            let solid = of(number);
            let (low, high) = solid.bounding_box();
            assert!(((high - low).max() - 1.0).abs() < 1e-9 && (low + high).norm() < 1e-9);
            assert!(solid.colors().is_some() || solid.texture().is_some_and(|t| t.width() == TEXTURE));
            kinds[usize::from(solid.texture().is_some())] += 1;
            known += usize::from(solid.colors().is_some_and(|c| c.contains(&palette[0])));
        }
        assert!((10..40).contains(&known), "{known}");
        assert!(kinds.iter().all(|k| *k > 10), "{kinds:?}");
        assert_eq!(of(5).vertices(), of(5).vertices());
        assert_ne!(of(5).vertices(), of(6).vertices());
    }

    #[test]
    fn rotations_point_everywhere() {
        let mut random = stream(9, 0);
        let mean: Vec3 =
            (0..4000).map(|_| random_rotation(&mut random).transform_direction(&Vec3::x())).sum::<Vec3>()
                / 4000.0;
        let spread: f64 = (0..4000)
            .map(|_| (random_rotation(&mut random).transform_direction(&Vec3::x())).z.powi(2))
            .sum::<f64>()
            / 4000.0;
        assert!(mean.norm() < 0.05 && (spread - 1.0 / 3.0).abs() < 0.03, "{mean:?} {spread}");
    }
}
