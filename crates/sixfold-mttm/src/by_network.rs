//! Matching by the network: descriptors find templates, pairs say mask, rotation, place, and whether they match (dissertation,
//! section 5.2.4).

use rayon::prelude::*;
use sixfold_geometry::Pose;
use sixfold_match::Scene;

use crate::align::camera_from_view;
use crate::estimate::{EstimateOptions, KnownObject, Placed, Stages, apart, is_known, place_at};
use crate::learned::Learned;
use crate::matching::{Entry, Match};
use crate::model::{Encoded, PairSays};
use crate::patch::Patch;
use crate::roi::{ProposalOptions, Roi, propose};

/// Distance of sampled centres as a share of the diameter: the network was trained with regions that are off by as much.
const STEP: f64 = 0.2;
/// Regions that go through the network at a time.
const AT_A_TIME: usize = 64;
/// Candidates of points whose pairs are looked at.
const LOOKED_AT: usize = 48;
/// The least trust that a pair leaves a pose whose surface agrees: the network is one witness of several.
const LEAST_TRUST: f64 = 0.1;

/// Samples regions, finds the nearest template of each by descriptors, and lays the best on the scene.
pub(crate) fn first_matching(
    scene: &Scene,
    object: &KnownObject,
    learned: &Learned,
    options: &EstimateOptions,
    stages: &mut Stages,
) -> Vec<Placed> {
    let proposals = ProposalOptions { step: STEP, layer: STEP, ..options.proposals };
    let rois = propose(scene, object.templates.diameter, &proposals);
    stages.sampled = rois.len();
    let encoded: Vec<Encoded> = rois.par_chunks(AT_A_TIME).map(|part| encode(scene, learned, part)).collect();
    let descriptors: Vec<_> = encoded.par_iter().map(|e| learned.model().describe(e)).collect();
    let nearest = learned.nearest(&descriptors.concat());
    let mut order: Vec<usize> = (0..rois.len()).collect();
    order.sort_by(|&a, &b| nearest[a].0.total_cmp(&nearest[b].0).then(a.cmp(&b)));
    let chosen = apart(&rois, order, 0.15 * object.templates.diameter, options.placed);
    let entries: Vec<Entry> = chosen.iter().map(|&i| object.matcher.entries()[nearest[i].1]).collect();
    let parts: Vec<Vec<Placed>> = chosen
        .par_chunks(AT_A_TIME / 2)
        .zip(entries.par_chunks(AT_A_TIME / 2))
        .map(|(chosen, entries)| {
            let regions: Vec<Encoded> =
                chosen.iter().map(|&i| encoded[i / AT_A_TIME].select(&[i % AT_A_TIME])).collect();
            let says = learned.model().compare(&Encoded::joined(&regions), &learned.templates(entries));
            let all = chosen.iter().zip(entries).zip(&says);
            all.map(|((&i, entry), says)| {
                let start = start(learned, &rois[i].camera_from_roi(), entry, says, options);
                place_at(scene, object, entry.template, start, trust(says), options)
            })
            .collect()
        })
        .collect();
    parts.concat()
}

/// Regions with the template that points match best: the network looks at the best of them, each with its own template and the
/// nearest by descriptor, and the pair that matches better is laid on the scene.
pub(crate) fn choose_and_place(
    scene: &Scene,
    object: &KnownObject,
    learned: &Learned,
    candidates: &[(Roi, Match)],
    options: &EstimateOptions,
) -> Vec<Placed> {
    let candidates = &candidates[..candidates.len().min(LOOKED_AT)];
    let parts: Vec<Vec<Placed>> = candidates
        .par_chunks(LOOKED_AT / 2)
        .map(|part| {
            let rois: Vec<Roi> = part.iter().map(|c| c.0).collect();
            let regions = encode(scene, learned, &rois);
            let nearest = learned.nearest(&learned.model().describe(&regions));
            let entries = object.matcher.entries();
            let by_points: Vec<Entry> = part.iter().map(|c| entries[c.1.entry]).collect();
            let by_descriptor: Vec<Entry> = nearest.iter().map(|n| entries[n.1]).collect();
            let first = learned.model().compare(&regions, &learned.templates(&by_points));
            let second = learned.model().compare(&regions, &learned.templates(&by_descriptor));
            let place = |roi: &Roi, entry: &Entry, says: &PairSays, score: f32| {
                let start = start(learned, &roi.camera_from_roi(), entry, says, options);
                let trust = trust(says) * f64::from(score).max(0.0).sqrt();
                place_at(scene, object, entry.template, start, trust, options)
            };
            (0..part.len())
                .map(|i| {
                    let (roi, matched) = &part[i];
                    let a = place(roi, &by_points[i], &first[i], matched.score);
                    let b = place(roi, &by_descriptor[i], &second[i], matched.score);
                    if b.support > a.support { b } else { a }
                })
                .collect()
        })
        .collect();
    parts.concat()
}

