//! Pix2Pose as a [`PoseEstimator`].

use std::path::Path;
use std::sync::{Arc, OnceLock};

use serde_json::{Map, Value, json};
use sixfold_align::DepthOptions;
use sixfold_align::outline::outline_mesh;
use sixfold_estimator::{
    Diagnostic, EstimatorError, Need, Needs, Object, PoseEstimate, PoseEstimator, PoseRefiner,
    PreparedObject, Query, RefinedObject, downcast,
};
use sixfold_geometry::{Camera, Image, NormalOptions, Pose, Rect, RgbImage, Vec3};
use sixfold_mesh::Mesh;

use crate::aligned::{AlignOptions, AlignedObject, estimate_aligned};
use crate::depth::align;
use crate::estimate::{EstimateError, Found, View, estimate};
use crate::model::Pix2PoseModel;
use crate::object::ObjectEntry;

pub(crate) const METHOD: &str = "pix2pose";

/// Poses from colour in given regions by a trained network (dissertation, chapter 3).
#[derive(Clone)]
pub struct Pix2PoseEstimator {
    /// The trained network.
    pub model: Pix2PoseModel,
    /// Both passes, PnP and the alignment of the outline.
    pub options: AlignOptions,
    /// Align the rendered outline with the image if there is a mesh.
    pub refine: bool,
    /// Align poses with the depth image.
    pub icp: bool,
    /// Id of the model's object, for objects that do not give one; `None`: its only object.
    pub object_id: Option<u32>,
    /// Refines aligned poses, unless they are aligned with depth.
    pub refiner: Option<Arc<dyn PoseRefiner>>,
}

impl Pix2PoseEstimator {
    /// The model of a weight file with default options.
    ///
    /// # Errors
    /// As [`Pix2PoseModel::load`].
    pub fn load(weights: &Path) -> Result<Pix2PoseEstimator, crate::model::ModelError> {
        Ok(Pix2PoseEstimator::new(Pix2PoseModel::load(weights)?))
    }

    /// A model with default options.
    pub fn new(model: Pix2PoseModel) -> Pix2PoseEstimator {
        Pix2PoseEstimator {
            model,
            options: AlignOptions::default(),
            refine: true,
            icp: false,
            object_id: None,
            refiner: None,
        }
    }

    /// Refines aligned poses by `refiner` too ([`AlignOptions::refiner_weight`]).
    #[must_use]
    pub fn with_refiner(self, refiner: Arc<dyn PoseRefiner>) -> Pix2PoseEstimator {
        Pix2PoseEstimator { refiner: Some(refiner), ..self }
    }

    /// The model's entry of an object; without an id, of its only one.
    ///
    /// # Errors
    /// [`EstimatorError::Method`] for an object that is not in the model, or if it has several and no id is given.
    pub fn entry(&self, id: Option<u32>) -> Result<&ObjectEntry, EstimatorError> {
        match (id, self.model.objects()) {
            (Some(id), _) => Ok(self.model.object(id).map_err(EstimatorError::method)?.1),
            (None, [only]) => Ok(only),
            (None, several) => {
                let ids: Vec<String> = several.iter().map(|o| o.id.to_string()).collect();
                let text =
                    format!("--object-id N is missing: the model was trained on objects {}", ids.join(", "));
                Err(EstimatorError::method(text))
            }
        }
    }

    /// An object prepared for the model, with its mesh if it has one.
    ///
    /// # Errors
    /// [`EstimatorError`] if it is not in the model, or its mesh is that of another object.
    pub fn object(&self, object: &Object) -> Result<Pix2PoseObject, EstimatorError> {
        let entry = self.entry(object.id.or(self.object_id))?;
        let mut notes = vec![];
        match &object.mesh {
            Some(mesh) => entry
                .check_mesh(mesh)
                .map_err(|e| EstimatorError::Object { object: object.name.clone(), source: Box::new(e) })?,
            None => notes.push(
                "without --object NAME_OR_MESH the outline is not aligned, and the overlay shows a box"
                    .to_owned(),
            ),
        }
        let name = if object.name.is_empty() { format!("object {}", entry.id) } else { object.name.clone() };
        Ok(Pix2PoseObject {
            name,
            id: entry.id,
            diameter: entry.diameter,
            mesh: object.mesh.clone(),
            solid: if object.mesh.is_none() { box_of(entry) } else { None },
            outline: OnceLock::new(),
            refined: OnceLock::new(),
            notes,
        })
    }

    /// Prepares what the alignment of an object's poses needs, which otherwise happens at its first pose.
    pub fn prepare_alignment(&self, object: &Pix2PoseObject) {
        self.alignment(object);
    }

