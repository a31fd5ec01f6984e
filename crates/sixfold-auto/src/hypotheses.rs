//! Poses of all methods in one pool: compared with the image, merged if they are the same, and compared with each other.

use rayon::prelude::*;
use serde_json::{Map, Value, json};
use sixfold_align::evidence::{EvidenceCollector, Scene, Shape};
use sixfold_align::{Evidence, VerificationOptions, Verifier, align_to_depth, refine};
use sixfold_estimator::{Need, PoseEstimate, PoseEstimator};
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::Mesh;

use crate::calibration::Calibration;
use crate::lookalikes::LookAlikes;
use crate::numbers::{NAMES, Numbers, Reported, add_others, of_evidence, strength};

/// Poses whose points are less than this fraction of the diameter apart are the same; [`SAME_BY_COLOR`] for methods on colour
/// alone, which have larger errors along the view axis. Chosen by hand; not swept.
const SAME: f64 = 0.1;
/// See [`SAME`].
const SAME_BY_COLOR: f64 = 0.2;
/// A pose is right if no point is farther from its true position, diameters.
const RIGHT: f64 = 0.1;
/// Poses that share more than this fraction of the smaller one's pixels are at the same place; chosen by hand, not swept.
const ONE_PLACE: f64 = 0.5;

/// A pose with its evidence and probability.
#[derive(Debug, Clone)]
pub struct Hypothesis {
    /// The method that found it.
    pub method: &'static str,
    /// All methods that found it.
    pub found_by: Vec<&'static str>,
    /// The method's estimate, with the pose after any refinement here.
    pub estimate: PoseEstimate,
    /// Agreement with the image.
    pub evidence: Evidence,
    /// The evidence and the comparison with other poses, as numbers.
    pub numbers: Numbers,
    /// Probability that the pose is right.
    pub probability: f64,
    strength: f64,
}

/// A pool of hypotheses for one object in one image.
pub(crate) struct Pool<'a> {
    pub scene: Scene<'a>,
    pub shape: Shape<'a>,
    pub diameter: f64,
    pub symmetries: &'a [Pose],
    /// Rotations that depth alone cannot distinguish.
    pub look_alikes: &'a LookAlikes,
    pub calibration: &'a Calibration,
    pub one_instance: bool,
    pub hypotheses: Vec<Hypothesis>,
    pub asked: usize,
}

