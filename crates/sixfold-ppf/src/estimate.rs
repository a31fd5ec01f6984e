//! From a prepared scene and an object's model to poses: vote, cluster, screen, refine, verify.
//!
//! Screening compares the object's samples with the depth image at the hypothesis as in the view-dependent re-scoring of Vidal et
//! al. (2018), section 3.4: only samples visible from that side count. It is cheap enough for hundreds of hypotheses, so the number
//! of votes has little influence.

use rayon::prelude::*;
use serde::Serialize;
use sixfold_align::{DepthRegion, VerificationOptions, VerificationScore, Verifier, verify};
use sixfold_geometry::{IcpLevel, IcpOptions, IndexedCloud, OptionError, PointCloud, Pose, icp};

use crate::V3;
use crate::clustering::{ClusterOptions, cluster};
use crate::model::ObjectModel;
use crate::voting::{Hypothesis, VotingOptions, vote};

/// Options of the pose estimation.
#[derive(Debug, Clone, PartialEq)]
pub struct PpfOptions {
    /// Voting.
    pub voting: VotingOptions,
    /// Clustering.
    pub clustering: ClusterOptions,
    /// Final scores.
    pub verification: VerificationOptions,
    /// Hypotheses that get a short ICP after screening.
    pub refined: usize,
    /// Hypotheses that get a full ICP and are verified by rendering.
    pub verified: usize,
    /// Exponent of the votes in the confidence, next to the verification, from 0 (no influence) to 1.
    pub vote_power: f64,
    /// Maximum number of instances of the object returned, 1 or more.
    pub max_instances: usize,
    /// Estimates whose [`PpfEstimate::confidence`] (0 to 1) is lower are not returned.
    pub min_score: f64,
}

/// [`PpfOptions::refined`]; chosen by hand for run time, not swept.
const REFINED: usize = 100;
/// [`PpfOptions::verified`]; chosen by hand for run time, not swept.
const VERIFIED: usize = 40;
/// [`PpfOptions::vote_power`]; chosen by hand, not swept.
const VOTE_POWER: f64 = 0.3;
/// [`PpfOptions::min_score`]: estimates below it are guesses. Chosen by hand; not swept.
const MIN_SCORE: f64 = 0.05;

/// Scene points closer than this to the surface of a found instance belong to it and do not vote for the next one, metres: the
/// points are downsampled to 2 mm. Chosen by hand; not swept.
const EXPLAINED: f64 = 0.003;
/// Largest fraction (numerator, denominator) of its pixels that an instance may share with those found before; chosen by hand, not
/// swept.
const MAX_SHARED: (usize, usize) = (3, 10);
/// Samples closer to the camera than this are not used in the screening, metres: depth cameras do not measure there.
const NEAREST: f32 = 0.05;
/// Lower bound of the cosine between ray and normal with which a difference in depth is converted to one along the normal: at
/// grazing angles the depth may differ by more. Chosen by hand; not swept.
const MIN_SLOPE: f32 = 0.3;
/// Weight in the screening of a sample whose depth agrees but whose normal does not, 0 to 1; chosen by hand, not swept.
const DEPTH_ALONE: f32 = 0.2;
/// Weight of all samples in the denominator of the screening score, where occluded ones do not count: the fewer samples are
/// visible, the lower the score. Chosen by hand; not swept.
const HIDDEN_WEIGHT: f32 = 0.15;
/// Depth tolerance in the first screening, in sampling steps: about the error of the voted poses. Chosen by hand; not swept.
const COARSE_TOLERANCE: f64 = 1.5;
/// Lower bound of this tolerance, metres; chosen by hand, not swept.
const MIN_COARSE_TOLERANCE: f64 = 0.006;
/// Cosine above which normals agree in the first screening, about 45 degrees; chosen by hand, not swept.
const COARSE_COSINE: f32 = 0.7;
/// Depth tolerance in the screening after the short ICP, in sampling steps; at least the inlier threshold of the verification.
/// Chosen by hand; not swept.
const FINE_TOLERANCE: f64 = 0.7;
/// Cosine above which normals agree in that screening, about 37 degrees; chosen by hand, not swept.
const FINE_COSINE: f32 = 0.8;
/// One in this many of the refined hypotheses is selected by votes, regardless of its screening score; chosen by hand, not swept.
const BY_VOTES: usize = 3;
/// Levels of the short ICP: rejection distance in sampling steps, and iterations. Chosen by hand; not swept.
const SHORT_LEVELS: [(f64, usize); 2] = [(2.5, 4), (1.2, 4)];
/// Largest angle between the normals of a correspondence, degrees; chosen by hand, not swept.
const SHORT_ANGLE: f64 = 50.0;
/// A level of the short ICP stops when a step is smaller than this, metres and radians; chosen by hand, well below the depth noise.
const SHORT_CONVERGENCE: f64 = 1e-4;
/// Fewest correspondences of the short ICP, two more than a pose needs; chosen by hand, not swept.
const SHORT_CORRESPONDENCES: usize = 8;
/// After the short ICP, poses are merged if their centres are closer than this fraction of the diameter and their rotations differ
/// by less than [`SAME_ANGLE`]. Chosen by hand; not swept.
const SAME_PLACE: f64 = 0.03;
/// See [`SAME_PLACE`]; radians.
const SAME_ANGLE: f64 = 0.1;
/// Factor on the number of verified hypotheses if there may be several instances; chosen by hand, not swept.
const SEVERAL: usize = 2;

