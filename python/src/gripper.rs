//! `Gripper`: a parallel-jaw gripper from a file, or a built-in one by name (`sixfold-grasp`).

use std::path::PathBuf;

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use sixfold::grasp::{Gripper, GripperError, read_gripper};

use crate::arrays::{about, bad};
use crate::guard::os_error;
use crate::mesh::PyMesh;

/// A parallel-jaw gripper: sizes in metres, forces in newtons. The origin of its frame is midway between the finger tips; z is the
/// approach direction, x the closing direction. Created by `load` from a file or by `built_in` from a name.
///
/// >>> gripper = Gripper.built_in("jaws-85")
/// >>> gripper.max_opening
/// 0.085
#[pyclass(name = "Gripper", module = "sixfold", frozen)]
pub(crate) struct PyGripper(Gripper);

#[pymethods]
impl PyGripper {
    /// Reads a gripper file (JSON; an example is crates/sixfold-grasp/grippers/jaws-85.json).
    ///
    /// Raises OSError when the file cannot be read, and ValueError, naming the field, for sizes that are not possible.
    #[staticmethod]
    fn load(path: PathBuf) -> PyResult<Self> {
        read_gripper(&path).map(PyGripper).map_err(|error| match &error {
            GripperError::Io { source, .. } => os_error(source.kind(), error.to_string()),
            _ => PyValueError::new_err(error.to_string()),
        })
    }

    /// A built-in gripper: "jaws-140" or "jaws-85".
    ///
    /// Raises ValueError for another name.
    #[staticmethod]
    fn built_in(name: &str) -> PyResult<Self> {
        let gripper = Gripper::built_in(name);
        gripper.map(PyGripper).ok_or_else(|| bad("name", Gripper::BUILT_IN.join(" or "), format!("{name:?}")))
    }

    /// Name of the gripper.
    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }

    /// Largest distance between the finger pads, metres.
    #[getter]
    fn max_opening(&self) -> f64 {
        self.0.max_opening
    }

    /// Length of the fingers, from the palm to the tips, metres.
    #[getter]
    fn finger_length(&self) -> f64 {
        self.0.finger_length
    }

    /// Width of the pads, metres.
    #[getter]
    fn finger_width(&self) -> f64 {
        self.0.finger_width
    }

    /// Largest force of one finger, newtons.
    #[getter]
    fn force(&self) -> f64 {
        self.0.force
    }

    /// Coulomb friction coefficient of the pads.
    #[getter]
    fn friction(&self) -> f64 {
        self.0.friction
    }

    /// The gripper as a Mesh in its own frame, for images, with the pads `opening` metres apart.
    ///
    /// Raises ValueError for an opening outside 0 to max_opening.
    fn mesh(&self, opening: f64) -> PyResult<PyMesh> {
        if !(0.0..=self.0.max_opening).contains(&opening) {
            let expected = format!("0 to {} m", self.0.max_opening);
            return Err(bad("opening", expected, opening.to_string()));
        }
        self.0.mesh(opening).map(PyMesh::plain).map_err(about("opening"))
    }

    fn __repr__(&self) -> String {
        format!("<Gripper: {}, opens {} m>", self.0.name, self.0.max_opening)
    }
}

/// A Gripper, a built-in one by name, or the default one.
pub(crate) fn gripper_of(argument: Option<&Bound<'_, PyAny>>) -> PyResult<Gripper> {
    let name = match argument {
        None => Gripper::BUILT_IN[0].to_owned(),
        Some(argument) => {
            if let Ok(gripper) = argument.cast::<PyGripper>() {
                return Ok(gripper.get().0.clone());
            }
            argument
                .extract::<String>()
                .map_err(|_| bad("gripper", "a Gripper or a name", argument.get_type().to_string()))?
        }
    };
    Gripper::built_in(&name).ok_or_else(|| {
        bad("gripper", format!("a Gripper, {}", Gripper::BUILT_IN.join(" or ")), format!("{name:?}"))
    })
}
