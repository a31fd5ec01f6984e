//! `try_grasp`: one grasp in the physics engine (`sixfold-simulation`).

use std::sync::Arc;

use numpy::PyArray2;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use sixfold::geometry::Pose;
use sixfold::mesh::Mesh;
use sixfold::simulation::{
    ConvexParts, Outcome, PartsOptions, SimulationError, TrialOptions, TrialReport, settle_at_centre,
    try_grasp as try_one,
};

use crate::arrays::{self, about, bad, positive};
use crate::gripper::gripper_of;
use crate::guard::interruptible;
use crate::mesh::PyMesh;

/// An object for trials: its mesh decomposed into convex parts, so that hollows stay hollow. The decomposition takes seconds;
/// keep the result.
///
/// convex: True uses the convex hull of the mesh as the only part. Ctrl-C interrupts it.
///
/// Raises ValueError for a mesh without faces or without volume.
///
/// >>> cube = Mesh([[x, y, z] for x in (0, .05) for y in (0, .05) for z in (0, .05)]).convex_hull()
/// >>> solid = Solid(cube, convex=True)
/// >>> bool(abs(solid.rest()[2, 3]) < 1e-3)  # its origin is at the bottom
/// True
#[pyclass(name = "Solid", module = "sixfold", frozen)]
pub(crate) struct PySolid {
    mesh: Arc<Mesh>,
    parts: Arc<ConvexParts>,
}

#[pymethods]
impl PySolid {
    #[new]
    #[pyo3(signature = (mesh, *, convex=false))]
    fn new(py: Python<'_>, mesh: &Bound<'_, PyMesh>, convex: bool) -> PyResult<Self> {
        let mesh = mesh.get().mesh.clone();
        let surface = mesh.clone();
        let parts = interruptible(py, move |_| {
            if convex {
                ConvexParts::of_convex(&surface)
            } else {
                ConvexParts::of_mesh(&surface, &PartsOptions::default())
            }
        })?;
        Ok(PySolid { mesh, parts: Arc::new(parts.map_err(about("mesh"))?) })
    }

    /// Number of convex parts.
    #[getter]
    fn part_count(&self) -> usize {
        self.parts.parts().len()
    }

    /// Simulates how the object falls from just above the table and comes to rest, and returns its pose at rest, (4, 4)
    /// world_from_object in metres, moved to the centre of the table. None if it does not come to rest. The world's z axis
    /// points up and the table's top is at z = 0.
    ///
    /// start: the object's rotation when it falls, as a pose (4, 4). None: its own z axis points up. Ctrl-C interrupts it.
    #[pyo3(signature = (start=None))]
    fn rest<'py>(
        &self,
        py: Python<'py>,
        start: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Option<Bound<'py, PyArray2<f64>>>> {
        let start = start.map_or(Ok(Pose::identity()), |pose| arrays::pose("start", pose))?;
        self.settled(py, start)?.map(|pose| arrays::from_pose(py, &pose)).transpose()
    }

    fn __repr__(&self) -> String {
        format!("<Solid: {} convex parts>", self.parts.parts().len())
    }
}

impl PySolid {
    pub(crate) fn parts(&self) -> Arc<ConvexParts> {
        self.parts.clone()
    }

    fn settled(&self, py: Python<'_>, start: Pose) -> PyResult<Option<Pose>> {
        let (mesh, parts) = (self.mesh.clone(), self.parts.clone());
        interruptible(py, move |_| settle_at_centre(&mesh, &parts, &start))
    }
}

/// The result of a trial. True if the object was held.
#[pyclass(name = "GraspTrial", module = "sixfold", frozen)]
pub(crate) struct GraspTrial {
    report: TrialReport,
    /// The pose at which the object stood, (4, 4) float64, metres.
    #[pyo3(get)]
    world_from_object: Py<PyArray2<f64>>,
}

#[pymethods]
impl GraspTrial {
    /// The outcome. "held": after lift and shake the object is between both fingers. "blocked": the gripper cannot reach the
    /// grasp without a collision. "missed": the fingers closed without the object. "lost_in_lift", "lost_in_shake": the object
    /// was lost then.
    #[getter]
    fn outcome(&self) -> &'static str {
        match self.report.outcome {
            Outcome::Held => "held",
            Outcome::Blocked => "blocked",
            Outcome::Missed => "missed",
            Outcome::LostInLift => "lost_in_lift",
            Outcome::LostInShake => "lost_in_shake",
        }
    }

    /// Whether the object was held to the end.
    #[getter]
    fn held(&self) -> bool {
        self.report.outcome == Outcome::Held
    }

    /// Distance of the pads at the end, metres.
    #[getter]
    fn gap(&self) -> f64 {
        self.report.gap
    }

    /// Height by which the object's origin rose, metres.
    #[getter]
    fn raised(&self) -> f64 {
        self.report.raised
    }

    /// Distance by which the object slid between the fingers after they closed, metres.
    #[getter]
    fn slip(&self) -> f64 {
        self.report.slip
    }

    /// Angle by which the object rotated between the fingers after they closed, radians.
    #[getter]
    fn turn(&self) -> f64 {
        self.report.turn
    }

    /// Distance by which the object was moved before the lift, metres.
    #[getter]
    fn pushed(&self) -> f64 {
        self.report.pushed
    }

    /// Simulated time, seconds.
    #[getter]
    fn time(&self) -> f64 {
        self.report.time
    }

    fn __bool__(&self) -> bool {
        self.held()
    }

    fn __repr__(&self) -> String {
        format!("<GraspTrial: {}>", self.outcome())
    }
}