impl Pool<'_> {
    /// Adds the poses that a method found, and recomputes all probabilities.
    pub(crate) fn add(&mut self, method: &dyn PoseEstimator, found: Vec<PoseEstimate>) {
        self.asked += 1;
        let by_depth = method.needs().depth != Need::Unused;
        let (scene, shape, diameter) = (&self.scene, &self.shape, self.diameter);
        let (look_alikes, one_instance) = (self.look_alikes, self.one_instance);
        let options = VerificationOptions::default();
        let with_alternatives = |mut estimate: PoseEstimate| {
            let alternatives = std::mem::take(&mut estimate.alternatives);
            std::iter::once(estimate).chain(alternatives)
        };
        let found: Vec<PoseEstimate> = found.into_iter().flat_map(with_alternatives).collect();
        let judged: Vec<Option<Hypothesis>> = found
            .into_par_iter()
            .map_init(EvidenceCollector::default, |collector, mut estimate| {
                if !is_before_camera(&estimate.camera_from_object, shape.mesh, diameter) {
                    return None;
                }
                let mut evidence = collector.collect(scene, shape, &estimate.camera_from_object, &options);
                if !by_depth
                    && let Some(moved) = moved_to_depth(scene, shape, diameter, &estimate.camera_from_object)
                {
                    let after = collector.collect(scene, shape, &moved, &options);
                    if ranking(&after) > ranking(&evidence) {
                        (estimate.camera_from_object, evidence) = (moved, after);
                    }
                }
                if by_depth
                    && let Some(other) =
                        look_alikes.best(scene, shape, diameter, (&estimate.camera_from_object, &evidence))
                {
                    (estimate.camera_from_object, evidence) = other;
                }
                let reported = Reported::of(&estimate, one_instance);
                let name = method.name();
                let distance = centre(&estimate.camera_from_object, shape.mesh).z;
                Some(Hypothesis {
                    method: name,
                    found_by: vec![name],
                    numbers: of_evidence(&evidence, &reported, distance / diameter),
                    strength: strength(&evidence, reported.similarity),
                    estimate,
                    evidence,
                    probability: 0.0,
                })
            })
            .collect();
        for hypothesis in judged.into_iter().flatten() {
            self.join(hypothesis);
        }
        self.compare();
    }

    /// Adds a hypothesis, or merges it with an equal one.
    fn join(&mut self, new: Hypothesis) {
        let same = |h: &&mut Hypothesis| {
            let limit = if h.evidence.depth.is_some() { SAME } else { SAME_BY_COLOR };
            distance(
                &h.estimate.camera_from_object,
                &new.estimate.camera_from_object,
                self.symmetries,
                &self.shape,
            ) < limit * self.diameter
        };
        let Some(place) = self.hypotheses.iter_mut().find(same) else {
            self.hypotheses.push(new);
            return;
        };
        let mut found_by = std::mem::take(&mut place.found_by);
        found_by.extend(new.found_by.iter().filter(|m| !place.found_by.contains(m)));
        found_by.sort_unstable();
        found_by.dedup();
        if new.strength > place.strength {
            *place = new;
        }
        place.found_by = found_by;
    }

    /// Compares every hypothesis with the others, and computes probabilities; sorts the most probable first.
    fn compare(&mut self) {
        let others: Vec<(f64, f64)> = self
            .hypotheses
            .iter()
            .enumerate()
            .map(|(i, h)| {
                let (mut here, mut elsewhere) = (0.0f64, 0.0f64);
                for (_, other) in self.hypotheses.iter().enumerate().filter(|(k, _)| *k != i) {
                    let best = if one_place(h, other) { &mut here } else { &mut elsewhere };
                    *best = best.max(other.strength);
                }
                (h.strength - here, h.strength - elsewhere)
            })
            .collect();
        for (h, (here, elsewhere)) in self.hypotheses.iter_mut().zip(others) {
            let agreement = (self.asked > 1).then(|| (h.found_by.len() - 1) as f64);
            add_others(&mut h.numbers, agreement, here, self.one_instance.then_some(elsewhere));
            h.probability = self.calibration.probability(&h.numbers);
        }
        self.exclude();
        self.hypotheses.sort_by(|a, b| b.probability.total_cmp(&a.probability));
    }

    /// Divides the probability among poses at one place of which at most one is right.
    fn exclude(&mut self) {
        let excludes = |i: usize, k: usize| {
            one_place(&self.hypotheses[i], &self.hypotheses[k]) && self.exclude_each_other(i, k)
        };
        let alone: Vec<f64> = self.hypotheses.iter().map(|h| h.probability).collect();
        let probabilities = exclusive(&alone, excludes);
        self.hypotheses
            .iter_mut()
            .zip(probabilities)
            .for_each(|(h, probability)| h.probability = probability);
    }

    /// The most probable hypotheses, one per place, at most `most`, each with the others at its place that are not much less
    /// probable. Of a hypothesis and its others at most one is right.
    pub(crate) fn chosen(&self, most: usize) -> Vec<(&Hypothesis, Vec<&Hypothesis>)> {
        let probabilities: Vec<f64> = self.hypotheses.iter().map(|h| h.probability).collect();
        let one_place = |i: usize, k: usize| one_place(&self.hypotheses[i], &self.hypotheses[k]);
        let of = |i: usize| &self.hypotheses[i];
        grouped(&probabilities, most, one_place, |i, k| self.exclude_each_other(i, k))
            .into_iter()
            .map(|(best, others)| (of(best), others.into_iter().map(of).collect()))
            .collect()
    }

    /// Whether two hypotheses are too far apart for both to be right.
    fn exclude_each_other(&self, i: usize, k: usize) -> bool {
        let poses = [i, k].map(|i| &self.hypotheses[i].estimate.camera_from_object);
        exclude_each_other(poses, self.symmetries, &self.shape, self.diameter)
    }

    /// The most probable hypotheses as estimates, one per place, at most `most`.
    pub(crate) fn estimates(&self, most: usize) -> Vec<PoseEstimate> {
        self.chosen(most).into_iter().map(|(best, others)| reported(best, &others)).collect()
    }
}

