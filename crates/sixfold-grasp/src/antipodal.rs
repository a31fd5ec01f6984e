//! The geometric planner: two contacts whose normals face away from each other, sampled on the cloud of one view.
//!
//! Friction holds an object between two contacts when the line between them is inside both friction cones (Nguyen 1988,
//! "Constructing force-closure grasps"; for points with normals Chen and Burdick 1993). As in Ten Pas et al. 2017 ("Grasp pose
//! detection in point clouds") a contact is sampled from the cloud, the closing direction from its normal or a second contact, and
//! the approach from the directions around it. Unlike there, no network scores the result, so this is not GPD but the antipodal
//! planner whose grasps GPD filters. The robot's arm is not considered: grasps that it cannot reach are included.

use std::f64::consts::FRAC_PI_2;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use sixfold_geometry::random::stream;
use sixfold_geometry::{KdTree, Pose, Vec3};
use thiserror::Error;

use crate::completion::assume_walls;
use crate::{
    AntipodalQuality, CollisionScene, CompletedObject, CompletionOptions, Grasp, GraspView, Gripper,
    complete_by_mirrors, gripper_pose,
};

/// An option out of range.
#[derive(Debug, Error, Clone, PartialEq)]
#[error("option {field}: found {found}, expected {expected}")]
pub struct OptionsError {
    /// Name of the field.
    pub field: &'static str,
    /// Its value.
    pub found: f64,
    /// The values allowed.
    pub expected: &'static str,
}

/// How the planner samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AntipodalOptions {
    /// First contacts sampled in one round.
    pub samples: usize,
    /// Maximum number of rounds; a further round starts while fewer than `enough` grasps were found.
    pub rounds: usize,
    /// See `rounds`.
    pub enough: usize,
    /// Closing directions per contact: against its normal, and towards sampled second contacts.
    pub closings: usize,
    /// Approach directions around each closing direction, over 180 degrees about the one from above.
    pub approaches: usize,
    /// Clearance between the object and each pad during the approach, metres.
    pub clearance: f64,
    /// Additional clearance where a contact is assumed and not seen (half of it if the full one does not fit), metres: an object is
    /// seldom as symmetric as it appears.
    pub contact_clearance: f64,
    /// Points within this distance of the outermost ones belong to the contact, metres.
    pub contact_depth: f64,
    /// Largest angle of the approach from straight down, radians. Without a table: from the viewing direction.
    pub max_tilt: f64,
    /// Complete the unseen side by symmetry and, if that gives no grasp, by walls below the outline.
    pub completion: Option<CompletionOptions>,
    /// Seed of the samples.
    pub seed: u64,
}

impl Default for AntipodalOptions {
    fn default() -> Self {
        AntipodalOptions {
            samples: 400,
            rounds: 4,
            enough: 25,
            closings: 3,
            approaches: 7,
            clearance: 0.012,
            contact_clearance: 0.015,
            contact_depth: 0.004,
            max_tilt: FRAC_PI_2,
            completion: Some(CompletionOptions::default()),
            seed: 0,
        }
    }
}

impl AntipodalOptions {
    /// Tests every field.
    ///
    /// # Errors
    /// [`OptionsError`], naming the first field out of range.
    pub fn check(&self) -> Result<(), OptionsError> {
        for (field, found) in [
            ("samples", self.samples),
            ("rounds", self.rounds),
            ("closings", self.closings),
            ("approaches", self.approaches),
        ] {
            if !(1..=1_000_000).contains(&found) {
                return Err(OptionsError { field, found: found as f64, expected: "1 to 1000000" });
            }
        }
        for (field, found, low, high, expected) in [
            ("clearance", self.clearance, 0.0, 0.1, "0 to 0.1 m"),
            ("doubt", self.contact_clearance, 0.0, 0.1, "0 to 0.1 m"),
            ("contact_depth", self.contact_depth, 1e-4, 0.05, "0.0001 to 0.05 m"),
            ("max_tilt", self.max_tilt, 0.0, std::f64::consts::PI, "0 to pi radians"),
        ] {
            if !(found >= low && found <= high) {
                return Err(OptionsError { field, found, expected });
            }
        }
        Ok(())
    }
}