    /// What an object's poses are aligned by; `None` without a mesh, or if they are not aligned.
    fn alignment<'a>(&self, object: &'a Pix2PoseObject) -> Option<AlignedObject<'a>> {
        let mesh = object.mesh.as_ref().filter(|_| self.refine)?;
        let outline = object.outline.get_or_init(|| outline_mesh(mesh));
        // The depth image determines a pose better than the refiner does.
        let refiner = self.refiner.as_ref().filter(|_| !self.icp);
        let refined = refiner.map(|by| object.refined.get_or_init(|| by.object(mesh)));
        Some(AlignedObject { id: object.id, outline, refiner: refined.map(AsRef::as_ref) })
    }

    /// The best pose of an object in a box of a pinhole image, before ICP; `None` if it is not visible there. Without a mesh the
    /// outline is not aligned.
    ///
    /// # Errors
    /// [`EstimateError`].
    pub fn pose_in_box(
        &self,
        image: &RgbImage,
        camera: &Camera,
        object: &Pix2PoseObject,
        bbox: &Rect,
    ) -> Result<Option<Pix2PosePose>, EstimateError> {
        if let Some(known) = self.alignment(object) {
            let aligned = estimate_aligned(&self.model, image, camera, known, bbox, &self.options)?;
            return Ok(aligned.map(|a| Pix2PosePose {
                camera_from_object: a.camera_from_object,
                score: a.score,
                refined: a.improved,
                agreement: a.agreement,
                found: a.found,
            }));
        }
        let found = estimate(&self.model, image, camera, object.id, bbox, &self.options.estimate)?;
        Ok(found.and_then(|found| {
            let best = found.hypotheses.first()?;
            let (score, camera_from_object) = (best.score, best.camera_from_object);
            Some(Pix2PosePose { camera_from_object, score, refined: false, agreement: None, found })
        }))
    }
}

/// A pose before ICP.
#[derive(Debug, Clone)]
pub struct Pix2PosePose {
    /// The pose.
    pub camera_from_object: Pose,
    /// Ratio of inlier correspondences to the object's pixels, 0 to 1.
    pub score: f64,
    /// Whether the outline was aligned with the image.
    pub refined: bool,
    /// Agreement of the image with the refined pose, 0 to 1, if a refiner found one.
    pub agreement: Option<f64>,
    /// The result of both passes.
    pub found: Found,
}

/// An object prepared for a trained network.
pub struct Pix2PoseObject {
    name: String,
    id: u32,
    diameter: f64,
    mesh: Option<Arc<Mesh>>,
    /// The bounding box of the model's coordinates, for overlays without a mesh.
    solid: Option<Mesh>,
    outline: OnceLock<Mesh>,
    refined: OnceLock<Arc<dyn RefinedObject>>,
    notes: Vec<String>,
}

impl PreparedObject for Pix2PoseObject {
    fn name(&self) -> &str {
        &self.name
    }

    fn mesh(&self) -> Option<&Mesh> {
        self.mesh.as_deref().or(self.solid.as_ref())
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }
}

impl PoseEstimator for Pix2PoseEstimator {
    fn name(&self) -> &'static str {
        METHOD
    }

    fn needs(&self) -> Needs {
        let depth = if self.icp { Need::Required } else { Need::Unused };
        let object = if self.icp { Need::Required } else { Need::Optional };
        Needs { depth, rgb: Need::Required, region: Need::Required, object }
    }

    fn depth_options(&self) -> DepthOptions {
        depth_for_icp()
    }

    fn prepare(&self, object: &Object) -> Result<Box<dyn PreparedObject>, EstimatorError> {
        Ok(Box::new(self.object(object)?))
    }

    fn estimate(
        &self,
        object: &dyn PreparedObject,
        query: &Query<'_>,
    ) -> Result<Vec<PoseEstimate>, EstimatorError> {
        let object: &Pix2PoseObject = downcast(object, METHOD)?;
        self.options.check().map_err(EstimatorError::method)?;
        let image = query.rgb(METHOD)?;
        let region = query.region.ok_or(EstimatorError::Input {
            what: "region that contains the object",
            method: METHOD,
            advice: "give --detector FILE.safetensors, --boxes, --box X,Y,W,H or --mask FILE",
        })?;
        let posed = match self.pose_in_box(image, query.camera, object, &region.bbox) {
            Ok(Some(posed)) => posed,
            Ok(None) => return Ok(vec![]),
            // Only the box is invalid.
            Err(error @ (EstimateError::Box(_) | EstimateError::Outside { .. })) => {
                return Err(EstimatorError::Region { source: Box::new(error) });
            }
            Err(error) => return Err(EstimatorError::method(error)),
        };
        let confidence = posed.score * region.score;
        if confidence < query.min_confidence {
            return Ok(vec![]);
        }
        let mut estimate = PoseEstimate::new(posed.camera_from_object, confidence);
        let mut icp = Value::Null;
        if let (true, Some(mesh)) = (self.icp, &object.mesh) {
            let depth = query.depth.ok_or(EstimatorError::Input {
                what: "depth image",
                method: METHOD,
                advice: "give one, or leave out --icp",
            })?;
            let seen = region.pixels_for_icp();
            match align(depth, mesh, object.diameter, &posed.camera_from_object, &posed.found, seen.as_ref())
            {
                Ok(aligned) => {
                    estimate.camera_from_object = aligned.camera_from_object;
                    icp = json!({ "inliers": aligned.inliers, "rms_mm": 1000.0 * aligned.rms });
                }
                Err(_) => estimate.notes.push(format!(
                    "too little depth is measured on {}: its pose is that from colour",
                    object.name
                )),
            }
        }
        estimate.details = details(object.id, &posed, icp);
        if query.diagnostics {
            let image = view_image(&posed.found.view);
            estimate.diagnostics.push(Diagnostic { name: "coordinates", image });
        }
        Ok(vec![estimate])
    }
}