impl Default for PpfOptions {
    fn default() -> Self {
        PpfOptions {
            voting: VotingOptions::default(),
            clustering: ClusterOptions::default(),
            verification: VerificationOptions::default(),
            refined: REFINED,
            verified: VERIFIED,
            vote_power: VOTE_POWER,
            max_instances: 1,
            min_score: MIN_SCORE,
        }
    }
}

impl PpfOptions {
    /// Checks every field, including those of voting, clustering and verification.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.voting.check()?;
        self.clustering.check()?;
        self.verification.check()?;
        OptionError::unless_some("refined", self.refined)?;
        OptionError::unless_some("verified", self.verified)?;
        OptionError::unless_fraction("vote_power", self.vote_power)?;
        OptionError::unless_some("max_instances", self.max_instances)?;
        OptionError::unless_within("min_score", self.min_score, 0.0.., "0 or more")
    }
}

/// A pose with its score.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PpfEstimate {
    /// The pose.
    pub camera_from_object: Pose,
    /// The scores of the verification.
    pub score: VerificationScore,
    /// Votes of the hypothesis it came from.
    pub votes: f32,
    /// Confidence in `0..=1`, by which estimates are ranked: [`VerificationScore::ranking`] times the votes as a fraction of the
    /// maximum, to the power [`PpfOptions::vote_power`].
    pub confidence: f64,
}

/// Run time of each stage of an estimate, in seconds.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Timing {
    /// Voting.
    pub voting: f64,
    /// Clustering.
    pub clustering: f64,
    /// Screening and short ICP.
    pub screening: f64,
    /// Full ICP and verification.
    pub verification: f64,
}

/// Finds the object in the scene, best first; empty when nothing scores high enough. The same input gives
/// the same output at any number of threads.
pub fn estimate(scene: &DepthRegion, model: &ObjectModel, options: &PpfOptions) -> Vec<PpfEstimate> {
    estimate_timed(scene, model, options).0
}

/// As [`estimate`], with the run time of each stage.
pub fn estimate_timed(
    scene: &DepthRegion,
    model: &ObjectModel,
    options: &PpfOptions,
) -> (Vec<PpfEstimate>, Timing) {
    let mut timing = Timing::default();
    let threshold = options.verification.threshold_for(model.diameter);
    let Some(target) = scene.indexed_cloud() else { return (vec![], timing) };
    let mut found: Vec<PpfEstimate> = vec![];
    let mut taken: Vec<u32> = vec![];
    // Instances mask each other's votes, so the explained points are removed after each round.
    for round in 0..options.max_instances.max(1) {
        let start = std::time::Instant::now();
        let cloud;
        let voters = if round == 0 {
            scene.cloud()
        } else {
            let width = scene.camera().width;
            let explained: Vec<_> = taken
                .iter()
                .map(|&i| {
                    let (x, y) = (i as usize % width, i as usize / width);
                    let z = f64::from(scene.depth()[(x, y)]);
                    scene.camera().unproject(&sixfold_geometry::Vec2::new(x as f64, y as f64), z)
                })
                .collect();
            cloud = scene.cloud_without(&explained, EXPLAINED);
            &cloud
        };
        let votes = vote(model, voters, &options.voting);
        timing.voting += start.elapsed().as_secs_f64();
        let start = std::time::Instant::now();
        let clusters = cluster(&votes, &model.centre, model.diameter, &model.symmetries, &options.clustering);
        timing.clustering += start.elapsed().as_secs_f64();
        let start = std::time::Instant::now();
        let refined = screen(scene, model, target, &clusters, options);
        timing.screening += start.elapsed().as_secs_f64();
        let start = std::time::Instant::now();
        let verified = verified(scene, model, &refined, threshold, options);
        timing.verification += start.elapsed().as_secs_f64();
        let before = found.len();
        let mut verifier = Verifier::default();
        for e in verified {
            if found.len() >= options.max_instances || e.confidence < options.min_score {
                break;
            }
            let mut pixels = verifier.explained_pixels(scene, &model.mesh, &e.camera_from_object, threshold);
            let shared = pixels.iter().filter(|p| taken.binary_search(p).is_ok()).count();
            if pixels.is_empty() || shared * MAX_SHARED.1 > pixels.len() * MAX_SHARED.0 {
                continue;
            }
            taken.append(&mut pixels);
            taken.sort_unstable();
            taken.dedup();
            found.push(e);
        }
        if found.len() == before || found.len() >= options.max_instances {
            break;
        }
    }
    found.sort_by(|a, b| b.confidence.total_cmp(&a.confidence));
    (found, timing)
}

