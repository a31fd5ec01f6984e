//! `Experience`: what a store kept of one grasp.

use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;
use sixfold::experience::Stored;
use sixfold::geometry::Image;

use crate::arrays::{self, about};
use crate::camera::PyCamera;

/// A grasp that worked, as an ExperienceStore kept it: the object cut out of its depth image, and what the gripper did.
///
/// >>> experience = store.get(1)  # doctest: +SKIP
/// >>> experience.picture().shape  # doctest: +SKIP
/// (384, 1152, 3)
#[pyclass(name = "Experience", module = "sixfold", frozen)]
pub(crate) struct PyExperience(Stored);

impl PyExperience {
    pub(crate) fn new(stored: Stored) -> Self {
        PyExperience(stored)
    }

    /// Pixels of the crop as an image.
    fn image<T: Clone>(&self, pixels: &[T]) -> PyResult<Image<T>> {
        let side = self.0.experience.crop.side;
        Image::from_vec(side, side, pixels.to_vec()).map_err(about("experience"))
    }
}

#[pymethods]
impl PyExperience {
    /// Its number in the store.
    #[getter]
    fn id(&self) -> i64 {
        self.0.id
    }

    /// Seconds since 1970.
    #[getter]
    fn time(&self) -> i64 {
        self.0.experience.time
    }

    /// What was grasped.
    #[getter]
    fn object(&self) -> &str {
        &self.0.experience.object
    }

    /// The part that was grasped, or None.
    #[getter]
    fn part(&self) -> Option<&str> {
        self.0.experience.part.as_deref()
    }

    /// The gripper's name.
    #[getter]
    fn gripper(&self) -> &str {
        &self.0.experience.gripper.name
    }

    /// Where it comes from, in words.
    #[getter]
    fn provenance(&self) -> &str {
        &self.0.experience.provenance
    }

    /// The network that made the feature.
    #[getter]
    fn network(&self) -> &str {
        &self.0.experience.network
    }

    /// Distance of the pads before closing, metres.
    #[getter]
    fn opening(&self) -> f64 {
        self.0.experience.opening
    }

    /// Distance of the contacts, metres.
    #[getter]
    fn width(&self) -> f64 {
        self.0.experience.width
    }

    /// The gripper when it closed, (4, 4) float64, metres.
    #[getter]
    fn camera_from_gripper<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::from_pose(py, &self.0.experience.camera_from_gripper)
    }

    /// The camera of the crop.
    #[getter]
    fn camera(&self) -> PyCamera {
        PyCamera(self.0.experience.crop.camera)
    }

    /// What the object stood on: unit normal and offset along it in metres, camera's frame; None where that is not known.
    #[getter]
    fn table(&self) -> Option<(f64, f64, f64, f64)> {
        self.0.experience.crop.table.map(|t| (t.normal.x, t.normal.y, t.normal.z, t.offset))
    }

    /// Which pixels show the object, (side, side) bool.
    #[getter]
    fn mask<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<bool>>> {
        arrays::from_image(py, self.image(&self.0.experience.crop.mask)?)
    }

    /// Pixels of the object near the gripper, (side, side) bool.
    #[getter]
    fn region<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<bool>>> {
        arrays::from_image(py, self.image(&self.0.experience.region)?)
    }

    /// Points in the camera's frame, (side, side, 3) float32, metres; zeros beside the object.
    #[getter]
    fn points<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        arrays::from_image_of(py, self.image(&self.0.experience.crop.points)?)
    }

    /// Unit normals in the camera's frame, (side, side, 3) float32; zeros beside the object.
    #[getter]
    fn normals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        arrays::from_image_of(py, self.image(&self.0.experience.crop.normals)?)
    }

    /// View-dependent normalised object coordinates (equation 6.1), (side, side, 3) float32, -1 to 1.
    #[getter]
    fn coordinates<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        arrays::from_image_of(py, self.image(&self.0.experience.crop.vd_noc)?)
    }

    /// What the network makes of it, (256,) float32.
    #[getter]
    fn feature<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        let copies = &self.0.experience.copies;
        PyArray1::from_vec(py, copies.first().map(|c| c.feature.clone()).unwrap_or_default())
    }

    /// Three images side by side, (4 side, 12 side, 3) uint8: normals with the gripper, coordinates, the pixels near the
    /// gripper.
    fn picture<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let picture = crate::guard::free(py, || self.0.experience.picture())?;
        arrays::from_image_of(py, picture.map_err(about("experience"))?)
    }

    fn __repr__(&self) -> String {
        format!("<Experience {}: {} with {}>", self.0.id, self.object(), self.gripper())
    }
}
