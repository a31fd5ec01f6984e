//! One complete attempt: an object comes to rest, a depth camera records it, the planner proposes grasps, and the gripper tries the
//! best one.

use rand::RngExt;
use serde::Serialize;
use sixfold_geometry::nalgebra::{Quaternion, UnitQuaternion};
use sixfold_geometry::random::stream;
use sixfold_geometry::{Pose, Vec3};
use sixfold_grasp::{
    AntipodalOptions, ClusterOptions, Grasp, GraspView, Gripper, ViewOptions, antipodal_grasps,
    cluster_grasps, find_objects,
};
use sixfold_mesh::Mesh;
use sixfold_render::DepthSensor;

use crate::{
    ConvexParts, Outcome, SimulatedView, SimulationError, TrialOptions, TrialReport, ViewPoint,
    settle_at_centre, simulate_view, try_grasp,
};

/// What is sampled in every attempt, and the options of camera, planner and trial.
#[derive(Debug, Clone, Copy)]
pub struct AttemptOptions {
    /// Let the object fall in any orientation; otherwise its own z axis is up and it is rotated about that axis.
    pub any_orientation: bool,
    /// Smallest and largest elevation of the camera above the table, radians.
    pub elevation: (f64, f64),
    /// Smallest and largest distance of the camera, metres.
    pub distance: (f64, f64),
    /// The depth camera's noise.
    pub sensor: Option<DepthSensor>,
    /// How the view is prepared.
    pub view: ViewOptions,
    /// How grasps are proposed.
    pub planner: AntipodalOptions,
    /// How proposals are clustered.
    pub clusters: ClusterOptions,
    /// How they are tried.
    pub trial: TrialOptions,
}

impl Default for AttemptOptions {
    fn default() -> Self {
        AttemptOptions {
            any_orientation: false,
            elevation: (30f64.to_radians(), 60f64.to_radians()),
            distance: (0.7, 1.0),
            sensor: Some(DepthSensor::kinect()),
            view: ViewOptions::default(),
            planner: AntipodalOptions::default(),
            clusters: ClusterOptions::default(),
            trial: TrialOptions::default(),
        }
    }
}

/// How an attempt ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum AttemptOutcome {
    /// The object did not come to rest on the table; does not count as an attempt of the planner.
    NoRest,
    /// Nothing was found on the table.
    NotSeen,
    /// No grasp was proposed.
    NoProposal,
    /// A grasp was tried.
    Tried(Outcome),
}

impl AttemptOutcome {
    /// Whether the object was held.
    pub fn is_success(self) -> bool {
        self == AttemptOutcome::Tried(Outcome::Held)
    }
}

/// One attempt.
#[derive(Debug, Clone)]
pub struct Attempt {
    /// How it ended.
    pub ending: AttemptOutcome,
    /// The object's pose at rest.
    pub world_from_object: Pose,
    /// The recorded view.
    pub view: Option<SimulatedView>,
    /// The proposed grasps: the best member of each cluster, by rank.
    pub proposals: Vec<Grasp>,
    /// Report of the trial of the first one.
    pub report: Option<TrialReport>,
    /// Time from the depth image to the ranked proposals, seconds.
    pub planning_seconds: f64,
    /// Time for the physics trial, seconds.
    pub trial_seconds: f64,
}

/// An object at rest on the table and its depth image: the start of an attempt.
#[derive(Debug, Clone)]
pub struct Scene {
    /// [`AttemptOutcome::NoRest`] or [`AttemptOutcome::NotSeen`] when there is nothing to grasp; otherwise
    /// [`AttemptOutcome::NoProposal`], because nothing was proposed yet.
    pub ending: AttemptOutcome,
    /// The object's pose.
    pub world_from_object: Pose,
    /// The recorded view.
    pub seen: Option<SimulatedView>,
    /// The same, prepared for grasping.
    pub view: Option<GraspView>,
    /// Seed of everything random that follows.
    pub noise: u64,
    /// Time from the depth image to the prepared view, seconds.
    pub seconds: f64,
}

/// The scene of attempt `number`: pose, view point and noise are sampled from `seed` and `number` alone.
pub fn scene(mesh: &Mesh, parts: &ConvexParts, options: &AttemptOptions, seed: u64, number: u64) -> Scene {
    scene_at(mesh, |start| settle_at_centre(mesh, parts, start), options, seed, number)
}

