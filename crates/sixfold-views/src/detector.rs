//! Boxes and masks of known objects in a colour image, without training for them: the proposals of a detector of any object are named by the
//! objects' views (the structure of CNOS, Nguyen et al. 2023). In the proposals most similar to an object its pose is estimated, and the object
//! rendered there gives box and mask, less what surer detections hide.
//!
//! Objects compete for the parts of the image: a detection's agreement `a` (that of `search`) is reduced to `a a^2 / (a^2 + o^2)`, where `o` is
//! that of the other object which agrees most with the same part (ours). A logistic function of its logarithm gives the score.
//!
//! The image's camera is not known. Poses are estimated for one with a usual field of view, and
//! may be wrong in distance; what is kept of them, boxes and masks, depends less on it.

use std::collections::BTreeMap;
use std::sync::Arc;

use rayon::prelude::*;
use sixfold_align::outline::projected_box;
use sixfold_estimator::{
    DetectedObject, EstimatorError, ObjectDetector, PoseEstimator, PreparedObject, Region, downcast,
};
use sixfold_geometry::{Camera, Mask, OptionError, Pose, Rect, RgbImage};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

use crate::estimator::{ViewsEstimator, ViewsObject};
use crate::search::{Place, Scored, places};

/// Focal length of the assumed camera, as a fraction of the longer side: a field of view of 58 degrees.
const FOCAL: f64 = 0.9;

/// Which detections are returned.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewsDetectOptions {
    /// Detections with a lower score (probability that the box overlaps the object by half) are left out.
    pub threshold: f64,
    /// Of two boxes of an object with a larger intersection over union, the one with the lower score is left out.
    pub overlap: f64,
    /// Maximum number of detections of an object, the best ones.
    pub per_object: usize,
    /// Maximum number of detections of an image, the best ones.
    pub max_detections: usize,
    /// Estimate poses, which give boxes and masks; otherwise these are the proposals' own.
    pub poses: bool,
    /// Also compute masks.
    pub masks: bool,
}

impl Default for ViewsDetectOptions {
    fn default() -> Self {
        ViewsDetectOptions {
            threshold: 0.5,
            overlap: 0.5,
            per_object: 100,
            max_detections: 100,
            poses: true,
            masks: true,
        }
    }
}

impl ViewsDetectOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_within("threshold", self.threshold, 0.0..=1.0, "0 to 1")?;
        OptionError::unless_within("overlap", self.overlap, 0.0..=1.0, "0 to 1")?;
        OptionError::unless_some("per_object", self.per_object)?;
        OptionError::unless_some("max_detections", self.max_detections)
    }
}

/// Detects objects by their views.
pub struct ViewsDetector {
    estimator: ViewsEstimator,
    proposals: Arc<dyn ObjectDetector>,
    objects: BTreeMap<u32, Box<dyn PreparedObject>>,
    /// Which detections are returned.
    pub options: ViewsDetectOptions,
    /// Called when an object has been searched.
    pub searched: Option<Box<dyn Fn(u32) + Send + Sync>>,
}

/// A detection before boxes are suppressed.
struct Candidate<S> {
    id: u32,
    /// How well the image agrees with it; after [`compete`] reduced by that of other objects there.
    agreement: f64,
    /// With what it competes.
    strength: f64,
    /// Which agreement gives a score of a half, and how steep scores are there.
    curve: [f64; 2],
    bbox: Rect,
    shown: S,
}

