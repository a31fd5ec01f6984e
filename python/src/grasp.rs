//! Grasps of a parallel-jaw gripper on objects in a depth image (`sixfold-grasp`).

use numpy::{PyArray2, PyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sixfold::dgcm::transfer::{Kind, ProposeError, ProposeOptions, propose, rank_by_outcome, rank_on_part};
use sixfold::geometry::Pose;
use sixfold::grasp::{
    AntipodalOptions, ClusterOptions, DrawnGrasp, Grasp, GraspFitter, GraspView, ViewError, ViewOptions,
    antipodal_grasps, cluster_grasps, draw_grasps as draw, find_objects as find,
};

use crate::arrays::{self, about, bad, whole};
use crate::camera::PyCamera;
use crate::experience::{ExperienceStore, lock, store_error};
use crate::gripper::gripper_of;
use crate::guard::interruptible;

/// A proposed grasp.
#[pyclass(name = "Grasp", module = "sixfold", frozen)]
pub(crate) struct PyGrasp {
    pose: Pose,
    /// Pose of the gripper when it closes, (4, 4) float64, metres: takes points from the gripper's frame to the camera's.
    #[pyo3(get)]
    camera_from_gripper: Py<PyArray2<f64>>,
    /// Distance between the pads before closing, metres.
    #[pyo3(get)]
    opening: f64,
    /// Distance between the two contacts, as far as known, metres.
    #[pyo3(get)]
    width: f64,
    /// Quality of the contacts, 0 to 1, from geometry alone: forces and the robot's reach are not considered.
    #[pyo3(get)]
    quality: f64,
    /// Part of the quality, 0 to 1: how far the closing axis is inside both friction cones.
    #[pyo3(get)]
    alignment: f64,
    /// Part of the quality, 0 to 1: the surface area that each pad touches.
    #[pyo3(get)]
    support: f64,
    /// Part of the quality, 0 to 1: how close the closing axis passes to the object's centre.
    #[pyo3(get)]
    centring: f64,
    /// Part of the quality, 0 to 1: fraction of the contact points that were seen; the others were assumed.
    #[pyo3(get)]
    observed: f64,
    /// Number of proposals in its cluster, which it represents.
    #[pyo3(get)]
    members: usize,
    /// Score by which grasps are ranked. Without experience: the sum of the qualities in its cluster. With experience: the success
    /// probability, 0 to 1; with `part` multiplied by a weight, 0 to 1, for holding that part.
    #[pyo3(get)]
    score: f64,
    /// Evidence from experience, a dict, or None without `experiences`. kind: origin of the grasp, "geometry" or "experience";
    /// agreement: fraction of experience that agrees with it, 0 to 1. Of a transferred grasp, otherwise None: id of the experience,
    /// distance between the features, hypothesis (the assumption about the object's size or rotation).
    #[pyo3(get)]
    experience: Option<Py<PyDict>>,
}

impl PyGrasp {
    pub(crate) fn pose(&self) -> Pose {
        self.pose
    }

    pub(crate) fn opening(&self) -> f64 {
        self.opening
    }

    pub(crate) fn width(&self) -> f64 {
        self.width
    }

    fn of(py: Python<'_>, proposed: &Proposed) -> PyResult<Self> {
        let best = &proposed.grasp;
        let experience = proposed.experience.map(|e| e.to_python(py)).transpose()?;
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
            members: proposed.members,
            score: proposed.score,
            experience,
        })
    }
}

/// A grasp with its score, before it is converted to Python.
struct Proposed {
    grasp: Grasp,
    score: f64,
    members: usize,
    experience: Option<Experienced>,
}