/// A hypothesis as it is reported.
fn reported(hypothesis: &Hypothesis, others: &[&Hypothesis]) -> PoseEstimate {
    let evidence = &hypothesis.evidence;
    let estimate = &hypothesis.estimate;
    let of = |h: &Hypothesis| PoseEstimate {
        probability: Some(h.probability),
        ..PoseEstimate::new(h.estimate.camera_from_object, h.probability)
    };
    let numbers: Map<String, Value> = NAMES
        .iter()
        .zip(&hypothesis.numbers)
        .filter_map(|(n, v)| Some(((*n).to_owned(), json!((*v)?))))
        .collect();
    PoseEstimate {
        verification: evidence.depth.map(|d| d.score),
        mask: Some(evidence.pixels.clone()),
        alternatives: others.iter().map(|other| of(other)).collect(),
        details: Map::from_iter([
            ("method".to_owned(), hypothesis.method.into()),
            ("found_by".to_owned(), json!(hypothesis.found_by)),
            ("evidence".to_owned(), numbers.into()),
        ]),
        diagnostics: estimate.diagnostics.clone(),
        notes: estimate.notes.clone(),
        ..of(hypothesis)
    }
}

/// Whether two poses are too far apart for both to be right.
fn exclude_each_other(poses: [&Pose; 2], symmetries: &[Pose], shape: &Shape<'_>, diameter: f64) -> bool {
    distance(poses[0], poses[1], symmetries, shape) > 2.0 * RIGHT * diameter
}

/// Hypotheses in the order of their probabilities, one per place, at most `most`, each with the others at its place that are not much less probable
/// and exclude it and each other.
fn grouped(
    probabilities: &[f64],
    most: usize,
    one_place: impl Fn(usize, usize) -> bool,
    excludes: impl Fn(usize, usize) -> bool,
) -> Vec<(usize, Vec<usize>)> {
    let mut chosen: Vec<(usize, Vec<usize>)> = vec![];
    for (new, probability) in probabilities.iter().enumerate() {
        if let Some((best, others)) = chosen.iter_mut().find(|(best, _)| one_place(*best, new)) {
            let probable = *probability > ALTERNATIVE * probabilities[*best];
            if probable && excludes(*best, new) && others.iter().all(|other| excludes(*other, new)) {
                others.push(new);
            }
        } else if chosen.len() < most {
            chosen.push((new, vec![]));
        }
    }
    chosen
}

/// The probabilities of events of which some exclude each other: with the odds `o = p / (1 - p)` of each by itself, `o / (1 + sum(o))` over it and
/// those that it excludes.
fn exclusive(alone: &[f64], excludes: impl Fn(usize, usize) -> bool) -> Vec<f64> {
    let odds: Vec<f64> = alone.iter().map(|p| p / (1.0 - p).max(1e-12)).collect();
    let of = |i: usize| {
        let others = (0..odds.len()).filter(|k| *k != i && excludes(i, *k)).map(|k| odds[k]);
        odds[i] / (1.0 + odds[i] + others.sum::<f64>())
    };
    (0..odds.len()).map(of).collect()
}

/// Another pose at the same place is reported if its probability exceeds this fraction of the best one's; chosen by hand, not
/// swept.
const ALTERNATIVE: f64 = 0.25;

/// An object whose centre is nearer than this many diameters is too close to the lens; chosen by hand, not swept.
const AGAINST_LENS: f64 = 0.5;

/// The centre of the bounding box in the camera's frame; the object's frame may be anywhere.
fn centre(pose: &Pose, mesh: &Mesh) -> Vec3 {
    let (low, high) = mesh.bounding_box();
    pose.transform_point(&(0.5 * (low + high)))
}

fn is_before_camera(pose: &Pose, mesh: &Mesh, diameter: f64) -> bool {
    let centre = centre(pose, mesh);
    centre.iter().all(|v| v.is_finite()) && centre.z > AGAINST_LENS * diameter
}

pub(crate) fn ranking(evidence: &Evidence) -> f64 {
    evidence.depth.map_or(0.0, |d| d.score.ranking())
}

/// A pose from colour, aligned with the measured surface.
pub(crate) fn moved_to_depth(
    scene: &Scene<'_>,
    shape: &Shape<'_>,
    diameter: f64,
    pose: &Pose,
) -> Option<Pose> {
    let image = scene.depth?;
    let aligned = align_to_depth(image, shape.mesh, diameter, pose, &|_, _| true).ok()?;
    Some(refine(&mut Verifier::default(), image, shape.mesh, &aligned.camera_from_object, shape.threshold))
}

/// The largest distance between a corner of the object's box at both poses, minimised over the symmetries, metres.
fn distance(a: &Pose, b: &Pose, symmetries: &[Pose], shape: &Shape<'_>) -> f64 {
    let corners = shape.mesh.box_corners();
    let at = |symmetry: &Pose| {
        let off = |c: &Vec3| (a.transform_point(&symmetry.transform_point(c)) - b.transform_point(c)).norm();
        corners.iter().map(off).fold(0.0, f64::max)
    };
    let none = at(&Pose::identity());
    symmetries.iter().map(at).fold(none, f64::min)
}