/// Proposes grasps on the object of a view, in the order of their samples. Every grasp is free of collisions with the cloud, the
/// assumed points and the table, and both its contacts are inside their friction cones. The same seed gives the same grasps at any
/// number of threads.
///
/// # Errors
/// [`OptionsError`].
pub fn antipodal_grasps(
    view: &GraspView,
    gripper: &Gripper,
    options: &AntipodalOptions,
) -> Result<Vec<Grasp>, OptionsError> {
    options.check()?;
    let seen = || CompletedObject { cloud: view.object.clone(), observed: view.object.len(), planes: vec![] };
    let Some(completion) = &options.completion else {
        return Ok(search(view, gripper, seen(), options));
    };
    let mut object = complete_by_mirrors(view, completion);
    let grasps = search(view, gripper, object.clone(), options);
    if !grasps.is_empty() {
        return Ok(grasps);
    }
    assume_walls(view, &mut object, completion);
    Ok(search(view, gripper, object, options))
}

/// Rounds of samples on a cloud.
fn search(
    view: &GraspView,
    gripper: &Gripper,
    object: CompletedObject,
    options: &AntipodalOptions,
) -> Vec<Grasp> {
    if object.cloud.is_empty() || object.cloud.normals.len() != object.cloud.len() {
        return vec![];
    }
    let planner = Planner::new(view, gripper, object, options);
    let mut grasps = vec![];
    for round in 0..options.rounds {
        if round > 0 && grasps.len() >= options.enough {
            break;
        }
        let samples = round * options.samples..(round + 1) * options.samples;
        let found: Vec<Vec<Grasp>> = samples
            .into_par_iter()
            .map(|sample| {
                let mut random = stream(options.seed, sample as u64);
                planner.sample(&mut random)
            })
            .collect();
        grasps.extend(found.into_iter().flatten());
    }
    grasps
}

/// Assumed thickness of objects behind their visible surface in the collision test of the palm, metres.
pub(crate) const THICKNESS: f64 = 0.02;

pub(crate) struct Planner<'a> {
    pub gripper: &'a Gripper,
    pub options: &'a AntipodalOptions,
    /// The downward direction, from which the tilt of an approach is measured.
    pub down: Vec3,
    pub centre: Vec3,
    pub object: CompletedObject,
    pub tree: KdTree,
    pub scene: CollisionScene,
    /// Half angle of the friction cone, radians.
    pub cone: f64,
    /// Spacing of the points, metres: each represents its square of surface area.
    pub step: f64,
    /// Whether no point is more than 3 cm above the table.
    flat: bool,
}

