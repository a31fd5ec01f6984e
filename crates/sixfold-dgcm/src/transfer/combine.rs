//! Ranks grasps from geometry and grasps from experience together.
//!
//! The dissertation combines the score of each geometric candidate with a score from experience (section 6.3.2). So it can only
//! choose among the proposals of the geometric planner, and fails if all of them are bad. Here the transferred grasps are
//! candidates as well, described by the same numbers; and the outcomes of earlier attempts determine the weight of each number
//! ([`crate::outcome`]).

use sixfold_geometry::nalgebra::{Quaternion, UnitQuaternion};
use sixfold_geometry::{Pose, Vec3};
use sixfold_grasp::learned::ScoredGrasp;
use sixfold_grasp::{ClusterOptions, Grasp, GraspCluster, GraspFitter};

use super::{Proposal, Proposals};
use crate::outcome::OutcomeModel;

/// The origin of a grasp.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// The geometric planner.
    Geometry,
    /// Experience.
    Experience,
}

/// A grasp with the scores for its rank.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ranked {
    /// The grasp.
    pub grasp: Grasp,
    /// Its origin.
    pub kind: Kind,
    /// The score by which grasps are ranked: the mean of the next two, or the success probability ([`rank_by_outcome`]).
    pub score: f64,
    /// Quality of its contacts relative to the best one's, 0 to 1.
    pub geometry: f64,
    /// The fraction of experience that agrees with the grasp, 0 to 1.
    pub experience: f64,
    /// The number of its proposal, for grasps from experience.
    pub proposal: Option<usize>,
    /// Number of grasps in the cluster.
    pub members: usize,
}

impl Ranked {
    /// A grasp of a planner alone: the best of a cluster.
    pub fn of_planner(cluster: GraspCluster) -> Ranked {
        Ranked {
            grasp: cluster.best,
            kind: Kind::Geometry,
            score: cluster.score,
            geometry: cluster.best_score,
            experience: 0.0,
            proposal: None,
            members: cluster.members,
        }
    }

    /// The success probability of a grasp of this origin.
    fn success_probability(&self, grasp: &Grasp, fitter: &GraspFitter<'_>, outcomes: &OutcomeModel) -> f64 {
        outcomes.success_probability(&fitter.describe(grasp), self.experience, self.kind == Kind::Experience)
    }
}

/// Ranks grasps of both kinds, best first, one of each cluster (5 cm and 15 degrees), by the mean of their quality and of the
/// fraction of experience that agrees. Without experience the order is that of the planner's clusters, without geometry that of the
/// summed scores of equation 6.6 (section 6.3.2).
pub fn rank(geometry: &[Grasp], experience: &[Proposal], clusters: &ClusterOptions) -> Vec<Ranked> {
    let mut candidates = candidates(geometry, experience, clusters);
    for c in &mut candidates {
        c.score = match (geometry.is_empty(), experience.is_empty()) {
            (true, _) => c.experience,
            (_, true) => c.geometry,
            _ => 0.5 * (c.geometry + c.experience),
        };
    }
    let (chosen, sums) = joined(candidates, clusters);
    if experience.is_empty() {
        // Planner only: clusters by summed quality.
        let mut order: Vec<usize> = (0..chosen.len()).collect();
        order.sort_by(|&a, &b| sums[b].total_cmp(&sums[a]).then(a.cmp(&b)));
        return order.into_iter().map(|i| chosen[i]).collect();
    }
    chosen
}

