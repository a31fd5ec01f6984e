//! Search without a given region: a detector of any object proposes boxes, the object's templates select those similar to it, and
//! poses are estimated there (the structure of CNOS, Nguyen et al. 2023, whose proposals and features come from foundation models; ours
//! are small networks). Of the poses, those at which the image is recognised as the object come first (`recognition`).
//!
//! Proposals and their features belong to the image: they are computed once, for all objects searched in it.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use sixfold_align::outline::projected_box;
use sixfold_estimator::{EstimatorError, ObjectDetector};
use sixfold_geometry::{Camera, Rect, RgbImage};

use crate::colour::Chroma;
use crate::error::ViewsError;
use crate::estimate::{Hypothesis, Part, Views};
use crate::features::Extractor;
use crate::matching::{colour_similarity, quick_similarity};
use crate::printed::ImageKeypoints;
use crate::recognition::Recognised;
use crate::templates::Template;

/// Boxes of two poses that overlap more than this (intersection over union) belong to one instance.
const ONE_INSTANCE: f64 = 0.5;

/// A box that may show an object, with the networks' features there.
pub(crate) struct Place {
    bbox: Rect,
    part: Part,
    chromas: Option<Vec<Chroma>>,
    recognised: Option<Recognised>,
}

impl Place {
    fn new(extractor: &Extractor, bbox: Rect, part: Part) -> Result<Place, ViewsError> {
        let recognised = extractor.recogniser().features(&[&part.patch.data], part.patch.width)?.pop();
        Ok(Place { bbox, chromas: part.chromas(), recognised, part })
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
        let mut detected = detector.detect(image)?;
        detected.sort_by(|a, b| b.region.score.total_cmp(&a.region.score));
        detected.truncate(most);
        let place = |bbox: Rect| -> Result<Option<Place>, ViewsError> {
            let part = Part::new(extractor, image, camera, &bbox, side)?;
            part.map(|part| Place::new(extractor, bbox, part)).transpose()
        };
        let places: Result<Vec<Option<Place>>, ViewsError> =
            detected.par_iter().map(|d| place(d.region.bbox)).collect();
        let places = Arc::new(places.map_err(EstimatorError::method)?.into_iter().flatten().collect());
        *kept = Some(Arc::clone(&places));
        Ok(places)
    }
}

