//! `Detector` and `ViewsDetector`: boxes and masks of known objects in an image, by a trained network or by views of their meshes.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use numpy::{PyArray1, PyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use sixfold::detect::detect::DetectOptions;
use sixfold::detect::detector::TrainedDetector;
use sixfold::detect::model::{DetectorModel, ModelError};
use sixfold::estimator::{EstimatorError, Object, ObjectDetector, PoseEstimator, Region};
use sixfold::geometry::{Mask, Rect};
use sixfold::nn::weights::WeightsError;
use sixfold::views::detector::{ViewsDetectOptions, ViewsDetector};
use sixfold::views::estimator::ViewsEstimator;

use crate::arrays::{self, about, bad, whole};
use crate::estimator::{estimator_error, shape_of};
use crate::guard::{interruptible, os_error};
use crate::training::file_or_value;

fn model_error(error: ModelError) -> PyErr {
    match &error {
        ModelError::Weights(WeightsError::Read { source, .. }) => os_error(source.kind(), error.to_string()),
        _ => PyValueError::new_err(error.to_string()),
    }
}

/// An object that a detector found.
#[pyclass(name = "DetectedObject", module = "sixfold", frozen)]
pub(crate) struct DetectedObject {
    /// The object's id.
    #[pyo3(get)]
    object_id: u32,
    /// Confidence, 0 to 1. Detector: the expected overlap of this box with the object's true box; ViewsDetector: the probability that
    /// this overlap (intersection over union) is at least a half.
    #[pyo3(get)]
    score: f64,
    /// Box of the visible part, (4,) float64: x, y, width, height in pixels.
    #[pyo3(get)]
    bbox: Py<PyArray1<f64>>,
    /// Mask of the visible part, (H, W) bool; None without masks.
    #[pyo3(get)]
    mask: Option<Py<PyArray2<bool>>>,
}

impl DetectedObject {
    fn new(py: Python<'_>, object_id: u32, score: f64, b: Rect, mask: Option<Mask>) -> PyResult<Self> {
        let mask = mask.map(|mask| Ok::<_, PyErr>(arrays::from_image(py, mask)?.unbind())).transpose()?;
        let bbox = PyArray1::from_vec(py, vec![b.x, b.y, b.width, b.height]).unbind();
        Ok(DetectedObject { object_id, score, bbox, mask })
    }
}

#[pymethods]
impl DetectedObject {
    fn __repr__(&self) -> String {
        format!("<DetectedObject: object {}, score {:.3}>", self.object_id, self.score)
    }
}

/// A trained detector that finds known objects in colour images. `load` reads one; `Pix2Pose` takes its boxes.
///
/// >>> detector = Detector.load("weights/detector-lmo.safetensors")  # doctest: +SKIP
/// >>> found = detector(rgb)  # doctest: +SKIP
/// >>> poses = pix2pose(rgb, [d.bbox for d in found], [d.object_id for d in found])  # doctest: +SKIP
#[pyclass(name = "Detector", module = "sixfold", frozen)]
pub(crate) struct Detector {
    model: Arc<DetectorModel>,
}

#[pymethods]
impl Detector {
    /// Reads a weight file (.safetensors) written by `train_detector` or `sixfold train detector`.
    ///
    /// Raises OSError when the file cannot be read; ValueError when it is not such a model.
    #[classmethod]
    fn load(_class: &Bound<'_, PyType>, py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let model = interruptible(py, move |_| DetectorModel::load(&path))?.map_err(model_error)?;
        Ok(Detector { model: Arc::new(model) })
    }

    /// Ids of the objects that the detector was trained on.
    #[getter]
    fn object_ids(&self) -> Vec<u32> {
        self.model.classes().iter().map(|class| class.id).collect()
    }

    /// The default threshold: detections with a lower score are left out.
    #[getter]
    fn threshold(&self) -> f32 {
        self.model.usage().threshold
    }

