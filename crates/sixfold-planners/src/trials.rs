//! Training data of planners: candidates on synthetic objects, proposed from one simulated depth view and tried in a physics
//! engine.
//!
//! GPD was trained on scanned objects with a geometric test of force closure, HAF on labelled heights. Here a candidate counts as
//! good if it held in one trial of the hard setting, with pose errors of the gripper and low friction.

use std::path::Path;

use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sixfold_geometry::Progress;
use sixfold_geometry::random::{Random, stream};
use sixfold_grasp::learned::{
    ApproachGridOptions, LocalFrameOptions, approach_grid_grasps, local_frame_grasps,
};
use sixfold_grasp::{AntipodalOptions, Grasp, GraspView, Gripper, antipodal_grasps};
use sixfold_io::LockError;
use sixfold_mesh::Mesh;
use sixfold_nn::options::OptionError;
use sixfold_simulation::{
    AttemptOutcome, ConvexParts, Hardness, PartsOptions, Scene, TrialOptions, scene, try_grasp,
};
use sixfold_synth::shapes::{Family, member, toy};
use thiserror::Error;

use crate::trial_file::{Candidate, SceneRow, TrialFile};

/// Scenes per object.
const SCENES_PER_OBJECT: u64 = 4;
/// Number of candidates per scene that are tried, for each source: GPD, HAF, the antipodal planner.
const TRIED: [(Source, usize); 3] =
    [(Source::LocalFrame, 6), (Source::ApproachGrid, 5), (Source::Antipodal, 5)];
/// HAF's candidates are sampled from a coarser grid than that used for planning.
const GRID: ApproachGridOptions = ApproachGridOptions { rolls: 6, step: 0.02 };
/// The gripper of the trials.
const GRIPPER: &str = "jaws-140";

/// Errors of trials.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TrialsError {
    /// The file cannot be read or written.
    #[error("trials {file}: {source}")]
    Io {
        /// The file.
        file: String,
        /// The cause.
        source: std::io::Error,
    },
    /// Another training is writing trials to the file.
    #[error(transparent)]
    Lock(#[from] LockError),
    /// The file has other contents.
    #[error("trials {file}, line {line}: found {found}, expected {expected}")]
    Content {
        /// The file.
        file: String,
        /// Number of the line.
        line: usize,
        /// The content found.
        found: String,
        /// The content expected.
        expected: String,
    },
    /// A synthetic object could not be generated or tried: never with these values.
    #[error("object {number}: {reason}")]
    Object {
        /// Its number.
        number: u64,
        /// The cause.
        reason: String,
    },
}

/// Options of the trials.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct TrialSetOptions {
    /// Number of scenes, four per object; eight of ten objects are for the training.
    pub scenes: u64,
    /// Seed of objects, scenes, candidates and trials.
    pub seed: u64,
}

impl Default for TrialSetOptions {
    fn default() -> Self {
        TrialSetOptions { scenes: 600, seed: 0 }
    }
}

impl TrialSetOptions {
    pub(crate) fn check(&self) -> Result<(), OptionError> {
        let fits = (40..=1_000_000).contains(&self.scenes);
        OptionError::unless(fits, "scenes", self.scenes, "40 to 1000000")
    }
}

/// The source of a candidate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// GPD's sampling.
    LocalFrame,
    /// HAF's sampling.
    ApproachGrid,
    /// The antipodal planner.
    Antipodal,
}

/// The purpose of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Part {
    /// For the training.
    Training,
    /// For the evaluation: objects of the same families that are not in the training.
    NewMembers,
    /// For the evaluation: objects of no family.
    NewShapes,
}

impl Part {
    pub(crate) fn of_scene(number: u64) -> Part {
        match number / SCENES_PER_OBJECT % 10 {
            8 => Part::NewMembers,
            9 => Part::NewShapes,
            _ => Part::Training,
        }
    }
}

/// The setting in which candidates are tried.
pub(crate) fn setting() -> Hardness {
    let gripper = Gripper::built_in(GRIPPER)
        .unwrap_or_else(|| unreachable!("{GRIPPER} is built in, a test of its crate says so"));
    Hardness::hard(gripper, TrialOptions::default())
}

/// Runs the trials that are missing in `file`; returns all its scenes, in order, as read from the file. `None` when it was stopped;
/// finished trials are kept. The same options give the same bytes, independent of the number of runs and threads.
pub(crate) fn complete(
    file: &Path,
    options: &TrialSetOptions,
    progress: &dyn Progress,
) -> Result<Option<Vec<SceneRow>>, TrialsError> {
    let mut rows = TrialFile::open(file, options)?;
    let total = options.scenes as usize;
    while (rows.len() as u64) < options.scenes {
        if !progress.report(rows.len(), total) {
            return Ok(None);
        }
        // All scenes of an object together, a few objects at a time: the convex decomposition of an object takes longer than its
        // scenes.
        let first = rows.len() as u64 / SCENES_PER_OBJECT;
        let last = options.scenes.div_ceil(SCENES_PER_OBJECT).min(first + 4);
        let made: Result<Vec<Vec<SceneRow>>, TrialsError> =
            (first..last).into_par_iter().map(|number| scenes_of_object(number, options)).collect();
        let skip = rows.len() - (first * SCENES_PER_OBJECT) as usize;
        for row in made?.into_iter().flatten().skip(skip) {
            if (rows.len() as u64) < options.scenes {
                rows.append(&row)?;
            }
        }
    }
    progress.report(total, total);
    rows.read(options.scenes).map(Some)
}

