//! Views as a [`PoseEstimator`].

use std::path::Path;
use std::sync::Arc;

use burn::tensor::Device;
use serde_json::{Map, json};
use sixfold_align::outline::outline_mesh;
use sixfold_estimator::{
    EstimatorError, MinConfidence, Need, Needs, Object, PoseEstimate, PoseEstimator, PreparedObject, Query,
    downcast,
};
use sixfold_io::Fnv1a;
use sixfold_mesh::Mesh;

use crate::error::ViewsError;
use crate::estimate::{Views, ViewsOptions};
use crate::features::Extractor;
use crate::file;
use crate::network::{ViewNetwork, shipped_hash};
use crate::refiner::Refiner;
use crate::refiner::network::RefinerNetwork;
use crate::templates::{Template, TemplateOptions, make_templates, view_mesh};

const METHOD: &str = "views";
/// Where an object's templates are kept in its folder.
const FILE: &str = "views.bin";

/// Poses of known objects from colour in given regions, without training for the object.
#[derive(Clone)]
pub struct ViewsEstimator {
    extractor: Arc<Extractor>,
    /// For the features of the network within the program alone.
    refiner: Option<Arc<Refiner>>,
    /// The hash of the network's weights, for templates that are kept.
    network: u64,
    /// How objects are rendered.
    pub templates: TemplateOptions,
    /// How poses are estimated.
    pub options: ViewsOptions,
}

impl ViewsEstimator {
    /// With the network within the program.
    ///
    /// # Errors
    /// [`ViewsError::Weights`].
    pub fn shipped() -> Result<ViewsEstimator, ViewsError> {
        let device = Device::default();
        let refiner = Refiner::new(RefinerNetwork::shipped(&device)?, device);
        let estimator = ViewsEstimator::new(Extractor::shipped()?, shipped_hash());
        Ok(ViewsEstimator { refiner: Some(Arc::new(refiner)), ..estimator })
    }

    /// With a network that `sixfold train views` wrote. The refiner within the program does not know its features: poses are refined
    /// by their products alone.
    ///
    /// # Errors
    /// [`ViewsError::Weights`].
    pub fn load(weights: &Path) -> Result<ViewsEstimator, ViewsError> {
        let device = Device::default();
        let (network, _) = ViewNetwork::load(weights, &device)?;
        let hash = sixfold_io::fnv1a_of_file(weights)
            .map_err(|source| ViewsError::Read { file: weights.to_owned(), source })?;
        Ok(ViewsEstimator::new(Extractor::new(network, device), hash))
    }

    fn new(extractor: Extractor, network: u64) -> ViewsEstimator {
        ViewsEstimator {
            extractor: Arc::new(extractor),
            refiner: None,
            network,
            templates: TemplateOptions::default(),
            options: ViewsOptions::default(),
        }
    }

    /// What decides about the templates of a mesh.
    fn key(&self, mesh: &Mesh, diameter: f64) -> u64 {
        let mut hash = Fnv1a::default();
        hash.write(&mesh.contents_hash().to_le_bytes());
        hash.write(&self.network.to_le_bytes());
        // Numbers print with all their digits.
        hash.write(format!("{diameter:?} {:?}", self.templates).as_bytes());
        hash.value()
    }

    /// The templates kept in the object's folder, or new ones.
    fn templates_of(
        &self,
        object: &Object,
        mesh: &Mesh,
        diameter: f64,
        key: u64,
        notes: &mut Vec<String>,
    ) -> Result<Vec<Template>, ViewsError> {
        let kept = object.file(FILE);
        if let Some(path) = &kept {
            match file::read(path, key) {
                Ok(Some(templates)) => return Ok(templates),
                Ok(None) => {}
                Err(error) => notes.push(format!("views of {} rendered again: {error}", object.name)),
            }
        }
        let templates = make_templates(mesh, &object.name, diameter, &self.extractor, &self.templates)?;
        if let Some(path) = &kept
            && let Err(error) = file::write(path, key, &templates)
        {
            notes.push(format!("views of {} not kept: {error}", object.name));
        }
        Ok(templates)
    }
}

/// An object as this method knows it.
pub struct ViewsObject {
    name: String,
    mesh: Arc<Mesh>,
    view: Mesh,
    outline: Mesh,
    templates: Vec<Template>,
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
        Needs { depth: Need::Unused, rgb: Need::Required, region: Need::Required, object: Need::Required }
    }

    /// Of the poses on the 100 LM-O development frames (ground-truth boxes) 69 % lie above 0.4, 90 % of those within a fifth of the
    /// diameter among them; 94 % of them are within half of it, of all 74 % (`benches/views_confidence.py`).
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
        let templates = self.templates_of(object, &view, diameter, key, &mut notes).map_err(wrap)?;
        if mesh.colors().is_none() && mesh.texture().is_none() {
            notes.push(format!(
                "{}: its mesh has no colours, its views are grey: expect fewer and less precise poses",
                object.name
            ));
        }
        let outline = outline_mesh(&mesh);
        Ok(Box::new(ViewsObject { name: object.name.clone(), mesh, view, outline, templates, notes }))
    }

    fn estimate(
        &self,
        object: &dyn PreparedObject,
        query: &Query<'_>,
    ) -> Result<Vec<PoseEstimate>, EstimatorError> {
        let object: &ViewsObject = downcast(object, METHOD)?;
        self.options.check().map_err(EstimatorError::method)?;
        let image = query.rgb(METHOD)?;
        let region = query.region.ok_or(EstimatorError::Input {
            what: "region that says where the object is",
            method: METHOD,
            advice: "give --detector FILE.safetensors, --boxes, --box X,Y,W,H or --mask FILE",
        })?;
        let views = Views {
            extractor: &self.extractor,
            mesh: &object.view,
            outline: &object.outline,
            templates: &object.templates,
            refiner: self.refiner.as_deref(),
            options: &self.options,
        };
        let found = views.find(image, query.camera, &region.bbox).map_err(EstimatorError::method)?;
        let Some(found) = found else {
            let source = format!(
                "box {:.0},{:.0},{:.0},{:.0}: expected pixels of the image, found none",
                region.bbox.x, region.bbox.y, region.bbox.width, region.bbox.height
            );
            return Err(EstimatorError::Region { source: source.into() });
        };
        let Some(best) = found.hypotheses.first() else { return Ok(vec![]) };
        let confidence = best.similarity.clamp(0.0, 1.0) * region.score;
        if confidence < query.min_confidence {
            return Ok(vec![]);
        }
        let mut estimate = PoseEstimate::new(best.camera_from_object, confidence);
        estimate.details = Map::from_iter([
            ("similarity".to_owned(), json!(best.similarity)),
            ("inliers".to_owned(), json!(best.inliers)),
        ]);
        Ok(vec![estimate])
    }
}