/// How depth images are prepared for ICP.
pub(crate) fn depth_for_icp() -> DepthOptions {
    DepthOptions { normals: NormalOptions::default(), remove_plane: false, ..DepthOptions::default() }
}

/// Details of an estimate: whether the outline was aligned, ICP, the square of the image in the last pass (x, y, side), and all
/// hypotheses from PnP, best first.
fn details(id: u32, posed: &Pix2PosePose, icp: Value) -> Map<String, Value> {
    let window = &posed.found.view.window;
    let hypothesis = |h: &crate::estimate::ThresholdHypothesis| {
        json!({
            "camera_from_object": h.camera_from_object.rows(),
            "confidence": h.score,
            "inliers": h.inliers,
            // Rounded to a decimal: 0.15, not the single-precision number closest to it.
            "threshold": (f64::from(h.threshold) * 1e6).round() / 1e6,
        })
    };
    let hypotheses: Vec<Value> = posed.found.hypotheses.iter().map(hypothesis).collect();
    Map::from_iter([
        ("object_id".to_owned(), id.into()),
        ("refined".to_owned(), posed.refined.into()),
        ("agreement".to_owned(), json!(posed.agreement)),
        ("icp".to_owned(), icp),
        ("window".to_owned(), json!([window.x, window.y, window.width])),
        ("hypotheses".to_owned(), hypotheses.into()),
    ])
}

/// The bounding box of the model's coordinates.
fn box_of(entry: &ObjectEntry) -> Option<Mesh> {
    let scale = entry.scale();
    let corner =
        |i: usize| scale.restore(&Vec3::from_fn(|axis, _| if i >> axis & 1 == 0 { -1.0 } else { 1.0 }));
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces = sides.iter().flat_map(|s| [[s[0], s[1], s[2]], [s[0], s[2], s[3]]]).collect();
    Mesh::new((0..8).map(corner).collect(), faces).ok()
}

/// Side of each of the four tiles of [`view_image`], pixels.
const TILE: usize = 256;
/// Gap between tiles, pixels.
const GAP: usize = 4;
/// Smallest probability of a visible pixel.
const VISIBLE: f32 = 0.5;

/// Input and output of the network side by side: input, coordinates (black where the object is not visible), expected error and
/// visibility (black 0, white 1).
pub(crate) fn view_image(view: &View) -> RgbImage {
    let (input, p) = (&view.input, &view.prediction);
    Image::from_fn(4 * TILE + 3 * GAP, TILE, |x, y| {
        let (tile, x) = (x / (TILE + GAP), x % (TILE + GAP));
        if x >= TILE {
            return [255; 3];
        }
        let at = |side: usize| (x * side / TILE, y * side / TILE);
        let (px, py) = at(p.side);
        let index = py * p.side + px;
        let grey = |v: f32| [(255.0 * v).clamp(0.0, 255.0) as u8; 3];
        match tile {
            0 => {
                let (ix, iy) = (x * input.width() / TILE, y * input.height() / TILE);
                input[(ix, iy)]
            }
            1 if p.visible[index] > VISIBLE => {
                p.coordinates[index].map(|v| (127.5 * (v + 1.0)).clamp(0.0, 255.0) as u8)
            }
            1 => [0; 3],
            2 => grey(p.error[index]),
            _ => grey(p.visible[index]),
        }
    })
}
