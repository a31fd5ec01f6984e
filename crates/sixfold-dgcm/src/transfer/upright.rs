//! Locates an experience on an upright object by its shape: rotated about the vertical, moved over the table and stretched until
//! each view explains the other ([`super::fit`]). This goes beyond the dissertation: the network's coordinates locate large parts,
//! but a handle has only a few pixels.

use std::f64::consts::TAU;

use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};
use sixfold_geometry::{Pose, Vec3};

use super::fit::Shape;

/// Rotations about the vertical in the first search.
const TURNS: usize = 20;
/// Scale factors along the table that are tried first.
const STRETCHES: [f64; 3] = [0.76, 1.0, 1.3];
/// Largest shift of an object in the first search, in steps of a centimetre.
const MOVES: i64 = 3;
/// Number of results of the first search that are refined.
const CLOSER: usize = 8;
/// Alignments rotated by less than this are the same, radians.
const SAME: f64 = 0.6;
/// Penalty of a rotation by 180 degrees, so that for a round object the same side is chosen.
const PENALTY_180: f64 = 0.01;

/// The alignment of an experience's upright object.
#[derive(Debug, Clone, Copy)]
pub(super) struct Upright {
    /// Rotation about the vertical, radians.
    pub yaw: f64,
    /// Scale factors along the table and along the vertical.
    pub stretch: [f64; 2],
    /// Translation on the table, metres.
    pub shift: Vec3,
    /// How well each view explains the other, 0 to 1.
    pub fit: f64,
}

impl Upright {
    /// Maps a point of the experience's table frame to that of the current view.
    pub(crate) fn map(&self, p: &Vec3) -> Vec3 {
        let (sin, cos) = self.yaw.sin_cos();
        let (x, y) = (p.x * self.stretch[0], p.y * self.stretch[0]);
        Vec3::new(cos * x - sin * y, sin * x + cos * y, p.z * self.stretch[1]) + self.shift
    }

    fn back(&self, p: &Vec3) -> Vec3 {
        let (sin, cos) = self.yaw.sin_cos();
        let p = p - self.shift;
        let (x, y) = (cos * p.x + sin * p.y, -sin * p.x + cos * p.y);
        Vec3::new(x / self.stretch[0], y / self.stretch[0], p.z / self.stretch[1])
    }

    /// The rotation from the experience's camera to the current one's.
    pub(crate) fn rotation(&self, there: &Shape, here: &Shape) -> Pose {
        let turn = Pose::new(UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.yaw), Vec3::zeros());
        let whole = here.table_from_camera.inverse() * turn * there.table_from_camera;
        whole.with_translation(Vec3::zeros())
    }

    /// Maps a point of the experience's camera frame to the current camera frame.
    pub(crate) fn map_camera(&self, p: &Vec3, there: &Shape, here: &Shape) -> Vec3 {
        let p = self.map(&there.table_from_camera.transform_point(p));
        here.table_from_camera.inverse().transform_point(&p)
    }

    fn judge(&mut self, pair: &Pair<'_>) {
        let explained = |points: &[Vec3], telling: &[f64]| {
            let all: f64 = points.iter().zip(telling).map(|(p, w)| w * pair.here.at(&self.map(p))).sum();
            all / telling.iter().sum::<f64>().max(1e-9)
        };
        let mut first = explained(&pair.there.points, &pair.telling_there);
        if !pair.held.is_empty() {
            let held: f64 = pair.held.iter().map(|p| pair.here.at(&self.map(p))).sum();
            first = 0.5 * (first + held / pair.held.len() as f64);
        }
        let here = pair.here.points.iter().zip(&pair.telling_here);
        let back: f64 = here.map(|(p, w)| w * pair.there.at(&self.back(p))).sum();
        let second = back / pair.telling_here.iter().sum::<f64>().max(1e-9);
        self.fit = 0.5 * (first + second) - 0.5 * PENALTY_180 * (1.0 - self.yaw.cos());
    }
}

/// Two views to compare.
struct Pair<'a> {
    here: &'a Shape,
    there: &'a Shape,
    held: &'a [Vec3],
    /// Weight of each point: how much it constrains the alignment.
    telling_here: Vec<f64>,
    telling_there: Vec<f64>,
}

