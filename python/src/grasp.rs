//! Grasps of a parallel-jaw gripper on what a depth image shows (`sixfold-grasp`).

use std::path::PathBuf;

use numpy::{PyArray2, PyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use sixfold_geometry::Pose;
use sixfold_grasp::{
    AntipodalOptions, ClusterOptions, DrawnGrasp, GraspCluster, GraspView, Gripper, GripperError, ViewError,
    ViewOptions, antipodal_grasps, cluster_grasps, draw_grasps as draw, find_objects as find, read_gripper,
};

use crate::arrays::{self, about, bad, whole};
use crate::camera::PyCamera;
use crate::guard::{interruptible, os_error};
use crate::mesh::PyMesh;

/// A parallel-jaw gripper: sizes in metres, forces in newtons. Its frame: the origin midway between the finger tips, z the
/// approach direction, x the closing direction. Made by `load` from a file or by `built_in` from a name.
///
/// >>> gripper = Gripper.built_in("jaws-85")
/// >>> gripper.max_opening
/// 0.085
#[pyclass(name = "Gripper", module = "sixfold", frozen)]
pub(crate) struct PyGripper(Gripper);

#[pymethods]
impl PyGripper {
    /// Reads a gripper file (JSON, as crates/sixfold-grasp/grippers/jaws-85.json is one).
    ///
    /// Raises OSError when the file cannot be read, ValueError with the field for sizes that no gripper has.
    #[staticmethod]
    fn load(path: PathBuf) -> PyResult<Self> {
        read_gripper(&path).map(PyGripper).map_err(|error| match &error {
            GripperError::Io { source, .. } => os_error(source.kind(), error.to_string()),
            _ => PyValueError::new_err(error.to_string()),
        })
    }

    /// A gripper that comes along: "jaws-140" or "jaws-85".
    ///
    /// Raises ValueError for another name.
    #[staticmethod]
    fn built_in(name: &str) -> PyResult<Self> {
        let gripper = Gripper::built_in(name);
        gripper.map(PyGripper).ok_or_else(|| bad("name", Gripper::BUILT_IN.join(" or "), format!("{name:?}")))
    }

    /// What it is called.
    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }

    /// Largest distance between the finger pads, metres.
    #[getter]
    fn max_opening(&self) -> f64 {
        self.0.max_opening
    }

    /// From the palm to the finger tips, metres.
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

    /// The gripper as a Mesh in its own frame, the pads `opening` metres apart, for pictures.
    ///
    /// Raises ValueError for an opening that it does not have.
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

/// A proposed grasp.
#[pyclass(name = "Grasp", module = "sixfold", frozen)]
pub(crate) struct PyGrasp {
    pose: Pose,
    /// Where the gripper closes, (4, 4) float64, metres: takes points of the gripper's frame to the camera's.
    #[pyo3(get)]
    camera_from_gripper: Py<PyArray2<f64>>,
    /// Distance of the pads before closing, metres.
    #[pyo3(get)]
    opening: f64,
    /// Distance of the two contacts as far as it is known, metres.
    #[pyo3(get)]
    width: f64,
    /// How good the contacts look, 0 to 1: geometry alone, no forces, no reach.
    #[pyo3(get)]
    quality: f64,
    /// Part of the quality: how far the closing axis lies inside both friction cones.
    #[pyo3(get)]
    alignment: f64,
    /// Part of the quality: how much surface each pad meets.
    #[pyo3(get)]
    support: f64,
    /// Part of the quality: how near the closing axis passes to the object's middle.
    #[pyo3(get)]
    centring: f64,
    /// Part of the quality: share of the contact points that were seen rather than assumed.
    #[pyo3(get)]
    observed: f64,
    /// How many proposals were joined into this one.
    #[pyo3(get)]
    members: usize,
    /// The sum of their qualities, by which grasps are ordered.
    #[pyo3(get)]
    score: f64,
}

impl PyGrasp {
    fn of(py: Python<'_>, cluster: &GraspCluster) -> PyResult<Self> {
        let best = &cluster.best;
        Ok(PyGrasp {
            pose: best.camera_from_gripper,
            camera_from_gripper: arrays::from_pose(py, &best.camera_from_gripper)?.unbind(),
            opening: best.opening,
            width: best.width,
            quality: best.quality.total(),
            alignment: best.quality.alignment,
            support: best.quality.support,
            centring: best.quality.centring,
            observed: best.quality.observed,
            members: cluster.members,
            score: cluster.score,
        })
    }
}

#[pymethods]
impl PyGrasp {
    fn __repr__(&self) -> String {
        format!("<Grasp: quality {:.3}, opening {:.3} m>", self.quality, self.opening)
    }
}

fn view_error(error: ViewError) -> PyErr {
    let argument = match error {
        ViewError::MaskSize { .. }
        | ViewError::EmptyMask
        | ViewError::NoDepthInMask { .. }
        | ViewError::SeveralObjects { .. }
        | ViewError::NoTable { .. } => "mask",
        _ => "depth",
    };
    PyValueError::new_err(format!("{argument}: {error}"))
}

/// What stands on the table of a depth image: a list of masks (H, W) bool, the largest first.
///
/// depth (H, W) in metres, without lens distortion. Ctrl-C is heard.
///
/// Raises ValueError when there is no table, for a depth in the wrong unit or without any value.
///
/// >>> masks = find_objects(depth, camera)  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (depth, camera, *, seed=0))]
pub(crate) fn find_objects<'py>(
    py: Python<'py>,
    depth: &Bound<'py, PyAny>,
    camera: PyCamera,
    seed: i64,
) -> PyResult<Vec<Bound<'py, PyArray2<bool>>>> {
    let depth = arrays::depth("depth", depth)?;
    let camera = camera.of_image("depth", depth.size())?;
    let options = ViewOptions { seed: arrays::seed(seed)?, ..ViewOptions::default() };
    let masks = interruptible(py, move |_| find(&depth, &camera, &options))?.map_err(view_error)?;
    masks.into_iter().map(|mask| arrays::from_image(py, mask)).collect()
}