/// What a candidate shows.
enum Shown<'a> {
    /// An object at a pose.
    Posed(&'a ViewsObject, Pose),
    /// A proposal.
    Place(&'a Place),
}

/// `curve` of poses: logistic regression on 48 simulated images (8 objects of LM-O, 12 synthetic ones; 2424 detections). On 25 real ones
/// of LM-O 73 of 76 detections with a score above a half are right.
const OF_POSES: [f64; 2] = [0.21, 4.5];
/// `curve` of places: the same on 2500 detections in 25 images of LM-O, since simulated ones ([3.2, 3.3]) give too high scores. On 25 others 52 of
/// 58 detections with a score above a half are right.
const OF_PLACES: [f64; 2] = [4.4, 4.2];

impl<S> Candidate<S> {
    /// Probability that it overlaps the object by half.
    fn score(&self) -> f64 {
        let [half, steepness] = self.curve;
        if self.agreement > 0.0 { 1.0 / (1.0 + (half / self.agreement).powf(steepness)) } else { 0.0 }
    }
}

impl ViewsDetector {
    /// Detects `objects`, prepared by `estimator`, each with the number by which it is reported, in the proposals of a detector of any object.
    /// With masks, `proposals` has to return masks too if no poses are estimated.
    pub fn new(
        estimator: ViewsEstimator,
        proposals: Arc<dyn ObjectDetector>,
        objects: BTreeMap<u32, Box<dyn PreparedObject>>,
    ) -> ViewsDetector {
        ViewsDetector {
            estimator,
            proposals,
            objects,
            options: ViewsDetectOptions::default(),
            searched: None,
        }
    }

    /// The poses of an object in the places most similar to it.
    fn posed<'a>(
        &'a self,
        (id, object): (u32, &'a ViewsObject),
        places: &[Place],
        image: &RgbImage,
        camera: &Camera,
    ) -> Result<Vec<Candidate<Shown<'a>>>, EstimatorError> {
        let views = self.estimator.views(object);
        let alike = views.most_alike(places, self.estimator.options.places);
        let located = views.located(&alike, places, image, camera, true).map_err(EstimatorError::method)?;
        let candidate = |Scored { pose, score: agreement, .. }: Scored<usize>| {
            let pose = pose.camera_from_object;
            let bbox = projected_box(views.outline, camera, &pose)?;
            let shown = Shown::Posed(object, pose);
            Some(Candidate { id, agreement, strength: agreement, curve: OF_POSES, bbox, shown })
        };
        Ok(located.into_iter().filter_map(candidate).collect())
    }

    /// All places, with the number of standard deviations by which they are more similar to an object than the image's places are.
    fn placed<'a>(
        &self,
        (id, object): (u32, &ViewsObject),
        places: &'a [Place],
    ) -> Vec<Candidate<Shown<'a>>> {
        let similar = self.estimator.views(object).place_similarities(places);
        let candidate = |(place, similar): (&'a Place, f32)| {
            let deviations = f64::from(similar.max(0.0));
            let bbox = place.region.bbox;
            Candidate {
                id,
                agreement: deviations,
                strength: deviations.exp(),
                curve: OF_PLACES,
                bbox,
                shown: Shown::Place(place),
            }
        };
        places.iter().zip(similar).map(candidate).collect()
    }
}

impl ObjectDetector for ViewsDetector {
    fn check_object(&self, object_id: u32) -> Result<(), EstimatorError> {
        if self.objects.contains_key(&object_id) {
            return Ok(());
        }
        let known: Vec<String> = self.objects.keys().map(u32::to_string).collect();
        let known = known.join(", ");
        Err(EstimatorError::method(format!("object {object_id}: expected one of {known}")))
    }

    fn detect(&self, image: &RgbImage) -> Result<Vec<DetectedObject>, EstimatorError> {
        self.options.check().map_err(EstimatorError::method)?;
        let (width, height) = image.size();
        let focal = FOCAL * width.max(height) as f64;
        let [cx, cy] = [width, height].map(|side| 0.5 * (side as f64 - 1.0));
        let camera = Camera::new(focal, focal, cx, cy, width, height).map_err(EstimatorError::method)?;
        let sizes = [self.estimator.options.proposals, self.estimator.options.side];
        let places = places(self.proposals.as_ref(), self.estimator.extractor(), image, &camera, sizes)?;
        let mut candidates = Vec::new();
        for (id, object) in &self.objects {
            let object: &ViewsObject = downcast(object.as_ref(), self.estimator.name())?;
            candidates.extend(match self.options.poses {
                true => self.posed((*id, object), &places, image, &camera)?,
                false => self.placed((*id, object), &places),
            });
            if let Some(searched) = &self.searched {
                searched(*id);
            }
        }
        compete(&mut candidates, self.options.overlap);
        let kept = suppress(candidates, &self.options);
        Ok(regions(kept, &camera, &self.options))
    }
}

