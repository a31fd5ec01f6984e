//! From matches to poses and points: geometry of all pairs, the largest group of matching photographs, and several initial pairs,
//! of which the best result is kept.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use rayon::prelude::*;
use sixfold_geometry::{Camera, Pose, Progress, Vec2, Vec3, stats::median};

use crate::error::{LeftOut, SfmError};
use crate::incremental::Growing;
use crate::lens::Lens;
use crate::matching::PairMatches;
use crate::options::SfmOptions;
use crate::tracks::{Track, joined};
use crate::two_view::{TwoViews, two_views};

/// Focal lengths that are tried if the camera is a guess, as fractions of the guess, and the number of pairs of photographs used.
/// Chosen by hand; not swept.
const FOCAL_LENGTHS: [f64; 7] = [0.6, 0.7, 0.82, 0.95, 1.1, 1.3, 1.55];
const FOCAL_PAIRS: usize = 12;
/// Maximum number of initial pairs that are tried. Chosen by hand; not swept.
const BEGINNINGS: usize = 6;
/// An initial pair that leads to this fraction of registered photographs is good enough. Chosen by hand; not swept.
const GOOD: f64 = 0.95;
/// Angle above which a larger one does not make a better initial pair, degrees; and the factor for planar pairs.
/// Chosen by hand; not swept.
const WIDE: f64 = 16.0;
const PLANE: f64 = 0.6;

/// A point of the scene.
#[derive(Debug, Clone, PartialEq)]
pub struct ScenePoint {
    /// Its position.
    pub position: Vec3,
    /// Photographs that show it, and the feature in each.
    pub seen: Vec<(usize, u32)>,
}

/// A reconstruction. The unit of length is the median distance of a photograph from its points.
#[derive(Debug, Clone, PartialEq)]
pub struct Reconstruction {
    /// The camera, refined if it was a guess.
    pub camera: Camera,
    /// For each photograph the camera's pose, or why it has none; the camera frame of the first photograph with a pose is the
    /// world's frame.
    pub camera_from_world: Vec<Result<Pose, LeftOut>>,
    /// Points of the scene.
    pub points: Vec<ScenePoint>,
    /// Root mean square reprojection error, pixels.
    pub rms_px: f64,
}

/// Two photographs, their geometry, and the matches that agree with it.
type Pair = ((usize, usize), TwoViews, Vec<(u32, u32)>);
type Pairs = Vec<Pair>;

/// Reconstructs a static scene from photographs. `pixels` holds the features of each photograph in raw pixels, `matches` the
/// matches of pairs (which may contain wrong ones), `camera` the camera of all photographs: exact, or a guess if
/// [`SfmOptions::refine_camera`] is set. Progress counts pairs of photographs, then photographs.
///
/// # Errors
/// [`SfmError`].
pub fn reconstruct(
    pixels: &[Vec<Vec2>],
    matches: &[PairMatches],
    camera: &Camera,
    options: &SfmOptions,
    progress: &dyn Progress,
) -> Result<Reconstruction, SfmError> {
    options.check()?;
    camera.check()?;
    check_matches(pixels, matches)?;
    let pinhole = without_lens(pixels, camera, options);
    let pixels = &pinhole[..];
    let total = matches.len() + pixels.len();
    let mut lens = Lens::of(camera);
    if !options.refine_camera {
        lens = Lens::of(&camera.without_distortion());
    }
    let enough: Vec<&PairMatches> =
        matches.iter().filter(|m| m.matches.len() >= options.min_matches).collect();
    if options.refine_camera {
        lens = with_best_focal_length(&lens, pixels, &enough, options);
    }
    let pairs = geometry(&lens, pixels, &enough, options, &|done| progress.report(done, total))
        .ok_or(SfmError::Stopped)?;
    let most = |i: usize| {
        let with = |((a, b), views, _): &Pair| if *a == i || *b == i { views.inliers.len() } else { 0 };
        pairs.iter().map(with).max().unwrap_or(0)
    };
    let most: Vec<usize> = (0..pixels.len()).map(most).collect();
    let pairs: Pairs = pairs.into_iter().filter(|(_, v, _)| v.inliers.len() >= options.min_matches).collect();
    let (group, left_out) = largest_group(pixels, &pairs, &most, options)?;
    let pairs: Pairs =
        pairs.into_iter().filter(|(p, ..)| group.contains(&p.0) && group.contains(&p.1)).collect();
    let degrees = pairs.iter().map(|(_, views, _)| views.angle).fold(0.0, f64::max);
    if degrees < options.min_angle {
        return Err(SfmError::NoBaseline { degrees, minimum: options.min_angle });
    }
    let tracks = tracks_of(pixels, &pairs);
    let go = |done: usize| progress.report(matches.len() + done, total);
    let best = best_beginning(pixels, &tracks, &pairs, &group, &lens, options, &go)?;
    let found = best.filter(|b| b.registered() >= options.min_photographs);
    let Some(mut state) = found else {
        return Err(SfmError::TooFew { found: 0, minimum: options.min_photographs, left_out });
    };
    state.adjust(50);
    state.adjust(50);
    progress.report(total, total);
    Ok(finished(&state, camera, left_out))
}