impl<'a> Planner<'a> {
    pub(crate) fn new(
        view: &GraspView,
        gripper: &'a Gripper,
        object: CompletedObject,
        options: &'a AntipodalOptions,
    ) -> Planner<'a> {
        Planner {
            gripper,
            options,
            down: view.table.map_or_else(Vec3::z, |t| -t.normal),
            centre: object.cloud.centroid().unwrap_or_else(Vec3::zeros),
            tree: KdTree::new(&object.cloud.points),
            scene: CollisionScene::new(&[&object.cloud, &view.obstacles], view.table)
                .with_thickness(&view.object.points, THICKNESS),
            object,
            cone: gripper.friction.atan(),
            step: view.step,
            flat: view.table.is_some_and(|t| view.object.points.iter().all(|p| t.distance(p) < 0.03)),
        }
    }

    /// All grasps from one first contact.
    fn sample(&self, random: &mut ChaCha8Rng) -> Vec<Grasp> {
        let cloud = &self.object.cloud;
        let first = random.random_range(0..cloud.len());
        let (p, n) = (cloud.points[first], cloud.normals[first]);
        let mut grasps = vec![];
        for k in 0..self.options.closings {
            let closing = if k == 0 { Some(-n) } else { self.towards_partner(&p, &n, random) };
            let Some(closing) = closing else { continue };
            for width in self.widths(&p, &closing) {
                let centre = p + closing * (0.5 * width);
                for approach in self.approaches(&closing) {
                    grasps.extend(self.deepest(&centre, &closing, &approach, width));
                }
            }
        }
        grasps
    }

    /// The direction to a second contact sampled from the cloud, such that the line between the contacts is inside both friction
    /// cones. Half of the samples are from the neighbourhood, because walls and handles are thin.
    fn towards_partner(&self, p: &Vec3, n: &Vec3, random: &mut ChaCha8Rng) -> Option<Vec3> {
        const DRAWS: usize = 40;
        const NEIGHBOURHOOD: f64 = 0.02;
        let cloud = &self.object.cloud;
        let cosine = self.cone.cos();
        let mut near: Vec<usize> = self.tree.within(p, NEIGHBOURHOOD).iter().map(|n| n.index).collect();
        // Only points on the other side of a wall, whose normals face away.
        near.retain(|&i| cloud.normals[i].dot(n) < -0.5);
        (0..DRAWS).find_map(|k| {
            let i = if k % 2 == 0 && !near.is_empty() {
                near[random.random_range(0..near.len())]
            } else {
                random.random_range(0..cloud.len())
            };
            let way = cloud.points[i] - p;
            let length = way.norm();
            if length < 0.002 || length > self.gripper.max_opening {
                return None;
            }
            let closing = way / length;
            (-n.dot(&closing) > cosine && cloud.normals[i].dot(&closing) > cosine).then_some(closing)
        })
    }

    /// Distances along the closing direction of second contacts that face away, at most three.
    fn widths(&self, p: &Vec3, closing: &Vec3) -> Vec<f64> {
        const RADIUS: f64 = 0.005;
        const GAP: f64 = 0.006;
        let limit = self.gripper.max_opening - 0.004;
        let cloud = &self.object.cloud;
        let mut hits: Vec<f64> = cloud
            .points
            .iter()
            .zip(&cloud.normals)
            .filter_map(|(q, n)| {
                let d = q - p;
                let t = d.dot(closing);
                let near = t > 0.002 && t < limit && (d - closing * t).norm_squared() < RADIUS * RADIUS;
                (near && n.dot(closing) > self.cone.cos()).then_some(t)
            })
            .collect();
        hits.sort_by(f64::total_cmp);
        let mut widths: Vec<Vec<f64>> = vec![];
        for t in hits {
            match widths.last_mut() {
                Some(group) if t - group[group.len() - 1] < GAP => group.push(t),
                _ => widths.push(vec![t]),
            }
        }
        widths.iter().take(3).map(|group| group[group.len() / 2]).collect()
    }

    /// Approach directions perpendicular to the closing direction, those from above first.
    fn approaches(&self, closing: &Vec3) -> Vec<Vec3> {
        let steepest = (self.down - closing * self.down.dot(closing)).try_normalize(0.05);
        let start = steepest.unwrap_or_else(|| {
            let any = if closing.x.abs() < 0.8 { Vec3::x() } else { Vec3::y() };
            closing.cross(&any).normalize()
        });
        let side = closing.cross(&start);
        let n = self.options.approaches as i32;
        (0..n)
            .map(|k| {
                // 0, 1, -1, 2, -2, ... steps, over 180 degrees.
                let step = if k % 2 == 1 { (k + 1) / 2 } else { -(k / 2) };
                let angle = f64::from(step) * 2.0 * FRAC_PI_2 / f64::from(n.max(2) - 1);
                start * angle.cos() + side * angle.sin()
            })
            .filter(|a| a.dot(&self.down) >= self.options.max_tilt.cos() - 1e-9)
            .collect()
    }

    /// The grasp whose pads reach furthest over the object along an approach, if there is one.
    fn deepest(&self, centre: &Vec3, closing: &Vec3, approach: &Vec3, width: f64) -> Option<Grasp> {
        let length = self.gripper.finger_length;
        let opening = (width + 2.0 * self.options.clearance).min(self.gripper.max_opening);
        // The last one is for flat objects only: higher ones would be held only at their edge.
        const FRACTIONS: [f64; 5] = [0.9, 0.6, 0.35, 0.2, 0.1];
        let fractions = if self.flat { &FRACTIONS[..] } else { &FRACTIONS[..4] };
        fractions.iter().find_map(|fraction| {
            let tip = centre + approach * (fraction * length);
            let pose = gripper_pose(&tip, approach, closing)?;
            self.grasp(&pose, opening)
        })
    }

    /// The grasp at about this pose: moved along x so that the object is midway between the pads, with collision test and quality.
    pub(crate) fn grasp(&self, pose: &Pose, opening: f64) -> Option<Grasp> {
        if self.scene.hit(self.gripper, pose, opening).is_some() {
            return None;
        }
        let (low, high) = self.extent(&self.between(pose, opening))?;
        let width = high - low;
        let centred = *pose * Pose::from_translation(Vec3::new(0.5 * (low + high), 0.0, 0.0));
        let opening = (width + 2.0 * self.options.clearance).min(self.gripper.max_opening);
        if opening < width + 0.003 || self.scene.hit(self.gripper, &centred, opening).is_some() {
            return None;
        }
        let between = self.between(&centred, opening);
        let quality = self.judge(&between, &centred)?;
        let opening = if quality.observed < 0.9 { self.widened(&centred, opening, width) } else { opening };
        Some(Grasp { camera_from_gripper: centred, opening, width, quality })
    }

    /// The opening with additional clearance for errors of the assumed points, if the fingers are then free and nothing else is
    /// between them.
    fn widened(&self, pose: &Pose, opening: f64, width: f64) -> f64 {
        let wider = |fraction: f64| {
            (opening + 2.0 * fraction * self.options.contact_clearance).min(self.gripper.max_opening)
        };
        let fits = |wider: &f64| {
            let extent = self.extent(&self.between(pose, *wider));
            extent.is_some_and(|(low, high)| high - low < width + 0.002)
                && self.scene.hit(self.gripper, pose, *wider).is_none()
        };
        [1.0, 0.5].map(wider).into_iter().find(fits).unwrap_or(opening)
    }

    /// Points between the pads, in the gripper's frame: index and point.
    pub(crate) fn between(&self, pose: &Pose, opening: f64) -> Vec<(usize, Vec3)> {
        let rotation = pose.rotation_matrix().transpose();
        let origin = pose.translation();
        let (half_opening, half_width) = (0.5 * opening, 0.5 * self.gripper.finger_width);
        let length = self.gripper.finger_length;
        let reach = half_opening.max(half_width) + length;
        let points = self.object.cloud.points.iter().enumerate();
        points
            .filter_map(|(i, p)| {
                let d = p - origin;
                if d.norm_squared() > reach * reach {
                    return None;
                }
                let q = rotation * d;
                (q.x.abs() < half_opening && q.y.abs() < half_width && q.z < 0.0 && q.z > -length)
                    .then_some((i, q))
            })
            .collect()
    }

    /// Extent along x of the points between the pads, without the two outermost on each side.
    pub(crate) fn extent(&self, between: &[(usize, Vec3)]) -> Option<(f64, f64)> {
        if between.len() < 8 {
            return None;
        }
        let mut x: Vec<f64> = between.iter().map(|(_, q)| q.x).collect();
        x.sort_by(f64::total_cmp);
        Some((x[2], x[x.len() - 3]))
    }

    /// The quality of the contacts; `None` when one of them is outside its friction cone.
    fn judge(&self, between: &[(usize, Vec3)], pose: &Pose) -> Option<AntipodalQuality> {
        let (low, high) = self.extent(between)?;
        let closing = pose.transform_direction(&Vec3::x());
        // On a thin wall each pad touches only its own side.
        let depth = self.options.contact_depth.min(0.4 * (high - low));
        let mut angle = 0.0f64;
        let mut support = f64::INFINITY;
        let (mut seen, mut all) = (0usize, 0usize);
        for side in [-1.0, 1.0] {
            let edge = if side < 0.0 { low + depth } else { high - depth };
            let faces = |i: usize| self.object.cloud.normals[i].dot(&closing) * side > 0.0;
            let contact: Vec<usize> = between
                .iter()
                .filter(|(i, q)| (q.x - edge) * side >= 0.0 && faces(*i))
                .map(|(i, _)| *i)
                .collect();
            let sum: Vec3 = contact.iter().map(|&i| self.object.cloud.normals[i]).sum();
            let normal = sum.try_normalize(1e-9)?;
            angle = angle.max((normal.dot(&closing) * side).clamp(-1.0, 1.0).acos());
            let area = contact.len() as f64 * self.step * self.step;
            support = support.min(area / (0.5 * self.gripper.finger_width * 0.015));
            seen += contact.iter().filter(|&&i| i < self.object.observed).count();
            all += contact.len();
        }
        if angle > self.cone || all == 0 {
            return None;
        }
        let midpoint: Vec3 =
            between.iter().map(|(i, _)| self.object.cloud.points[*i]).sum::<Vec3>() / between.len() as f64;
        // The horizontal distance from the centre of the points between the pads to the vertical line through the object's centre,
        // without its component along the closing axis, which loads the friction of the pads with no torque.
        let lever = self.centre - midpoint;
        let lever = lever - self.down * lever.dot(&self.down);
        let across = lever - closing * lever.dot(&closing);
        Some(AntipodalQuality {
            alignment: (1.0 - angle / self.cone).clamp(0.0, 1.0),
            support: support.min(1.0),
            centring: (-across.norm() / 0.05).exp(),
            observed: seen as f64 / all as f64,
        })
    }
}
