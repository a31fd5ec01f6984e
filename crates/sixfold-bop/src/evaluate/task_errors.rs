//! The errors of every estimate of a task against every pose.

use sixfold_geometry::{Camera, DepthImage, Pose};
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

use super::tasks::{Object, Task};
use crate::errors::{Placement, VsdError, VsdOptions, add, adi, mspd, mssd, vsd};
use crate::results::Estimate;
use crate::scene_files::GroundTruth;

/// All errors of a task, `[estimate][ground truth]`; MSSD and ADD in diameters, MSPD in pixels scaled to an image
/// width of 640.
#[derive(Default)]
pub(super) struct TaskErrors {
    pub mssd: Vec<Vec<f64>>,
    pub mspd: Vec<Vec<f64>>,
    pub add: Vec<Vec<f64>>,
    /// `[tau][estimate][ground truth]`.
    pub vsd: Option<Vec<Vec<Vec<f64>>>>,
    /// Per pose to be found, the smallest ADD and ADI in metres.
    pub nearest: Vec<[f64; 2]>,
}

/// Largest error of the accuracy-threshold curves, metres.
pub(super) const LARGEST_AUC_ERROR: f64 = 0.1;

/// Errors of every estimate against every pose of a task.
pub(super) fn surface_and_projection(
    task: &Task<'_>,
    object: &Object,
    camera: &Camera,
    with_add: bool,
) -> TaskErrors {
    let width = 640.0 / camera.width as f64;
    let table = |error: &dyn Fn(&Placement, &Placement) -> f64| -> Vec<Vec<f64>> {
        let truth: Vec<Placement> = task.poses.iter().map(GroundTruth::placement).collect();
        let row = |e: &&Estimate| truth.iter().map(|g| error(&e.placement(), g)).collect();
        task.estimates.iter().map(row).collect()
    };
    // Poses further apart than a diameter are wrong at every threshold; the reference implementation skips them too.
    let apart = |e: &Placement, g: &Placement| e.distance_to(g) >= object.diameter;
    let d = object.diameter;
    TaskErrors {
        mssd: table(&|e, g| {
            if apart(e, g) { f64::INFINITY } else { mssd(&object.points, e, g, &object.symmetries) / d }
        }),
        mspd: table(&|e, g| width * mspd(&object.points, e, g, camera, &object.symmetries)),
        add: if with_add {
            table(&|e, g| match (apart(e, g), object.symmetric) {
                (true, _) => f64::INFINITY,
                (false, true) => adi(&object.points, e, g) / d,
                (false, false) => add(&object.points, e, g) / d,
            })
        } else {
            Vec::new()
        },
        vsd: None,
        nearest: if with_add { nearest_errors(task, object) } else { Vec::new() },
    }
}

/// For every target pose, the smallest ADD and the smallest ADI of the task's estimates, metres; infinite if the task
/// has no estimates.
fn nearest_errors(task: &Task<'_>, object: &Object) -> Vec<[f64; 2]> {
    let of = |g: &GroundTruth| {
        task.estimates.iter().fold([f64::INFINITY; 2], |[a, s], e| {
            let (e, g) = (e.placement(), g.placement());
            // Both errors are at least the distance of the centres of the two equal point sets minus both radii.
            if e.distance_to(&g) >= object.diameter + LARGEST_AUC_ERROR {
                return [a, s];
            }
            [a.min(add(&object.points, e, g)), s.min(adi(&object.points, e, g))]
        })
    };
    task.poses.iter().zip(&task.valid).filter(|(_, valid)| **valid).map(|(g, _)| of(g)).collect()
}

pub(super) fn visible_surface(
    task: &Task<'_>,
    object: &Object,
    camera: &Camera,
    test: &DepthImage,
    frame: &mut VisibilityBuffer,
    options: &VsdOptions,
) -> Result<Vec<Vec<Vec<f64>>>, VsdError> {
    let mut render = |pose: &Pose| {
        let shown = SceneObject { mesh: &object.mesh, camera_from_object: *pose };
        frame.render(&[shown], &RenderOptions::default());
        frame.depth()
    };
    let mut truth: Vec<Option<DepthImage>> = vec![None; task.poses.len()];
    let taus = options.taus.values().len();
    let mut by_tau = vec![vec![vec![1.0; task.poses.len()]; task.estimates.len()]; taus];
    for (i, estimate) in task.estimates.iter().enumerate() {
        let mut rendered = None;
        for (g, pose) in task.poses.iter().map(|p| &p.camera_from_object).enumerate() {
            if !spheres_overlap(&estimate.camera_from_object, pose, object.diameter) {
                continue;
            }
            let expected = &*truth[g].get_or_insert_with(|| render(pose));
            let shown = rendered.get_or_insert_with(|| render(&estimate.camera_from_object));
            let errors = vsd(shown, expected, test, camera, object.diameter, options)?;
            for (tau, error) in errors.into_iter().enumerate() {
                by_tau[tau][i][g] = error;
            }
        }
    }
    Ok(by_tau)
}

/// Whether the projections of the spheres around two poses can overlap (the reference's quick test).
fn spheres_overlap(a: &Pose, b: &Pose, diameter: f64) -> bool {
    let (a, b) = (a.translation(), b.translation());
    if a.z == 0.0 || b.z == 0.0 {
        return false;
    }
    let distance = ((a.x / a.z - b.x / b.z).powi(2) + (a.y / a.z - b.y / b.z).powi(2)).sqrt();
    distance < 0.5 * diameter * (1.0 / a.z + 1.0 / b.z)
}
