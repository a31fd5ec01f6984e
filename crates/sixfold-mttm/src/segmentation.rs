//! Masks by the network alone, before any alignment (dissertation, sections 5.2.4 and 5.3.2).
//!
//! Descriptors choose regions and their nearest templates; for each pair the network predicts mask, position of the object, and
//! whether both match. The regions are then centred on the predicted positions and matched again without their background. The
//! dissertation does this once, with the centre of the mask, and ranks regions by the distance of descriptors. Here it is repeated
//! [`ROUNDS`] times, with the predicted position, and regions are ranked by the predicted probability of a match.

use std::sync::Arc;

use rayon::prelude::*;
use sixfold_align::DepthRegion;
use sixfold_geometry::{Pose, Vec3};

use crate::align::camera_from_view;
use crate::by_network::{encode, start};
use crate::estimate::{
    APART, KnownObject, MttmOptions, Placed, SAME_ROTATION, Stages, apart, is_known, place_at,
};
use crate::learned::Learned;
use crate::mask::Pixels;
use crate::matching::Entry;
use crate::model::PairOutput;
use crate::published::{MERGED, MIN_MASK, mask_pixels, overlaps, visible_centre};
use crate::regions::RegionCache;
use crate::roi::Roi;

/// Regions of the first matching that are compared with their templates as pairs: those with the nearest templates. Chosen by hand;
/// not swept.
const COMPARED: usize = 200;
/// Most probable matches of all rounds whose masks are compared; chosen by hand for run time, not swept.
const MASKED: usize = 200;
/// Regions that are centred and matched again in each round, those with the most probable matches. Chosen by hand; not swept.
const CENTRED: usize = 40;
/// Smallest distance of their centres, as a fraction of the diameter; chosen by hand, not swept.
const CENTRES_APART: f64 = 0.1;
/// How often regions are centred and matched again: of 100 targets the best regions had right masks for 67, 73, 75, 76 and 76 after
/// 0 to 4 rounds.
const ROUNDS: usize = 3;
/// Templates that a centred region is compared with: 8 instead of 4 change nothing.
const TEMPLATES: usize = 4;
/// Nearest templates examined for each of them: most are neighbours of one another. Chosen by hand; not swept.
const NEAREST: usize = 60;
/// Pairs that go through the network at a time; does not affect the result.
const AT_A_TIME: usize = 32;

/// A region, a template, and what the network predicts for the pair.
#[derive(Debug, Clone)]
struct Candidate {
    roi: Roi,
    entry: Entry,
    output: PairOutput,
    /// The object's predicted position, camera frame.
    centre: Vec3,
}

impl Candidate {
    fn new(scene: &DepthRegion, learned: &Learned, roi: Roi, entry: Entry, output: PairOutput) -> Candidate {
        let place = match output.offset {
            Some(offset) => Vec3::from(offset) * learned.size(),
            None => visible_centre(scene, &roi, learned.size(), &output.mask),
        };
        Candidate { centre: roi.camera_from_roi().transform_point(&place), roi, entry, output }
    }
}

/// Most probable matches first; ties keep their order.
fn sort(candidates: &mut [Candidate]) {
    candidates.sort_by(|a, b| b.output.matching.total_cmp(&a.output.matching));
}

/// Masks that do not overlap, each with the poses of its candidates, which [`MttmOptions::align`] aligns. Without alignment the most
/// probable match is the best.
pub(crate) fn hypotheses(
    scene: &DepthRegion,
    object: &KnownObject,
    learned: &Learned,
    cache: &RegionCache,
    options: &MttmOptions,
    stages: &mut Stages,
) -> Vec<Placed> {
    let mut last = first_matching(scene, object, learned, cache, stages);
    let mut candidates = last.clone();
    for _ in 0..ROUNDS {
        sort(&mut last);
        last = matched_again(scene, object, learned, &last);
        candidates.extend(last.iter().cloned());
    }
    sort(&mut candidates);
    candidates.truncate(MASKED);
    let size = learned.size();
    let masks: Vec<Pixels> =
        candidates.par_iter().map(|c| mask_pixels(scene, &c.roi, size, &c.output.mask, 1)).collect();
    let mut regions: Vec<(Arc<Pixels>, Vec<&Candidate>)> = vec![];
    for (candidate, mask) in candidates.iter().zip(masks) {
        if mask.len() < MIN_MASK {
            continue;
        }
        if let Some((_, of_region)) = regions.iter_mut().find(|(kept, _)| overlaps(kept, &mask, MERGED)) {
            of_region.push(candidate);
        } else if regions.len() < options.regions {
            regions.push((Arc::new(mask), vec![candidate]));
        }
    }
    stages.regions = regions.len();
    regions
        .par_iter()
        .map(|(mask, of_region)| {
            let mut placed: Vec<Placed> = vec![];
            for c in of_region {
                if placed.len() == options.hypotheses {
                    break;
                }
                let pose = start(scene, object, learned, &c.roi, &c.entry, &c.output, options);
                if is_known(object, &placed, c.entry.template, &pose) {
                    continue;
                }
                let probability = f64::from(c.output.matching);
                let found = place_at(scene, object, c.entry.template, pose, probability, options);
                let support = if options.align { found.support } else { probability };
                placed.push(Placed { support, mask: Some(mask.clone()), ..found });
            }
            placed
        })
        .collect::<Vec<_>>()
        .concat()
}