fn check_matches(pixels: &[Vec<Vec2>], matches: &[PairMatches]) -> Result<(), SfmError> {
    for PairMatches { pair: (first, second), matches } in matches {
        let (first, second) = (*first, *second);
        let wrong = |what: String| SfmError::Matches { first, second, what };
        if first >= second || second >= pixels.len() {
            return Err(wrong(format!("expected two different of {}, the smaller first", pixels.len())));
        }
        let (a, b) = (pixels[first].len(), pixels[second].len());
        if let Some((i, j)) = matches.iter().find(|(i, j)| *i as usize >= a || *j as usize >= b) {
            return Err(wrong(format!("features {i} and {j}, expected less than {a} and {b}")));
        }
    }
    Ok(())
}

/// Pixels without the distortion of a known camera.
fn without_lens(pixels: &[Vec<Vec2>], camera: &Camera, options: &SfmOptions) -> Vec<Vec<Vec2>> {
    if options.refine_camera {
        return pixels.to_vec();
    }
    // Pixels whose distortion cannot be inverted are moved far outside, where they agree with nothing.
    let of = |p: &Vec2| camera.undistort_point(p).unwrap_or(Vec2::repeat(-1e6));
    pixels.iter().map(|all| all.iter().map(of).collect()).collect()
}

fn rays(lens: &Lens, pixels: &[Vec<Vec2>], of: &PairMatches) -> Vec<(Vec2, Vec2)> {
    let ray = |photograph: usize, feature: u32| {
        lens.ray(&pixels[photograph][feature as usize]).unwrap_or(Vec2::repeat(1e3))
    };
    of.matches.iter().map(|(i, j)| (ray(of.pair.0, *i), ray(of.pair.1, *j))).collect()
}

fn seed_of(options: &SfmOptions, (a, b): (usize, usize)) -> u64 {
    options.seed.wrapping_mul(0x9e37_79b9).wrapping_add((a as u64) << 20 | b as u64)
}

fn of_pair(lens: &Lens, pixels: &[Vec<Vec2>], m: &PairMatches, options: &SfmOptions) -> Option<TwoViews> {
    let threshold = options.threshold_px / lens.numbers[0];
    two_views(&rays(lens, pixels, m), threshold, options.samples, seed_of(options, m.pair))
}

