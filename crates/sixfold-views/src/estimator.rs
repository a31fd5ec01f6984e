//! Views as a [`PoseEstimator`].

use std::path::Path;
use std::sync::Arc;

use serde_json::{Map, json};
use sixfold_align::outline::outline_mesh;
use sixfold_estimator::{
    EstimatorError, MinConfidence, Need, Needs, Object, ObjectDetector, PoseEstimate, PoseEstimator,
    PreparedObject, Query, downcast,
};
use sixfold_io::Fnv1a;
use sixfold_mesh::Mesh;
use sixfold_nn::device;
use sixfold_nn::lite0::imagenet_encoder_hash;

use crate::error::ViewsError;
use crate::estimate::{Hypothesis, Views, ViewsOptions};
use crate::features::Extractor;
use crate::file;
use crate::network::{ViewNetwork, shipped_hash};
use crate::printed::{KeptKeypoints, Printed};
use crate::refiner::Refiner;
use crate::refiner::network::RefinerNetwork;
use crate::search::Places;
use crate::templates::{Template, TemplateOptions, make_templates, view_mesh};

const METHOD: &str = "views";
/// File of an object's templates in its folder.
const FILE: &str = "views.bin";

/// Poses of known objects from colour, without training for the object, in given regions or in the proposals of a detector of any
/// object.
#[derive(Clone)]
pub struct ViewsEstimator {
    extractor: Arc<Extractor>,
    /// Trained only for the features of the shipped network.
    refiner: Option<Arc<Refiner>>,
    /// Proposes regions of any object, for queries without a region.
    proposals: Option<Arc<dyn ObjectDetector>>,
    /// The hash of the network's weights, for templates that are kept.
    network: u64,
    /// How objects are rendered.
    pub templates: TemplateOptions,
    /// How poses are estimated.
    pub options: ViewsOptions,
}

impl ViewsEstimator {
    /// With the shipped network.
    ///
    /// # Errors
    /// [`ViewsError::Weights`].
    pub fn shipped() -> Result<ViewsEstimator, ViewsError> {
        let device = device::chosen();
        let refiner = Refiner::new(RefinerNetwork::shipped(&device)?, device);
        let estimator = ViewsEstimator::new(Extractor::shipped()?, shipped_hash());
        Ok(ViewsEstimator { refiner: Some(Arc::new(refiner)), ..estimator })
    }

    /// With a network written by `sixfold train views`. The shipped refiner was not trained on its features, so poses are refined
    /// by their products only.
    ///
    /// # Errors
    /// [`ViewsError::Weights`].
    pub fn load(weights: &Path) -> Result<ViewsEstimator, ViewsError> {
        let device = device::chosen();
        let (network, _) = ViewNetwork::load(weights, &device)?;
        let hash = sixfold_io::fnv1a_of_file(weights)
            .map_err(|source| ViewsError::Read { file: weights.to_owned(), source })?;
        Ok(ViewsEstimator::new(Extractor::new(network, device)?, hash))
    }

    fn new(extractor: Extractor, network: u64) -> ViewsEstimator {
        ViewsEstimator {
            extractor: Arc::new(extractor),
            refiner: None,
            proposals: None,
            network,
            templates: TemplateOptions::default(),
            options: ViewsOptions::default(),
        }
    }

    /// Searches in the detections of `detector` if a query has no region. The class of the detections is not used.
    #[must_use]
    pub fn with_proposals(self, detector: Arc<dyn ObjectDetector>) -> ViewsEstimator {
        ViewsEstimator { proposals: Some(detector), ..self }
    }

    pub(crate) fn extractor(&self) -> &Extractor {
        &self.extractor
    }

    pub(crate) fn views<'a>(&'a self, object: &'a ViewsObject) -> Views<'a> {
        Views {
            extractor: &self.extractor,
            mesh: &object.view,
            outline: &object.outline,
            templates: &object.templates,
            printed: Some(&object.printed),
            refiner: self.refiner.as_deref(),
            options: &self.options,
        }
    }

    /// A hash of everything that affects the templates of a mesh.
    fn key(&self, mesh: &Mesh, diameter: f64) -> u64 {
        let mut hash = Fnv1a::default();
        hash.write(&mesh.contents_hash().to_le_bytes());
        hash.write(&self.network.to_le_bytes());
        hash.write(&imagenet_encoder_hash().to_le_bytes());
        // Numbers are printed with all their digits.
        hash.write(format!("{diameter:?} {:?}", self.templates).as_bytes());
        hash.value()
    }