/// Computes the pose of a gripper (4, 4) from the centre between its finger tips, tip (3,) in metres, and its approach and
/// closing directions (3,). They need not be unit vectors nor exactly perpendicular: the approach keeps its direction. By
/// default the approach is (0, 0, -1) and the closing direction (1, 0, 0).
///
/// Raises ValueError if the directions are parallel or zero.
///
/// >>> gripper_pose([0, 0, 0.02])[:3, 2]
/// array([ 0.,  0., -1.])
#[pyfunction]
#[pyo3(signature = (tip, approach=None, closing=None))]
pub(crate) fn gripper_pose<'py>(
    py: Python<'py>,
    tip: &Bound<'py, PyAny>,
    approach: Option<&Bound<'py, PyAny>>,
    closing: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    use sixfold::geometry::Vec3;
    let tip = arrays::vector3("tip", tip)?;
    let approach = approach.map_or(Ok(-Vec3::z()), |d| arrays::vector3("approach", d))?;
    let closing = closing.map_or(Ok(Vec3::x()), |d| arrays::vector3("closing", d))?;
    let pose = sixfold::grasp::gripper_pose(&tip, &approach, &closing).ok_or_else(|| {
        let found = format!("{:?} and {:?}", approach.as_slice(), closing.as_slice());
        bad("approach, closing", "two different directions", found)
    })?;
    arrays::from_pose(py, &pose)
}

/// Tries one grasp in a physics engine. The gripper moves along its approach direction, closes with a limited force, lifts and
/// shakes. Only Coulomb friction holds the object. The same arguments give the same result on every machine.
///
/// object: a Solid, or a Mesh, which is decomposed into convex parts first.
/// world_from_gripper: the gripper's pose when it closes, (4, 4), metres. The world's z axis points up and the table's top is at
///     z = 0. For a Grasp it is world_from_camera @ grasp.camera_from_gripper.
/// world_from_object: the pose at which the object stands, (4, 4), metres. None: Solid.rest().
/// gripper: a Gripper, or the name of a built-in one. None: "jaws-140".
/// opening: distance of the pads before closing, metres. None: the gripper's maximum.
/// friction, force: friction coefficient of the pads and force of a finger in newtons, instead of the gripper's.
/// mass: mass of the object, kg.
/// table_friction: friction coefficient of the table.
/// lift: height of the lift, metres.
///
/// Ctrl-C interrupts it.
///
/// Raises ValueError for a mesh without volume, an object that does not come to rest, and options out of range.
///
/// >>> cube = Mesh([[x, y, z] for x in (0, .05) for y in (0, .05) for z in (0, .05)]).convex_hull()
/// >>> trial = try_grasp(Solid(cube, convex=True), gripper_pose([0, 0, 0.01]), gripper="jaws-85")
/// >>> trial.outcome
/// 'held'
#[pyfunction]
#[pyo3(signature = (object, world_from_gripper, *, world_from_object=None, gripper=None, opening=None, friction=None, force=None, mass=0.2, table_friction=0.5, lift=0.1))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn try_grasp(
    py: Python<'_>,
    object: &Bound<'_, PyAny>,
    world_from_gripper: &Bound<'_, PyAny>,
    world_from_object: Option<&Bound<'_, PyAny>>,
    gripper: Option<&Bound<'_, PyAny>>,
    opening: Option<f64>,
    friction: Option<f64>,
    force: Option<f64>,
    mass: f64,
    table_friction: f64,
    lift: f64,
) -> PyResult<GraspTrial> {
    let world_from_gripper = arrays::pose("world_from_gripper", world_from_gripper)?;
    let standing = world_from_object.map(|pose| arrays::pose("world_from_object", pose)).transpose()?;
    let mut gripper = gripper_of(gripper)?;
    if let Some(friction) = friction {
        gripper.friction = friction;
        gripper.check("").map_err(about("friction"))?;
    }
    if let Some(force) = force {
        gripper.force = force;
        gripper.check("").map_err(about("force"))?;
    }
    let opening = opening.map_or(Ok(gripper.max_opening), |o| positive("opening", o))?;
    let options = TrialOptions { mass, table_friction, lift, ..TrialOptions::default() };
    options.check().map_err(simulation_error)?;
    let made;
    let solid = match object.cast::<PySolid>() {
        Ok(solid) => solid.get(),
        Err(_) => {
            let mesh = object.cast::<PyMesh>();
            let mesh = mesh.map_err(|_| bad("object", "a Solid or a Mesh", object.get_type().to_string()))?;
            made = PySolid::new(py, mesh, false)?;
            &made
        }
    };
    let world_from_object = match standing {
        Some(pose) => pose,
        None => solid.settled(py, Pose::identity())?.ok_or_else(|| {
            bad("world_from_object", "where the object stands", "None, and it does not come to rest")
        })?,
    };
    let parts = solid.parts.clone();
    let report = interruptible(py, move |_| {
        try_one(&parts, &world_from_object, &gripper, &world_from_gripper, opening, &options)
    })?;
    let report = report.map_err(simulation_error)?;
    Ok(GraspTrial { report, world_from_object: arrays::from_pose(py, &world_from_object)?.unbind() })
}

pub(crate) fn simulation_error(error: SimulationError) -> PyErr {
    match &error {
        SimulationError::Option { field, found, expected } => bad(field, expected, found.to_string()),
        _ => PyValueError::new_err(format!("object: {error}")),
    }
}