/// Matches a region again, centred where its template says and without its background, and adds the nearest templates that
/// differ, laid on the scene.
pub(crate) fn second_matching(
    scene: &Scene,
    object: &KnownObject,
    learned: &Learned,
    options: &EstimateOptions,
    found: &mut Vec<Placed>,
) {
    let Some(seed) = found.first().cloned() else { return };
    let roi = Roi { centre: seed.camera_from_view.translation() };
    let region = encode(scene, learned, std::slice::from_ref(&roi));
    // The seed's own template at the nearest turn, for a mask.
    let in_roi = roi.camera_from_roi().inverse() * seed.camera_from_view;
    let turn = {
        let right = in_roi.transform_direction(&sixfold_geometry::Vec3::x());
        right.y.atan2(right.x)
    };
    let own = Entry { template: seed.template, turn };
    let model = learned.model();
    let Some(says) = model.compare(&region, &learned.templates(&[own])).pop() else { return };
    let alone = model.without_background(&region, says.mask);
    let Some(descriptor) = model.describe(&alone).pop() else { return };
    let camera_from_roi = roi.camera_from_roi();
    let mut chosen: Vec<Entry> = vec![];
    let most = options.hypotheses;
    for (_, entry) in learned.ranked(&descriptor).into_iter().take(60 * most) {
        if chosen.len() >= most {
            break;
        }
        let entry = object.matcher.entries()[entry];
        let start = camera_from_view(&camera_from_roi, entry.turn);
        let new = object.object_pose(&start, entry.template);
        let same = chosen.iter().any(|c| {
            let other = object.object_pose(&camera_from_view(&camera_from_roi, c.turn), c.template);
            other.rotation_angle_to(&new) < 0.3
        });
        if !same {
            chosen.push(entry);
        }
    }
    if chosen.is_empty() {
        return;
    }
    let regions = region.select(&vec![0; chosen.len()]);
    let says = model.compare(&regions, &learned.templates(&chosen));
    for (entry, says) in chosen.iter().zip(&says) {
        let start = start(learned, &camera_from_roi, entry, says, options);
        // The seed itself may start better here.
        if found.len() == 1 || !is_known(object, &found[1..], entry.template, &start) {
            found.push(place_at(scene, object, entry.template, start, trust(says), options));
        }
    }
}

fn encode(scene: &Scene, learned: &Learned, rois: &[Roi]) -> Encoded {
    let (size, side) = (learned.size(), learned.model().side());
    let patches: Vec<Patch> =
        rois.iter().map(|roi| Patch::of_scene(scene, roi, size, side, |_| true)).collect();
    learned.model().encode(&patches)
}

/// From where a template is aligned.
fn start(
    learned: &Learned,
    camera_from_roi: &Pose,
    entry: &Entry,
    says: &PairSays,
    options: &EstimateOptions,
) -> Pose {
    if options.predicted_pose {
        learned.camera_from_view(camera_from_roi, entry.turn, says)
    } else {
        camera_from_view(camera_from_roi, entry.turn)
    }
}

fn trust(says: &PairSays) -> f64 {
    LEAST_TRUST + (1.0 - LEAST_TRUST) * f64::from(says.matching)
}