/// An object of the trials, in the orientation before it comes to rest.
pub(crate) fn object(number: u64, options: &TrialSetOptions) -> Result<Mesh, TrialsError> {
    let mut random = stream(options.seed, number);
    let made = if Part::of_scene(number * SCENES_PER_OBJECT) == Part::NewShapes {
        toy(&mut random)
    } else {
        let family = Family::ALL[random.random_range(0..Family::ALL.len())];
        let rest = family.rests()[random.random_range(0..family.rests().len())];
        member(family, &mut random).map(|m| m.mesh.transformed(&rest.rotation()))
    };
    made.map_err(|e| TrialsError::Object { number, reason: e.to_string() })
}

/// The number of the object of a scene.
pub(crate) fn object_of(scene: u64) -> u64 {
    scene / SCENES_PER_OBJECT
}

fn scenes_of_object(number: u64, options: &TrialSetOptions) -> Result<Vec<SceneRow>, TrialsError> {
    let wrong = |reason: &dyn std::fmt::Display| TrialsError::Object { number, reason: reason.to_string() };
    let mesh = object(number, options)?;
    let parts = ConvexParts::of_mesh(&mesh, &PartsOptions::default()).map_err(|e| wrong(&e))?;
    let scenes = number * SCENES_PER_OBJECT..(number + 1) * SCENES_PER_OBJECT;
    scenes
        .map(|scene_number| {
            let setting = setting_of_scene(scene_number);
            let scene = scene(&mesh, &parts, &setting.options, options.seed, scene_number);
            tried(&scene, &parts, &setting, scene_number).map_err(|e| wrong(&e))
        })
        .collect()
}

/// The setting of a scene: in one scene of each object, the object is in any orientation.
pub(crate) fn setting_of_scene(number: u64) -> Hardness {
    let mut setting = setting();
    setting.options.any_orientation = number % SCENES_PER_OBJECT == SCENES_PER_OBJECT - 1;
    setting
}

/// Tries some candidates of a scene.
fn tried(
    scene: &Scene,
    parts: &ConvexParts,
    setting: &Hardness,
    number: u64,
) -> Result<SceneRow, sixfold_simulation::SimulationError> {
    let mut row = SceneRow::new(number, &scene.world_from_object);
    let (Some(view), Some(seen)) = (&scene.view, &scene.seen) else { return Ok(row) };
    let mut random = stream(scene.noise, number);
    for (source, count) in TRIED {
        let candidates = some(candidates(view, &setting.gripper, source, scene.noise), count, &mut random);
        for grasp in candidates {
            let sent = seen.world_from_camera * grasp.camera_from_gripper;
            let seed = scene.noise.wrapping_add(row.candidates.len() as u64);
            let (rest, reached) = (&scene.world_from_object, setting.reached(&sent, seed));
            let report =
                try_grasp(parts, rest, &setting.real, &reached, grasp.opening, &setting.options.trial)?;
            let held = AttemptOutcome::Tried(report.outcome).is_success();
            row.candidates.push(Candidate::new(source, &grasp, held));
        }
    }
    Ok(row)
}

fn candidates(view: &GraspView, gripper: &Gripper, source: Source, seed: u64) -> Vec<Grasp> {
    match source {
        Source::LocalFrame => {
            let options = LocalFrameOptions { samples: 20, seed, ..LocalFrameOptions::default() };
            local_frame_grasps(view, gripper, &options)
        }
        Source::ApproachGrid => approach_grid_grasps(view, gripper, &GRID),
        Source::Antipodal => {
            let options = AntipodalOptions { samples: 100, rounds: 1, seed, ..AntipodalOptions::default() };
            antipodal_grasps(view, gripper, &options).unwrap_or_default()
        }
    }
}

/// `count` random ones of them, or all if there are fewer.
fn some(mut grasps: Vec<Grasp>, count: usize, random: &mut Random) -> Vec<Grasp> {
    for k in 0..count.min(grasps.len()) {
        let other = random.random_range(k..grasps.len());
        grasps.swap(k, other);
    }
    grasps.truncate(count);
    grasps
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stopped_set_is_completed_to_the_same_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let options = TrialSetOptions { scenes: 5, seed: 5 };
        let whole = folder.path().join("whole.jsonl");
        let rows = complete(&whole, &options, &()).unwrap().unwrap();
        assert_eq!(rows.len(), 5);
        let count: usize = rows.iter().map(|r| r.candidates.len()).sum();
        let held = rows.iter().flat_map(|r| &r.candidates).filter(|c| c.held).count();
        assert!(count > 20 && held > 0 && held < count, "{held} of {count}");
        // A run that was stopped within a line.
        let bytes = std::fs::read(&whole).unwrap();
        let cut = folder.path().join("cut.jsonl");
        std::fs::write(&cut, &bytes[..bytes.len() * 6 / 10]).unwrap();
        let threads = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(threads.install(|| complete(&cut, &options, &())).unwrap().unwrap(), rows);
        assert_eq!(std::fs::read(&cut).unwrap(), bytes);
        // From a file with more scenes than requested the first are used.
        let fewer = TrialSetOptions { scenes: 3, ..options };
        assert_eq!(complete(&cut, &fewer, &()).unwrap().unwrap(), rows[..3]);
        let other = TrialSetOptions { seed: 6, ..options };
        let error = complete(&cut, &other, &()).unwrap_err().to_string();
        assert!(error.contains("cut.jsonl") && error.contains("other options"), "{error}");
    }

    #[test]
    fn objects_that_are_measured_on_are_not_trained_on() {
        let parts: Vec<Part> = (0..80).map(Part::of_scene).collect();
        let count = |part: Part| parts.iter().filter(|p| **p == part).count();
        assert_eq!((count(Part::Training), count(Part::NewMembers), count(Part::NewShapes)), (64, 8, 8));
        for scenes in parts.chunks(SCENES_PER_OBJECT as usize) {
            assert!(scenes.iter().all(|p| *p == scenes[0]), "scenes of one object stay together");
        }
    }
}
