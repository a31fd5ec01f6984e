//! Samples from trials: every scene is rendered again exactly as in its trials, and each candidate has its outcome.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;
use sixfold_geometry::Progress;
use sixfold_grasp::{Grasp, GraspView, Gripper};
use sixfold_simulation::scene_at;

use crate::trial_file::SceneRow;
use crate::trials::{Part, TrialSetOptions, TrialsError, object, object_of, setting_of_scene};

/// A candidate that was tried.
#[derive(Debug, Clone)]
pub struct Sample<T> {
    /// The planner's input for it.
    pub seen: T,
    /// Whether it held.
    pub held: bool,
    /// The scene that it belongs to.
    pub scene: u64,
}

/// Samples for the training and for the evaluation.
#[derive(Debug, Clone)]
pub struct Samples<T> {
    /// For the training.
    pub training: Vec<Sample<T>>,
    /// For the evaluation: new members of the families.
    pub new_members: Vec<Sample<T>>,
    /// For the evaluation: new shapes.
    pub new_shapes: Vec<Sample<T>>,
}

/// The planner's inputs for all trials, in their order; `None` when it was stopped.
pub(crate) fn samples<T: Send>(
    rows: &[SceneRow],
    options: &TrialSetOptions,
    see: impl Fn(&GraspView, &Gripper, &Grasp) -> T + Sync,
    progress: &dyn Progress,
) -> Result<Option<Samples<T>>, TrialsError> {
    let done = AtomicUsize::new(0);
    let of_row = |row: &SceneRow| {
        let samples = of_scene(row, options, &see)?;
        let done = done.fetch_add(1, Ordering::Relaxed) + 1;
        Ok(progress.report(done, rows.len()).then_some(samples))
    };
    let made: Result<Vec<Option<Vec<Sample<T>>>>, TrialsError> = rows.par_iter().map(of_row).collect();
    let Some(made) = made?.into_iter().collect::<Option<Vec<_>>>() else { return Ok(None) };
    let mut all = Samples { training: vec![], new_members: vec![], new_shapes: vec![] };
    for (row, samples) in rows.iter().zip(made) {
        match Part::of_scene(row.scene) {
            Part::Training => all.training.extend(samples),
            Part::NewMembers => all.new_members.extend(samples),
            Part::NewShapes => all.new_shapes.extend(samples),
        }
    }
    Ok(Some(all))
}

fn of_scene<T>(
    row: &SceneRow,
    options: &TrialSetOptions,
    see: impl Fn(&GraspView, &Gripper, &Grasp) -> T,
) -> Result<Vec<Sample<T>>, TrialsError> {
    if row.candidates.is_empty() {
        return Ok(vec![]);
    }
    let mesh = object(object_of(row.scene), options)?;
    let setting = setting_of_scene(row.scene);
    let rest = |_: &sixfold_geometry::Pose| Some(row.world_from_object());
    let scene = scene_at(&mesh, rest, &setting.options, options.seed, row.scene);
    let Some(view) = &scene.view else { return Ok(vec![]) };
    let sample = |c: &crate::trial_file::Candidate| Sample {
        seen: see(view, &setting.gripper, &c.grasp()),
        held: c.held,
        scene: row.scene,
    };
    Ok(row.candidates.iter().map(sample).collect())
}