    /// The model's card, a dict: its training data, training and scores.
    #[getter]
    fn card<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        crate::bop::json_to_python(py, self.model.card())
    }

    /// Searches for the detector's objects in an image: a list of DetectedObject, best first.
    ///
    /// rgb: (H, W, 3) uint8, of any size; large images are downscaled for the network. object_ids: return only these objects.
    /// threshold: minimum score, 0 to 1, instead of the model's. overlap: if two boxes of an object have a larger intersection over
    /// union, 0 to 1, the one with the lower score is left out. per_object, max_detections: maximum number of detections of each
    /// object and of all objects (before object_ids is applied). scales: number of
    /// sizes at which the image is processed, each smaller by the square root of two. masks=False: compute no masks. Ctrl-C interrupts it.
    ///
    /// Raises ValueError for an unknown object, an option out of range or an image without pixels.
    #[pyo3(signature = (rgb, *, object_ids=None, threshold=None, overlap=0.5, per_object=100, max_detections=100, scales=1, masks=true))]
    #[allow(clippy::too_many_arguments)]
    fn __call__(
        &self,
        py: Python<'_>,
        rgb: &Bound<'_, PyAny>,
        object_ids: Option<&Bound<'_, PyAny>>,
        threshold: Option<f64>,
        overlap: f64,
        per_object: i64,
        max_detections: i64,
        scales: i64,
        masks: bool,
    ) -> PyResult<Vec<DetectedObject>> {
        let image = arrays::rgb("rgb", rgb)?;
        let wanted = object_ids.map(|ids| arrays::ids("object_ids", ids)).transpose()?;
        for id in wanted.iter().flatten() {
            self.model.check_object(*id).map_err(about("object_ids"))?;
        }
        let options = DetectOptions {
            threshold: fraction("threshold", threshold.unwrap_or(f64::from(self.threshold())))?,
            overlap: fraction("overlap", overlap)?,
            per_class: whole("per_object", per_object, 1)?,
            max_detections: whole("max_detections", max_detections, 1)?,
            scales: whole("scales", scales, 1)?,
            masks,
            ..DetectOptions::default()
        };
        let model = self.model.clone();
        let found = interruptible(py, move |_| model.detect(&image, &options))?.map_err(about("rgb"))?;
        let mut out = Vec::with_capacity(found.len());
        for d in found {
            let object_id = self.model.id_of(d.class);
            if wanted.as_ref().is_some_and(|ids| !ids.contains(&object_id)) {
                continue;
            }
            out.push(DetectedObject::new(py, object_id, f64::from(d.score), d.bbox, d.mask)?);
        }
        Ok(out)
    }

    fn __repr__(&self) -> String {
        let ids: Vec<String> = self.object_ids().iter().map(u32::to_string).collect();
        format!("<Detector: objects {}>", ids.join(", "))
    }
}

/// Finds objects in colour images by rendered views of their meshes, without training for them.
///
/// objects: a dict from ids to Meshes. A detector of any object proposes boxes; in those most similar to an object's views its pose is
/// estimated, which gives box and mask, without what detections with higher scores hide. Objects compete for the same part of an image, so
/// give all that may be there. poses=False: keep the proposed boxes and masks and only name them; several times as fast, but less exact.
/// masks=False: compute no masks. threshold: minimum score, 0 to 1. overlap: if two boxes of an object have a larger intersection over
/// union, 0 to 1, the one with the lower score is left out. per_object, max_detections: maximum number of detections of each object and of
/// all. Rendering an object takes up to 20 s. Ctrl-C interrupts it.
///
/// Raises ValueError for no objects, a mesh without faces or an option out of range.
///
/// >>> detector = ViewsDetector({1: mug, 2: can})  # doctest: +SKIP
/// >>> detector(rgb)  # doctest: +SKIP
/// [<DetectedObject: object 2, score 0.936>]
#[pyclass(name = "ViewsDetector", module = "sixfold", frozen)]
pub(crate) struct PyViewsDetector {
    detector: Arc<ViewsDetector>,
    ids: Vec<u32>,
}

