//! `Photograph`: the input of Neural Object Learning (`sixfold-nol`).

use std::sync::Arc;

use numpy::{PyArray2, PyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use sixfold::data::PosedImage;
use sixfold::nol::NolError;

use crate::arrays::{self, about, bad};
use crate::camera::PyCamera;

pub(crate) fn nol_error(error: NolError) -> PyErr {
    match &error {
        NolError::Option { field, expected, found } => {
            let argument = match *field {
                "sources per view" => "per_view",
                field if field.starts_with("source") => "photographs",
                field => field,
            };
            bad(argument, expected, found)
        }
        _ => PyValueError::new_err(format!("photographs: {error}")),
    }
}

/// A photograph of an object with an approximate pose, for refine_poses and synthesize. It is immutable.
///
/// rgb: the image, (H, W, 3) uint8, without lens distortion.
/// camera_from_object: the pose, (4, 4), with an error of at most a centimetre and some degrees.
/// mask: where the object is visible, (H, W) bool. None: all of its outline.
/// name: the name used in messages.
///
/// Raises ValueError for a camera with distortion, an image or mask of another size than the camera's, and a pose that puts the
/// object outside the image.
///
/// >>> import numpy as np
/// >>> pose = np.eye(4)
/// >>> pose[2, 3] = 0.7
/// >>> Photograph(np.zeros((480, 640, 3), np.uint8), Camera(500, 500, 320, 240, 640, 480), pose, name="first")
/// <Photograph: first>
#[pyclass(name = "Photograph", module = "sixfold", frozen)]
pub(crate) struct PyPhotograph(pub(crate) PosedImage);

#[pymethods]
impl PyPhotograph {
    #[new]
    #[pyo3(signature = (rgb, camera, camera_from_object, mask=None, *, name="unnamed"))]
    fn new(
        rgb: &Bound<'_, PyAny>,
        camera: PyCamera,
        camera_from_object: &Bound<'_, PyAny>,
        mask: Option<&Bound<'_, PyAny>>,
        name: &str,
    ) -> PyResult<Self> {
        let image = arrays::rgb("rgb", rgb)?;
        let camera = camera.of_image("rgb", image.size())?;
        let pose = arrays::pose("camera_from_object", camera_from_object)?;
        let mask = mask.map(|mask| arrays::mask("mask", mask)).transpose()?;
        // A user's photograph shows one object; its id in a dataset does not matter.
        let photograph =
            PosedImage::new(name, 1, Arc::new(image), camera, pose).map_err(about("camera_from_object"))?;
        Ok(PyPhotograph(match mask {
            Some(mask) => photograph.with_mask(&mask).map_err(about("mask"))?,
            None => photograph,
        }))
    }

    /// The name used in messages.
    #[getter]
    fn name(&self) -> &str {
        self.0.name()
    }

    /// The camera.
    #[getter]
    fn camera(&self) -> PyCamera {
        PyCamera(*self.0.camera())
    }

    /// The pose, (4, 4) float64, metres.
    #[getter]
    fn camera_from_object<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::from_pose(py, self.0.camera_from_object())
    }

    /// The image, (H, W, 3) uint8.
    #[getter]
    fn rgb<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<u8>>> {
        arrays::from_image_of(py, self.0.image().as_ref().clone())
    }

    /// Where the object is visible, (H, W) bool, or None.
    #[getter]
    fn mask<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<bool>>>> {
        self.0.mask().map(|mask| arrays::from_image(py, mask.to_mask())).transpose()
    }

    /// The same photograph with another pose (4, 4).
    fn with_pose(&self, camera_from_object: &Bound<'_, PyAny>) -> PyResult<Self> {
        let pose = arrays::pose("camera_from_object", camera_from_object)?;
        self.0.with_pose(pose).map(PyPhotograph).map_err(about("camera_from_object"))
    }

    fn __repr__(&self) -> String {
        format!("<Photograph: {}>", self.0.name())
    }
}