/// Reduces the agreement of each candidate the more, the better another object agrees with about the same box.
fn compete<S: Sync>(candidates: &mut [Candidate<S>], overlap: f64) {
    let factor = |of: &Candidate<S>| {
        let rival = |c: &&Candidate<S>| c.id != of.id && c.bbox.iou(&of.bbox) > overlap;
        let other = candidates.iter().filter(rival).map(|c| c.strength).fold(0.0, f64::max);
        if of.strength > 0.0 { 1.0 / (1.0 + (other / of.strength).powi(2)) } else { 0.0 }
    };
    let factors: Vec<f64> = candidates.par_iter().map(factor).collect();
    candidates.iter_mut().zip(factors).for_each(|(c, factor)| c.agreement *= factor);
}

/// The candidates by decreasing score without those below the threshold, those that overlap a better one of their object, and those beyond the
/// largest numbers.
fn suppress<S>(mut candidates: Vec<Candidate<S>>, options: &ViewsDetectOptions) -> Vec<Candidate<S>> {
    candidates.retain(|c| c.score() >= options.threshold && c.agreement > 0.0);
    candidates.sort_by(|a, b| b.score().total_cmp(&a.score()));
    let mut kept: Vec<Candidate<S>> = Vec::new();
    for candidate in candidates {
        let mut same = kept.iter().filter(|k| k.id == candidate.id);
        let full = kept.len() >= options.max_detections || same.clone().count() >= options.per_object;
        if !full && same.all(|k| k.bbox.iou(&candidate.bbox) <= options.overlap) {
            kept.push(candidate);
        }
    }
    kept
}

/// The pixels of a rendered object, ascending, with the inverse of their depth.
type Pixels = Vec<(u32, f32)>;

fn pixels(frame: &mut VisibilityBuffer, mesh: &Mesh, pose: &Pose) -> Pixels {
    frame.render(&[SceneObject { mesh, camera_from_object: *pose }], &RenderOptions::default());
    let near = frame.inverse_depth();
    let ([x0, y0, x1, y1], width) = (frame.covered(), frame.width());
    let inside = (y0..y1).flat_map(|y| (x0..x1).map(move |x| y * width + x));
    inside.filter(|i| near[*i] > 0.0).map(|i| (i as u32, near[i])).collect()
}

/// The regions of candidates, of which the surer come first. A pose's region is what the object rendered there shows, without what surer
/// detections elsewhere hide; if they leave less than [`SEEN`] of it, it is left out.
fn regions(
    candidates: Vec<Candidate<Shown<'_>>>,
    camera: &Camera,
    options: &ViewsDetectOptions,
) -> Vec<DetectedObject> {
    let rendered: Vec<Pixels> = candidates
        .par_iter()
        .map_init(
            || VisibilityBuffer::new(camera),
            |frame, c| match &c.shown {
                Shown::Posed(object, pose) => pixels(frame, &object.view, pose),
                Shown::Place(_) => vec![],
            },
        )
        .collect();
    let region = |(number, c): (usize, &Candidate<Shown<'_>>)| {
        let region = match &c.shown {
            Shown::Place(place) => {
                let mask = place.region.mask.clone().filter(|_| options.masks);
                Region { score: c.score(), mask, ..Region::of_box(c.bbox) }
            }
            Shown::Posed(..) => {
                let hides = |other: &usize| candidates[*other].bbox.iou(&c.bbox) <= options.overlap;
                let before: Vec<&Pixels> = (0..number).filter(hides).map(|other| &rendered[other]).collect();
                let (mask, count) = visible(&rendered[number], &before, (camera.width, camera.height));
                let region =
                    Region::of_mask(mask).filter(|_| count as f64 >= SEEN * rendered[number].len() as f64)?;
                let Rect { x, y, width, height } = region.bbox;
                // From the first to the last pixel, as all detectors' boxes.
                let bbox = Rect { x, y, width: width - 1.0, height: height - 1.0 };
                let mask = region.mask.filter(|_| options.masks);
                Region { score: c.score(), mask, ..Region::of_box(bbox) }
            }
        };
        Some(DetectedObject { object_id: c.id, region })
    };
    candidates.par_iter().enumerate().filter_map(region).collect()
}