/// Ranks experience's grasps as the dissertation does for its network alone (section 6.3.2): those within 5 cm and 15 degrees of
/// the best remaining one form a cluster, whose grasp is their mean pose and whose score is the sum of equation 6.6.
pub fn rank_experience_as_published(experience: &[Proposal], clusters: &ClusterOptions) -> Vec<Ranked> {
    let mut left: Vec<usize> = (0..experience.len()).collect();
    left.sort_by(|&a, &b| experience[b].score.total_cmp(&experience[a].score).then(a.cmp(&b)));
    let mut ranked: Vec<Ranked> = vec![];
    while let Some(&seed) = left.first() {
        let best = &experience[seed].grasp;
        let (members, others): (Vec<usize>, Vec<usize>) =
            left.iter().partition(|&&i| i == seed || near(best, &experience[i].grasp, clusters));
        let score = members.iter().map(|&i| experience[i].score).sum();
        let poses: Vec<Pose> = members.iter().map(|&i| experience[i].grasp.camera_from_gripper).collect();
        ranked.push(Ranked {
            grasp: Grasp { camera_from_gripper: mean_pose(&poses), ..*best },
            kind: Kind::Experience,
            score,
            geometry: best.quality.total(),
            experience: score,
            proposal: Some(seed),
            members: members.len(),
        });
        left = others;
    }
    ranked.sort_by(|a, b| b.score.total_cmp(&a.score));
    ranked
}

/// The mean of gripper poses that are close to one another; each is rotated by half a turn if that is closer to the first.
fn mean_pose(poses: &[Pose]) -> Pose {
    let half_turn = Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::PI].into());
    let (mut translation, mut rotation) = (Vec3::zeros(), Quaternion::from_parts(0.0, Vec3::zeros()));
    let first = poses.first().copied().unwrap_or_else(Pose::identity);
    for pose in poses {
        let rotated = *pose * half_turn;
        let nearer =
            if rotated.rotation_angle_to(&first) < pose.rotation_angle_to(&first) { rotated } else { *pose };
        let q = nearer.rotation().into_inner();
        let sign = if q.dot(&first.rotation().into_inner()) < 0.0 { -1.0 } else { 1.0 };
        rotation += q * sign;
        translation += pose.translation();
    }
    Pose::new(UnitQuaternion::new_normalize(rotation), translation / poses.len().max(1) as f64)
}

/// Ranks the planner's grasps as the dissertation does with its network ("GPD + DGCM-Net", section 6.3.2): the mean of the
/// planner's score (quality, or that of a learned planner), scaled to 0..1, and of the experience's score, which is the average of
/// equation 6.6 over the proposals within 5 cm and 15 degrees, 0 if there are none.
pub fn rank_as_published(
    planned: &[ScoredGrasp],
    experience: &[Proposal],
    clusters: &ClusterOptions,
) -> Vec<Ranked> {
    let geometry: Vec<Grasp> = planned.iter().map(|p| p.grasp).collect();
    // The planner's grasps are first, in their order.
    let mut candidates = candidates(&geometry, experience, clusters);
    candidates.truncate(planned.len());
    let scores = || planned.iter().map(|p| p.score);
    let (low, high) = (scores().fold(f64::INFINITY, f64::min), scores().fold(0.0, f64::max));
    for (c, planned) in candidates.iter_mut().zip(planned) {
        let range = high - low;
        c.geometry = if range > 0.0 { (planned.score - low) / range } else { 1.0 };
        let agreeing = || experience.iter().filter(|p| near(&c.grasp, &p.grasp, clusters)).map(|p| p.score);
        c.experience = agreeing().sum::<f64>() / agreeing().count().max(1) as f64;
        c.score = 0.5 * (c.geometry + c.experience);
    }
    joined(candidates, clusters).0
}

/// Ranks the planner's grasps by the mean of relative quality and of the fraction of experience that agrees; only the proposals
/// from experience are left out. For comparisons: if all of the planner's grasps are bad, so is the best.
pub fn rank_by_agreement(
    geometry: &[Grasp],
    experience: &[Proposal],
    clusters: &ClusterOptions,
) -> Vec<Ranked> {
    let mut candidates = candidates(geometry, experience, clusters);
    candidates.retain(|c| c.kind == Kind::Geometry);
    for c in &mut candidates {
        c.score = 0.5 * (c.geometry + c.experience);
    }
    joined(candidates, clusters).0
}

