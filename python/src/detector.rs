//! `Detector`: finds boxes and masks of known objects in an image.

use std::path::PathBuf;
use std::sync::Arc;

use numpy::{PyArray1, PyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyType;
use sixfold::detect::detect::DetectOptions;
use sixfold::detect::model::{DetectorModel, ModelError};
use sixfold::nn::weights::WeightsError;

use crate::arrays::{self, about, bad, whole};
use crate::guard::{interruptible, os_error};

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
    /// Confidence, 0 to 1: the expected overlap of this box with the object's true box.
    #[pyo3(get)]
    score: f32,
    /// Box of the visible part, (4,) float64: x, y, width, height in pixels.
    #[pyo3(get)]
    bbox: Py<PyArray1<f64>>,
    /// Mask of the visible part, (H, W) bool; None without masks.
    #[pyo3(get)]
    mask: Option<Py<PyArray2<bool>>>,
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
            let b = d.bbox;
            out.push(DetectedObject {
                object_id,
                score: d.score,
                bbox: PyArray1::from_vec(py, vec![b.x, b.y, b.width, b.height]).unbind(),
                mask: d
                    .mask
                    .map(|mask| Ok::<_, PyErr>(arrays::from_image(py, mask)?.unbind()))
                    .transpose()?,
            });
        }
        Ok(out)
    }

    fn __repr__(&self) -> String {
        let ids: Vec<String> = self.object_ids().iter().map(u32::to_string).collect();
        format!("<Detector: objects {}>", ids.join(", "))
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