/// Detections of which less than this fraction is visible are left out; BOP's targets are visible to a tenth.
const SEEN: f64 = 0.1;

/// The pixels of an object at which none of the others is nearer, and their number.
fn visible(own: &Pixels, others: &[&Pixels], (width, height): (usize, usize)) -> (Mask, usize) {
    let mut mask = Mask::filled(width, height, false);
    own.iter().for_each(|(i, _)| mask.as_mut_slice()[*i as usize] = true);
    for other in others {
        let mut rest = own.as_slice();
        for (i, near) in *other {
            rest = &rest[rest.partition_point(|(k, _)| k < i)..];
            match rest.first() {
                Some((k, own)) if k == i && near > own => mask.as_mut_slice()[*i as usize] = false,
                Some(_) => {}
                None => break,
            }
        }
    }
    let count = mask.as_slice().iter().filter(|visible| **visible).count();
    (mask, count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::tests::{cuboid, part, photographed};
    use crate::templates::TemplateOptions;
    use sixfold_estimator::Object;
    use sixfold_mesh::ModelInfo;

    fn candidate(id: u32, agreement: f64, x: f64) -> Candidate<()> {
        let bbox = Rect { x, y: 0.0, width: 10.0, height: 10.0 };
        Candidate { id, agreement, strength: agreement, curve: OF_POSES, bbox, shown: () }
    }

    fn agreements(candidates: &[Candidate<()>]) -> Vec<f64> {
        candidates.iter().map(|c| (c.agreement * 1e3).round() / 1e3).collect()
    }

    #[test]
    fn another_object_at_the_same_place_reduces_the_agreement() {
        // 3 and 4 pixels apart the intersections over union are 0.538 and 0.429.
        let mut all = [
            candidate(1, 0.4, 0.0),
            candidate(2, 0.2, 3.0),
            candidate(2, 0.8, 4.0),
            candidate(1, 0.1, 0.0),
            candidate(3, 0.0, 0.0),
        ];
        compete(&mut all, 0.5);
        // Its own object's other candidates do not compete, and those elsewhere neither.
        let expected = [0.4 / 1.25, 0.2 / 5.0, 0.8, 0.1 / 5.0, 0.0];
        assert_eq!(agreements(&all), expected.map(|v: f64| (v * 1e3).round() / 1e3));
    }

    #[test]
    fn the_better_of_overlapping_detections_is_kept() {
        let all = || {
            vec![
                candidate(1, 0.2, 3.0),
                candidate(1, 0.4, 0.0),
                candidate(2, 0.3, 0.0),
                candidate(1, 0.1, 4.0),
                candidate(1, 0.0, 90.0),
            ]
        };
        let default = ViewsDetectOptions { threshold: 0.0, ..ViewsDetectOptions::default() };
        let kept = |options: ViewsDetectOptions| agreements(&suppress(all(), &options));
        assert_eq!(kept(default.clone()), [0.4, 0.3, 0.1]);
        assert_eq!(kept(ViewsDetectOptions { overlap: 0.6, ..default.clone() }), [0.4, 0.3, 0.2]);
        assert_eq!(kept(ViewsDetectOptions { per_object: 1, ..default.clone() }), [0.4, 0.3]);
        assert_eq!(kept(ViewsDetectOptions { max_detections: 2, ..default.clone() }), [0.4, 0.3]);
        // 0.21 gives a score of a half.
        assert_eq!(kept(ViewsDetectOptions { threshold: 0.5, ..default }), [0.4, 0.3]);
        assert!((candidate(1, 0.21, 0.0).score() - 0.5).abs() < 1e-9);
        let place = Candidate { curve: OF_PLACES, ..candidate(1, 4.4, 0.0) };
        assert!((place.score() - 0.5).abs() < 1e-9);
        assert!((candidate(1, 0.42, 0.0).score() - 1.0 / (1.0 + 0.5f64.powf(4.5))).abs() < 1e-9);
    }

    #[test]
    fn pixels_at_which_another_object_is_nearer_are_hidden() {
        let own = vec![(1, 0.5), (2, 0.5), (5, 0.5), (9, 0.5)];
        let others = [vec![(0, 1.0), (1, 1.0), (5, 0.4)], vec![(2, 0.5), (9, 0.6), (11, 1.0)]];
        let (mask, count) = visible(&own, &others.iter().collect::<Vec<_>>(), (4, 3));
        let shown: Vec<usize> = (0..12).filter(|i| mask.as_slice()[*i]).collect();
        assert_eq!((shown, count), (vec![2, 5], 2));
    }

    /// An object in front of the camera as a detection.
    fn posed<'a>(
        camera: &Camera,
        object: &'a dyn PreparedObject,
        id: u32,
        at: [f64; 3],
    ) -> Candidate<Shown<'a>> {
        let object: &ViewsObject = downcast(object, "views").unwrap();
        let pose = Pose::from_translation(at.into());
        let bbox = projected_box(&object.outline, camera, &pose).unwrap();
        let shown = Shown::Posed(object, pose);
        Candidate { id, agreement: 1.0, strength: 1.0, curve: OF_POSES, bbox, shown }
    }

    #[test]
    fn what_surer_detections_elsewhere_hide_is_left_out() {
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let mut estimator = ViewsEstimator::shipped().unwrap();
        estimator.templates = TemplateOptions { directions: 4, rotations: 1, ..TemplateOptions::default() };
        let prepared = |mesh: Mesh| {
            let info = ModelInfo::of_mesh(&mesh);
            estimator.prepare(&Object::of_mesh("an object", mesh, info)).unwrap()
        };
        let [cube, plate] = [[0.05; 3], [0.15, 0.15, 0.002]]
            .map(|half| prepared(cuboid(half.map(|v: f64| -v), half, [90; 3])));
        let options = ViewsDetectOptions::default();
        let width = |found: &[DetectedObject]| {
            found.iter().map(|d| (d.object_id, d.region.bbox.width.round())).collect::<Vec<_>>()
        };
        let own = |z: f64| posed(&camera, cube.as_ref(), 1, [0.0, 0.0, z]);
        let beside = |x: f64| posed(&camera, plate.as_ref(), 2, [x, 0.0, 0.7]);
        let alone = regions(vec![own(1.0)], &camera, &options);
        let whole = width(&alone)[0].1;
        // From the first column of the mask to the last one.
        let [_, _, columns, _] = alone[0].region.mask.as_ref().unwrap().bounding_box().unwrap();
        assert_eq!(alone[0].region.bbox.width + 1.0, columns as f64);
        // The plate hides the right half of the cube behind it; all but 12 %, all but 5 %, all.
        let half = width(&regions(vec![beside(0.15), own(1.0)], &camera, &options));
        assert!(half[1].0 == 1 && (0.4..0.6).contains(&(half[1].1 / whole)), "{half:?} of {whole}");
        let number = |x: f64| regions(vec![beside(x), own(1.0)], &camera, &options).len();
        assert_eq!([0.122, 0.117, 0.1].map(number), [2, 1, 1]);
        // A less certain one hides nothing, nor does one behind.
        assert_eq!(width(&regions(vec![own(1.0), beside(0.15)], &camera, &options))[0].1, whole);
        let before = width(&regions(vec![own(0.5)], &camera, &options))[0].1;
        assert_eq!(width(&regions(vec![beside(0.15), own(0.5)], &camera, &options))[1].1, before);
    }

    /// Proposes these boxes.
    struct Boxes(Vec<Rect>);

    impl ObjectDetector for Boxes {
        fn check_object(&self, _: u32) -> Result<(), EstimatorError> {
            Ok(())
        }

        fn detect(&self, image: &RgbImage) -> Result<Vec<DetectedObject>, EstimatorError> {
            let mask = |b: &Rect| {
                let inside = |x: usize, y: usize| {
                    (b.x..=b.x + b.width).contains(&(x as f64))
                        && (b.y..=b.y + b.height).contains(&(y as f64))
                };
                Mask::from_fn(image.width(), image.height(), inside)
            };
            let region = |b: &Rect| Region { mask: Some(mask(b)), ..Region::of_box(*b) };
            Ok(self.0.iter().map(|b| DetectedObject { object_id: 0, region: region(b) }).collect())
        }
    }

    #[test]
    fn an_object_is_named_among_proposals_and_its_pose_gives_box_and_mask() {
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let (image, truth, bbox) = photographed(&camera);
        let mut estimator = ViewsEstimator::shipped().unwrap();
        estimator.templates = TemplateOptions { directions: 40, rotations: 8, ..TemplateOptions::default() };
        estimator.options.places = 2;
        // A box that shows most of the object, and others.
        let near = Rect { x: bbox.x + 16.0, width: bbox.width - 32.0, ..bbox };
        let boxes = vec![Rect { x: 40.0, y: 300.0, ..bbox }, Rect { x: 300.0, y: 20.0, ..bbox }, near];
        let plate = cuboid([-0.1, -0.1, -0.005], [0.1, 0.1, 0.005], [40, 90, 190]);
        let prepared = |mesh: Mesh| {
            let info = ModelInfo::of_mesh(&mesh);
            estimator.prepare(&Object::of_mesh("an object", mesh, info)).unwrap()
        };
        let objects = BTreeMap::from([(4, prepared(plate)), (7, prepared(part()))]);
        let mut detector = ViewsDetector::new(estimator.clone(), Arc::new(Boxes(boxes)), objects);
        assert!(detector.check_object(7).is_ok());
        let message = detector.check_object(5).unwrap_err().to_string();
        assert!(message.contains("object 5") && message.contains("4, 7"), "{message}");

        let found = detector.detect(&image).unwrap();
        assert_eq!(found.iter().map(|d| d.object_id).collect::<Vec<_>>(), [7]);
        let region = &found[0].region;
        assert!(region.score > 0.5 && region.score <= 1.0, "{}", region.score);
        assert!(region.bbox.iou(&bbox) > 0.85 && near.iou(&bbox) < 0.8, "{:?}", region.bbox);
        let mut frame = VisibilityBuffer::new(&camera);
        frame.render(&[SceneObject { mesh: &part(), camera_from_object: truth }], &RenderOptions::default());
        let (mask, truth) = (region.mask.as_ref().unwrap(), frame.mask(0));
        let count = |of: &dyn Fn(bool, bool) -> bool| {
            mask.as_slice().iter().zip(truth.as_slice()).filter(|(a, b)| of(**a, **b)).count() as f64
        };
        let overlap = count(&|a, b| a && b) / count(&|a, b| a || b);
        assert!(overlap > 0.85, "{overlap}");

        // Without poses the proposals and their masks are named.
        detector.options.poses = false;
        detector.options.threshold = 0.0;
        let found = detector.detect(&image).unwrap();
        let first = found.iter().find(|d| d.object_id == 7).unwrap();
        assert_eq!(first.region.bbox, near);
        assert!(first.region.mask.as_ref().unwrap()[(near.x as usize + 1, near.y as usize + 1)]);
        detector.options.masks = false;
        assert!(detector.detect(&image).unwrap().iter().all(|d| d.region.mask.is_none()));
        detector.options.overlap = 1.5;
        assert!(detector.detect(&image).unwrap_err().to_string().contains("overlap"));
    }
}
