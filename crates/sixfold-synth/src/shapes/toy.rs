//! Toys: synthetic objects that belong to no family. A network that has to distinguish unknown objects needs more variety
//! than eight families provide. (The dissertation trains on the same objects that it tests.)
//!
//! Every toy consists of 3 to 8 overlapping solids (`sweep.rs`, boxes): figures with a plane of mirror symmetry (body, head,
//! ears, limbs, beak, tail), machine parts (plates with a window and posts, brackets, tools), and random heaps.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use rand::{Rng, RngExt};
use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::{Mesh, MeshError};

use super::solids::Builder;
use super::sweep::Sweep;

/// Range of a toy's diameter, metres.
pub(crate) const TOY_DIAMETER: (f64, f64) = (0.07, 0.28);
/// The second largest side of a toy's box is at least this, metres.
pub(crate) const TOY_MIN_SIDE: f64 = 0.03;
/// Maximum number of solids in a toy.
const MOST: usize = 8;

/// Makes a random toy: 1,500 to 6,000 faces, metres, z up, standing on z = 0 over the origin, with a diameter uniform in
/// `TOY_DIAMETER`. Its solids overlap, so parts of their surfaces are inside it.
///
/// # Errors
/// [`MeshError`]: never with these numbers.
pub fn toy(random: &mut impl Rng) -> Result<Mesh, MeshError> {
    let (solids, turn) = match random.random_range(0..10u32) {
        0..=3 => (figure(random)?, UnitQuaternion::identity()),
        4..=6 => (machine(random)?, quarter_turns(random)),
        _ => (heap(random)?, random_rotation(random)),
    };
    let mesh = Mesh::merged(&solids)?.transformed(&Pose::new(turn, Vec3::zeros()));
    let diameter = between(random, TOY_DIAMETER.0, TOY_DIAMETER.1);
    standing(&mesh, diameter)
}

/// The mesh scaled to this diameter, not too thin, standing on z = 0.
fn standing(mesh: &Mesh, diameter: f64) -> Result<Mesh, MeshError> {
    let mut mesh = mesh.scaled(diameter / mesh.diameter());
    // Widening also increases the diameter a little, so a second and third round may be needed.
    for _ in 0..12 {
        let (low, high) = mesh.bounding_box();
        let size = high - low;
        let longest = size.imax();
        let second = (0..3).filter(|axis| *axis != longest).max_by(|a, b| size[*a].total_cmp(&size[*b]));
        let Some(second) = second.filter(|axis| size[*axis] < TOY_MIN_SIDE) else { break };
        let mut stretch = Vec3::repeat(1.0);
        stretch[second] = 1.15 * TOY_MIN_SIDE / size[second];
        let vertices = mesh.vertices().iter().map(|v| v.component_mul(&stretch)).collect();
        let wider = Mesh::new(vertices, mesh.faces().to_vec())?;
        mesh = wider.scaled(diameter / wider.diameter());
    }
    let (low, high) = mesh.bounding_box();
    let centre = (low + high) * 0.5;
    Ok(mesh.transformed(&Pose::from_translation(-Vec3::new(centre.x, centre.y, low.z))))
}

