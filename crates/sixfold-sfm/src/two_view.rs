//! The camera's motion between two photographs: RANSAC (Fischler and Bolles 1981) over the five-point method, and the homography if
//! all matches lie on one plane, because a plane allows two motions.

use rand::RngExt;
use sixfold_geometry::homography::homography;
use sixfold_geometry::random::stream;
use sixfold_geometry::stats::median;
use sixfold_geometry::{Mat3, Pose, Vec2};

use crate::five_point::essential_matrices;
use crate::homography::{motions, transfer};
use crate::relative::{before_both, essential, motion_of, parallax, refined, sampson};

/// Probability that at least one sample contains no wrong match. Chosen by hand; not swept.
const CONFIDENCE: f64 = 0.999;
/// The matches count as planar if a homography holds for this fraction of those that agree with the motion.
/// Chosen by hand; not swept.
const PLANAR: f64 = 0.9;
/// Samples of four matches for the homography. Chosen by hand; not swept.
const PLANE_SAMPLES: usize = 100;
/// Passes of refining the motion with the best matches. Chosen by hand; not swept.
const PASSES: usize = 3;
/// Minimum fraction of the agreeing matches in front of both cameras. Chosen by hand; not swept.
const BEFORE: f64 = 0.7;

/// The geometry of two photographs.
#[derive(Debug, Clone, PartialEq)]
pub struct TwoViews {
    /// Indices of the matches that agree with the motion.
    pub inliers: Vec<usize>,
    /// Takes points of the first camera's frame to the second's, translation of length 1; for points on a plane there may be two.
    pub motions: Vec<Pose>,
    /// Median angle between the two rays to a point, degrees.
    pub angle: f64,
    /// Whether all agreeing matches lie on one plane.
    pub planar: bool,
}

/// The motion that most matches agree with. `pairs` are points on the planes `z = 1`; `threshold` is a distance there. `None` for
/// fewer than eight matches, or if no motion has eight that agree. The same input and seed give the same motion.
pub fn two_views(pairs: &[(Vec2, Vec2)], threshold: f64, samples: usize, seed: u64) -> Option<TwoViews> {
    let count = pairs.len();
    if count < 8 {
        return None;
    }
    let limit = threshold * threshold;
    let gain = |e: Mat3| pairs.iter().map(|p| (1.0 - sampson(&e, p).powi(2) / limit).max(0.0)).sum::<f64>();
    let agreeing =
        |e: Mat3| (0..count).filter(|i| sampson(&e, &pairs[*i]).powi(2) < limit).collect::<Vec<usize>>();
    let mut random = stream(seed, 0);
    let (mut best, mut needed): (Option<(f64, Pose)>, usize) = (None, samples);
    let mut done = 0;
    while done < needed.min(samples) {
        done += 1;
        let Some(chosen) = distinct::<5>(&mut random, count) else { break };
        let [first, second] = [chosen.map(|i| pairs[i].0), chosen.map(|i| pairs[i].1)];
        for e in essential_matrices(&first, &second) {
            let sum = gain(e);
            if best.as_ref().is_some_and(|b| sum <= b.0) || sum < 6.0 {
                continue;
            }
            let inliers = agreeing(e);
            let of: Vec<(Vec2, Vec2)> = inliers.iter().map(|i| pairs[*i]).collect();
            let Some(motion) = motion_of(&e, &of) else { continue };
            // The motion of a sample is noisy: refine it over all matches that agree.
            let motion = refined(&motion, pairs, 2.0 * threshold, 3);
            let e = essential(&motion);
            let sum = sum.max(gain(e));
            if best.as_ref().is_none_or(|b| sum > b.0) {
                let fraction = agreeing(e).len() as f64 / count as f64;
                let clean = (1.0 - CONFIDENCE).ln() / (1.0 - fraction.powi(5)).ln();
                needed =
                    if clean.is_finite() { (clean.ceil() as usize).max(20) } else { needed.min(done + 20) };
                best = Some((sum, motion));
            }
        }
    }
    let mut motion = refined(&best?.1, pairs, threshold, 20);
    // Repeat without residuals above four standard deviations: in a narrow view, a wrong match within the threshold has a strong
    // influence.
    for _ in 0..PASSES {
        let e = essential(&motion);
        let mut errors: Vec<f64> =
            pairs.iter().map(|p| sampson(&e, p).abs()).filter(|r| *r < threshold).collect();
        let deviation = 1.4826 * median(&mut errors)?;
        motion = refined(&motion, pairs, (4.0 * deviation).clamp(1e-3 * threshold, threshold), 20);
    }
    of_motion(pairs, &motion, threshold, seed)
}