/// Ranks grasps of both kinds by their success probability, best first, one of each cluster. The score is that probability. A model
/// without attempts uses its prior from simulated attempts.
pub fn rank_by_outcome(
    geometry: &[Grasp],
    experience: &[Proposal],
    clusters: &ClusterOptions,
    fitter: &GraspFitter<'_>,
    outcomes: &OutcomeModel,
) -> Vec<Ranked> {
    let mut candidates = candidates(geometry, experience, clusters);
    for c in &mut candidates {
        c.score = c.success_probability(&c.grasp, fitter, outcomes);
    }
    let (mut chosen, _) = joined(candidates, clusters);
    let few = chosen.len().min(REFINED);
    for c in &mut chosen[..few] {
        refine(c, fitter, outcomes);
    }
    chosen.sort_by(|a, b| b.score.total_cmp(&a.score));
    chosen
}

/// Ranks grasps of both kinds by the probability of holding the same part as the experience: the success probability times
/// `Proposals::holds_the_same`. With experience on one part only (a handle) the best grasp is on the counterpart of that part,
/// whether geometry or experience proposed it. The planner's grasps that do not hold it are left out; transferred ones are kept,
/// last, because they come from such a part.
pub fn rank_on_part(
    geometry: &[Grasp],
    experience: &Proposals,
    clusters: &ClusterOptions,
    fitter: &GraspFitter<'_>,
    outcomes: &OutcomeModel,
) -> Vec<Ranked> {
    let mut candidates = candidates(geometry, &experience.proposals, clusters);
    for c in &mut candidates {
        let minimum = if c.kind == Kind::Experience { 0.01 } else { 0.0 };
        c.score = c.success_probability(&c.grasp, fitter, outcomes)
            * experience.holds_the_same(&c.grasp, fitter.gripper()).max(minimum);
    }
    candidates.retain(|c| c.score > 0.0);
    joined(candidates, clusters).0
}

/// Number of best grasps that are refined.
const REFINED: usize = 6;

/// Moves a grasp by small steps while this increases its success probability: along the approach, along the pads, and rotated about
/// each of its axes. When no step helps, the step size is halved, once.
fn refine(c: &mut Ranked, fitter: &GraspFitter<'_>, outcomes: &OutcomeModel) {
    const ROUNDS: usize = 5;
    const STEP: f64 = 0.006;
    let turn = 8f64.to_radians();
    let mut size = 1.0;
    for _ in 0..ROUNDS {
        let start = c.grasp.camera_from_gripper;
        let mut better = None;
        for (axis, sign) in (1..6).flat_map(|axis| [-size, size].map(|sign| (axis, sign))) {
            let mut twist = [0.0; 6];
            twist[axis] = sign * if axis < 3 { STEP } else { turn };
            let moved = start * Pose::exp(&twist.into());
            let Some(grasp) = fitter.fit(&moved, c.grasp.opening) else { continue };
            let score = c.success_probability(&grasp, fitter, outcomes);
            if score > c.score + 1e-6 {
                c.score = score;
                better = Some(grasp);
            }
        }
        match better {
            Some(grasp) => c.grasp = grasp,
            None if size < 1.0 => break,
            None => size = 0.5,
        }
    }
}

fn near(a: &Grasp, b: &Grasp, clusters: &ClusterOptions) -> bool {
    let (distance, angle) = a.difference(b);
    distance <= clusters.distance && angle <= clusters.angle
}

/// All grasps with quality and the fraction of experience that agrees, but without a score.
fn candidates(geometry: &[Grasp], experience: &[Proposal], clusters: &ClusterOptions) -> Vec<Ranked> {
    let all: f64 = experience.iter().map(|p| p.score).sum();
    let best = geometry
        .iter()
        .chain(experience.iter().filter(|p| p.firm).map(|p| &p.grasp))
        .map(|g| g.quality.total())
        .fold(1e-9, f64::max);
    let both = geometry
        .iter()
        .map(|g| (g, Kind::Geometry, None))
        .chain(experience.iter().enumerate().map(|(i, p)| (&p.grasp, Kind::Experience, Some(i))));
    both.map(|(grasp, kind, proposal)| {
        let agreeing =
            experience.iter().filter(|p| near(grasp, &p.grasp, clusters)).fold(0.0, |sum, p| sum + p.score);
        Ranked {
            grasp: *grasp,
            kind,
            score: 0.0,
            geometry: grasp.quality.total() / best,
            experience: if all > 0.0 { agreeing / all } else { 0.0 },
            proposal,
            members: 1,
        }
    })
    .collect()
}