/// Whether two poses are at the same place in the image.
fn one_place(a: &Hypothesis, b: &Hypothesis) -> bool {
    let (a, b) = (&a.evidence.pixels, &b.evidence.pixels);
    shared(a, b) as f64 > ONE_PLACE * a.len().min(b.len()) as f64
}

/// Number of values that two ascending lists share.
fn shared(a: &[u32], b: &[u32]) -> usize {
    let (mut i, mut k, mut count) = (0, 0, 0);
    while i < a.len() && k < b.len() {
        match a[i].cmp(&b[k]) {
            std::cmp::Ordering::Less => i += 1,
            std::cmp::Ordering::Greater => k += 1,
            std::cmp::Ordering::Equal => (i, k, count) = (i + 1, k + 1, count + 1),
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::nalgebra::UnitQuaternion;

    use super::*;

    #[test]
    fn shared_pixels_are_counted() {
        assert_eq!(shared(&[1, 3, 5, 9], &[2, 3, 9, 10]), 2);
        assert_eq!(shared(&[], &[1]), 0);
    }

    #[test]
    fn an_object_at_the_lens_is_no_pose() {
        let mesh = |z: f64| {
            let vertices = vec![Vec3::new(0.0, 0.0, z), Vec3::new(0.2, 0.0, z), Vec3::new(0.0, 0.1, z)];
            Mesh::new(vertices, vec![[0, 1, 2]]).unwrap()
        };
        let at = |z| is_before_camera(&Pose::from_translation(Vec3::new(0.0, 0.0, z)), &mesh(0.0), 0.2);
        assert_eq!([at(-1.0), at(0.05), at(0.5), at(f64::NAN)], [false, false, true, false]);
        // A scan whose frame is a metre behind it.
        assert!(is_before_camera(&Pose::from_translation(Vec3::new(0.0, 0.0, -0.5)), &mesh(1.0), 0.2));
    }

    #[test]
    fn of_equal_poses_that_exclude_each_other_none_is_probable() {
        let all = exclusive(&[0.9, 0.9, 0.6, 1.0], |i, k| i.max(k) == 1);
        assert!((all[0] - 9.0 / 19.0).abs() < 1e-12 && all[1] == all[0], "{all:?}");
        assert!((all[2] - 0.6).abs() < 1e-12 && (all[3] - 1.0).abs() < 1e-9, "{all:?}");
    }

    #[test]
    fn a_pose_is_reported_with_those_at_its_place_that_exclude_it() {
        // Places 0 and 1 of poses 0 to 5; poses 1 and 2 are near each other, 5 is improbable.
        let place = [0, 0, 0, 1, 0, 0];
        let near = |i: usize, k: usize| [i.min(k), i.max(k)] == [1, 2];
        let of = |most| {
            let probabilities = [0.4, 0.3, 0.25, 0.2, 0.15, 0.09];
            grouped(&probabilities, most, |i, k| place[i] == place[k], |i, k| !near(i, k))
        };
        assert_eq!(of(2), [(0, vec![1, 4]), (3, vec![])]);
        assert_eq!(of(1), [(0, vec![1, 4])]);
    }

    #[test]
    fn two_poses_exclude_each_other_if_the_truth_cannot_be_near_both() {
        let corners =
            (0..8).map(|i| Vec3::from_fn(|k, _| if i >> k & 1 == 1 { 0.05 } else { -0.05 })).collect();
        let mesh = Mesh::new(corners, vec![[0, 1, 2]]).unwrap();
        let shape = Shape { mesh: &mesh, colored: &mesh, threshold: 0.008 };
        let diameter = mesh.diameter();
        let pose = Pose::from_translation(Vec3::z());
        let beside = |diameters: f64| Pose::from_translation(Vec3::new(diameters * diameter, 0.0, 1.0));
        let half = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), std::f64::consts::PI);
        let half = Pose::new(half, Vec3::zeros());
        let exclude = |other: Pose, symmetries: &[Pose]| {
            exclude_each_other([&pose, &other], symmetries, &shape, diameter)
        };
        assert!(!exclude(beside(0.19), &[]) && exclude(beside(0.21), &[]));
        assert!(exclude(pose * half, &[]) && !exclude(pose * half, &[half]));
    }
}