/// Grasps on an object of a depth image, from its geometry alone: two contacts within the friction cones, fingers and palm
/// free of what was seen (Nguyen 1988). A list of Grasp, best first, empty when nothing fits.
///
/// depth (H, W) in metres, without lens distortion; mask (H, W) bool of the object, or None for the largest thing on the
/// table; gripper: a Gripper or the name of one that comes along; most: so many at most; seen_only=True assumes nothing
/// about the hidden side. The same input and seed give the same result. Ctrl-C is heard.
///
/// Raises ValueError for a mask without depth or of several objects, no table, a depth in the wrong unit.
///
/// >>> best = propose_grasps(depth, camera, gripper="jaws-85")[0]  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (depth, camera, mask=None, *, gripper=None, most=5, seen_only=false, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn propose_grasps(
    py: Python<'_>,
    depth: &Bound<'_, PyAny>,
    camera: PyCamera,
    mask: Option<&Bound<'_, PyAny>>,
    gripper: Option<&Bound<'_, PyAny>>,
    most: i64,
    seen_only: bool,
    seed: i64,
) -> PyResult<Vec<PyGrasp>> {
    let depth = arrays::depth("depth", depth)?;
    let camera = camera.of_image("depth", depth.size())?;
    let mask = mask.map(|mask| arrays::mask("mask", mask)).transpose()?;
    let gripper = gripper_of(gripper)?;
    let most = whole("most", most, 1)?;
    let seed = arrays::seed(seed)?;
    let view = ViewOptions { seed, ..ViewOptions::default() };
    let default = AntipodalOptions::default();
    let planner = AntipodalOptions { seed, completion: default.completion.filter(|_| !seen_only), ..default };
    let clusters = interruptible(py, move |stop| {
        let mask = match mask {
            Some(mask) => Some(mask),
            None => find(&depth, &camera, &view)?.into_iter().next(),
        };
        stop.check();
        let Some(mask) = mask else { return Ok(vec![]) };
        let view = GraspView::new(&depth, &camera, &mask, &view)?;
        stop.check();
        let grasps = antipodal_grasps(&view, &gripper, &planner)
            .unwrap_or_else(|error| unreachable!("default options: {error}"));
        Ok(cluster_grasps(&grasps, &ClusterOptions::default()))
    })?
    .map_err(view_error)?;
    clusters.iter().take(most).map(|cluster| PyGrasp::of(py, cluster)).collect()
}

/// Grippers drawn over an image at their grasps, the first in green and on top: (H, W, 3) uint8.
///
/// rgb (H, W, 3) uint8; depth (H, W) in metres: behind what it shows the grippers are fainter.
///
/// Raises ValueError for images of another size than the camera's.
///
/// >>> picture = draw_grasps(rgb, grasps, camera, gripper="jaws-85")  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (rgb, grasps, camera, *, gripper=None, depth=None))]
pub(crate) fn draw_grasps<'py>(
    py: Python<'py>,
    rgb: &Bound<'py, PyAny>,
    grasps: Vec<PyRef<'py, PyGrasp>>,
    camera: PyCamera,
    gripper: Option<&Bound<'py, PyAny>>,
    depth: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArray3<u8>>> {
    let image = arrays::rgb("rgb", rgb)?;
    let camera = camera.of_image("rgb", image.size())?;
    let depth = depth.map(|depth| arrays::depth("depth", depth)).transpose()?;
    if let Some(depth) = &depth {
        camera.check_image(depth.width(), depth.height()).map_err(about("depth"))?;
    }
    let gripper = gripper_of(gripper)?;
    let drawn: Vec<DrawnGrasp> = grasps
        .iter()
        .enumerate()
        .rev()
        .map(|(place, grasp)| DrawnGrasp {
            camera_from_gripper: grasp.pose,
            opening: grasp.opening,
            color: if place == 0 { [60, 220, 80] } else { [86, 150, 233] },
        })
        .collect();
    let picture = interruptible(py, move |_| draw(&image, depth.as_ref(), &camera, &gripper, &drawn))?;
    arrays::from_image_of(py, picture.map_err(about("gripper"))?)
}

/// A Gripper, the name of one that comes along, or the default one.
fn gripper_of(argument: Option<&Bound<'_, PyAny>>) -> PyResult<Gripper> {
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