    /// The views kept in the object's folder, or newly rendered ones.
    fn views_of(
        &self,
        object: &Object,
        mesh: &Mesh,
        diameter: f64,
        key: u64,
        notes: &mut Vec<String>,
    ) -> Result<(Vec<Template>, Printed), ViewsError> {
        let kept = object.file(FILE);
        if let Some(path) = &kept {
            match file::read(path, key) {
                Ok(Some((templates, views))) => return Ok((templates, Printed { views, diameter })),
                Ok(None) => {}
                Err(error) => notes.push(format!("views of {} rendered again: {error}", object.name)),
            }
        }
        let templates = make_templates(mesh, &object.name, diameter, &self.extractor, &self.templates)?;
        let printed = Printed::of_mesh(mesh, diameter);
        if let Some(path) = &kept
            && let Err(error) = file::write(path, key, &templates, &printed.views)
        {
            notes.push(format!("views of {} not kept: {error}", object.name));
        }
        Ok((templates, printed))
    }
}

/// An object prepared for this method.
pub struct ViewsObject {
    name: String,
    mesh: Arc<Mesh>,
    pub(crate) view: Mesh,
    pub(crate) outline: Mesh,
    templates: Vec<Template>,
    printed: Printed,
    notes: Vec<String>,
}

impl PreparedObject for ViewsObject {
    fn name(&self) -> &str {
        &self.name
    }

    fn mesh(&self) -> Option<&Mesh> {
        Some(&self.mesh)
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }
}