/// The sampled regions whose nearest templates are nearest, compared with these.
fn first_matching(
    scene: &DepthRegion,
    object: &KnownObject,
    learned: &Learned,
    cache: &RegionCache,
    stages: &mut Stages,
) -> Vec<Candidate> {
    let regions = cache.of(scene, learned);
    stages.sampled = regions.sampled;
    let (nearest, order) = learned.nearest_first(&regions.descriptors);
    let chosen = apart(&regions.rois, order, APART * object.templates.diameter, COMPARED);
    let candidates = chosen.par_chunks(AT_A_TIME).map(|part| {
        let entries: Vec<Entry> = part.iter().map(|&i| object.matcher.entries()[nearest[i].1]).collect();
        let output = learned.model().compare(&regions.encoded(part), &learned.templates(&entries));
        let pairs = part.iter().zip(entries).zip(output);
        pairs.map(|((&i, e), o)| Candidate::new(scene, learned, regions.rois[i], e, o)).collect()
    });
    candidates.collect::<Vec<Vec<Candidate>>>().concat()
}

/// Regions centred on the positions of the first of `last` that are apart, matched without their background.
fn matched_again(
    scene: &DepthRegion,
    object: &KnownObject,
    learned: &Learned,
    last: &[Candidate],
) -> Vec<Candidate> {
    let distance = CENTRES_APART * object.templates.diameter;
    let mut seeds: Vec<&Candidate> = vec![];
    for c in last {
        if seeds.len() < CENTRED && seeds.iter().all(|s| (s.centre - c.centre).norm() > distance) {
            seeds.push(c);
        }
    }
    if seeds.is_empty() {
        return vec![];
    }
    let model = learned.model();
    let rois: Vec<Roi> = seeds.iter().map(|c| Roi { centre: c.centre }).collect();
    let regions = encode(scene, learned, &rois);
    let own: Vec<Entry> = seeds.iter().map(|c| c.entry).collect();
    let masks = model.compare(&regions, &learned.templates(&own)).into_iter().flat_map(|o| o.mask).collect();
    let descriptors = model.describe(&model.without_background(&regions, masks));
    let pairs: Vec<(usize, Entry)> = rois
        .par_iter()
        .zip(&descriptors)
        .enumerate()
        .map(|(region, (roi, descriptor))| {
            let entries = nearest_entries(object, learned, &roi.camera_from_roi(), descriptor, TEMPLATES);
            entries.into_iter().map(|e| (region, e)).collect()
        })
        .collect::<Vec<Vec<_>>>()
        .concat();
    let candidates = pairs.par_chunks(AT_A_TIME).map(|part| {
        let (numbers, entries): (Vec<usize>, Vec<Entry>) = part.iter().copied().unzip();
        let output = model.compare(&regions.select(&numbers), &learned.templates(&entries));
        part.iter().zip(output).map(|(p, o)| Candidate::new(scene, learned, rois[p.0], p.1, o)).collect()
    });
    candidates.collect::<Vec<Vec<Candidate>>>().concat()
}

/// The nearest templates whose poses differ.
pub(crate) fn nearest_entries(
    object: &KnownObject,
    learned: &Learned,
    camera_from_roi: &Pose,
    descriptor: &crate::model::Descriptor,
    most: usize,
) -> Vec<Entry> {
    let pose = |e: &Entry| object.object_pose(&camera_from_view(camera_from_roi, e.turn), e.template);
    let mut chosen: Vec<(Entry, Pose)> = vec![];
    for (_, number) in learned.ranked(descriptor).into_iter().take(NEAREST * most) {
        if chosen.len() == most {
            break;
        }
        let entry = object.matcher.entries()[number];
        let new = pose(&entry);
        if !chosen.iter().any(|c| c.1.rotation_angle_to(&new) < SAME_ROTATION) {
            chosen.push((entry, new));
        }
    }
    chosen.into_iter().map(|c| c.0).collect()
}
