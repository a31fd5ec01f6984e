//! Search without a given region: a detector of any object proposes boxes, the object's templates select those similar to it, and
//! poses are estimated there (the structure of CNOS, Nguyen et al. 2023, whose proposals and features come from foundation models; ours
//! are small networks). Similarities are standardised for each view, over all boxes: `(s - mean) / deviation` (as in speaker verification, Z-norm,
//! Auckenthaler et al. 2000). Of the poses, those come first at which the image is more similar to the object (`recognition`) than it is elsewhere:
//! by `agreement (s - sum(s_i) / (n + 8))`, where `s` and `s_i` are the similarities of the render at the pose to the image there and to the `n` boxes
//! (the subtraction as above; the product and the 8 are ours). After the last refinement a pose counts with all that are alike, by the sum of the fourth
//! powers of their scores (a vote, as in the generalised Hough transform, Ballard 1981; ours here).
//!
//! Proposals and their features belong to the image: they are computed once, for all objects searched in it.

use std::collections::HashSet;
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use sixfold_align::outline::projected_box;
use sixfold_estimator::{EstimatorError, ObjectDetector, Region};
use sixfold_geometry::{Camera, Pose, Rect, RgbImage, Vec2};

use crate::colour::Chroma;
use crate::error::ViewsError;
use crate::estimate::{Hypothesis, Part, Views};
use crate::features::Extractor;
use crate::matching::{colour_similarity, quick_similarity};
use crate::printed::ImageKeypoints;
use crate::recognition::Recognised;
use crate::refiner::Progress;
use crate::templates::Template;

/// Boxes of two poses that overlap more than this (intersection over union) belong to one instance.
const ONE_INSTANCE: f64 = 0.5;

/// Added to standard deviations: views that distinguish nothing do not decide.
const LEAST_DEVIATION: f32 = 0.02;

/// Number of templates that are compared with all places at a time: about a megabyte.
const AT_ONCE: usize = 16;

/// Number of poses, over all places, that are refined further after each of the first iterations. With 20 places this takes as long as
/// refining all poses of 8; AR_MSSD / AR_MSPD / ADD(-S) on 85 targets of LM-O's development frames .413 / .532 / .365 instead of .395 / .507 / .365.
const KEPT: [usize; 2] = [48, 24];

/// So many times as many poses as are refined in a crop of their own are compared with the image there before.
const CONSIDERED: usize = 2;

/// Number of places without any similarity that are added to those of an image: if there are only few, they may all be the object's own.
const UNLIKE: f32 = 8.0;

/// Poses are alike if no corner of the object's bounding box is farther apart in the image than this fraction of the object's size there. Of 0.03,
/// 0.05, 0.07, 0.1, 0.15 and 0.2, and of the powers 2, 3, 4 and 6 of [`VOTES`], these are best on 239 targets of LM-O's development frames:
/// AR_MSSD / AR_MSPD / recall of an MSSD below 0.1 diameters .453 / .564 / .234 instead of .433 / .556 / .218 for the best scores.
const ALIKE: f64 = 0.07;
/// A pose is preferred by the sum of this power of the scores of all that are alike.
const VOTES: i32 = 4;
/// Weight of a pose's own score in this sum, in addition: decides between poses that are alike.
const OWN: f64 = 1e-3;
/// As [`ALIKE`], for [`Found::support`]; of 0.05, 0.07, 0.1, 0.15, 0.2 and 0.3 this one tells right poses of these targets best from wrong ones.
const SUPPORT: f64 = 0.2;

/// A region that may show an object, with the networks' features there.
pub(crate) struct Place {
    pub(crate) region: Region,
    part: Part,
    chromas: Option<Vec<Chroma>>,
    recognised: Option<Recognised>,
}

impl Place {
    fn new(extractor: &Extractor, region: Region, part: Part) -> Result<Place, ViewsError> {
        let recognised = extractor.recogniser().features(&[&part.patch.data], part.patch.width)?.pop();
        Ok(Place { region, chromas: part.chromas(), recognised, part })
    }

    /// Similarity of what it shows to a template, 0 to 1.
    fn recognised_as(&self, template: &Template) -> f32 {
        self.recognised.as_ref().map_or(0.0, |seen| template.appearance.similarity(seen))
    }