/// The best of each cluster, best first, and the summed qualities of the clusters.
fn joined(mut candidates: Vec<Ranked>, clusters: &ClusterOptions) -> (Vec<Ranked>, Vec<f64>) {
    // Equal scores: the better contacts first.
    candidates.sort_by(|a, b| b.score.total_cmp(&a.score).then(b.geometry.total_cmp(&a.geometry)));
    let mut chosen: Vec<Ranked> = vec![];
    let mut sums: Vec<f64> = vec![];
    for candidate in candidates {
        match chosen.iter().position(|c| near(&c.grasp, &candidate.grasp, clusters)) {
            Some(cluster) => {
                chosen[cluster].members += 1;
                sums[cluster] += candidate.geometry;
            }
            None => {
                chosen.push(candidate);
                sums.push(candidate.geometry);
            }
        }
    }
    (chosen, sums)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transfer::AlignmentHypothesis;
    use sixfold_experience::{Attempt, Crop, CropOptions, Match};
    use sixfold_geometry::{Camera, DepthImage, Mask, Plane, PointCloud};
    use sixfold_grasp::{
        AntipodalOptions, AntipodalQuality, GraspDescription, GraspView, Gripper, gripper_pose,
    };

    fn grasp(x: f64, alignment: f64) -> Grasp {
        let quality = AntipodalQuality { alignment, support: 1.0, centring: 1.0, observed: 1.0 };
        let pose = Pose::exp(&[x, 0.0, 0.6, 0.0, 0.0, 0.0].into());
        Grasp { camera_from_gripper: pose, opening: 0.06, width: 0.04, quality }
    }

    fn proposal(x: f64, score: f64) -> Proposal {
        let from = Match { experience: 1, angle: 0.0, distance: -score.ln() };
        Proposal {
            grasp: grasp(x, 0.5),
            score,
            from,
            hypothesis: AlignmentHypothesis::Scaled,
            moved: 0.0,
            firm: true,
        }
    }

    #[test]
    fn experience_decides_between_grasps_of_like_quality() {
        let geometry = [grasp(0.0, 0.95), grasp(0.2, 0.9)];
        let options = ClusterOptions::default();
        let alone = rank(&geometry, &[], &options);
        assert!(alone[0].grasp.camera_from_gripper.translation().x.abs() < 1e-9);
        let both = rank(&geometry, &[proposal(0.21, 0.5), proposal(0.2, 0.4)], &options);
        assert!((both[0].grasp.camera_from_gripper.translation().x - 0.2).abs() < 0.02);
        assert_eq!((both[0].kind, both[0].members), (Kind::Geometry, 3));
        // Candidates from experience if geometry has none.
        let only = rank(&geometry, &[proposal(-0.3, 0.5)], &options);
        assert!(only.iter().any(|r| r.kind == Kind::Experience && r.proposal == Some(0)));
        let dgcm = rank(&[], &[proposal(0.0, 0.1), proposal(0.2, 0.3), proposal(0.21, 0.3)], &options);
        assert!(dgcm[0].grasp.camera_from_gripper.translation().x > 0.1 && dgcm[0].experience > 0.8);
    }

    /// A bar of 30 x 3 x 5 cm on a table, seen from above, with its lower half assumed.
    fn bar() -> GraspView {
        let mut object = PointCloud::default();
        for i in 0..=120 {
            for k in 0..=20 {
                for side in [-1.0, 1.0] {
                    let (x, z) = (0.0025 * f64::from(i) - 0.15, 0.6 - 0.0025 * f64::from(k));
                    object.points.push(Vec3::new(x, 0.015 * side, z));
                    object.normals.push(Vec3::y() * side);
                }
            }
        }
        GraspView {
            camera: Camera::new(500.0, 500.0, 31.5, 31.5, 64, 64).unwrap(),
            depth: DepthImage::filled(64, 64, 0.0),
            mask: Mask::filled(64, 64, false),
            table: Some(Plane { normal: -Vec3::z(), offset: -0.6 }),
            object,
            obstacles: PointCloud::default(),
            step: 0.0025,
            cut_by_edge: false,
        }
    }

    #[test]
    fn outcomes_decide_between_grasps_and_move_the_best() {
        let view = bar();
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let options = AntipodalOptions { completion: None, ..AntipodalOptions::default() };
        let fitter = GraspFitter::new(&view, &gripper, &options).unwrap();
        // Both across the bar, at its end and near its centre, with the tips reaching just over its upper edge.
        let at = |x: f64| {
            let tip = Vec3::new(x, 0.0, 0.575);
            fitter.fit(&gripper_pose(&tip, &Vec3::z(), &Vec3::y()).unwrap(), 0.06).unwrap()
        };
        let (end, centre) = (at(0.12), at(0.05));
        // A gripper that lost every object over which its pads reached by less than 3 cm, wherever it was held.
        let attempts: Vec<Attempt> = (0..80)
            .map(|k| {
                let overlap = 0.001 * f64::from(k % 50);
                let description = GraspDescription { overlap, ..fitter.describe(&centre) };
                Attempt {
                    description,
                    agreement: 0.0,
                    transferred: false,
                    held: overlap > 0.03,
                    gripper: gripper.name.clone(),
                    object: "bar".to_owned(),
                    time: 0,
                    provenance: k.to_string(),
                }
            })
            .collect();
        let clusters = ClusterOptions::default();
        let rank =
            |outcomes: &OutcomeModel| rank_by_outcome(&[end, centre], &[], &clusters, &fitter, outcomes);
        let untaught = rank(&OutcomeModel::default());
        assert!(untaught[0].grasp.camera_from_gripper.translation().x < 0.06, "nearer to the centre");
        let taught = rank(&OutcomeModel::learn(&attempts, &gripper.name));
        assert_eq!(taught.len(), 2);
        let depth = |r: &Ranked| fitter.describe(&r.grasp).overlap;
        assert!(
            depth(&taught[0]) > fitter.describe(&centre).overlap + 0.005,
            "it reaches deeper: {taught:?}"
        );
        let outcomes = OutcomeModel::learn(&attempts, &gripper.name);
        let unmoved = outcomes.success_probability(&fitter.describe(&centre), 0.0, false);
        assert!(taught[0].score > 1.5 * unmoved, "{} {unmoved}", taught[0].score);
        assert!(taught.is_sorted_by(|a, b| a.score >= b.score));
        // The moved grasp still satisfies the planner's tests.
        let again = fitter.fit(&taught[0].grasp.camera_from_gripper, taught[0].grasp.opening);
        assert!(again.is_some());
    }

    #[test]
    fn on_a_part_grasps_of_its_counterpart_come_first() {
        let view = bar();
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let options = AntipodalOptions { completion: None, ..AntipodalOptions::default() };
        let fitter = GraspFitter::new(&view, &gripper, &options).unwrap();
        let at = |x: f64| {
            let tip = Vec3::new(x, 0.0, 0.575);
            fitter.fit(&gripper_pose(&tip, &Vec3::z(), &Vec3::y()).unwrap(), 0.06).unwrap()
        };
        // The network's view of the bar: its upper side, whose left end was held in experience.
        let camera = Camera::new(575.0, 575.0, 159.5, 119.5, 320, 240).unwrap();
        let inside = |x: usize, y: usize| (40..280).contains(&x) && (104..136).contains(&y);
        let depth = DepthImage::from_fn(320, 240, |x, y| if inside(x, y) { 0.56 } else { 0.0 });
        let crop = Crop::new(&depth, &camera, &Mask::from_fn(320, 240, inside), &CropOptions::compact());
        let crop = crop.unwrap();
        let mut held_before = vec![0.0; crop.mask.len()];
        crop.pixels().filter(|&i| crop.points[i][0] < -0.06).for_each(|i| held_before[i] = 0.7);
        let elsewhere = Proposal { grasp: at(0.06), ..proposal(0.0, 0.9) };
        let found = Proposals {
            nearest: vec![],
            crop,
            proposals: vec![elsewhere],
            held_before,
            grasp_centres: vec![],
        };
        // The success probability is highest at the centre of the bar, but its left end was requested.
        let ranked = rank_on_part(
            &[at(0.0), at(-0.09)],
            &found,
            &ClusterOptions::default(),
            &fitter,
            &OutcomeModel::default(),
        );
        let places: Vec<f64> =
            ranked.iter().map(|r| r.grasp.camera_from_gripper.translation().x.signum()).collect();
        assert_eq!(places, [-1.0, 1.0], "the left end, then the transferred one; the centre is left out");
        assert_eq!((ranked[0].kind, ranked[1].kind), (Kind::Geometry, Kind::Experience));
    }

    #[test]
    fn as_published_the_planners_score_and_the_mean_of_the_near_experience_are_averaged() {
        // Qualities 0.3 + 0.7 a: 0.3, 0.65 and 1, which become 0, 0.5 and 1.
        let geometry = [grasp(0.0, 0.0), grasp(0.3, 0.5), grasp(-0.3, 1.0)];
        // Two near to the second, whose mean counts, and one near no grasp.
        let proposals = [proposal(0.29, 0.6), proposal(0.33, 0.9), proposal(0.1, 1.0)];
        let planned = geometry.map(|grasp| ScoredGrasp { grasp, score: grasp.quality.total() });
        let ranked = rank_as_published(&planned, &proposals, &ClusterOptions::default());
        assert!(ranked.iter().all(|r| r.kind == Kind::Geometry && r.proposal.is_none()));
        let found: Vec<[f64; 4]> = ranked
            .iter()
            .map(|r| [r.grasp.camera_from_gripper.translation().x, r.geometry, r.experience, r.score])
            .collect();
        let expected = [[0.3, 0.5, 0.75, 0.625], [-0.3, 1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0]];
        for (found, expected) in found.iter().zip(&expected) {
            for (a, b) in found.iter().zip(expected) {
                assert!((a - b).abs() < 1e-9, "{found:?} {expected:?}");
            }
        }
        // By the fraction of experience that agrees, 1.5 of 2.5, the score differs.
        let agreed = rank_by_agreement(&geometry, &proposals, &ClusterOptions::default());
        assert!((agreed[0].score - 0.5 * (0.65 + 0.6)).abs() < 1e-9, "{}", agreed[0].score);
    }

    #[test]
    fn as_published_a_cluster_is_its_mean_pose_and_its_summed_score() {
        let at = |x: f64, angle: f64, score: f64| {
            let mut p = proposal(x, score);
            p.grasp.camera_from_gripper =
                Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, angle].into()).with_translation(Vec3::new(x, 0.0, 0.6));
            p
        };
        let half = std::f64::consts::PI;
        // The best one alone; three of about the same grasp, one of them rotated by half a turn.
        let found = [at(0.0, 0.1, 0.4), at(0.3, 0.0, 0.7), at(0.04, 0.3, 0.3), at(0.02, 0.2 + half, 0.5)];
        let ranked = rank_experience_as_published(&found, &ClusterOptions::default());
        assert_eq!(ranked.iter().map(|r| r.members).collect::<Vec<_>>(), [3, 1]);
        assert!((ranked[0].score - 1.2).abs() < 1e-12 && (ranked[1].score - 0.7).abs() < 1e-12);
        assert_eq!(ranked[0].proposal, Some(3), "its best member");
        let mean = ranked[0].grasp.camera_from_gripper;
        assert!((mean.translation() - Vec3::new(0.02, 0.0, 0.6)).norm() < 1e-9);
        let expected = Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.2 + half].into());
        assert!(mean.rotation_angle_to(&expected) < 1e-6);
        assert!(rank_experience_as_published(&[], &ClusterOptions::default()).is_empty());
    }
}
