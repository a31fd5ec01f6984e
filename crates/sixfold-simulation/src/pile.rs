//! Several objects dropped on the table: cluttered scenes, in which objects touch, lean on and lie on one another.

use std::f64::consts::TAU;

use rand::{Rng, RngExt};
use rapier3d::prelude::RigidBodyHandle;
use sixfold_geometry::nalgebra::{Quaternion, UnitQuaternion};
use sixfold_geometry::random::stream;
use sixfold_geometry::{Pose, Vec3};

use crate::error::check_ranges;
use crate::world::{body_pose, insert_object, world};
use crate::{ConvexParts, SimulationError};

/// Time step, seconds; longer than that of grasps, because nothing is held here.
const STEP: f64 = 0.004;
/// Steps between two checks of which objects still move: 0.1 s.
const STEPS: usize = 25;
/// An object that moves less than this between two checks is at rest: metres and radians.
const REST: (f64, f64) = (0.0005, 0.005);
/// Number of checks after which objects that still move are removed, and after which the simulation ends.
const PATIENCE: (usize, usize) = (30, 40);
/// Largest number of hull vertices per part: the others protrude by less than half a millimetre.
const CORNERS: usize = 400;
/// Height above the table at which objects are released, metres.
const HEIGHT: f64 = 0.002;
/// Friction coefficient of each object; between two objects it is the product.
const FRICTION: f64 = 0.75;

/// How objects are dropped.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PileOptions {
    /// Radius of the disc around the origin over which the objects' centres are dropped, metres.
    pub radius: f64,
    /// Objects whose centre gets further than this from the origin are removed, metres.
    pub reach: f64,
    /// Fraction of the objects that start upright (their z axis up, rotated about it); the others start in any orientation.
    pub upright: f64,
    /// Fraction of the objects that are dropped at any place; the others are put at a free place (if one is found).
    pub stacked: f64,
}

impl Default for PileOptions {
    fn default() -> Self {
        PileOptions { radius: 0.18, reach: 0.31, upright: 0.5, stacked: 0.4 }
    }
}

impl PileOptions {
    /// Tests every field.
    ///
    /// # Errors
    /// [`SimulationError::Option`].
    pub fn check(&self) -> Result<(), SimulationError> {
        check_ranges(&[
            ("radius", self.radius, 0.0, 0.8, "0 to 0.8 m"),
            ("reach", self.reach, self.radius.max(0.01), 0.9, "from radius to 0.9 m"),
            ("upright", self.upright, 0.0, 1.0, "a fraction from 0 to 1"),
            ("stacked", self.stacked, 0.0, 1.0, "a fraction from 0 to 1"),
        ])
    }
}

/// An object with its precomputed sizes before it is dropped.
struct Dropped {
    number: usize,
    upright: bool,
    parts: ConvexParts,
    rotation: UnitQuaternion<f64>,
    /// Centre of its bounding box in its own frame, and the largest distance of a vertex from there.
    centre: Vec3,
    radius: f64,
    /// Largest distance of a vertex from the vertical axis through the centre, in its initial rotation.
    width: f64,
    /// Depth of the lowest vertex below the centre, in its initial rotation.
    below: f64,
}

impl Dropped {
    fn new(number: usize, parts: &ConvexParts, upright: bool, rotation: UnitQuaternion<f64>) -> Self {
        let parts = parts.thinned(CORNERS);
        let corners = || parts.parts().iter().flatten();
        let low = corners().fold(Vec3::repeat(f64::INFINITY), |low, c| low.inf(c));
        let high = corners().fold(Vec3::repeat(f64::NEG_INFINITY), |high, c| high.sup(c));
        let centre = (low + high) * 0.5;
        let radius = corners().map(|c| (c - centre).norm()).fold(0.0, f64::max);
        let rotated = || corners().map(|c| rotation * (c - centre));
        let width = rotated().map(|c| c.xy().norm()).fold(0.0, f64::max);
        let below = rotated().map(|c| -c.z).fold(0.0, f64::max);
        Dropped { number, upright, parts, rotation, centre, radius, width, below }
    }

    /// Its pose when its centre is at `place` in the world.
    fn at(&self, place: &Vec3) -> Pose {
        Pose::new(self.rotation, place - self.rotation * self.centre)
    }
}