/// As [`scene`], with a function `rest` from the pose at which the object is released to its pose at rest (`None` if it does not
/// rest). With a stored pose at rest this renders the scene without physics.
pub fn scene_at(
    mesh: &Mesh,
    rest: impl FnOnce(&Pose) -> Option<Pose>,
    options: &AttemptOptions,
    seed: u64,
    number: u64,
) -> Scene {
    let mut random = stream(seed, number);
    let yaw = random.random_range(-std::f64::consts::PI..std::f64::consts::PI);
    let upright = Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, yaw].into());
    let any: [f64; 4] = std::array::from_fn(|_| random.random_range(-1.0..1.0));
    let start = if options.any_orientation {
        let q = Quaternion::new(any[0], any[1], any[2], any[3]);
        Pose::new(UnitQuaternion::from_quaternion(q), Vec3::zeros())
    } else {
        upright
    };
    let mut draw = |(low, high): (f64, f64)| low + (high - low) * random.random::<f64>();
    let azimuth = draw((-std::f64::consts::PI, std::f64::consts::PI));
    let elevation = draw(options.elevation);
    let distance = draw(options.distance);
    let offset = Vec3::new(draw((-0.05, 0.05)), draw((-0.05, 0.05)), 0.0);
    let noise: u64 = random.random();
    let mut result = Scene {
        ending: AttemptOutcome::NoRest,
        world_from_object: start,
        seen: None,
        view: None,
        noise,
        seconds: 0.0,
    };
    let Some(rest) = rest(&start) else { return result };
    let (low, high) = mesh.transformed(&rest).bounding_box();
    result.world_from_object = rest;
    let point =
        ViewPoint { azimuth, elevation, distance, target: offset + Vec3::z() * (0.5 * (high.z - low.z)) };
    result.ending = AttemptOutcome::NotSeen;
    let Ok(seen) = simulate_view(mesh, &rest, &point, options.sensor.as_ref(), noise) else {
        return result;
    };
    let began = std::time::Instant::now();
    let view_options = ViewOptions { seed: noise, ..options.view };
    let masks = find_objects(&seen.depth, &seen.camera, &view_options).unwrap_or_default();
    result.view =
        masks.first().and_then(|mask| GraspView::new(&seen.depth, &seen.camera, mask, &view_options).ok());
    result.seconds = began.elapsed().as_secs_f64();
    result.seen = Some(seen);
    if result.view.is_some() {
        result.ending = AttemptOutcome::NoProposal;
    }
    result
}

/// Runs attempt `number` with the geometric planner: pose, view point and noise are sampled from `seed` and `number` alone.
///
/// # Errors
/// [`SimulationError`] for options out of range.
pub fn attempt(
    mesh: &Mesh,
    parts: &ConvexParts,
    gripper: &Gripper,
    options: &AttemptOptions,
    seed: u64,
    number: u64,
) -> Result<Attempt, SimulationError> {
    let scene = scene(mesh, parts, options, seed, number);
    let mut result = Attempt {
        ending: scene.ending,
        world_from_object: scene.world_from_object,
        view: scene.seen,
        proposals: vec![],
        report: None,
        planning_seconds: 0.0,
        trial_seconds: 0.0,
    };
    let (Some(view), Some(seen)) = (scene.view, &result.view) else { return Ok(result) };
    let world_from_camera = seen.world_from_camera;
    let rest = scene.world_from_object;
    let began = std::time::Instant::now();
    let planner = AntipodalOptions { seed: scene.noise, ..options.planner };
    let grasps = antipodal_grasps(&view, gripper, &planner).map_err(|e| SimulationError::Option {
        field: e.field,
        found: e.found,
        expected: e.expected,
    })?;
    let clusters = cluster_grasps(&grasps, &options.clusters);
    result.planning_seconds = scene.seconds + began.elapsed().as_secs_f64();
    result.proposals = clusters.iter().map(|c| c.best).collect();
    let Some(grasp) = result.proposals.first() else { return Ok(result) };
    let began = std::time::Instant::now();
    let world_from_gripper = world_from_camera * grasp.camera_from_gripper;
    let report = try_grasp(parts, &rest, gripper, &world_from_gripper, grasp.opening, &options.trial)?;
    result.trial_seconds = began.elapsed().as_secs_f64();
    result.report = Some(report);
    result.ending = AttemptOutcome::Tried(report.outcome);
    Ok(result)
}