impl Pair<'_> {
    /// Points that are explained at every rotation of the object get a low weight: those of a mug's wall, in contrast to those of
    /// its handle.
    fn weigh(&mut self, anywhere: &[Upright]) {
        let telling = |value: f64| (1.0 - value / anywhere.len().max(1) as f64).max(0.05).powi(2);
        let here = self.here.points.iter();
        self.telling_here =
            here.map(|p| telling(anywhere.iter().map(|u| self.there.at(&u.back(p))).sum())).collect();
        let there = self.there.points.iter();
        self.telling_there =
            there.map(|p| telling(anywhere.iter().map(|u| self.here.at(&u.map(p))).sum())).collect();
    }
}

/// Up to two alignments of an experience's object, best first; `held` are the held points, in the experience's table frame. Empty
/// if either table is unknown.
pub(super) fn upright(here: &Shape, there: &Shape, held: &[Vec3]) -> Vec<Upright> {
    if !(here.stands && there.stands && here.height > 0.005 && there.height > 0.005) {
        return vec![];
    }
    let up = (here.height / there.height).clamp(0.5, 2.0);
    let centre = Shape::centre(here.points.iter().copied());
    let few: Vec<Vec3> = there.points.iter().step_by(3).copied().collect();
    let few_held: Vec<Vec3> = held.iter().step_by(2).copied().collect();
    let ones = |shape: &Shape| vec![1.0; shape.points.len()];
    let mut pair = Pair { here, there, held: &[], telling_here: ones(here), telling_there: ones(there) };
    let mut first: Vec<Upright> = vec![];
    for k in 0..TURNS {
        let yaw = TAU * k as f64 / TURNS as f64;
        for stretch in STRETCHES {
            let mut tried = Upright { yaw, stretch: [stretch, up], shift: Vec3::zeros(), fit: 0.0 };
            let moved: Vec<Vec3> = few.iter().map(|p| tried.map(p)).collect();
            let held: Vec<Vec3> = few_held.iter().map(|p| tried.map(p)).collect();
            let start = centre - Shape::centre(moved.iter().copied());
            let mut best = (f64::MIN, start);
            for (x, y) in (-MOVES..=MOVES).flat_map(|y| (-MOVES..=MOVES).map(move |x| (x, y))) {
                let shift = start + Vec3::new(x as f64, y as f64, 0.0) * 0.01;
                let sum = |points: &[Vec3]| {
                    points.iter().map(|p| here.at(&(p + shift))).sum::<f64>() / points.len().max(1) as f64
                };
                let value = sum(&moved) + sum(&held);
                if value > best.0 {
                    best = (value, shift);
                }
            }
            tried.shift = best.1;
            tried.judge(&pair);
            first.push(tried);
        }
    }
    first.sort_by(|a, b| b.fit.total_cmp(&a.fit));
    // The best of every rotation, sorted.
    let mut starts: Vec<Upright> = vec![];
    for tried in first {
        if starts.iter().all(|s| s.yaw != tried.yaw) {
            starts.push(tried);
        }
    }
    pair.held = held;
    pair.weigh(&starts);
    starts.iter_mut().for_each(|tried| tried.judge(&pair));
    starts.sort_by(|a, b| b.fit.total_cmp(&a.fit));
    starts.truncate(CLOSER);
    for (size, count) in [(1.0, CLOSER), (0.5, CLOSER / 2), (0.25, CLOSER / 2)] {
        starts.truncate(count);
        starts.iter_mut().for_each(|tried| climb(tried, size, &pair));
        starts.sort_by(|a, b| b.fit.total_cmp(&a.fit));
    }
    starts.sort_by(|a, b| b.fit.total_cmp(&a.fit));
    let mut found: Vec<Upright> = vec![];
    for tried in starts {
        let apart = |f: &Upright| (f.yaw - tried.yaw).cos() < SAME.cos();
        if found.len() < 2 && found.iter().all(apart) {
            found.push(tried);
        }
    }
    found
}