/// Indices of the model's samples that are visible at a pose.
fn visible_samples(model: &ObjectModel, pose: &Pose) -> impl Iterator<Item = usize> {
    let centre = pose.transform_point(&model.centre);
    let towards = pose.inverse().transform_direction(&-centre.normalize()).cast::<f32>();
    let bit = 1u64 << model.view_of(&towards);
    model.visible_from.iter().enumerate().filter(move |(_, v)| **v & bit != 0).map(|(i, _)| i)
}

/// How well the visible samples agree with the depth image, in 0..=1.
#[doc(hidden)]
pub(crate) fn screening_score(
    scene: &DepthRegion,
    model: &ObjectModel,
    pose: &Pose,
    tolerance: f32,
    cosine: f32,
) -> f32 {
    let rotation = pose.rotation_matrix().cast::<f32>();
    let t: V3 = pose.translation().cast();
    let (fx, fy) = (scene.camera().fx as f32, scene.camera().fy as f32);
    let (cx, cy) = (scene.camera().cx as f32, scene.camera().cy as f32);
    let (width, height) = (scene.camera().width as f32, scene.camera().height as f32);
    let (mut total, mut good, mut occluded, mut out) = (0f32, 0f32, 0f32, 0f32);
    for i in visible_samples(model, pose) {
        let p = rotation * model.samples.points[i].cast::<f32>() + t;
        let n = rotation * model.samples.normals[i].cast::<f32>();
        if p.z <= NEAREST {
            continue;
        }
        let x = (fx * p.x / p.z + cx).round();
        let y = (fy * p.y / p.z + cy).round();
        total += 1.0;
        if !(x >= 0.0 && y >= 0.0 && x < width && y < height) {
            occluded += 1.0;
            continue;
        }
        let pixel = (x as usize, y as usize);
        let z = scene.depth()[pixel];
        if z <= 0.0 {
            continue;
        }
        // Distance to the tangent plane along the ray: at grazing angles the depth may differ by more.
        let slope = (-n.dot(&p) / p.norm()).clamp(MIN_SLOPE, 1.0);
        let difference = (z - p.z) * slope;
        if difference > tolerance {
            out += 1.0;
        } else if difference < -tolerance {
            occluded += 1.0;
        } else {
            let m = scene.normals()[pixel];
            let agreement = n.x * m[0] + n.y * m[1] + n.z * m[2];
            good += if agreement > cosine { 1.0 } else { DEPTH_ALONE };
        }
    }
    if total == 0.0 {
        return 0.0;
    }
    let seen = total - occluded;
    good / (seen + HIDDEN_WEIGHT * total) * (1.0 - out / total)
}