impl Views<'_> {
    /// The object's poses in the places similar to it, best first, at most `instances`, no two of the same instance.
    pub(crate) fn search(
        &self,
        image: &RgbImage,
        camera: &Camera,
        places: &[Place],
        keypoints: Option<&ImageKeypoints>,
        instances: usize,
    ) -> Result<Vec<Hypothesis>, ViewsError> {
        let mut alike: Vec<(&Place, f32)> =
            places.par_iter().map(|place| (place, self.max_similarity(place))).collect();
        alike.sort_by(|a, b| b.1.total_cmp(&a.1));
        alike.truncate(self.options.places.saturating_add(instances - 1));
        let mut pool: Vec<(usize, Hypothesis)> = Vec::new();
        for (number, (place, _)) in alike.iter().enumerate() {
            let poses = self.coarse(&place.part, &self.ranked(&place.part), self.options.place_hypotheses)?;
            pool.extend(poses.into_iter().map(|pose| (number, pose)));
        }
        pool.sort_by(|a, b| b.1.similarity.total_cmp(&a.1.similarity));
        // The best of all and, if several instances are requested, the best of each place.
        let mut seen = vec![false; alike.len()];
        let mut chosen = Vec::new();
        for (number, pose) in pool {
            let first = !std::mem::replace(&mut seen[number], true);
            if chosen.len() < self.options.place_close || (first && instances > 1) {
                chosen.push((pose, alike[number].0.bbox));
            }
        }
        let prints = self.prints(keypoints, camera);
        chosen.extend(self.by_print(prints.as_ref(), camera, instances));
        let found =
            self.recognised(self.closer_all(chosen, prints.as_ref(), image, camera)?, image, camera)?;
        let mut kept: Vec<Hypothesis> = Vec::new();
        for hypothesis in found {
            if kept.len() < instances && kept.iter().all(|k| !self.one(camera, k, &hypothesis)) {
                kept.push(hypothesis);
            }
        }
        Ok(kept)
    }

    /// Poses that are sorted by similarity, sorted by the product of it and of how similar the image is to the object rendered there. At one
    /// place the most similar pose decides for all, so that their order is kept: these features are too coarse for it.
    fn recognised(
        &self,
        poses: Vec<Hypothesis>,
        image: &RgbImage,
        camera: &Camera,
    ) -> Result<Vec<Hypothesis>, ViewsError> {
        // The best pose of each place, and the place of each pose.
        let mut best: Vec<Hypothesis> = Vec::new();
        let mut places: Vec<usize> = Vec::with_capacity(poses.len());
        for pose in &poses {
            places.push(best.iter().position(|best| self.one(camera, best, pose)).unwrap_or(best.len()));
            if places.last() == Some(&best.len()) {
                best.push(*pose);
            }
        }
        let recogniser = self.extractor.recogniser();
        let similar: Result<Vec<Option<f64>>, ViewsError> = best
            .par_iter()
            .map(|pose| recogniser.similarity(self.mesh, image, camera, &pose.camera_from_object))
            .collect();
        let similar = similar?;
        let score = |(pose, place): (Hypothesis, usize)| {
            (pose.similarity * similar[place].unwrap_or(0.0).max(0.0), pose)
        };
        let mut scored: Vec<(f64, Hypothesis)> = poses.into_iter().zip(places).map(score).collect();
        scored.sort_by(|a, b| b.0.total_cmp(&a.0));
        Ok(scored.into_iter().map(|(_, pose)| pose).collect())
    }

    /// Similarity of a crop to its most similar template, on a subset of features: selects the places to examine further.
    fn max_similarity(&self, place: &Place) -> f32 {
        let weight = self.options.place_colour;
        let of = |template| {
            quick_similarity(template, &place.part.map)
                + weight * place.colour_of(template)
                + self.options.place_recognition * place.recognised_as(template)
        };
        let recognised = self.templates.par_iter().filter(|t| !t.appearance.cells.is_empty());
        recognised.map(of).reduce(|| f32::NEG_INFINITY, f32::max)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::ViewsOptions;
    use crate::estimate::tests::{part, photographed, without_refiner};
    use crate::templates::{TemplateOptions, make_templates};
    use sixfold_geometry::{Pose, Vec3};

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
        let place = |bbox: Rect| {
            let part = Part::new(&extractor, &image, &camera, &bbox, 160).unwrap().unwrap();
            Place::new(&extractor, bbox, part).unwrap()
        };
        let most = |place: &Place| templates.iter().map(|t| place.recognised_as(t)).fold(0.0, f32::max);
        let similarity = |place_recognition: f32, place: &Place| {
            let options = ViewsOptions { place_recognition, ..ViewsOptions::default() };
            let views = without_refiner(&extractor, &mesh, &templates, &options);
            views.max_similarity(place)
        };
        let own = place(bbox);
        for beside in [Rect { x: 40.0, y: 300.0, ..bbox }, Rect { x: 300.0, y: 20.0, ..bbox }] {
            let other = place(beside);
            assert!(most(&own) > most(&other) + 0.1, "{} {}", most(&own), most(&other));
            let gain = |weight: f32| similarity(weight, &own) - similarity(weight, &other);
            assert!(gain(2.0) > gain(0.0) + 0.1, "{} {}", gain(2.0), gain(0.0));
        }
    }

    #[test]
    fn of_poses_that_agree_equally_the_one_on_the_object_comes_first() {
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let (image, truth, _) = photographed(&camera);
        let (extractor, mesh, options) = (Extractor::shipped().unwrap(), part(), ViewsOptions::default());
        let views = without_refiner(&extractor, &mesh, &[], &options);
        let pose =
            |camera_from_object| Hypothesis { camera_from_object, similarity: 0.6, inliers: 20, drawn: 0.0 };
        let beside = truth.with_translation(truth.translation() + Vec3::new(-0.3, 0.1, 0.0));
        let behind = truth.with_translation(-truth.translation());
        let poses = [behind, beside, truth].map(pose).to_vec();
        let sorted = views.recognised(poses, &image, &camera).unwrap();
        assert_eq!(sorted.iter().map(|h| h.camera_from_object).collect::<Vec<_>>(), [truth, beside, behind]);
        // At one place the order is kept.
        let near = truth.with_translation(truth.translation() + Vec3::new(0.02, 0.0, 0.0));
        let sorted = views.recognised([near, truth].map(pose).to_vec(), &image, &camera).unwrap();
        assert_eq!(sorted[0].camera_from_object, near);
        let similarity =
            |pose: &Pose| extractor.recogniser().similarity(&mesh, &image, &camera, pose).unwrap();
        assert!(similarity(&truth).unwrap() > similarity(&beside).unwrap() + 0.1);
        assert_eq!(similarity(&behind), None);
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
        let place = |image: &RgbImage| {
            let part = Part::new(&extractor, image, &camera, &bbox, options.side).unwrap().unwrap();
            Place::new(&extractor, bbox, part).unwrap()
        };
        let best = |place: &Place| templates.iter().map(|t| place.colour_of(t)).fold(0.0, f32::max);
        let [own, other, none] = [&image, &swapped, &grey].map(|image| best(&place(image)));
        assert!(own > other + 0.1 && none == 0.0, "{own} {other} {none}");
        let similarity = |place_colour: f32| {
            let options = ViewsOptions { place_colour, ..options.clone() };
            let views = without_refiner(&extractor, &mesh, &templates, &options);
            views.max_similarity(&place(&image))
        };
        assert!(similarity(0.5) > similarity(0.0) + 0.1);
    }
}
