//! Matching by the network: descriptors find templates; for each pair of region and template the network predicts mask, rotation,
//! position, and whether they match (dissertation, section 5.2.4).

use std::path::Path;
use std::sync::Arc;

use rayon::prelude::*;
use sixfold_align::DepthRegion;
use sixfold_estimator::Object;
use sixfold_geometry::{Pose, Vec3};

use crate::align::camera_from_view;
use crate::error::StoreError;
use crate::estimate::{
    APART, KnownObject, MatchedBy, MttmOptions, Placed, Stages, apart, is_known, place_at,
};
use crate::estimator::MttmEstimator;
use crate::learned::Learned;
use crate::matching::Entry;
use crate::model::{Encoded, MttmModel, PairOutput};
use crate::patch::Patch;
use crate::published::{self, visible_centre};
use crate::regions::RegionCache;
use crate::roi::Roi;
use crate::segmentation::nearest_entries;

/// Regions compared with their templates as pairs: fewest and most. Chosen by hand; not swept.
const COMPARED: (usize, usize) = (64, 400);
/// Pairs that go through the network at a time; does not affect the result.
const AT_A_TIME: usize = 32;
/// Lower bound of the trust in a pair, so that the network cannot reject a pose whose surface agrees. Chosen by hand; not swept.
const MIN_TRUST: f64 = 0.1;

/// Between those bounds, the number of compared regions is the number of sampled ones divided by [`ONE_IN`], minus [`LESS`]: a
/// fuller scene has more regions that resemble the object. Chosen by hand; not swept.
const ONE_IN: usize = 5;
/// See [`ONE_IN`].
const LESS: usize = 30;
/// Fraction (numerator, denominator) of the compared regions, the best matching ones, whose templates are aligned with the scene;
/// chosen by hand, not swept.
const ALIGNED: (usize, usize) = (3, 4);
impl KnownObject {
    /// The same object, with the network's descriptors of its templates.
    pub fn with_network(mut self, model: Arc<MttmModel>) -> KnownObject {
        self.learned = Some(Learned::new(model, &self.templates, self.matcher.entries()));
        self
    }

    /// The same, with the network's descriptors kept in a file. The second value says why an existing file could not be used or the
    /// new one could not be written.
    pub fn with_network_cached(
        mut self,
        model: Arc<MttmModel>,
        path: &Path,
    ) -> (KnownObject, Option<StoreError>) {
        let (learned, note) = Learned::cached(path, model, &self.templates, self.matcher.entries());
        self.learned = Some(learned);
        (self, note)
    }
}

impl MttmEstimator {
    /// The same object with the network's descriptors, if there is a network; problems with the descriptor file are added to
    /// `notes`.
    pub(crate) fn described(
        &self,
        known: KnownObject,
        object: &Object,
        notes: &mut Vec<String>,
    ) -> KnownObject {
        let Some(network) = &self.network else { return known };
        match object.file(&self.file_name("descriptors")) {
            None => known.with_network(network.clone()),
            Some(file) => {
                let (known, note) = known.with_network_cached(network.clone(), &file);
                let say = |n| format!("descriptors of {} not kept, or computed again: {n}", object.name);
                notes.extend(note.map(say));
                known
            }
        }
    }
}

/// Samples regions, finds the nearest template of each by descriptors, and aligns the best with the scene from the predicted pose.
/// With `MatchedBy::Both` each region is also matched by points there, and the template that agrees better with the scene is kept.
pub(crate) fn first_matching(
    scene: &DepthRegion,
    object: &KnownObject,
    learned: &Learned,
    cache: &RegionCache,
    options: &MttmOptions,
    stages: &mut Stages,
) -> Vec<Placed> {
    let diameter = object.templates.diameter;
    let size = learned.size();
    let regions = cache.of(scene, learned);
    let rois = &regions.rois;
    stages.sampled = regions.sampled;
    let (nearest, order) = learned.nearest_first(&regions.descriptors);
    let compared = (rois.len() / ONE_IN).saturating_sub(LESS).clamp(COMPARED.0, COMPARED.1);
    let chosen = apart(rois, order, APART * diameter, compared);
    let entries: Vec<Entry> = chosen.iter().map(|&i| object.matcher.entries()[nearest[i].1]).collect();
    let output: Vec<Vec<PairOutput>> = chosen
        .par_chunks(AT_A_TIME)
        .zip(entries.par_chunks(AT_A_TIME))
        .map(|(chosen, entries)| {
            learned.model().compare(&regions.encoded(chosen), &learned.templates(entries))
        })
        .collect();
    let output = output.concat();
    let mut order: Vec<usize> = (0..chosen.len()).collect();
    order.sort_by(|&a, &b| output[b].matching.total_cmp(&output[a].matching).then(a.cmp(&b)));
    order.truncate(ALIGNED.0 * compared / ALIGNED.1);
    let by_points = (options.matched_by == MatchedBy::Both).then(|| {
        // Regions centred on the predicted centre of the object.
        let centred: Vec<Roi> = order
            .iter()
            .map(|&k| {
                let roi = &rois[chosen[k]];
                let place = match output[k].offset {
                    Some(offset) => Vec3::from(offset) * size,
                    None => visible_centre(scene, roi, size, &output[k].mask),
                };
                Roi { centre: roi.camera_from_roi().transform_point(&place) }
            })
            .collect();
        let template_size = object.templates.size;
        let found = object.matcher.best(centred.len(), |i| centred[i].cells(scene, template_size, |_| true));
        centred.into_iter().zip(found).collect::<Vec<_>>()
    });
    order
        .par_iter()
        .enumerate()
        .map(|(n, &k)| {
            let (output, entry) = (&output[k], &entries[k]);
            let start = start(scene, object, learned, &rois[chosen[k]], entry, output, options);
            let placed = place_at(scene, object, entry.template, start, trust(output), options);
            let Some((roi, found)) = by_points.as_ref().map(|all| &all[n]) else { return placed };
            let entry = object.matcher.entries()[found.entry];
            let start = camera_from_view(&roi.camera_from_roi(), entry.turn);
            let other = place_at(scene, object, entry.template, start, trust(output), options);
            if other.support > placed.support { other } else { placed }
        })
        .collect()
}