/// The focal length with which most matches of the strongest pairs agree with a motion.
fn with_best_focal_length(
    lens: &Lens,
    pixels: &[Vec<Vec2>],
    all: &[&PairMatches],
    options: &SfmOptions,
) -> Lens {
    let mut strongest = all.to_vec();
    strongest.sort_by_key(|m| (std::cmp::Reverse(m.matches.len()), m.pair));
    // Neighbouring pairs are similar: take every third of three times as many.
    let chosen: Vec<&PairMatches> = strongest.into_iter().step_by(3).take(FOCAL_PAIRS).collect();
    // A tight threshold, so that errors of a few pixels show.
    let tight = SfmOptions { threshold_px: 0.5 * options.threshold_px, ..*options };
    let agreeing = |factor: &f64| {
        let lens = lens.with_focal_length(factor * lens.numbers[0]);
        let of = |m: &&PairMatches| of_pair(&lens, pixels, m, &tight).map_or(0, |v| v.inliers.len());
        chosen.par_iter().map(of).sum::<usize>()
    };
    let as_it_is = options.focal_length_from_camera.then_some(1.0);
    let factors: Vec<f64> = as_it_is.into_iter().chain(FOCAL_LENGTHS).collect();
    let counts: Vec<usize> = factors.iter().map(agreeing).collect();
    let most = counts.iter().copied().max().unwrap_or(0);
    // The nearest to the guess among those that are about as good as the best.
    let best = factors
        .iter()
        .zip(&counts)
        .filter(|(_, count)| **count as f64 >= 0.98 * most as f64)
        .min_by(|a, b| a.0.ln().abs().total_cmp(&b.0.ln().abs()));
    best.map_or(*lens, |(factor, _)| lens.with_focal_length(factor * lens.numbers[0]))
}

/// The geometry of all pairs that have one; `None` when asked to stop.
fn geometry(
    lens: &Lens,
    pixels: &[Vec<Vec2>],
    all: &[&PairMatches],
    options: &SfmOptions,
    go: &(dyn Fn(usize) -> bool + Sync),
) -> Option<Pairs> {
    let (done, going) = (AtomicUsize::new(0), AtomicBool::new(true));
    let of = |m: &&PairMatches| {
        if !going.load(Ordering::Relaxed) {
            return None;
        }
        let found = of_pair(lens, pixels, m, options);
        if !go(done.fetch_add(1, Ordering::Relaxed) + 1) {
            going.store(false, Ordering::Relaxed);
        }
        let views = found?;
        let matches = views.inliers.iter().map(|i| m.matches[*i]).collect();
        Some((m.pair, views, matches))
    };
    let found: Vec<Option<_>> = all.par_iter().map(of).collect();
    going.into_inner().then(|| found.into_iter().flatten().collect())
}

type Group = (Vec<usize>, Vec<Option<LeftOut>>);

/// The largest group of matching photographs, and why the others are not in it. `most` holds for each photograph the largest number
/// of matches with another one that agree with a motion.
fn largest_group(
    pixels: &[Vec<Vec2>],
    pairs: &Pairs,
    most: &[usize],
    options: &SfmOptions,
) -> Result<Group, SfmError> {
    let count = pixels.len();
    let mut group: Vec<usize> = (0..count).collect();
    for ((a, b), ..) in pairs {
        let (from, into) = (group[*a].max(group[*b]), group[*a].min(group[*b]));
        group.iter_mut().filter(|g| **g == from).for_each(|g| *g = into);
    }
    let members = |of: usize| (0..count).filter(|i| group[*i] == of).collect::<Vec<usize>>();
    let largest = (0..count).map(members).reduce(|best, g| if g.len() > best.len() { g } else { best });
    let largest = largest.unwrap_or_default();
    let reason = |i: usize| {
        if largest.contains(&i) && largest.len() > 1 {
            return None;
        }
        let (found, minimum) = (pixels[i].len(), options.min_features);
        if found < minimum {
            return Some(LeftOut::FewFeatures { found, minimum });
        }
        let own = members(group[i]);
        if own.len() > 1 {
            return Some(LeftOut::OtherGroup { group: own.into_iter().filter(|k| *k != i).collect() });
        }
        Some(LeftOut::FewMatches { found: most[i], minimum: options.min_matches })
    };
    let left_out: Vec<Option<LeftOut>> = (0..count).map(reason).collect();
    if largest.len() < options.min_photographs.max(2) {
        let found = if largest.len() > 1 { largest.len() } else { 0 };
        return Err(SfmError::TooFew { found, minimum: options.min_photographs, left_out });
    }
    Ok((largest, left_out))
}

