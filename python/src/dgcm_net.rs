//! `DgcmNet`: the network that compares the current view of an object with earlier ones (`sixfold-dgcm`).

use std::path::PathBuf;
use std::sync::Arc;

use numpy::PyArray1;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyType;
use sixfold::dgcm::model::{DgcmModel, ModelError};
use sixfold::experience::Crop;
use sixfold::geometry::{Camera, DepthImage, Mask};
use sixfold::grasp::{GraspView, ViewOptions};
use sixfold::nn::weights::WeightsError;

use crate::arrays::{self, about, bad};
use crate::bop::json_to_python;
use crate::camera::PyCamera;
use crate::grasp::view_error;
use crate::guard::{interruptible, os_error};

fn model_error(error: ModelError) -> PyErr {
    match &error {
        ModelError::Weights(WeightsError::Read { source, .. }) => os_error(source.kind(), error.to_string()),
        _ => PyValueError::new_err(error.to_string()),
    }
}

/// The network for grasping from experience (dissertation, chapter 6). It computes a feature of 256 numbers from the view of an
/// object, similar for objects of similar shape, and finds corresponding points of two objects. `load` reads one.
///
/// >>> network = DgcmNet.load("weights/dgcm.safetensors")  # doctest: +SKIP
/// >>> network.feature(depth, camera, mask).shape  # doctest: +SKIP
/// (256,)
#[pyclass(name = "DgcmNet", module = "sixfold", frozen)]
pub(crate) struct DgcmNet(Arc<DgcmModel>);

#[pymethods]
impl DgcmNet {
    /// Reads a weight file (.safetensors) written by `train_dgcm` or `sixfold train dgcm`.
    ///
    /// Raises OSError when the file cannot be read; ValueError when it is not such a model.
    #[classmethod]
    fn load(_class: &Bound<'_, PyType>, py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        read_network(py, path).map(DgcmNet)
    }

    /// The model's card, a dict: its training data, training and scores.
    #[getter]
    fn card<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        json_to_python(py, self.0.card())
    }

    /// A name that identifies the network of a feature. Features of different networks cannot be compared.
    #[getter]
    fn fingerprint(&self) -> String {
        self.0.fingerprint()
    }

    /// Computes the feature of an object: (256,) float32.
    ///
    /// depth: (H, W), metres, without lens distortion. mask: (H, W) bool, the object's pixels. Ctrl-C interrupts it.
    ///
    /// Raises ValueError for a mask without depth or of several objects, and for images of another size than the camera's.
    #[pyo3(signature = (depth, camera, mask, *, seed=0))]
    fn feature<'py>(
        &self,
        py: Python<'py>,
        depth: &Bound<'py, PyAny>,
        camera: PyCamera,
        mask: &Bound<'py, PyAny>,
        seed: i64,
    ) -> PyResult<Bound<'py, PyArray1<f32>>> {
        let input = DepthInput::new(depth, camera, mask, seed)?;
        let model = self.0.clone();
        let feature = interruptible(py, move |_| input.crop(&model).map(|crop| model.encode(&crop).feature))?;
        Ok(PyArray1::from_vec(py, feature?))
    }

    fn __repr__(&self) -> String {
        format!("<DgcmNet: {}>", self.0.fingerprint())
    }
}

fn read_network(py: Python<'_>, path: PathBuf) -> PyResult<Arc<DgcmModel>> {
    Ok(Arc::new(interruptible(py, move |_| DgcmModel::load(&path))?.map_err(model_error)?))
}

/// The network of a DgcmNet or of a weight file.
pub(crate) fn network_of(py: Python<'_>, weights: &Bound<'_, PyAny>) -> PyResult<Arc<DgcmModel>> {
    if let Ok(network) = weights.cast::<DgcmNet>() {
        return Ok(network.get().0.clone());
    }
    let path: PathBuf = weights
        .extract()
        .map_err(|_| bad("weights", "a DgcmNet or the path of its file", weights.get_type().to_string()))?;
    read_network(py, path)
}

/// An object in a depth image, as given by the caller.
pub(crate) struct DepthInput {
    depth: DepthImage,
    camera: Camera,
    mask: Mask,
    options: ViewOptions,
}

impl DepthInput {
    pub(crate) fn new(
        depth: &Bound<'_, PyAny>,
        camera: PyCamera,
        mask: &Bound<'_, PyAny>,
        seed: i64,
    ) -> PyResult<DepthInput> {
        let depth = arrays::depth("depth", depth)?;
        let camera = camera.of_image("depth", depth.size())?;
        let options = ViewOptions { seed: arrays::seed(seed)?, ..ViewOptions::default() };
        Ok(DepthInput { camera, mask: arrays::mask("mask", mask)?, depth, options })
    }

    pub(crate) fn crop(&self, model: &DgcmModel) -> PyResult<Crop> {
        let view =
            GraspView::new(&self.depth, &self.camera, &self.mask, &self.options).map_err(view_error)?;
        Crop::of_view(&view, model.crop_options()).map_err(about("mask"))
    }
}