/// Matches regions again, centred on their seeds (the first of `found` of each) and without their background, and adds the nearest
/// templates that differ, aligned with the scene.
pub(crate) fn second_matching(
    scene: &DepthRegion,
    object: &KnownObject,
    learned: &Learned,
    options: &MttmOptions,
    found: &mut [Vec<Placed>],
) {
    let seeds: Vec<Placed> = found.iter().filter_map(|f| f.first().cloned()).collect();
    if seeds.is_empty() || seeds.len() != found.len() {
        return;
    }
    let model = learned.model();
    let rois: Vec<Roi> = seeds.iter().map(|s| Roi { centre: s.camera_from_view.translation() }).collect();
    // Each seed's own template at its pose, for a mask.
    let own: Vec<Entry> = seeds
        .iter()
        .zip(&rois)
        .map(|(seed, roi)| {
            let roi_from_view = roi.camera_from_roi().inverse() * seed.camera_from_view;
            let right = roi_from_view.transform_direction(&Vec3::x());
            Entry { template: seed.template, turn: right.y.atan2(right.x) }
        })
        .collect();
    let regions = encode(scene, learned, &rois);
    let masks = model.compare(&regions, &learned.templates(&own)).into_iter().flat_map(|s| s.mask).collect();
    let descriptors = model.describe(&model.without_background(&regions, masks));
    let chosen: Vec<(usize, Entry)> = rois
        .par_iter()
        .zip(&descriptors)
        .enumerate()
        .map(|(region, (roi, descriptor))| {
            let most = options.network_hypotheses;
            let entries = nearest_entries(object, learned, &roi.camera_from_roi(), descriptor, most);
            entries.into_iter().map(|entry| (region, entry)).collect::<Vec<_>>()
        })
        .collect::<Vec<_>>()
        .concat();
    let output: Vec<Vec<PairOutput>> = chosen
        .par_chunks(AT_A_TIME)
        .map(|part| {
            let numbers: Vec<usize> = part.iter().map(|c| c.0).collect();
            let entries: Vec<Entry> = part.iter().map(|c| c.1).collect();
            model.compare(&regions.select(&numbers), &learned.templates(&entries))
        })
        .collect();
    let output = output.concat();
    let placed: Vec<Option<Placed>> = chosen
        .par_iter()
        .zip(&output)
        .map(|((region, entry), output)| {
            let start = start(scene, object, learned, &rois[*region], entry, output, options);
            // The seed's own template may get a better initial pose here.
            let known = is_known(object, &found[*region][1..], entry.template, &start);
            (!known).then(|| place_at(scene, object, entry.template, start, trust(output), options))
        })
        .collect();
    for ((region, _), placed) in chosen.iter().zip(placed) {
        found[*region].extend(placed);
    }
}

pub(crate) fn encode(scene: &DepthRegion, learned: &Learned, rois: &[Roi]) -> Encoded {
    let (size, side) = (learned.size(), learned.model().side());
    let patches: Vec<Patch> =
        rois.iter().map(|roi| Patch::of_scene(scene, roi, size, side, |_| true)).collect();
    learned.model().encode(&patches.iter().collect::<Vec<_>>())
}

/// The initial pose for aligning a template.
pub(crate) fn start(
    scene: &DepthRegion,
    object: &KnownObject,
    learned: &Learned,
    roi: &Roi,
    entry: &Entry,
    output: &PairOutput,
    options: &MttmOptions,
) -> Pose {
    let camera_from_roi = roi.camera_from_roi();
    if !options.predicted_pose {
        return camera_from_view(&camera_from_roi, entry.turn);
    }
    learned.camera_from_view(&camera_from_roi, entry.turn, output).unwrap_or_else(|| {
        let centre = visible_centre(scene, roi, learned.size(), &output.mask);
        let centre = camera_from_roi.transform_point(&centre);
        published::start(object, &camera_from_roi, &centre, entry, output, options)
    })
}

fn trust(output: &PairOutput) -> f64 {
    MIN_TRUST + (1.0 - MIN_TRUST) * f64::from(output.matching)
}