/// Drops objects on the plane z = 0 and lets them come to rest: world_from_object for each, metres; `None` for objects that rolled
/// or fell out of reach, or do not rest within four seconds (for all, if `options` are invalid).
///
/// Objects are released where they touch nothing, upright ones 2 mm above the table, others above those below them. The result is a
/// deterministic function of the arguments.
pub fn drop_objects(
    parts: &[&ConvexParts],
    options: &PileOptions,
    seed: u64,
    number: u64,
) -> Vec<Option<Pose>> {
    let mut poses = vec![None; parts.len()];
    if options.check().is_err() {
        return poses;
    }
    let mut random = stream(seed, number);
    let mut objects: Vec<Dropped> = vec![];
    for (number, parts) in parts.iter().enumerate() {
        let upright = random.random::<f64>() < options.upright;
        let turn = if upright { yaw(&mut random) } else { any_turn(&mut random) };
        objects.push(Dropped::new(number, parts, upright, turn));
    }
    // Upright objects are placed first, before others take their space.
    objects.sort_by_key(|o| !o.upright);
    let mut world = world(STEP, 60.0, 0.8);
    let mut placed: Vec<(Vec3, f64, f64)> = vec![];
    let mut falling: Vec<(RigidBodyHandle, &Dropped)> = vec![];
    for object in &objects {
        let place = choose_place(object, &placed, options, &mut random);
        placed.push((place, object.radius, object.width));
        let (body, collider) = insert_object(&mut world, &object.parts, &object.at(&place), 0.2, 3.0);
        if let Some(collider) = world.colliders.get_mut(collider) {
            collider.set_friction(FRICTION as f32);
        }
        falling.push((body, object));
    }
    let mut last: Vec<Option<Pose>> = vec![None; parts.len()];
    for iteration in 0..PATIENCE.1 {
        for _ in 0..STEPS {
            world.step();
        }
        let mut all_rest = true;
        let mut kept = vec![];
        for (body, object) in falling {
            let pose = body_pose(&world, body);
            let centre = pose.transform_point(&object.centre);
            let rests = last[object.number]
                .is_some_and(|l| l.distance_to(&pose) < REST.0 && l.rotation_angle_to(&pose) < REST.1);
            last[object.number] = Some(pose);
            // `!(a < b)` also removes objects whose position is NaN.
            let away = !(centre.xy().norm() < options.reach) || centre.z < 0.0;
            if away || (!rests && iteration == PATIENCE.0) {
                world.remove_body(body);
                all_rest = false;
                continue;
            }
            all_rest &= rests;
            poses[object.number] = rests.then_some(pose);
            kept.push((body, object));
        }
        falling = kept;
        if all_rest {
            break;
        }
    }
    for (number, pose) in poses.iter_mut().enumerate() {
        if !falling.iter().any(|(_, o)| o.number == number) {
            *pose = None;
        }
    }
    poses
}

/// Where an object's centre starts: a free place on the table if it needs one and one is found, otherwise above the objects already
/// there.
fn choose_place(
    object: &Dropped,
    placed: &[(Vec3, f64, f64)],
    options: &PileOptions,
    random: &mut impl Rng,
) -> Vec3 {
    let free_wanted = object.upright || random.random::<f64>() >= options.stacked;
    let on_table = object.below + HEIGHT;
    let mut best = (f64::INFINITY, Vec3::zeros());
    for _ in 0..if free_wanted { 40 } else { 1 } {
        let (angle, r) = (TAU * random.random::<f64>(), options.radius * random.random::<f64>().sqrt());
        let spot = Vec3::new(r * angle.cos(), r * angle.sin(), on_table);
        let mut height = on_table;
        for (other, radius, width) in placed {
            let apart = (other.xy() - spot.xy()).norm();
            let (reach, near) = (object.radius + radius + HEIGHT, object.width + width + HEIGHT);
            // Side by side: with their widths as rotated; one above the other: with their bounding spheres.
            if apart < near {
                height = height.max(other.z + (reach * reach - apart * apart).max(0.0).sqrt());
            }
        }
        if height < best.0 {
            best = (height, Vec3::new(spot.x, spot.y, height));
        }
        if height <= on_table {
            break;
        }
    }
    best.1
}

fn yaw(random: &mut impl Rng) -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vec3::z_axis(), TAU * random.random::<f64>())
}