/// Body, head and attached parts, the same on both sides of the plane y = 0.
fn figure(random: &mut impl Rng) -> Result<Vec<Mesh>, MeshError> {
    let upright = random.random::<f64>() < 0.5;
    let lean = if upright { between(random, -0.2, 0.2) } else { between(random, 0.9, 1.7) };
    let round = match random.random_range(0..3u32) {
        0 => Kind::Lathed,
        1 => Kind::Superquadric,
        _ => Kind::Ellipsoid,
    };
    let body = solid(round, between(random, 0.25, 0.5), 0.0, random)?
        .transformed(&Pose::from_translation(Vec3::z() * -0.5))
        .transformed(&in_plane(Vec3::zeros(), lean));
    let mut parts = vec![body.clone()];
    let up = if upright { Vec3::z() } else { Vec3::new(1.0, 0.0, between(random, 0.2, 1.2)) };
    let head = if random.random::<f64>() < 0.85 {
        let kind = if random.random::<f64>() < 0.7 { Kind::Ellipsoid } else { Kind::Superquadric };
        let head = solid(kind, between(random, 0.35, 0.55), 0.0, random)?;
        let head = attach(&body, &up, &head.scaled(between(random, 0.35, 0.75)), true, random);
        parts.push(head.clone());
        head
    } else {
        body.clone()
    };
    let back = if upright { Vec3::new(-1.0, 0.0, -0.6) } else { Vec3::new(-1.0, 0.0, 0.3) };
    let low = between(random, -1.2, -0.4);
    // Parts that may be attached: on head or body, direction, length and probability.
    let growths = [
        (&head, Vec3::new(between(random, -0.4, 0.3), 0.6, 0.7), (0.1, 0.4), 0.6),
        (&body, Vec3::new(0.5, 0.6, low), (0.2, 0.6), 0.7),
        (&head, Vec3::new(1.0, 0.0, between(random, -0.3, 0.3)), (0.1, 0.3), 0.5),
        (&body, Vec3::new(if upright { 0.0 } else { -0.6 }, 0.7, -0.1 + low * 0.8), (0.2, 0.6), 0.5),
        (&body, back, (0.2, 0.8), 0.5),
    ];
    for (parent, direction, (shortest, longest), often) in growths {
        let paired = direction.y > 0.0;
        let wanted = random.random::<f64>() < often || parts.len() < 2;
        if !wanted || parts.len() + 1 + usize::from(paired) > MOST {
            continue;
        }
        let kind = Kind::ALL[random.random_range(0..Kind::ALL.len())];
        let bend = if random.random::<f64>() < 0.5 { between(random, -1.8, 1.8) } else { 0.0 };
        let grown = solid(kind, between(random, 0.15, 0.5), bend, random)?;
        let grown = grown.scaled(between(random, shortest, longest));
        let grown = attach(parent, &direction, &grown, !paired, random);
        if paired {
            parts.push(mirrored(&grown)?);
        }
        parts.push(grown);
    }
    while parts.len() < 3 {
        let grown = solid(Kind::Superquadric, between(random, 0.2, 0.5), 0.0, random)?;
        let direction = Vec3::new(between(random, -1.0, 1.0), 0.0, between(random, -1.0, 1.0));
        parts.push(attach(&body, &direction, &grown.scaled(between(random, 0.2, 0.6)), true, random));
    }
    Ok(parts)
}

/// A plate, a bracket or a tool.
fn machine(random: &mut impl Rng) -> Result<Vec<Mesh>, MeshError> {
    match random.random_range(0..3u32) {
        0 => plate(random),
        1 => bracket(random),
        _ => tool(random),
    }
}

/// A plate, whole or with a window, and posts on it.
fn plate(random: &mut impl Rng) -> Result<Vec<Mesh>, MeshError> {
    let (length, width) = (1.0, between(random, 0.35, 1.0));
    let thick = between(random, 0.06, 0.2);
    let mut parts = vec![];
    if random.random::<f64>() < 0.5 {
        let bar = between(random, 0.12, 0.3) * width;
        for side in [-1.0, 1.0] {
            let at = Vec3::new(0.0, side * 0.5 * (width - bar), 0.0);
            parts.push(block(&Vec3::new(length, bar, thick), &Pose::from_translation(at))?);
            let at = Vec3::new(side * 0.5 * (length - bar), 0.0, 0.0);
            parts.push(block(&Vec3::new(bar, width - bar, thick), &Pose::from_translation(at))?);
        }
    } else {
        parts.push(block(&Vec3::new(length, width, thick), &Pose::identity())?);
    }
    let posts = random.random_range(2..=(MOST - parts.len()).min(4));
    for _ in 0..posts {
        let tall = between(random, 0.15, 0.8);
        // On the rim, so that it also fits a plate with a window.
        let (x, y) = (between(random, -0.42, 0.42), between(random, -0.42, 0.42) * width);
        let (x, y) = if random.random::<f64>() < 0.5 {
            (x, 0.42 * width * y.signum())
        } else {
            (0.42 * x.signum(), y)
        };
        let side = if random.random::<f64>() < 0.8 { 0.0 } else { PI };
        let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), side);
        let pose = Pose::new(turn, Vec3::new(x, y, 0.0));
        if random.random::<f64>() < 0.4 {
            let size = Vec3::new(between(random, 0.12, 0.3), between(random, 0.12, 0.3), tall);
            parts.push(block(&size, &(pose * Pose::from_translation(Vec3::z() * (0.5 * tall))))?);
        } else {
            let kind = [Kind::Bar, Kind::Cone, Kind::Lathed][random.random_range(0..3usize)];
            let width = between(random, 0.07, 0.15) / tall;
            parts.push(solid(kind, width, 0.0, random)?.scaled(tall).transformed(&pose));
        }
    }
    Ok(parts)
}