impl PoseEstimator for ViewsEstimator {
    fn name(&self) -> &'static str {
        METHOD
    }

    fn needs(&self) -> Needs {
        let region = if self.proposals.is_some() { Need::Optional } else { Need::Required };
        Needs { depth: Need::Unused, rgb: Need::Required, region, object: Need::Required }
    }

    /// Of the poses on the 100 LM-O development frames (ground-truth boxes) 71 % have a confidence above 0.4, including 93 % of
    /// those with an MSSD below a fifth of the diameter; 93 % of the poses above have an MSSD below half the diameter, of all poses
    /// 76 % (`benches/views_confidence.py`).
    fn min_confidence(&self) -> MinConfidence {
        MinConfidence { image: 0.4, dataset: 0.0 }
    }

    fn prepare(&self, object: &Object) -> Result<Box<dyn PreparedObject>, EstimatorError> {
        let mesh = object.needed_mesh(METHOD)?.clone();
        let diameter = object.info.as_ref().map_or_else(|| mesh.diameter(), |info| info.diameter);
        let mut notes = Vec::new();
        let wrap = |e| EstimatorError::Object { object: object.name.clone(), source: Box::new(e) };
        self.templates.check().map_err(EstimatorError::method)?;
        let view = view_mesh(&mesh);
        let key = self.key(&mesh, diameter);
        let (templates, printed) = self.views_of(object, &view, diameter, key, &mut notes).map_err(wrap)?;
        if mesh.colors().is_none() && mesh.texture().is_none() {
            notes.push(format!(
                "{}: its mesh has no colours, its views are grey: expect fewer and less precise poses",
                object.name
            ));
        }
        let outline = outline_mesh(&mesh);
        Ok(Box::new(ViewsObject {
            name: object.name.clone(),
            mesh,
            view,
            outline,
            templates,
            printed,
            notes,
        }))
    }

    fn estimate(
        &self,
        object: &dyn PreparedObject,
        query: &Query<'_>,
    ) -> Result<Vec<PoseEstimate>, EstimatorError> {
        let object: &ViewsObject = downcast(object, METHOD)?;
        self.options.check().map_err(EstimatorError::method)?;
        let image = query.rgb(METHOD)?;
        let views = self.views(object);
        let keypoints = (!object.printed.views.is_empty())
            .then(|| query.image_memo.get_or_default::<KeptKeypoints>().of_image(image));
        let keypoints = keypoints.as_deref();
        let one = |pose: &Hypothesis, score: f64, details: &[(&str, f64)]| {
            let confidence = pose.similarity.clamp(0.0, 1.0) * score;
            let mut estimate = PoseEstimate::new(pose.camera_from_object, confidence);
            let details = details.iter().map(|(name, value)| ((*name).to_owned(), json!(value)));
            estimate.details = Map::from_iter(details.chain([
                ("similarity".to_owned(), json!(pose.similarity)),
                ("inliers".to_owned(), json!(pose.inliers)),
            ]));
            estimate
        };
        let estimate =
            |pose: &Hypothesis, rival: Option<&Hypothesis>, score: f64, details: &[(&str, f64)]| {
                let mut estimate = one(pose, score, details);
                estimate.alternatives.extend(rival.map(|rival| one(rival, score, details)));
                (estimate.confidence >= query.min_confidence).then_some(estimate)
            };
        let Some(region) = query.region else {
            let proposals = self.proposals.as_deref().ok_or(EstimatorError::Input {
                what: "region that contains the object",
                method: METHOD,
                advice: "give --detector FILE.safetensors, --boxes, --box X,Y,W,H or --mask FILE",
            })?;
            let sizes = [self.options.proposals, self.options.side];
            let kept: Arc<Places> = query.image_memo.get_or_default();
            let places = kept.of_image(proposals, &self.extractor, image, query.camera, sizes)?;
            let number = [query.max_instances, query.runners_up];
            let found = views.search(image, query.camera, &places, keypoints, number);
            return Ok(found
                .map_err(EstimatorError::method)?
                .iter()
                .filter_map(|f| {
                    estimate(
                        &f.pose,
                        f.rival.as_ref(),
                        1.0,
                        &[("recognised", f.recognised), ("support", f.support)],
                    )
                })
                .collect());
        };
        let found =
            views.find(image, query.camera, &region.bbox, keypoints).map_err(EstimatorError::method)?;
        let Some((found, rival)) = found else {
            let source = format!(
                "box {:.0},{:.0},{:.0},{:.0}: expected pixels of the image, found none",
                region.bbox.x, region.bbox.y, region.bbox.width, region.bbox.height
            );
            return Err(EstimatorError::Region { source: source.into() });
        };
        Ok(found.first().and_then(|h| estimate(h, rival.as_ref(), region.score, &[])).into_iter().collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::tests::{part, photographed};
    use sixfold_estimator::{DetectedObject, Region};
    use sixfold_geometry::{Camera, Rect, RgbImage};
    use sixfold_mesh::ModelInfo;

    /// Detects an object in each of these boxes, and counts its calls.
    struct Somewhere(Vec<Rect>, std::sync::atomic::AtomicUsize);

    impl ObjectDetector for Somewhere {
        fn check_object(&self, _: u32) -> Result<(), EstimatorError> {
            Ok(())
        }

        fn detect(&self, _: &RgbImage) -> Result<Vec<DetectedObject>, EstimatorError> {
            self.1.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            let region = |bbox: &Rect| DetectedObject { object_id: 0, region: Region::of_box(*bbox) };
            Ok(self.0.iter().map(region).collect())
        }
    }

    #[test]
    fn without_a_region_an_object_is_found_among_proposals_which_are_made_once() {
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let (image, truth, bbox) = photographed(&camera);
        let beside = Rect { x: 40.0, y: 300.0, ..bbox };
        let above = Rect { x: 300.0, y: 20.0, ..bbox };
        let detector = Arc::new(Somewhere(vec![beside, above, bbox], 0.into()));
        let mut estimator = ViewsEstimator::shipped().unwrap();
        estimator.templates = TemplateOptions { directions: 60, rotations: 12, ..TemplateOptions::default() };
        // Only one place is searched: the templates must choose the right one.
        estimator.options = ViewsOptions { places: 1, close: 1, ..ViewsOptions::default() };
        assert_eq!(estimator.needs().region, Need::Required);
        let mesh = part();
        let info = ModelInfo::of_mesh(&mesh);
        let object = Object::of_mesh("part", mesh, info);
        let prepared = estimator.prepare(&object).unwrap();
        let query = Query { rgb: Some(&image), ..Query::new(&camera) };
        let error = estimator.estimate(prepared.as_ref(), &query).unwrap_err();
        assert!(matches!(error, EstimatorError::Input { .. }), "{error}");

        let estimator = estimator.with_proposals(detector.clone());
        assert_eq!(estimator.needs().region, Need::Optional);
        for _ in 0..2 {
            let image_memo = query.image_memo.clone();
            let again = Query { rgb: Some(&image), image_memo, ..Query::new(&camera) };
            let found = estimator.estimate(prepared.as_ref(), &again).unwrap();
            assert_eq!(found.len(), 1);
            let pose = found[0].camera_from_object;
            assert!(pose.distance_to(&truth) < 0.05, "{pose:?} instead of {truth:?}");
        }
        assert_eq!(detector.1.load(std::sync::atomic::Ordering::Relaxed), 1);
        // As many instances as requested, each at a place of its own.
        let query = Query { rgb: Some(&image), max_instances: 3, ..Query::new(&camera) };
        let found = estimator.estimate(prepared.as_ref(), &query).unwrap();
        assert!(!found.is_empty() && found.len() <= 3);
        assert!(found[0].camera_from_object.distance_to(&truth) < 0.05);
        // The same with what tells the pose from other places, if two of the three are only runners-up.
        let query = Query { rgb: Some(&image), max_instances: 3, runners_up: 2, ..Query::new(&camera) };
        let found = estimator.estimate(prepared.as_ref(), &query).unwrap();
        assert!(!found.is_empty() && found.len() <= 3);
        assert!(found[0].camera_from_object.distance_to(&truth) < 0.05);
        let number = |name: &str| found[0].details[name].as_f64().unwrap();
        let (recognised, support) = (number("recognised"), number("support"));
        assert!(recognised > 0.05 && support > 0.1 && support <= 1.0 + 1e-9, "{recognised} {support}");
        // In a given region there is no search of the image.
        let region = Region::of_box(bbox);
        let query = Query { rgb: Some(&image), region: Some(&region), ..Query::new(&camera) };
        let found = estimator.estimate(prepared.as_ref(), &query).unwrap();
        assert!(found[0].details.contains_key("similarity") && !found[0].details.contains_key("support"));
    }
}