/// A uniformly random rotation (Shoemake 1992, "Uniform random rotations").
fn any_turn(random: &mut impl Rng) -> UnitQuaternion<f64> {
    let [u, v, w] = [random.random::<f64>(), random.random(), random.random()];
    let (a, b) = ((1.0 - u).sqrt(), u.sqrt());
    let ((sv, cv), (sw, cw)) = ((TAU * v).sin_cos(), (TAU * w).sin_cos());
    UnitQuaternion::from_quaternion(Quaternion::new(b * cw, a * sv, a * cv, b * sw))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::to_engine;
    use rapier3d::parry::query::contact;
    use sixfold_synth::primitives as shapes;

    fn objects() -> Vec<ConvexParts> {
        let mut list = vec![];
        for k in 0..4 {
            let size = 0.04 + 0.02 * f64::from(k);
            let cuboid = shapes::cuboid(Vec3::new(size, 0.7 * size, 1.4 * size)).unwrap();
            list.push(ConvexParts::of_convex(&cuboid).unwrap());
            let bowl = shapes::bowl(0.5 * size + 0.02, 0.8 * size, 0.004).unwrap();
            list.push(ConvexParts::of_convex(&bowl).unwrap());
        }
        list
    }

    /// Penetration of the deepest pair of parts, metres; negative is a gap of up to 3 mm.
    fn deepest(a: (&ConvexParts, &Pose), b: (&ConvexParts, &Pose)) -> Option<f64> {
        let (pa, pb) = (to_engine(a.1), to_engine(b.1));
        let mut worst: Option<f64> = None;
        for (_, x) in a.0.shapes() {
            for (_, y) in b.0.shapes() {
                // About once in a few hundred pairs the engine's query is wrong for one order of the two and right for the other.
                let there = contact(&pa, &*x, &pb, &*y, 0.003);
                let back = contact(&pb, &*y, &pa, &*x, 0.003);
                if let (Ok(Some(there)), Ok(Some(back))) = (there, back) {
                    let depth = -f64::from(there.dist.max(back.dist));
                    worst = Some(worst.map_or(depth, |w: f64| w.max(depth)));
                }
            }
        }
        worst
    }

    #[test]
    fn objects_rest_on_the_plane_or_on_one_another() {
        let objects = objects();
        let parts: Vec<&ConvexParts> = objects.iter().collect();
        let heap = PileOptions { radius: 0.06, stacked: 1.0, ..PileOptions::default() };
        let (mut resting, mut dropped, mut stacked) = (0, 0, 0);
        for number in 0..16 {
            let options = if number < 8 { PileOptions::default() } else { heap };
            let poses = drop_objects(&parts, &options, 7, number);
            assert_eq!(poses.len(), parts.len());
            let there: Vec<(&ConvexParts, Pose)> =
                parts.iter().zip(&poses).filter_map(|(p, pose)| Some((*p, (*pose)?))).collect();
            dropped += poses.len();
            resting += there.len();
            for (i, (part, pose)) in there.iter().enumerate() {
                let corners = part.parts().iter().flatten().map(|c| pose.transform_point(c));
                let lowest = corners.map(|c| c.z).fold(f64::INFINITY, f64::min);
                assert!(lowest > -0.003, "{number} {i}: {lowest}");
                let others = there.iter().enumerate().filter(|(j, _)| *j != i);
                let touch: Vec<f64> =
                    others.filter_map(|(_, (q, other))| deepest((part, pose), (q, other))).collect();
                assert!(touch.iter().all(|depth| *depth < 0.003), "{number} {i}: {touch:?}");
                assert!(lowest < 0.003 || !touch.is_empty(), "{number} {i} floats at {lowest}");
                stacked += usize::from(lowest >= 0.003);
                assert!(pose.transform_point(&Vec3::zeros()).xy().norm() < 0.6);
            }
            assert_eq!(poses, drop_objects(&parts, &options, 7, number));
        }
        assert!(resting * 10 > dropped * 8, "{resting} of {dropped}");
        assert!(stacked > 0);
        assert_ne!(drop_objects(&parts, &heap, 7, 0), drop_objects(&parts, &heap, 8, 0));
    }

    #[test]
    fn the_upright_ones_stand() {
        let objects = objects();
        let parts: Vec<&ConvexParts> = objects.iter().take(5).collect();
        let standing = |upright: f64| -> usize {
            let options = PileOptions { upright, stacked: 0.0, radius: 0.3, reach: 0.4 };
            (0..6)
                .flat_map(|number| drop_objects(&parts, &options, 1, number))
                .flatten()
                .filter(|pose| pose.transform_direction(&Vec3::z()).z > 0.99)
                .count()
        };
        let (all, none) = (standing(1.0), standing(0.0));
        assert!(all >= 27, "{all} of 30");
        assert!(none < 20, "{none} of 30");
    }

    #[test]
    fn options_are_checked() {
        let bad = PileOptions { upright: 1.5, ..PileOptions::default() };
        let error = bad.check().unwrap_err().to_string();
        assert!(error.contains("upright") && error.contains("1.5"), "{error}");
        let bad = PileOptions { reach: 0.1, radius: 0.2, ..PileOptions::default() };
        assert!(bad.check().unwrap_err().to_string().contains("reach"));
        let cube = ConvexParts::of_convex(&shapes::cuboid(Vec3::repeat(0.05)).unwrap()).unwrap();
        assert_eq!(drop_objects(&[&cube], &bad, 0, 0), [None]);
        assert!(drop_objects(&[], &PileOptions::default(), 0, 0).is_empty());
    }

    /// `cargo test --release -- --ignored --nocapture time_of_a_pile` prints the time for eight detailed objects.
    #[test]
    #[ignore = "a measurement"]
    fn time_of_a_pile() {
        let meshes: Vec<_> = (0..8)
            .map(|k| shapes::bowl(0.05 + 0.004 * f64::from(k), 0.07, 0.004).unwrap().surfels())
            .collect();
        let objects: Vec<ConvexParts> =
            meshes.iter().flatten().map(|m| ConvexParts::of_convex(m).unwrap()).collect();
        let parts: Vec<&ConvexParts> = objects.iter().collect();
        let start = std::time::Instant::now();
        for number in 0..20 {
            drop_objects(&parts, &PileOptions::default(), 0, number);
        }
        let corners = parts[0].parts()[0].len();
        println!(
            "{:.3} s a pile of {}, {corners} corners",
            start.elapsed().as_secs_f64() / 20.0,
            parts.len()
        );
    }
}