/// Blocks at right angles, each at the end of the previous one, and a boss.
fn bracket(random: &mut impl Rng) -> Result<Vec<Mesh>, MeshError> {
    let broad = between(random, 0.15, 0.6);
    let thick = between(random, 0.1, 0.25);
    let (mut corner, mut parts) = (Vec3::zeros(), vec![]);
    let mut axis = 0usize;
    for _ in 0..random.random_range(2..=4usize) {
        let length = between(random, 0.4, 1.0);
        let way = if random.random::<f64>() < 0.5 { -1.0 } else { 1.0 };
        let mut size = Vec3::repeat(thick);
        size[axis] = length + thick;
        // If all legs are in a plane, they have the same breadth; otherwise they are square.
        size.y = size.y.max(broad);
        let mut step = Vec3::zeros();
        step[axis] = way * length;
        parts.push(block(&size, &Pose::from_translation(corner + step * 0.5))?);
        corner += step;
        axis = if random.random::<f64>() < 0.8 { 2 - axis.min(2) } else { 1 };
    }
    while parts.len() < random.random_range(3..=5usize) {
        let parent = parts[random.random_range(0..parts.len())].clone();
        let kind = if random.random::<f64>() < 0.5 { Kind::Bar } else { Kind::Lathed };
        let boss = solid(kind, between(random, 0.25, 0.6), 0.0, random)?;
        let axis = Vec3::ith(random.random_range(0..3usize), 1.0);
        parts.push(attach(&parent, &axis, &boss.scaled(between(random, 0.2, 0.4)), false, random));
    }
    Ok(parts)
}

/// A grip with a head across its end and one or two tips.
fn tool(random: &mut impl Rng) -> Result<Vec<Mesh>, MeshError> {
    let bend = if random.random::<f64>() < 0.4 { between(random, -0.8, 0.8) } else { 0.0 };
    let grip = solid(Kind::Bar, between(random, 0.06, 0.16), bend, random)?;
    let end = grip.vertices().last().copied().unwrap_or_else(Vec3::z);
    let across = between(random, 0.3, 0.8);
    let thick = between(random, 0.15, 0.35);
    let at_end = Pose::from_translation(end);
    let head = if random.random::<f64>() < 0.5 {
        block(&Vec3::new(across, thick, between(random, 0.12, 0.35)), &at_end)?
    } else {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), FRAC_PI_2);
        let kind = [Kind::Lathed, Kind::Superquadric, Kind::Bar][random.random_range(0..3usize)];
        solid(kind, between(random, 0.15, 0.4), 0.0, random)?
            .scaled(across)
            .transformed(&Pose::from_translation(Vec3::z() * (-0.5 * across)))
            .transformed(&Pose::new(turn, end))
    };
    let mut parts = vec![grip.clone(), head.clone()];
    for _ in 0..random.random_range(1..=3usize) {
        let parent = if random.random::<f64>() < 0.75 { &head } else { &grip };
        let kind = Kind::ALL[random.random_range(0..Kind::ALL.len())];
        let tip = solid(kind, between(random, 0.15, 0.5), 0.0, random)?;
        let direction = Vec3::ith(if random.random::<f64>() < 0.6 { 0 } else { 2 }, 1.0)
            * if random.random::<f64>() < 0.5 { -1.0 } else { 1.0 };
        parts.push(attach(parent, &direction, &tip.scaled(between(random, 0.15, 0.4)), true, random));
    }
    Ok(parts)
}

/// Solids attached to each other at random.
fn heap(random: &mut impl Rng) -> Result<Vec<Mesh>, MeshError> {
    let mut parts: Vec<Mesh> = vec![];
    for number in 0..random.random_range(3..=MOST) {
        let kind = Kind::ALL[random.random_range(0..Kind::ALL.len())];
        let bend = if random.random::<f64>() < 0.4 { between(random, -2.2, 2.2) } else { 0.0 };
        let new = solid(kind, between(random, 0.15, 0.6), bend, random)?;
        if number == 0 {
            parts.push(new);
            continue;
        }
        // Mostly to the first ones, so that not all heaps become chains.
        let parent = random.random_range(0..parts.len()).min(random.random_range(0..parts.len()));
        let direction = random_rotation(random) * Vec3::z();
        let new = new.scaled(between(random, 0.3, 0.9));
        parts.push(attach(&parts[parent].clone(), &direction, &new, false, random));
    }
    Ok(parts)
}