    /// Similarity of its colours to a template's, 0 to 1; 0 if either has none.
    fn colour_of(&self, template: &Template) -> f32 {
        self.chromas.as_ref().map_or(0.0, |chromas| colour_similarity(template, chromas))
    }
}

/// The places of an image, computed once.
#[derive(Default)]
pub(crate) struct Places(Mutex<Option<Arc<Vec<Place>>>>);

impl Places {
    /// The proposals of a detector of any object, by decreasing score, at most `most`; computed once.
    pub(crate) fn of_image(
        &self,
        detector: &dyn ObjectDetector,
        extractor: &Extractor,
        image: &RgbImage,
        camera: &Camera,
        [most, side]: [usize; 2],
    ) -> Result<Arc<Vec<Place>>, EstimatorError> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(places) = kept.as_ref() {
            return Ok(places.clone());
        }
        let places = Arc::new(places(detector, extractor, image, camera, [most, side])?);
        *kept = Some(Arc::clone(&places));
        Ok(places)
    }
}

/// The proposals of a detector of any object in an image, by decreasing score, at most `most`, with features in crops of `side` pixels.
pub(crate) fn places(
    detector: &dyn ObjectDetector,
    extractor: &Extractor,
    image: &RgbImage,
    camera: &Camera,
    [most, side]: [usize; 2],
) -> Result<Vec<Place>, EstimatorError> {
    let mut detected = detector.detect(image)?;
    detected.sort_by(|a, b| b.region.score.total_cmp(&a.region.score));
    detected.truncate(most);
    let place = |region: Region| -> Result<Option<Place>, ViewsError> {
        let part = Part::new(extractor, image, camera, &region.bbox, side)?;
        part.map(|part| Place::new(extractor, region, part)).transpose()
    };
    let places: Result<Vec<Option<Place>>, ViewsError> =
        detected.into_par_iter().map(|d| place(d.region)).collect();
    Ok(places.map_err(EstimatorError::method)?.into_iter().flatten().collect())
}

/// A pose with what the image's places say about it, [`Views::recognised`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Scored<T> {
    pub(crate) pose: Hypothesis,
    /// How much more similar the image is there to the object rendered at the pose than its places are on average.
    pub(crate) more: f64,
    /// The product of that and of the pose's similarity, by which poses are sorted.
    pub(crate) score: f64,
    /// What was given with the pose.
    pub(crate) of: T,
}

/// A pose that was found without a given region.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Found {
    pub(crate) pose: Hypothesis,
    /// [`Settled::rival`](crate::close::Settled::rival).
    pub(crate) rival: Option<Hypothesis>,
    /// [`Scored::more`].
    pub(crate) recognised: f64,
    /// Fraction of the squared scores of all examined poses that belongs to those that are alike. Searches that start from different templates end in about
    /// the same pose if it is right, but seldom if it is wrong.
    pub(crate) support: f64,
}