/// Evidence from experience for a grasp.
#[derive(Clone, Copy)]
struct Experienced {
    kind: &'static str,
    agreement: f64,
    /// The experience from which it was transferred: number, distance between the features, hypothesis.
    from: Option<(i64, f64, &'static str)>,
}

impl Experienced {
    fn to_python(self, py: Python<'_>) -> PyResult<Py<PyDict>> {
        let dict = PyDict::new(py);
        dict.set_item("kind", self.kind)?;
        dict.set_item("agreement", self.agreement)?;
        dict.set_item("id", self.from.map(|f| f.0))?;
        dict.set_item("distance", self.from.map(|f| f.1))?;
        dict.set_item("hypothesis", self.from.map(|f| f.2))?;
        Ok(dict.unbind())
    }
}

#[pymethods]
impl PyGrasp {
    fn __repr__(&self) -> String {
        format!("<Grasp: quality {:.3}, opening {:.3} m>", self.quality, self.opening)
    }
}

pub(crate) fn view_error(error: ViewError) -> PyErr {
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

/// Finds the objects on the table in a depth image: a list of masks (H, W) bool, the largest first.
///
/// depth (H, W) in metres, without lens distortion. Ctrl-C interrupts it.
///
/// Raises ValueError if no table is found, or for a depth image in the wrong unit or without any value.
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

/// Proposes grasps on an object in a depth image: two contacts within the friction cones, with fingers and palm free of visible
/// surfaces (Nguyen 1988). Returns a list of Grasp, best first; empty if there is none.
///
/// depth (H, W) in metres, without lens distortion; mask (H, W) bool of the object, or None for the largest object on the table;
/// gripper: a Gripper or the name of a built-in one, by default "jaws-140"; most: maximum number of grasps. seen_only=True makes no
/// assumption about the hidden side. The same input and seed give the same result. Ctrl-C interrupts it.
///
/// experiences: an ExperienceStore. Its successful grasps are transferred to the object and ranked together with the planner's
/// (dissertation, sections 6.2.3 and 6.3.2), by the success probability that the store's attempts predict (without attempts, those
/// of the simulation). weights: a DgcmNet or the path of its file, instead of the store's. part: uses only experiences on parts of
/// this name, such as "handle", and returns only grasps on the same part; empty if there is no such experience.
///
/// Raises ValueError for a mask without depth or of several objects, if no table is found, for a depth image in the wrong unit, for
/// weights or part without `experiences`, and for `experiences` without any weights.
///
/// >>> best = propose_grasps(depth, camera, gripper="jaws-85")[0]  # doctest: +SKIP
/// >>> learnt = propose_grasps(depth, camera, experiences=store)[0]  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (depth, camera, mask=None, *, gripper=None, most=5, seen_only=false, experiences=None, weights=None, part=None, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn propose_grasps(
    py: Python<'_>,
    depth: &Bound<'_, PyAny>,
    camera: PyCamera,
    mask: Option<&Bound<'_, PyAny>>,
    gripper: Option<&Bound<'_, PyAny>>,
    most: i64,
    seen_only: bool,
    experiences: Option<&Bound<'_, ExperienceStore>>,
    weights: Option<&Bound<'_, PyAny>>,
    part: Option<String>,
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
    let learnt = match experiences {
        Some(store) => Some((store.get().network(py, weights)?, store.get().share())),
        None if weights.is_some() || part.is_some() => {
            let argument = if part.is_some() { "part" } else { "weights" };
            return Err(bad(argument, "experiences, to which it applies", "none"));
        }
        None => None,
    };
    let proposed = interruptible(py, move |stop| {
        let mask = match mask {
            Some(mask) => Some(mask),
            None => find(&depth, &camera, &view)?.into_iter().next(),
        };
        stop.check();
        let Some(mask) = mask else { return Ok(vec![]) };
        let view = GraspView::new(&depth, &camera, &mask, &view)?;
        stop.check();
        let planned = || {
            antipodal_grasps(&view, &gripper, &planner)
                .unwrap_or_else(|error| unreachable!("default options: {error}"))
        };
        let clusters = ClusterOptions::default();
        let Some((model, store)) = learnt else {
            let clusters = cluster_grasps(&planned(), &clusters);
            let plain = clusters.iter().map(|c| Proposed {
                grasp: c.best,
                score: c.score,
                members: c.members,
                experience: None,
            });
            return Ok(plain.collect());
        };
        let on_part = part.is_some();
        let options = ProposeOptions { part, ..ProposeOptions::default() };
        let fitter = GraspFitter::new(&view, &gripper, &planner)
            .unwrap_or_else(|error| unreachable!("default options: {error}"));
        let (found, outcomes) = {
            let mut opened = lock(&store);
            let memory = opened.memory(&model).map_err(ProposeError::Store)?;
            (propose(&fitter, &model, memory, &options)?, memory.outcomes(&gripper.name))
        };
        stop.check();
        let geometry = planned();
        let ranked = if on_part {
            rank_on_part(&geometry, &found, &clusters, &fitter, &outcomes)
        } else {
            rank_by_outcome(&geometry, &found.proposals, &clusters, &fitter, &outcomes)
        };
        let learnt = ranked.iter().map(|r| {
            let from = r.proposal.map(|i| &found.proposals[i]);
            let kind = match r.kind {
                Kind::Geometry => "geometry",
                Kind::Experience => "experience",
            };
            let from = from.map(|p| (p.from.experience, p.from.distance, p.hypothesis.name()));
            let experience = Some(Experienced { kind, agreement: r.experience, from });
            Proposed { grasp: r.grasp, score: r.score, members: r.members, experience }
        });
        Ok::<Vec<Proposed>, GraspError>(learnt.collect())
    })?
    .map_err(GraspError::into_python)?;
    proposed.iter().take(most).map(|p| PyGrasp::of(py, p)).collect()
}

/// Why no grasps can be proposed.
enum GraspError {
    View(ViewError),
    Experience(ProposeError),
}

impl From<ViewError> for GraspError {
    fn from(error: ViewError) -> Self {
        GraspError::View(error)
    }
}

impl From<ProposeError> for GraspError {
    fn from(error: ProposeError) -> Self {
        GraspError::Experience(error)
    }
}

impl GraspError {
    fn into_python(self) -> PyErr {
        match self {
            GraspError::View(error) => view_error(error),
            GraspError::Experience(ProposeError::Store(error)) => store_error(error),
            GraspError::Experience(error) => about("mask")(error),
        }
    }
}

/// Draws grippers at their grasps over an image, the first in green and on top: (H, W, 3) uint8.
///
/// rgb (H, W, 3) uint8; gripper: as for propose_grasps; depth (H, W) in metres: grippers are fainter where they are behind a
/// measured surface.
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