/// The kind of a solid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Ellipsoid,
    Superquadric,
    Bar,
    Cone,
    Block,
    Lathed,
}

impl Kind {
    const ALL: [Kind; 6] =
        [Kind::Ellipsoid, Kind::Superquadric, Kind::Bar, Kind::Cone, Kind::Block, Kind::Lathed];
}

/// A solid of length 1 along z from the origin, `width` its half width, bent by an angle (if it is a bar or a cone).
fn solid(kind: Kind, width: f64, bend: f64, random: &mut impl Rng) -> Result<Mesh, MeshError> {
    let rows = random.random_range(14..=16usize);
    let sides = random.random_range(18..=22usize);
    let flat = if random.random::<f64>() < 0.5 { between(random, 0.5, 1.0) } else { 1.0 };
    let (profile, section, bend) = match kind {
        Kind::Ellipsoid => (Sweep::round_profile(1.0, rows), 1.0, 0.3 * bend),
        Kind::Superquadric => {
            let exponent = between(random, 0.2, 1.5);
            (Sweep::round_profile(exponent, rows), between(random, 0.2, 1.4), 0.0)
        }
        Kind::Bar => {
            let ends = [(0.0, 1.0), (1.0, between(random, 0.4, 1.1))];
            let section = if random.random::<f64>() < 0.3 { 0.3 } else { 1.0 };
            (Sweep::profile_through(&ends, rows), section, bend)
        }
        Kind::Cone => {
            let tip = between(random, 0.02, 0.35);
            let profile = (0..=rows).map(|k| k as f64 / rows as f64).map(|s| (s, 1.0 + s * (tip - 1.0)));
            (profile.collect(), 1.0, bend)
        }
        Kind::Block => {
            let size = Vec3::new(2.0 * width, 2.0 * width * flat, 1.0);
            return block(&size, &Pose::from_translation(Vec3::z() * 0.5));
        }
        Kind::Lathed => {
            let waists = random.random_range(2..=4usize);
            let mut points = vec![(0.0, between(random, 0.4, 1.0))];
            for k in 1..=waists {
                points.push((k as f64 / (waists + 1) as f64, between(random, 0.35, 1.0)));
            }
            points.push((1.0, between(random, 0.2, 1.0)));
            let flat = Sweep::profile_through(&points, rows);
            return Sweep { profile: flat, radii: (width, width), section: 1.0, bend: 0.0 }.mesh(sides);
        }
    };
    Sweep { profile, radii: (width, width * flat), section, bend }.mesh(sides)
}

/// A box of this size, centred at `pose`.
fn block(size: &Vec3, pose: &Pose) -> Result<Mesh, MeshError> {
    let mut builder = Builder::default();
    builder.cuboid(size, pose, 7);
    builder.finish(&Vec3::repeat(1.0))
}

/// Attaches `part` (from the origin along z) to `parent`'s surface in a direction from its centre, sunk in by a tenth to a
/// third of its length; `centred` keeps it in the plane y = 0.
fn attach(parent: &Mesh, direction: &Vec3, part: &Mesh, centred: bool, random: &mut impl Rng) -> Mesh {
    let (low, high) = parent.bounding_box();
    let centre = (low + high) * 0.5;
    let direction = direction.try_normalize(1e-9).unwrap_or_else(Vec3::z);
    let mut best = (f64::NEG_INFINITY, centre, direction);
    for face in 0..parent.faces().len() {
        let [a, b, c] = parent.triangle(face);
        let Some(normal) = (b - a).cross(&(c - a)).try_normalize(1e-12) else { continue };
        let place = (a + b + c) / 3.0;
        let along = (place - centre).try_normalize(1e-9).map_or(-1.0, |d| d.dot(&direction));
        if along > best.0 {
            best = (along, place, normal);
        }
    }
    let (_, mut place, normal) = best;
    let spread = Vec3::from_fn(|_, _| between(random, -0.35, 0.35));
    let mut axis = normal * between(random, 0.3, 1.0) + direction * 0.5 + spread;
    let (low, high) = part.bounding_box();
    let sink = between(random, 0.1, 0.33) * (high.z - low.z);
    if centred {
        place.y = 0.0;
        axis.y = 0.0;
        let place = place - axis.try_normalize(1e-9).unwrap_or(direction) * sink;
        return part.transformed(&in_plane(place, axis.x.atan2(axis.z)));
    }
    let axis = axis.try_normalize(1e-9).unwrap_or(direction);
    let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), between(random, 0.0, TAU));
    part.transformed(&Pose::new(towards(&axis) * roll, place - axis * sink))
}