fn tracks_of(pixels: &[Vec<Vec2>], pairs: &Pairs) -> Vec<Track> {
    let counts: Vec<usize> = pixels.iter().map(Vec::len).collect();
    let mut order: Vec<&Pair> = pairs.iter().collect();
    order.sort_by_key(|(pair, _, matches)| (std::cmp::Reverse(matches.len()), *pair));
    let all = order
        .into_iter()
        .flat_map(|((a, b), _, matches)| matches.iter().map(move |(i, j)| [(*a, *i), (*b, *j)]));
    joined(&counts, all)
}

fn best_beginning<'a>(
    pixels: &'a [Vec<Vec2>],
    tracks: &'a [Track],
    pairs: &Pairs,
    group: &[usize],
    lens: &Lens,
    options: &'a SfmOptions,
    go: &dyn Fn(usize) -> bool,
) -> Result<Option<Growing<'a>>, SfmError> {
    let score = |v: &TwoViews| {
        let wide = v.angle.min(WIDE) * if v.angle < options.min_angle { 0.0 } else { 1.0 };
        wide * (v.inliers.len() as f64).sqrt() * if v.planar { PLANE } else { 1.0 }
    };
    let mut order: Vec<&Pair> = pairs.iter().collect();
    order.sort_by(|a, b| score(&b.1).total_cmp(&score(&a.1)).then(a.0.cmp(&b.0)));
    let beginnings = order.iter().flat_map(|(pair, v, _)| v.motions.iter().map(move |m| (*pair, m)));
    let mut best: Option<Growing<'a>> = None;
    for (pair, motion) in beginnings.take(BEGINNINGS) {
        let Some(mut state) = Growing::started(pixels, tracks, options, lens, pair, motion) else { continue };
        if !state.grow(group, go) {
            return Err(SfmError::Stopped);
        }
        let worth = |s: &Growing<'_>| (s.registered(), s.agreeing());
        let planar = order.iter().any(|(p, v, _)| *p == pair && v.motions.len() > 1);
        let good = !planar && state.registered() as f64 >= GOOD * group.len() as f64;
        if best.as_ref().is_none_or(|b| worth(&state) > worth(b)) {
            best = Some(state);
        }
        if good {
            break;
        }
    }
    Ok(best)
}

fn finished(state: &Growing<'_>, camera: &Camera, left_out: Vec<Option<LeftOut>>) -> Reconstruction {
    let first = state.poses.iter().flatten().next().copied().unwrap_or_default();
    let mut distances = vec![];
    let (mut squares, mut count) = (0.0, 0usize);
    for (track, point) in state.tracks.iter().zip(&state.points) {
        let Some((point, used)) = point else { continue };
        for ((photograph, feature), _) in track.iter().zip(used).filter(|(_, used)| **used) {
            let Some(pose) = state.poses[*photograph] else { continue };
            let p = pose.transform_point(point);
            distances.push(p.norm());
            if let Some(pixel) = state.lens.project(&p) {
                squares += (pixel - state.pixels[*photograph][*feature as usize]).norm_squared();
                count += 1;
            }
        }
    }
    let unit = median(&mut distances).filter(|d| *d > 0.0).unwrap_or(1.0);
    let scaled = |pose: &Pose| {
        let pose = pose * &first.inverse();
        pose.with_translation(pose.translation() / unit)
    };
    let pose_of = |(i, left): (usize, Option<LeftOut>)| match (&state.poses[i], left) {
        (Some(pose), None) => Ok(scaled(pose)),
        (_, Some(reason)) => Err(reason),
        (None, None) => Err(state.left_out[i].clone().unwrap_or(LeftOut::FewInliers { found: 0, of: 0 })),
    };
    let points = state.tracks.iter().zip(&state.points).filter_map(|(track, point)| {
        let (position, used) = point.as_ref()?;
        let seen = track.iter().zip(used).filter(|(_, used)| **used).map(|(seen, _)| *seen).collect();
        Some(ScenePoint { position: first.transform_point(position) / unit, seen })
    });
    Reconstruction {
        camera: if state.options.refine_camera { state.lens.camera() } else { *camera },
        camera_from_world: left_out.into_iter().enumerate().map(pose_of).collect(),
        points: points.collect(),
        rms_px: (squares / count.max(1) as f64).sqrt(),
    }
}