impl Views<'_> {
    /// The object's poses in the places similar to it, best first, at most `most`, no two of the same instance; of these `runners_up` only as far as
    /// the search for the others finds them.
    pub(crate) fn search(
        &self,
        image: &RgbImage,
        camera: &Camera,
        places: &[Place],
        keypoints: Option<&ImageKeypoints>,
        [most, runners_up]: [usize; 2],
    ) -> Result<Vec<Found>, ViewsError> {
        let instances = most.saturating_sub(runners_up).max(1);
        let alike = self.most_alike(places, self.options.places.saturating_add(instances - 1));
        let located = self.located(&alike, places, image, camera, instances > 1)?;
        let located = located.into_iter().map(|scored| (scored.pose, scored.of)).collect();
        let chosen = first(located, self.options.place_close, instances > 1).into_iter();
        let mut chosen: Vec<(Hypothesis, Rect)> =
            chosen.map(|(h, number)| (h, alike[number].region.bbox)).collect();
        let prints = self.prints(keypoints, camera);
        chosen.extend(self.by_print(prints.as_ref(), camera, instances));
        let closer = self.closer_all(chosen, prints.as_ref(), image, camera)?;
        let found = self.recognised(closer.into_iter().map(|h| (h, ())).collect(), places, image, camera)?;
        let mut kept: Vec<Found> = Vec::new();
        for found in self.agreed(&found, camera) {
            if kept.len() < most && kept.iter().all(|k| !self.one(camera, &k.pose, &found.pose)) {
                kept.push(found);
            }
        }
        for found in kept.iter_mut().take(instances) {
            let settled = self.settled(found.pose, prints.as_ref(), image, camera)?;
            (found.pose, found.rival) = (settled.pose, settled.rival);
        }
        Ok(kept)
    }

    /// The places most similar to the object, at most `most`.
    pub(crate) fn most_alike<'p>(&self, places: &'p [Place], most: usize) -> Vec<&'p Place> {
        let mut alike: Vec<(&Place, f32)> = places.iter().zip(self.place_similarities(places)).collect();
        alike.sort_by(|a, b| b.1.total_cmp(&a.1));
        alike.into_iter().take(most).map(|(place, _)| place).collect()
    }

    /// Poses in the places `alike`, of all `places` of the image, each with its score and the number of its place, best first: those with which the
    /// refiner agrees most and, if `of_each` place, its best.
    pub(crate) fn located(
        &self,
        alike: &[&Place],
        places: &[Place],
        image: &RgbImage,
        camera: &Camera,
        of_each: bool,
    ) -> Result<Vec<Scored<usize>>, ViewsError> {
        let mut pool = self.pool(alike, of_each)?;
        pool.sort_by(|a, b| b.0.similarity.total_cmp(&a.0.similarity));
        let considered = first(pool, self.options.place_close.saturating_mul(CONSIDERED), of_each);
        self.recognised(considered, places, image, camera)
    }

    /// Poses in some places, each with the place's number. The refiner renders and compares all of them once; after each of the first iterations
    /// only those at which the image agrees best go on, over all places together, and, if `of_each` place, the best there (successive halving, Jamieson and Talwalkar 2016).
    fn pool(&self, places: &[&Place], of_each: bool) -> Result<Vec<(Hypothesis, usize)>, ViewsError> {
        let most = self.options.place_hypotheses;
        let Some(refiner) = self.refiner else {
            let coarse = |place: &&Place| self.coarse(&place.part, &self.ranked(&place.part), most);
            let coarse: Result<Vec<Vec<Hypothesis>>, ViewsError> = places.par_iter().map(coarse).collect();
            let numbered = coarse?.into_iter().enumerate();
            return Ok(numbered
                .flat_map(|(number, all)| all.into_iter().map(move |h| (h, number)))
                .collect());
        };
        type Started = (Hypothesis, Progress);
        let start = |place: &&Place| -> Vec<Started> {
            let starts = self.starts(&place.part, &self.ranked(&place.part), most);
            starts.into_iter().map(|h| (h, Progress::new(h.camera_from_object))).collect()
        };
        let mut all: Vec<Vec<Started>> = places.par_iter().map(start).collect();
        let nearest = self.nearest();
        for pass in 0..=self.options.refinements {
            all.par_iter_mut().zip(places).try_for_each(|(here, place)| {
                let mut moving: Vec<&mut Progress> = here.iter_mut().map(|(_, progress)| progress).collect();
                refiner.advance(self.extractor, self.mesh, &place.part.target(), &mut moving, nearest)
            })?;
            if let Some(kept) = KEPT.get(pass) {
                stop_all_but(&mut all, *kept, of_each);
            }
        }
        let mut pool = Vec::new();
        for (number, (place, here)) in places.iter().zip(all).enumerate() {
            pool.extend(here.into_iter().map(|(hypothesis, progress)| {
                let camera_from_object = place.part.crop.to_camera(&progress.best.pose);
                (Hypothesis { camera_from_object, similarity: progress.best.score, ..hypothesis }, number)
            }));
        }
        Ok(pool)
    }

    /// Poses sorted by the product of their similarity and of how much more similar the image is there to the object rendered at the pose
    /// than the image's places are on average: what they have in common with the object does not count.
    fn recognised<T: Send>(
        &self,
        poses: Vec<(Hypothesis, T)>,
        places: &[Place],
        image: &RgbImage,
        camera: &Camera,
    ) -> Result<Vec<Scored<T>>, ViewsError> {
        let recogniser = self.extractor.recogniser();
        let seen: Vec<&Recognised> = places.iter().filter_map(|place| place.recognised.as_ref()).collect();
        let scored = |(pose, of): (Hypothesis, T)| -> Result<Scored<T>, ViewsError> {
            let compared = recogniser.compare(self.mesh, image, camera, &pose.camera_from_object)?;
            let more = compared.map_or(0.0, |(view, here)| {
                let elsewhere: f32 = seen.iter().map(|seen| view.similarity(seen)).sum();
                f64::from(view.similarity(&here) - elsewhere / (seen.len() as f32 + UNLIKE)).max(0.0)
            });
            Ok(Scored { pose, more, score: pose.similarity * more, of })
        };
        let scored: Result<Vec<Scored<T>>, ViewsError> = poses.into_par_iter().map(scored).collect();
        let mut scored = scored?;
        scored.sort_by(|a, b| b.score.total_cmp(&a.score));
        Ok(scored)
    }

    /// The poses on which most of the others agree first, with their support.
    fn agreed(&self, poses: &[Scored<()>], camera: &Camera) -> Vec<Found> {
        let apart = self.apart(poses, camera);
        let [votes, supports] =
            [(ALIKE, VOTES), (SUPPORT, 2)].map(|(near, power)| sums_of_alike(poses, &apart, near, power));
        let total: f64 = poses.iter().map(|scored| scored.score.powi(2)).sum();
        let mut agreed: Vec<(f64, Found)> = Vec::new();
        for ((scored, votes), support) in poses.iter().zip(votes).zip(supports) {
            let support = support / total.max(f64::MIN_POSITIVE);
            let found = Found { pose: scored.pose, rival: None, recognised: scored.more, support };
            agreed.push((votes + OWN * scored.score.powi(VOTES), found));
        }
        agreed.sort_by(|a, b| b.0.total_cmp(&a.0));
        agreed.into_iter().map(|(_, found)| found).collect()
    }

    /// How far the corners of each pose are from those of every other in the image at most, and its own size there, pixels; no distance to a pose that is not
    /// before the camera.
    fn apart<T>(&self, poses: &[Scored<T>], camera: &Camera) -> Vec<(f64, Vec<Option<f64>>)> {
        let corners: Vec<Option<[Vec2; 8]>> =
            poses.iter().map(|scored| self.corners(camera, &scored.pose.camera_from_object)).collect();
        let distance = |a: &Option<[Vec2; 8]>, b: &Option<[Vec2; 8]>| {
            let pairs = a.as_ref()?.iter().zip(b.as_ref()?);
            Some(pairs.map(|(a, b)| (a - b).norm()).fold(0.0, f64::max))
        };
        let apart = |(scored, own): (&Scored<T>, &Option<[Vec2; 8]>)| {
            let bbox = projected_box(self.outline, camera, &scored.pose.camera_from_object);
            let size = bbox.map_or(0.0, |bbox| bbox.area().sqrt());
            (size, corners.iter().map(|other| distance(own, other)).collect())
        };
        poses.iter().zip(&corners).map(apart).collect()
    }

    /// The corners of the object's bounding box in the image; `None` if one is not before the camera.
    fn corners(&self, camera: &Camera, pose: &Pose) -> Option<[Vec2; 8]> {
        let corners = self.mesh.box_corners().into_iter();
        let projected: Vec<Vec2> =
            corners.map_while(|corner| camera.project(&pose.transform_point(&corner))).collect();
        projected.try_into().ok()
    }

    /// How much more similar the most similar template is to each place than to the other places, in standard deviations over the
    /// places: some views (plain, without edges) are similar to everything. On a subset of features: selects the places to examine further.
    pub(crate) fn place_similarities(&self, places: &[Place]) -> Vec<f32> {
        let templates: Vec<&Template> =
            self.templates.iter().filter(|t| !t.appearance.cells.is_empty()).collect();
        let of = |place: &Place, template: &Template| {
            quick_similarity(template, &place.part.map)
                + self.options.place_colour * place.colour_of(template)
                + self.options.place_recognition * place.recognised_as(template)
        };
        // A few templates at a time, which stay in the cache while all places are compared with them.
        let relatives = |templates: &[&Template]| -> Vec<Vec<f32>> {
            let mut all = vec![Vec::with_capacity(places.len()); templates.len()];
            for place in places {
                all.iter_mut().zip(templates).for_each(|(all, template)| all.push(of(place, template)));
            }
            all.into_iter().map(relative).collect()
        };
        let all: Vec<Vec<f32>> = templates.par_chunks(AT_ONCE).flat_map_iter(relatives).collect();
        let most = |place: usize| all.iter().map(|of| of[place]).fold(f32::NEG_INFINITY, f32::max);
        (0..places.len()).map(most).collect()
    }

    /// Whether two poses belong to one instance: their boxes in the image overlap more than [`ONE_INSTANCE`].
    fn one(&self, camera: &Camera, a: &Hypothesis, b: &Hypothesis) -> bool {
        let boxed = |h: &Hypothesis| projected_box(self.outline, camera, &h.camera_from_object);
        match (boxed(a), boxed(b)) {
            (Some(a), Some(b)) => a.iou(&b) > ONE_INSTANCE,
            _ => self.same(a, b),
        }
    }
}