#[pymethods]
impl PyViewsDetector {
    #[new]
    #[pyo3(signature = (objects, *, poses=true, masks=true, threshold=0.5, overlap=0.5, per_object=100, max_detections=100))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        objects: &Bound<'_, PyDict>,
        poses: bool,
        masks: bool,
        threshold: f64,
        overlap: f64,
        per_object: i64,
        max_detections: i64,
    ) -> PyResult<Self> {
        let mut meshes = BTreeMap::new();
        for (id, mesh) in objects {
            let number = id.extract::<u32>();
            let number =
                number.map_err(|_| bad("objects", "whole numbers from 0 as keys", id.to_string()))?;
            meshes.insert(number, shape_of(py, &mesh)?);
        }
        if meshes.is_empty() {
            return Err(bad("objects", "at least one Mesh by its id", "none"));
        }
        let options = ViewsDetectOptions {
            threshold: f64::from(fraction("threshold", threshold)?),
            overlap: f64::from(fraction("overlap", overlap)?),
            per_object: whole("per_object", per_object, 1)?,
            max_detections: whole("max_detections", max_detections, 1)?,
            poses,
            masks,
        };
        let ids = meshes.keys().copied().collect();
        let estimator = interruptible(py, |_| ViewsEstimator::shipped())?;
        let estimator = estimator.map_err(|error| file_or_value(&error))?;
        let proposals = interruptible(py, |_| TrainedDetector::proposals())?;
        let proposals = proposals.map_err(|error| file_or_value(&error))?;
        let proposals = Arc::new(proposals.with_masks(masks && !poses));
        let detector = interruptible(py, move |stop| -> Result<_, EstimatorError> {
            let mut prepared = BTreeMap::new();
            for (id, (mesh, info)) in meshes {
                stop.check();
                let name = format!("object {id}");
                let object = Object { name, id: Some(id), mesh: Some(mesh), info: Some(info), folder: None };
                prepared.insert(id, estimator.prepare(&object)?);
            }
            let mut detector = ViewsDetector::new(estimator, proposals, prepared);
            detector.options = options;
            Ok(detector)
        })?;
        Ok(PyViewsDetector { detector: Arc::new(detector.map_err(estimator_error)?), ids })
    }

    /// Ids of the objects.
    #[getter]
    fn object_ids(&self) -> Vec<u32> {
        self.ids.clone()
    }

    /// Searches for the objects in an image: a list of DetectedObject, best first.
    ///
    /// rgb: (H, W, 3) uint8, of any size; no camera is needed. An object takes about a second. The same input gives the same result with any
    /// number of threads. Ctrl-C interrupts it.
    ///
    /// Raises ValueError for an image without pixels.
    fn __call__(&self, py: Python<'_>, rgb: &Bound<'_, PyAny>) -> PyResult<Vec<DetectedObject>> {
        let image = arrays::rgb("rgb", rgb)?;
        let detector = self.detector.clone();
        let found = interruptible(py, move |_| detector.detect(&image))?.map_err(about("rgb"))?;
        let object =
            |(id, region): (u32, Region)| DetectedObject::new(py, id, region.score, region.bbox, region.mask);
        found.into_iter().map(|d| object((d.object_id, d.region))).collect()
    }

    fn __repr__(&self) -> String {
        let ids: Vec<String> = self.ids.iter().map(u32::to_string).collect();
        format!("<ViewsDetector: objects {}>", ids.join(", "))
    }
}

/// A number from 0 to 1.
fn fraction(argument: &str, value: f64) -> PyResult<f32> {
    if (0.0..=1.0).contains(&value) {
        Ok(value as f32)
    } else {
        Err(bad(argument, "a number from 0 to 1", value.to_string()))
    }
}
