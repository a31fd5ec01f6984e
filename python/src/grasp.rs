//! Grasps of a parallel-jaw gripper on what a depth image shows (`sixfold-grasp`).

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
    /// Part of the quality: how near the closing axis passes to the object's centre.
    #[pyo3(get)]
    centring: f64,
    /// Part of the quality: fraction of the contact points that were seen rather than assumed.
    #[pyo3(get)]
    observed: f64,
    /// How many proposals were joined into this one.
    #[pyo3(get)]
    members: usize,
    /// By what grasps are ordered: the sum of their qualities; with experience the mean of quality and agreement, 0 to 1.
    #[pyo3(get)]
    score: f64,
    /// What experience says of it, a dict, or None for grasps by geometry alone: kind ("geometry" or "experience", where
    /// the grasp comes from), agreement (of experience that agrees with it, 0 to 1), id (of the experience that it was
    /// transferred from, or None), distance (of the features), hypothesis (what was assumed about the size).
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

/// A grasp with its rank's numbers, before it becomes Python's.
struct Proposed {
    grasp: Grasp,
    score: f64,
    members: usize,
    experience: Option<Experienced>,
}

/// What experience says of a grasp.
#[derive(Clone, Copy)]
struct Experienced {
    kind: &'static str,
    agreement: f64,
    /// Number, distance and hypothesis of the experience that it was transferred from.
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
/// about the hidden side. With `experiences`, an ExperienceStore, grasps that worked are transferred to the object and
/// ranked together with the planner's (dissertation, sections 6.2.3 and 6.3.2), by the chance to hold where the store knows what
/// came of attempts; weights: a DgcmNet or the path of its file in place of the store's; part: only experiences on parts of
/// this name, such as "handle", and only grasps that hold what they held. The same input and seed give the same result. Ctrl-C
/// is heard.
///
/// Raises ValueError for a mask without depth or of several objects, no table, a depth in the wrong unit, a part without
/// experiences.
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
        Some(store) => Some((store.get().network(py, weights)?, store.get().agreement())),
        None if weights.is_some() || part.is_some() => {
            let argument = if part.is_some() { "part" } else { "weights" };
            return Err(bad(argument, "experiences, which it belongs to", "none"));
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