/// For each pose the sum of the scores, to some power, of all poses that are not farther `apart` ([`Views::apart`]) than the fraction `near` of its size in
/// the image; 0 for a pose that is not before the camera.
fn sums_of_alike<T>(
    poses: &[Scored<T>],
    apart: &[(f64, Vec<Option<f64>>)],
    near: f64,
    power: i32,
) -> Vec<f64> {
    let sum = |(size, distances): &(f64, Vec<Option<f64>>)| {
        let alike = |distance: &Option<f64>| distance.is_some_and(|distance| distance <= near * size);
        let of_alike = poses.iter().zip(distances).filter(|(_, distance)| alike(distance));
        of_alike.map(|(scored, _)| scored.score.powi(power)).sum()
    };
    apart.iter().map(sum).collect()
}

/// The first `most` of some poses with the numbers of their places and, if `of_each` place, the first there.
fn first(poses: Vec<(Hypothesis, usize)>, most: usize, of_each: bool) -> Vec<(Hypothesis, usize)> {
    let mut seen = HashSet::new();
    let chosen = |(rank, (_, number)): &(usize, (Hypothesis, usize))| {
        let first_there = seen.insert(*number);
        *rank < most || (of_each && first_there)
    };
    poses.into_iter().enumerate().filter(chosen).map(|(_, pose)| pose).collect()
}