/// The pose with a position in the plane y = 0 and a rotation within this plane, from z towards x.
fn in_plane(place: Vec3, angle: f64) -> Pose {
    Pose::new(UnitQuaternion::from_axis_angle(&Vector3::y_axis(), angle), place)
}

/// The mesh mirrored at the plane y = 0, its faces still facing outwards.
fn mirrored(mesh: &Mesh) -> Result<Mesh, MeshError> {
    let vertices = mesh.vertices().iter().map(|v| Vec3::new(v.x, -v.y, v.z)).collect();
    Mesh::new(vertices, mesh.faces().iter().map(|[a, b, c]| [*a, *c, *b]).collect())
}

fn between(random: &mut impl Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * random.random::<f64>()
}

/// The shortest rotation from z to `axis`.
fn towards(axis: &Vec3) -> UnitQuaternion<f64> {
    UnitQuaternion::rotation_between(&Vec3::z(), axis)
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI))
}

/// A uniformly distributed rotation.
fn random_rotation(random: &mut impl Rng) -> UnitQuaternion<f64> {
    let (z, angle) = (between(random, -1.0, 1.0), between(random, 0.0, TAU));
    let r = (1.0 - z * z).max(0.0).sqrt();
    let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), between(random, 0.0, TAU));
    towards(&Vec3::new(r * angle.cos(), r * angle.sin(), z)) * roll
}

/// A rotation that puts a machine part on any of its sides.
fn quarter_turns(random: &mut impl Rng) -> UnitQuaternion<f64> {
    let mut quarter = || f64::from(random.random_range(0..4u32)) * FRAC_PI_2;
    UnitQuaternion::from_axis_angle(&Vector3::x_axis(), quarter())
        * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), quarter())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn toys_have_their_sizes_and_are_all_different() {
        let draw = |seed| toy(&mut ChaCha8Rng::seed_from_u64(seed)).unwrap();
        let (mut smallest, mut largest) = (f64::INFINITY, 0.0f64);
        let mut flatness = vec![];
        for seed in 0..200 {
            let mesh = draw(seed);
            assert!(mesh.vertices().iter().all(|v| v.iter().all(|c| c.is_finite())), "{seed}");
            let diameter = mesh.diameter();
            assert!((TOY_DIAMETER.0 - 1e-6..TOY_DIAMETER.1 + 1e-6).contains(&diameter), "{seed} {diameter}");
            (smallest, largest) = (smallest.min(diameter), largest.max(diameter));
            let (low, high) = mesh.bounding_box();
            assert!(low.z.abs() < 1e-9 && (low.x + high.x).abs() < 1e-9 && (low.y + high.y).abs() < 1e-9);
            let mut size: Vec<f64> = (high - low).iter().copied().collect();
            size.sort_by(f64::total_cmp);
            assert!(size[1] >= TOY_MIN_SIDE, "{seed} {size:?}");
            flatness.push(size[0] / size[2]);
            let faces = mesh.faces().len();
            assert!((1500..=6000).contains(&faces), "{seed} {faces}");
        }
        // Covers the whole range, and shapes from flat to round.
        assert!(smallest < 0.08 && largest > 0.27, "{smallest} {largest}");
        flatness.sort_by(f64::total_cmp);
        assert!(flatness[20] < 0.35 && flatness[180] > 0.6, "{flatness:?}");
        assert_eq!(draw(5).vertices(), draw(5).vertices());
        assert_ne!(draw(5).vertices(), draw(6).vertices());
    }

    #[test]
    fn figures_are_alike_on_both_sides() {
        for seed in 0..20 {
            let parts = figure(&mut ChaCha8Rng::seed_from_u64(seed)).unwrap();
            assert!((3..=MOST).contains(&parts.len()), "{seed} {}", parts.len());
            let (low, high) = Mesh::merged(&parts).unwrap().bounding_box();
            assert!((low.y + high.y).abs() < 1e-6, "{seed} {low:?} {high:?}");
        }
    }
}