/// Hill climbing with steps of one size while they improve the fit.
fn climb(best: &mut Upright, size: f64, pair: &Pair<'_>) {
    for _ in 0..4 {
        let before = best.fit;
        for (axis, sign) in (0..4).flat_map(|axis| [-1.0, 1.0].map(|sign| (axis, sign * size))) {
            let mut tried = *best;
            match axis {
                0 => tried.yaw += 0.13 * sign,
                1 => tried.shift.x += 0.005 * sign,
                2 => tried.shift.y += 0.005 * sign,
                _ => tried.stretch[0] *= (0.08 * sign).exp(),
            }
            tried.judge(pair);
            if tried.fit > best.fit {
                *best = tried;
            }
        }
        if best.fit <= before + 1e-3 {
            break;
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use sixfold_geometry::{Camera, Mask, Mat3, Plane};
    use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};
    use sixfold_synth::shapes::{Family, Member, member};

    use super::*;
    use sixfold_experience::{Crop, CropOptions};

    /// A synthetic object on a table, 0.7 m from a camera that looks down at 40 degrees.
    struct Seen {
        member: Member,
        crop: Crop,
        camera_from_object: Pose,
    }

    fn seen(family: Family, seed: u64, yaw: f64) -> Seen {
        let member = member(family, &mut ChaCha8Rng::seed_from_u64(seed)).unwrap();
        let camera = Camera::new(575.0, 575.0, 319.5, 239.5, 640, 480).unwrap();
        let (sin, cos) = (-40f64.to_radians()).sin_cos();
        let z = Vec3::new(0.0, cos, sin);
        let axes = Mat3::from_columns(&[Vec3::x(), z.cross(&Vec3::x()), z]);
        let camera_from_world = Pose::from_parts(&axes, -z * 0.7).unwrap().inverse();
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        let camera_from_object = camera_from_world * Pose::new(turn, Vec3::zeros());
        let mut frame = VisibilityBuffer::new(&camera);
        frame.render(&[SceneObject { mesh: &member.mesh, camera_from_object }], &RenderOptions::default());
        let depth = frame.depth();
        let mask = Mask::from_fn(640, 480, |x, y| depth[(x, y)] > 0.0);
        let crop = Crop::new(&depth, &camera, &mask, &CropOptions::compact()).unwrap();
        let normal = camera_from_world.transform_direction(&Vec3::z());
        let offset = normal.dot(&camera_from_world.transform_point(&Vec3::zeros()));
        Seen { member, crop: Crop { table: Some(Plane { normal, offset }), ..crop }, camera_from_object }
    }

    impl Seen {
        fn part_at(&self, p: &Vec3) -> &'static str {
            self.member.part_at(&self.camera_from_object.inverse().transform_point(p))
        }
    }

    /// The best alignment of one view's handle with another view, and the fraction of it that is on the handle there.
    fn handle_found(here: &Seen, there: &Seen) -> (Upright, f64) {
        let on_handle: Vec<Vec3> = there
            .crop
            .pixels()
            .map(|i| there.crop.point(i))
            .filter(|p| there.part_at(p) == "handle")
            .collect();
        assert!(on_handle.len() > 40, "the handle is seen: {}", on_handle.len());
        let shapes = [&here.crop, &there.crop].map(Shape::new);
        let held: Vec<Vec3> =
            on_handle.iter().map(|p| shapes[1].table_from_camera.transform_point(p)).collect();
        let best = upright(&shapes[0], &shapes[1], &held)[0];
        let mapped = on_handle.iter().map(|p| best.map_camera(p, &shapes[1], &shapes[0]));
        let right = mapped.filter(|p| here.part_at(p) == "handle").count();
        (best, right as f64 / on_handle.len() as f64)
    }

    #[test]
    fn a_handle_is_found_on_another_mug_wherever_it_points() {
        // The handles point to both sides and towards the camera; pointing away they would be hidden.
        for (k, (there, here)) in
            [(0.2, -1.2), (-2.8, -0.4), (-1.4, 0.1), (-0.5, -2.7)].into_iter().enumerate()
        {
            let k = k as u64;
            let (best, right) =
                handle_found(&seen(Family::Mug, 20 + k, here), &seen(Family::Mug, 30 + k, there));
            assert!(right > 0.7, "{there} to {here}: {right} of the handle, {best:?}");
            let off = (best.yaw - (here - there)).sin().abs();
            assert!(off < 0.35, "{there} to {here}: {best:?}");
        }
        let (_, right) = handle_found(&seen(Family::Drill, 1, 1.0), &seen(Family::Drill, 2, -0.6));
        assert!(right > 0.7, "{right} of the drill's handle");
    }

    #[test]
    fn of_a_round_thing_the_same_side_is_taken() {
        // Some synthetic cans are oval.
        let is_round = |s: &Seen| {
            let of = |k: usize| s.member.mesh.vertices().iter().map(|p| p[k]).fold(f64::MIN, f64::max);
            (of(0) - of(1)).abs() < 1e-4
        };
        let mut round = (0..40).map(|seed| seen(Family::Can, seed, 0.4 + seed as f64)).filter(is_round);
        let shapes = [(); 2].map(|()| Shape::new(&round.next().unwrap().crop));
        let best = upright(&shapes[0], &shapes[1], &[])[0];
        assert!(best.yaw.cos() > 0.9 && best.fit > 0.7, "{best:?}");
        // Mapping there and back gives the same point.
        let p = Vec3::new(0.03, -0.02, 0.05);
        assert!((best.back(&best.map(&p)) - p).norm() < 1e-12);
        // The mapped height is that of the other object.
        let top = best.map(&Vec3::new(0.0, 0.0, shapes[1].height)).z;
        assert!((top - shapes[0].height).abs() < 0.002, "{top}");
    }

    #[test]
    fn a_rotation_goes_along_with_its_points() {
        let [here, there] =
            [(1, 0.3), (2, 1.5)].map(|(seed, yaw)| Shape::new(&seen(Family::Mug, seed, yaw).crop));
        let moved = Upright { yaw: 0.7, stretch: [1.0; 2], shift: Vec3::new(0.1, 0.2, 0.0), fit: 0.0 };
        let rotation = moved.rotation(&there, &here);
        for (p, q) in [(Vec3::x(), Vec3::y()), (Vec3::z(), Vec3::new(0.1, -0.4, 0.3))] {
            let apart = moved.map_camera(&p, &there, &here) - moved.map_camera(&q, &there, &here);
            assert!((apart - rotation.transform_direction(&(p - q))).norm() < 1e-9, "{apart}");
        }
    }

    #[test]
    fn a_handle_determines_the_yaw_better_than_the_wall() {
        let mug = seen(Family::Mug, 31, -0.3);
        let shape = Shape::new(&mug.crop);
        let ones = || vec![1.0; shape.points.len()];
        let mut pair =
            Pair { here: &shape, there: &shape, held: &[], telling_here: ones(), telling_there: ones() };
        // Rotated about the mug's own axis.
        let axis = shape.table_from_camera.transform_point(&mug.camera_from_object.translation());
        let anywhere: Vec<Upright> = (0..TURNS)
            .map(|k| {
                let yaw = TAU * k as f64 / TURNS as f64;
                let mut rotated = Upright { yaw, stretch: [1.0; 2], shift: Vec3::zeros(), fit: 0.0 };
                rotated.shift = axis - rotated.map(&axis);
                rotated
            })
            .collect();
        pair.weigh(&anywhere);
        let camera_from_table = shape.table_from_camera.inverse();
        for telling in [&pair.telling_here, &pair.telling_there] {
            let mean = |part: &str| {
                let of = |p: &Vec3| mug.part_at(&camera_from_table.transform_point(p)) == part;
                let some: Vec<f64> =
                    shape.points.iter().zip(telling).filter(|(p, _)| of(p)).map(|(_, w)| *w).collect();
                assert!(some.len() > 10, "{part}: {}", some.len());
                some.iter().sum::<f64>() / some.len() as f64
            };
            assert!(mean("handle") > 1.5 * mean("body"), "{} {}", mean("handle"), mean("body"));
        }
    }

    #[test]
    fn without_a_table_nothing_is_said() {
        let [a, b] = [1, 2].map(|seed| seen(Family::Mug, seed, 0.0));
        let without_table = Crop { table: None, ..b.crop.clone() };
        assert!(upright(&Shape::new(&a.crop), &Shape::new(&without_table), &[]).is_empty());
        assert!(upright(&Shape::new(&without_table), &Shape::new(&a.crop), &[]).is_empty());
        assert!(!upright(&Shape::new(&b.crop), &Shape::new(&a.crop), &[]).is_empty());
    }
}