/// Stops the refinement of all poses but the `kept` best and, if `of_each` place, the best there.
fn stop_all_but(all: &mut [Vec<(Hypothesis, Progress)>], kept: usize, of_each: bool) {
    let mut scores: Vec<f64> = all.iter().flatten().map(|(_, progress)| progress.best.score).collect();
    scores.sort_by(|a, b| b.total_cmp(a));
    let Some(least) = scores.get(kept.saturating_sub(1)).copied() else { return };
    for here in all {
        let best = here.iter().map(|(_, progress)| progress.best.score).fold(0.0, f64::max);
        let least = if of_each { least.min(best) } else { least };
        here.iter_mut().filter(|(_, progress)| progress.best.score < least).for_each(|(_, p)| p.next = None);
    }
}

/// Numbers less their mean, relative to their standard deviation.
fn relative(mut values: Vec<f32>) -> Vec<f32> {
    let count = values.len().max(1) as f32;
    let mean = values.iter().sum::<f32>() / count;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / count;
    values.iter_mut().for_each(|v| *v = (*v - mean) / (variance.sqrt() + LEAST_DEVIATION));
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::ViewsOptions;
    use crate::estimate::tests::{part, photographed, without_refiner};
    use crate::recognition::{Appearance, CHANNELS};
    use crate::templates::{TemplateOptions, make_templates};
    use sixfold_geometry::Vec3;
    use sixfold_geometry::nalgebra::UnitQuaternion;

    /// A box of an image as a place.
    fn place(extractor: &Extractor, image: &RgbImage, camera: &Camera, bbox: Rect) -> Place {
        let part = Part::new(extractor, image, camera, &bbox, 160).unwrap().unwrap();
        Place::new(extractor, Region::of_box(bbox), part).unwrap()
    }

    /// Top left corners of boxes that do not show the object of [`photographed`].
    const ELSEWHERE: [[f64; 2]; 5] =
        [[40.0, 300.0], [300.0, 20.0], [20.0, 30.0], [420.0, 330.0], [430.0, 60.0]];

    #[test]
    fn the_place_that_shows_the_object_is_recognised_without_colours() {
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let (image, _, bbox) = photographed(&camera);
        let image = image.map(|rgb| [rgb[1]; 3]);
        let extractor = Extractor::shipped().unwrap();
        let mesh = part();
        let few = TemplateOptions { directions: 40, rotations: 6, ..TemplateOptions::default() };
        let templates = make_templates(&mesh, "part", mesh.diameter(), &extractor, &few).unwrap();
        // Every second rotation is enough.
        let with = templates.iter().filter(|t| !t.appearance.cells.is_empty()).count();
        assert_eq!(2 * with, templates.len());
        let place = |bbox: Rect| place(&extractor, &image, &camera, bbox);
        let most = |place: &Place| templates.iter().map(|t| place.recognised_as(t)).fold(0.0, f32::max);
        let others = ELSEWHERE.map(|[x, y]| place(Rect { x, y, ..bbox }));
        let places: Vec<Place> = [place(bbox)].into_iter().chain(others).collect();
        for other in &places[1..] {
            assert!(most(&places[0]) > most(other) + 0.1, "{} {}", most(&places[0]), most(other));
        }
        let gain = |place_recognition: f32| {
            let options = ViewsOptions { place_recognition, ..ViewsOptions::default() };
            let similar =
                without_refiner(&extractor, &mesh, &templates, &options).place_similarities(&places);
            similar[0] - similar[1..].iter().copied().fold(f32::NEG_INFINITY, f32::max)
        };
        assert!(gain(2.0) > 0.1 && gain(2.0) > gain(0.0) + 0.1, "{} {}", gain(2.0), gain(0.0));
    }

    #[test]
    fn a_view_that_is_similar_to_everything_does_not_decide() {
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let (image, _, bbox) = photographed(&camera);
        let extractor = Extractor::shipped().unwrap();
        let mesh = part();
        // Places that differ only in what is recognised there: something common to all, most of it in the first, and something of their own.
        let place = |[common, own]: [f32; 2], number: usize| {
            let part = Part::new(&extractor, &image, &camera, &bbox, 32).unwrap().unwrap();
            let mut features = vec![0.0; 4 * CHANNELS];
            for cell in features.chunks_exact_mut(CHANNELS) {
                (cell[0], cell[number + 1]) = (common, own);
            }
            Place {
                region: Region::of_box(bbox),
                part,
                chromas: None,
                recognised: Some(Recognised { cells: 2, features }),
            }
        };
        let places = [place([0.9, 0.4], 0), place([0.8, 0.6], 1), place([0.8, 0.6], 2)];
        let few = TemplateOptions { directions: 1, rotations: 3, side: 32, ..TemplateOptions::default() };
        let mut templates = make_templates(&mesh, "part", mesh.diameter(), &extractor, &few).unwrap();
        templates.retain(|t| !t.appearance.cells.is_empty());
        for (template, channel) in templates.iter_mut().zip([0, 2]) {
            let mut features = vec![0.0; CHANNELS];
            features[channel] = 1.0;
            template.appearance = Appearance { cells: vec![0], features };
        }
        let most: Vec<f32> =
            places.iter().map(|p| templates.iter().map(|t| p.recognised_as(t)).fold(0.0, f32::max)).collect();
        assert_eq!(most, [0.9, 0.8, 0.8]);
        let options = ViewsOptions::default();
        let similar = without_refiner(&extractor, &mesh, &templates, &options).place_similarities(&places);
        assert!(similar[1] > similar[0] + 0.1 && similar[0] > similar[2], "{similar:?}");
    }

    #[test]
    fn only_the_poses_at_which_the_image_agrees_best_go_on() {
        let all = || {
            let started = |score: f64| {
                let pose = Pose::identity();
                let mut progress = Progress::new(pose);
                progress.best.score = score;
                (Hypothesis { camera_from_object: pose, similarity: 0.0, inliers: 0, drawn: 0.0 }, progress)
            };
            vec![[0.9, 0.2, 0.7].map(started).into(), [0.3, 0.1].map(started).into(), vec![]]
        };
        let go_on = |kept: usize, of_each: bool| {
            let mut all: Vec<Vec<(Hypothesis, Progress)>> = all();
            stop_all_but(&mut all, kept, of_each);
            all.iter().flatten().map(|(_, progress)| progress.next.is_some()).collect::<Vec<_>>()
        };
        assert_eq!(go_on(2, false), [true, false, true, false, false]);
        assert_eq!(go_on(2, true), [true, false, true, true, false]);
        assert_eq!(go_on(4, false), [true, true, true, true, false]);
        assert_eq!(go_on(9, false), [true; 5]);
    }

    #[test]
    fn the_first_poses_are_chosen_and_the_first_of_each_place() {
        let pose = |number: usize| {
            let camera_from_object = Pose::from_translation(Vec3::z());
            (Hypothesis { camera_from_object, similarity: 0.5, inliers: 20, drawn: 0.0 }, number)
        };
        let numbers = |most: usize, of_each: bool| -> Vec<usize> {
            let poses = [4, 4, 0, 4, 2, 0].map(pose).into();
            first(poses, most, of_each).into_iter().map(|(_, number)| number).collect()
        };
        assert_eq!(numbers(2, false), [4, 4]);
        assert_eq!(numbers(2, true), [4, 4, 0, 2]);
        assert_eq!(numbers(1, true), [4, 0, 2]);
        assert_eq!(numbers(9, false), [4, 4, 0, 4, 2, 0]);
    }

    #[test]
    fn numbers_relative_to_their_deviation() {
        let deviation = 2f32.sqrt() + LEAST_DEVIATION;
        assert_eq!(relative(vec![1.0, 3.0, 5.0, 3.0]), [-2.0 / deviation, 0.0, 2.0 / deviation, 0.0]);
        assert_eq!(relative(vec![0.4, 0.4]), [0.0, 0.0]);
        assert_eq!(relative(vec![]), [0.0; 0]);
    }

    #[test]
    fn of_poses_that_agree_equally_the_one_on_the_object_comes_first() {
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let (image, truth, bbox) = photographed(&camera);
        let (extractor, mesh, options) = (Extractor::shipped().unwrap(), part(), ViewsOptions::default());
        let views = without_refiner(&extractor, &mesh, &[], &options);
        let beside = truth.with_translation(truth.translation() + Vec3::new(-0.3, 0.1, 0.0));
        let behind = truth.with_translation(-truth.translation());
        let place = |bbox: Rect| place(&extractor, &image, &camera, bbox);
        let places: Vec<Place> = ELSEWHERE.map(|[x, y]| place(Rect { x, y, ..bbox })).into();
        let sorted = |poses: &[(Pose, f64)], places: &[Place]| -> Vec<Pose> {
            let pose = |(camera_from_object, similarity): &(Pose, f64)| {
                let camera_from_object = *camera_from_object;
                (Hypothesis { camera_from_object, similarity: *similarity, inliers: 20, drawn: 0.0 }, ())
            };
            let poses = poses.iter().map(pose).collect();
            let sorted = views.recognised(poses, places, &image, &camera).unwrap();
            sorted.iter().map(|scored| scored.pose.camera_from_object).collect()
        };
        let poses = [behind, beside, truth].map(|pose| (pose, 0.6));
        assert_eq!(sorted(&poses, &places), [truth, beside, behind]);
        // Also without places to compare with, and if the only place is the object's own.
        assert_eq!(sorted(&poses, &[]), [truth, beside, behind]);
        assert_eq!(sorted(&poses, &[place(bbox)]), [truth, beside, behind]);
        let similarity =
            |pose: &Pose| extractor.recogniser().similarity(&mesh, &image, &camera, pose).unwrap();
        // What the image's places have in common with the object does not count.
        let ratio = similarity(&beside).unwrap() / similarity(&truth).unwrap();
        let poses = [(beside, 0.5), (truth, 0.8 * 0.5 * ratio)];
        assert_eq!(sorted(&poses, &[]), [beside, truth]);
        assert_eq!(sorted(&poses, &places), [truth, beside]);
        assert!(similarity(&truth).unwrap() > similarity(&beside).unwrap() + 0.1);
        assert_eq!(similarity(&behind), None);
    }

    #[test]
    fn a_pose_on_which_several_agree_comes_before_a_better_one_alone() {
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let (_, truth, bbox) = photographed(&camera);
        let (extractor, mesh, options) = (Extractor::shipped().unwrap(), part(), ViewsOptions::default());
        let views = without_refiner(&extractor, &mesh, &[], &options);
        // Moves the object by a fraction of its size in the image.
        let size = bbox.area().sqrt() / camera.fx * truth.translation().z;
        let moved = |sizes: f64| truth.with_translation(truth.translation() + Vec3::x() * sizes * size);
        let behind = truth.with_translation(-truth.translation());
        let scored = |(camera_from_object, score): &(Pose, f64)| {
            let camera_from_object = *camera_from_object;
            let pose = Hypothesis { camera_from_object, similarity: 0.5, inliers: 9, drawn: 0.0 };
            Scored { pose, more: 0.1 * score, score: *score, of: () }
        };
        let sums = |poses: &[(Pose, f64)], near: f64| {
            let poses: Vec<_> = poses.iter().map(scored).collect();
            sums_of_alike(&poses, &views.apart(&poses, &camera), near, 2)
        };
        let poses = [(truth, 3.0), (moved(0.03), 1.0), (moved(0.1), 2.0), (behind, 1.0)];
        assert_eq!(sums(&poses, 0.06), [10.0, 10.0, 4.0, 0.0]);
        // Rotated about the axis of view by ten degrees: the centre stays.
        let turn = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), 10f64.to_radians());
        let rotated = Pose::new(turn * truth.rotation(), truth.translation());
        assert_eq!(sums(&[(truth, 1.0), (rotated, 1.0)], 0.06), [1.0; 2]);

        let agreed = |poses: &[(Pose, f64)]| -> Vec<(f64, f64)> {
            let agreed = views.agreed(&poses.iter().map(scored).collect::<Vec<_>>(), &camera);
            let number = |found: &Found| {
                (found.pose.camera_from_object.translation().x, (found.support * 100.0).round())
            };
            agreed.iter().map(number).collect()
        };
        let x = |pose: Pose| pose.translation().x;
        // Of two that agree, the better one comes first; both come before a third that is better than either.
        let poses = [(moved(0.5), 1.0), (truth, 0.8), (moved(0.02), 0.9)];
        assert_eq!(agreed(&poses), [(x(moved(0.02)), 59.0), (x(truth), 59.0), (x(moved(0.5)), 41.0)]);
        // But not before one that is much better.
        let poses = [(moved(0.5), 1.0), (moved(0.02), 0.8), (truth, 0.7)];
        assert_eq!(agreed(&poses)[0], (x(moved(0.5)), 47.0));
        // Poses a tenth of the size apart support each other, but do not vote for each other.
        let poses = [(moved(0.5), 1.0), (moved(0.1), 0.9), (truth, 0.9)];
        let found = agreed(&poses);
        assert_eq!(found[0], (x(moved(0.5)), 38.0));
        assert!(found[1..].iter().all(|(_, support)| *support == 62.0), "{found:?}");
        assert_eq!(agreed(&[(truth, 0.0)])[0].1, 0.0);
    }

    #[test]
    fn a_place_in_other_colours_is_less_similar() {
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let (image, _, bbox) = photographed(&camera);
        let swapped = image.map(|[red, green, blue]| [*blue, *green, *red]);
        let grey = image.map(|rgb| [rgb[1]; 3]);
        let extractor = Extractor::shipped().unwrap();
        let mesh = part();
        let few = TemplateOptions { directions: 20, rotations: 4, ..TemplateOptions::default() };
        let templates = make_templates(&mesh, "part", mesh.diameter(), &extractor, &few).unwrap();
        let options = ViewsOptions::default();
        let place = |image: &RgbImage| place(&extractor, image, &camera, bbox);
        let best = |place: &Place| templates.iter().map(|t| place.colour_of(t)).fold(0.0, f32::max);
        let [own, other, none] = [&image, &swapped, &grey].map(|image| best(&place(image)));
        assert!(own > other + 0.1 && none == 0.0, "{own} {other} {none}");
        // With the weight 0 all are equal: the features are those of grey images.
        let places = [place(&image), place(&swapped), place(&grey)];
        let gain = |place_colour: f32| {
            let options = ViewsOptions { place_colour, place_recognition: 0.0, ..options.clone() };
            let similar =
                without_refiner(&extractor, &mesh, &templates, &options).place_similarities(&places);
            similar[0] - similar[1].max(similar[2])
        };
        assert!(gain(0.5) > gain(0.0) + 0.1, "{} {}", gain(0.5), gain(0.0));
    }
}