fn of_motion(pairs: &[(Vec2, Vec2)], motion: &Pose, threshold: f64, seed: u64) -> Option<TwoViews> {
    let e = essential(motion);
    let inliers: Vec<usize> =
        (0..pairs.len()).filter(|i| sampson(&e, &pairs[*i]).abs() < threshold).collect();
    let of: Vec<(Vec2, Vec2)> = inliers.iter().map(|i| pairs[*i]).collect();
    if of.len() < 8 {
        return None;
    }
    let motion = motion_of(&e, &of)?;
    let mut angles: Vec<f64> = of.iter().map(|p| parallax(&motion, p).to_degrees()).collect();
    let angle = median(&mut angles)?;
    // Nearly parallel rays intersect anywhere, so whether their points are in front of the cameras carries no information.
    if angle > 1.0 && (before_both(&motion, &of) as f64) < BEFORE * of.len() as f64 {
        return None;
    }
    let (planar, others) = match plane(&of, threshold, seed) {
        Some(map) => (true, motions(&map, &of)),
        None => (false, vec![]),
    };
    let mut motions = vec![motion];
    for other in others {
        let apart = |m: &Pose| {
            m.rotation_angle_to(&other) + m.translation().cross(&other.translation()).norm()
                > 5f64.to_radians()
        };
        if motions.iter().all(apart) {
            motions.push(other);
        }
    }
    Some(TwoViews { inliers, motions, angle, planar })
}

/// The homography of a plane that contains nearly all matches.
fn plane(pairs: &[(Vec2, Vec2)], threshold: f64, seed: u64) -> Option<Mat3> {
    let mut random = stream(seed, 1);
    // Transfer errors are about twice as long as distances from epipolar lines.
    let limit = (2.0 * threshold).powi(2);
    let agreeing =
        |map: &Mat3| pairs.iter().filter(|p| transfer(map, p) < limit).copied().collect::<Vec<_>>();
    let mut best: Vec<(Vec2, Vec2)> = vec![];
    for _ in 0..PLANE_SAMPLES {
        let chosen = distinct::<4>(&mut random, pairs.len())?;
        let Some(map) = homography(&chosen.map(|i| pairs[i])) else { continue };
        let found = agreeing(&map);
        if found.len() > best.len() {
            best = found;
        }
    }
    let map = homography(&best)?;
    (agreeing(&map).len() as f64 > PLANAR * pairs.len() as f64).then_some(map)
}

/// Different numbers below `count`.
fn distinct<const N: usize>(
    random: &mut sixfold_geometry::random::Random,
    count: usize,
) -> Option<[usize; N]> {
    if count < N {
        return None;
    }
    let mut chosen = [usize::MAX; N];
    for k in 0..N {
        chosen[k] = loop {
            let i = random.random_range(0..count);
            if !chosen[..k].contains(&i) {
                break i;
            }
        };
    }
    Some(chosen)
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Vec3;

    fn scene(motion: &Pose, count: usize, flat: bool, wrong: f64) -> Vec<(Vec2, Vec2)> {
        let mut random = stream(5, 0);
        (0..count)
            .map(|i| {
                let mut number = |low: f64, high: f64| random.random_range(low..high);
                let (x, y, z) = (number(-1.0, 1.0), number(-1.0, 1.0), number(-0.5, 0.5));
                let p = Vec3::new(x, y, 3.0 + 0.3 * x + if flat { 0.0 } else { z });
                let q = motion.transform_point(&p);
                let b = if (i as f64) < wrong * count as f64 {
                    Vec2::new(number(-0.4, 0.4), number(-0.4, 0.4))
                } else {
                    (q / q.z).xy()
                };
                ((p / p.z).xy(), b)
            })
            .collect()
    }

    #[test]
    fn the_motion_is_found_among_wrong_matches_and_on_a_plane() {
        let motion = Pose::exp(&[0.8, 0.1, 0.2, 0.05, -0.25, 0.1].into());
        let truth = motion.with_translation(motion.translation().normalize());
        for (flat, wrong) in [(false, 0.0), (false, 0.5), (true, 0.0), (true, 0.3)] {
            let pairs = scene(&motion, 200, flat, wrong);
            let found = two_views(&pairs, 0.003, 1000, 1).unwrap();
            let error = |m: &Pose| (m.inverse() * truth).log().norm();
            let best = found.motions.iter().map(error).fold(f64::INFINITY, f64::min);
            assert!(best < 1e-4, "{flat} {wrong}: {best:e}");
            assert_eq!(found.planar, flat);
            let right = 200 - (200.0 * wrong) as usize;
            assert!(found.inliers.len() >= right && found.inliers.len() <= right + 10);
            assert_eq!(Some(found), two_views(&pairs, 0.003, 1000, 1));
        }
    }

    #[test]
    fn a_rotation_alone_has_no_angle() {
        let rotation = Pose::exp(&[0.0, 0.0, 0.0, 0.05, -0.25, 0.1].into());
        let found = two_views(&scene(&rotation, 100, false, 0.0), 0.003, 200, 1).unwrap();
        assert!(found.angle < 0.1, "{}", found.angle);
        assert!(two_views(&[], 0.003, 200, 1).is_none());
    }
}
