//! `Experience`: one successful grasp of a store.

use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;
use sixfold::experience::Stored;
use sixfold::geometry::Image;

use crate::arrays::{self, about};
use crate::camera::PyCamera;

/// A successful grasp in an ExperienceStore: the object, cropped from its depth image, and the pose of the gripper.
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

    /// Time of the experience, seconds since 1970.
    #[getter]
    fn time(&self) -> i64 {
        self.0.experience.time
    }

    /// Name of the grasped object.
    #[getter]
    fn object(&self) -> &str {
        &self.0.experience.object
    }

    /// Name of the grasped part, or None.
    #[getter]
    fn part(&self) -> Option<&str> {
        self.0.experience.part.as_deref()
    }

    /// The gripper's name.
    #[getter]
    fn gripper(&self) -> &str {
        &self.0.experience.gripper.name
    }

    /// Origin of the experience, as text.
    #[getter]
    fn provenance(&self) -> &str {
        &self.0.experience.provenance
    }

    /// Fingerprint of the network that computed the feature.
    #[getter]
    fn network(&self) -> &str {
        &self.0.experience.network
    }

    /// Distance between the pads before closing, metres.
    #[getter]
    fn opening(&self) -> f64 {
        self.0.experience.opening
    }

    /// Distance between the contacts, metres.
    #[getter]
    fn width(&self) -> f64 {
        self.0.experience.width
    }

    /// Pose of the gripper when it closed, (4, 4) float64, metres.
    #[getter]
    fn camera_from_gripper<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::from_pose(py, &self.0.experience.camera_from_gripper)
    }

    /// The camera of the crop.
    #[getter]
    fn camera(&self) -> PyCamera {
        PyCamera(self.0.experience.crop.camera)
    }

    /// Plane on which the object stood: unit normal (three numbers) and signed distance from the origin along the normal in metres,
    /// in the camera's frame. None if unknown.
    #[getter]
    fn table(&self) -> Option<(f64, f64, f64, f64)> {
        self.0.experience.crop.table.map(|t| (t.normal.x, t.normal.y, t.normal.z, t.offset))
    }

    /// Pixels that show the object, (side, side) bool.
    #[getter]
    fn mask<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<bool>>> {
        arrays::from_image(py, self.image(&self.0.experience.crop.mask)?)
    }

    /// Pixels of the object near the gripper, (side, side) bool.
    #[getter]
    fn region<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<bool>>> {
        arrays::from_image(py, self.image(&self.0.experience.region)?)
    }

    /// Points in the camera's frame, (side, side, 3) float32, metres; zero outside the object.
    #[getter]
    fn points<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        arrays::from_image_of(py, self.image(&self.0.experience.crop.points)?)
    }

    /// Unit normals in the camera's frame, (side, side, 3) float32; zero outside the object.
    #[getter]
    fn normals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        arrays::from_image_of(py, self.image(&self.0.experience.crop.normals)?)
    }

    /// View-dependent normalised object coordinates (VD-NOC; dissertation, equation 6.1), (side, side, 3) float32, -1 to 1; zero
    /// outside the object.
    #[getter]
    fn coordinates<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        arrays::from_image_of(py, self.image(&self.0.experience.crop.vd_noc)?)
    }

    /// Feature of the crop, computed by the network, (256,) float32.
    #[getter]
    fn feature<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        let copies = &self.0.experience.copies;
        PyArray1::from_vec(py, copies.first().map(|c| c.feature.clone()).unwrap_or_default())
    }

    /// Three images side by side, (4 side, 12 side, 3) uint8: the normals with the gripper, the coordinates, and the normals with
    /// the pixels near the gripper marked.
    fn picture<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let picture = crate::guard::free(py, || self.0.experience.picture())?;
        arrays::from_image_of(py, picture.map_err(about("experience"))?)
    }

    fn __repr__(&self) -> String {
        format!("<Experience {}: {} with {}>", self.0.id, self.object(), self.gripper())
    }
}