/// The first selection: compares the samples of every hypothesis with the depth image, runs a short ICP for the best
/// [`PpfOptions::refined`], and removes duplicates; best first.
pub fn screen(
    scene: &DepthRegion,
    model: &ObjectModel,
    target: &IndexedCloud,
    clusters: &[Hypothesis],
    options: &PpfOptions,
) -> Vec<Hypothesis> {
    let step = model.diameter * model.options.sampling_step;
    let coarse = (COARSE_TOLERANCE * step).max(MIN_COARSE_TOLERANCE) as f32;
    let mut scored: Vec<(f32, usize)> = clusters
        .par_iter()
        .enumerate()
        .map(|(i, h)| (screening_score(scene, model, &h.camera_from_object, coarse, COARSE_COSINE), i))
        .collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    // The best by agreement, and those with the most votes regardless of their score: the coarse pose of a thin or curved object
    // agrees poorly before the refinement.
    let by_votes = options.refined / BY_VOTES;
    let mut rank = 0;
    scored.retain(|&(_, i)| {
        rank += 1;
        rank <= options.refined - by_votes || i < by_votes
    });
    let level = |(steps, iterations)| IcpLevel { rejection_distance: steps * step, iterations, stride: 1 };
    let short = IcpOptions {
        levels: SHORT_LEVELS.map(level).to_vec(),
        max_angle: SHORT_ANGLE.to_radians(),
        convergence: SHORT_CONVERGENCE,
        min_correspondences: SHORT_CORRESPONDENCES,
    };
    let fine = (FINE_TOLERANCE * step).max(options.verification.threshold_for(model.diameter)) as f32;
    let mut refined: Vec<(f32, usize, Pose)> = scored
        .par_iter()
        .map(|&(_, i)| {
            let start = clusters[i].camera_from_object;
            let mut source = PointCloud::default();
            for k in visible_samples(model, &start) {
                source.points.push(model.samples.points[k]);
                source.normals.push(model.samples.normals[k]);
            }
            let pose = icp(&source, target, &start, &short).map_or(start, |r| r.target_from_source);
            (screening_score(scene, model, &pose, fine, FINE_COSINE), i, pose)
        })
        .collect();
    refined.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    // Half of the hypotheses are selected by votes, half by agreement.
    let limit = options.verified * if options.max_instances > 1 { SEVERAL } else { 1 };
    let mut by_votes: Vec<_> = refined.clone();
    by_votes.sort_by_key(|&(_, i, _)| i);
    let mixed = refined.into_iter().zip(by_votes).flat_map(|(a, b)| [a, b]);
    // Hypotheses that converged to the same pose are merged.
    let mut kept: Vec<Hypothesis> = vec![];
    for (_, i, pose) in mixed {
        let votes = clusters[i].votes;
        let centre = |p: &Pose| p.transform_point(&model.centre);
        let same = kept.iter().position(|k| {
            (centre(&k.camera_from_object) - centre(&pose)).norm() < SAME_PLACE * model.diameter
                && k.camera_from_object.rotation_angle_to(&pose) < SAME_ANGLE
        });
        match same {
            Some(k) => kept[k].votes = kept[k].votes.max(votes),
            None if kept.len() < limit => kept.push(Hypothesis { camera_from_object: pose, votes }),
            None => {}
        }
    }
    kept
}

/// The second selection: hypotheses refined and verified with the mesh, sorted by confidence.
fn verified(
    scene: &DepthRegion,
    model: &ObjectModel,
    hypotheses: &[Hypothesis],
    threshold: f64,
    options: &PpfOptions,
) -> Vec<PpfEstimate> {
    let most_votes = hypotheses.iter().map(|h| h.votes).fold(0.0, f32::max);
    let poses: Vec<Pose> = hypotheses.iter().map(|h| h.camera_from_object).collect();
    let mut verified: Vec<PpfEstimate> = verify(scene, &model.mesh, &poses, threshold, &options.verification)
        .into_iter()
        .zip(hypotheses)
        .map(|(v, h)| {
            let support = f64::from(h.votes / most_votes.max(1.0)).clamp(0.0, 1.0);
            let confidence = v.score.ranking() * support.powf(options.vote_power);
            PpfEstimate {
                camera_from_object: v.camera_from_object,
                score: v.score,
                votes: h.votes,
                confidence,
            }
        })
        .collect();
    // A stable sort: ties keep the order of the screening.
    verified.sort_by(|a, b| b.confidence.total_cmp(&a.confidence));
    verified
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_out_of_range_are_named() {
        let options = PpfOptions::default();
        assert_eq!(options.check(), Ok(()));
        assert_eq!(PpfOptions { min_score: 1.1, ..options.clone() }.check(), Ok(()));
        let named = |options: PpfOptions| options.check().unwrap_err().option;
        let voting = VotingOptions { bin_margin: f32::NAN, ..options.voting };
        assert_eq!(named(PpfOptions { voting, ..options.clone() }), "voting.bin_margin");
        let clustering = ClusterOptions { distance: 0.0, ..options.clustering };
        assert_eq!(named(PpfOptions { clustering, ..options.clone() }), "clustering.distance");
        let verification = VerificationOptions { normal_angle: -1.0, ..options.verification };
        assert_eq!(named(PpfOptions { verification, ..options.clone() }), "verification.normal_angle");
        assert_eq!(named(PpfOptions { vote_power: f64::NAN, ..options.clone() }), "vote_power");
        assert_eq!(named(PpfOptions { min_score: f64::NAN, ..options.clone() }), "min_score");
        assert_eq!(named(PpfOptions { max_instances: 0, ..options }), "max_instances");
    }
}
