//! Scores of a result file on a dataset: BOP'19 localisation (AR of VSD, MSSD, MSPD), ADD(-S) recall, and BOP'24
//! detection (AP of MSSD and MSPD).
//!
//! Definitions as in the BOP Challenge's evaluation (Hodan et al. 2020; docs of bop_toolkit): errors of the top
//! `inst_count` estimates per image and object against the most visible `inst_count` poses, greedy matching per
//! threshold, recall over all targets, mean over thresholds.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use rayon::prelude::*;
use serde::Serialize;
use sixfold_geometry::{Camera, DepthImage, Pose, Progress};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};
use thiserror::Error;

use crate::dataset::{BopDataset, Models, Scene};
use crate::dataset_error::DatasetError;
use crate::errors::{Placement, Taus, VsdError, VsdOptions, add, adi, mspd, mssd, vsd};
use crate::points::ModelPoints;
use crate::results::Estimate;
use crate::scene_files::{GroundTruth, Target, TargetObject};
use crate::score::{
    area_under_accuracy, average_precision, by_falling_score, fractions_05_to_50, greedy_matches,
    pixels_5_to_50,
};

/// How an evaluation is done. The default is the BOP Challenge's.
#[derive(Debug, Clone, PartialEq)]
pub struct EvalOptions {
    /// Step of discretised continuous symmetries, as a fraction of the diameter.
    pub max_symmetry_step: f64,
    /// VSD's tolerances.
    pub vsd: VsdOptions,
    /// A pose is right by VSD if its error is below a threshold; recall is the mean over these.
    pub vsd_thresholds: Vec<f64>,
    /// Compute VSD at all: it renders every estimate and every target.
    pub compute_vsd: bool,
    /// Which poses are targets: `None` takes the `inst_count` most visible ones (BOP'19), a number takes those with
    /// at least that visible fraction.
    pub visib_gt_min: Option<f64>,
    /// Steps of the recall curves.
    pub curve_steps: usize,
    /// Which model folder.
    pub models: Models,
}

impl Default for EvalOptions {
    fn default() -> Self {
        EvalOptions {
            max_symmetry_step: 0.01,
            vsd: VsdOptions::default(),
            vsd_thresholds: fractions_05_to_50(),
            compute_vsd: true,
            visib_gt_min: None,
            curve_steps: 50,
            models: Models::Evaluation,
        }
    }
}

/// Why an evaluation cannot be done at all.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EvalError {
    /// An option is out of range.
    #[error("option {field}: found {found}, expected {expected}")]
    Option {
        /// Name of the option.
        field: &'static str,
        /// What it held.
        found: f64,
        /// What it should hold.
        expected: &'static str,
    },
    /// The dataset is broken.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A depth image does not fit (cannot happen with images that passed the size check).
    #[error(transparent)]
    Vsd(#[from] VsdError),
    /// Whoever received the progress asked to stop.
    #[error("the evaluation was stopped")]
    Stopped,
}

/// The delta of ITODD in the BOP Challenge, metres; of all others it is the default.
const ITODD: (&str, f64) = ("itodd", 0.005);
/// Threshold of VSD and least visible fraction of a pose that is to be found, in the benchmark of 2018 (Hodan, Michel et al. 2018,
/// section 4.2) and in table 3.6 of the dissertation.
const PUBLISHED: (f64, f64) = (0.3, 0.1);

impl EvalOptions {
    /// Those of the BOP Challenge for the dataset in a folder, which is known by its name.
    pub fn for_dataset(folder: &Path) -> EvalOptions {
        let mut options = EvalOptions::default();
        if folder.file_name().is_some_and(|name| name.eq_ignore_ascii_case(ITODD.0)) {
            options.vsd.delta = ITODD.1;
        }
        options
    }

    /// Those of the benchmark of 2018, by which the dissertation scores T-LESS (section 3.4.4): VSD below 0.3 with a tolerance of
    /// 20 mm, of every pose that is at least 10 % visible.
    pub fn published() -> EvalOptions {
        let (threshold, visible) = PUBLISHED;
        EvalOptions {
            vsd: VsdOptions::published(),
            vsd_thresholds: vec![threshold],
            visib_gt_min: Some(visible),
            ..EvalOptions::default()
        }
    }

    /// How VSD is averaged, in words; `None` as in the BOP Challenge, where it counts for AR.
    fn vsd_protocol(&self) -> Option<String> {
        let usual = EvalOptions::default();
        let same = self.vsd.taus == usual.vsd.taus
            && self.vsd_thresholds == usual.vsd_thresholds
            && self.vsd.missing_is_visible == usual.vsd.missing_is_visible;
        if same {
            return None;
        }
        let list = |values: &[f64], factor: f64| {
            let texts: Vec<String> =
                values.iter().map(|v| format!("{}", (v * factor * 1e6).round() / 1e6)).collect();
            texts.join(", ")
        };
        let taus = match &self.vsd.taus {
            Taus::Diameters(values) => format!("{} diameters", list(values, 1.0)),
            Taus::Metres(values) => format!("{} mm", list(values, 1000.0)),
        };
        let missing =
            if self.vsd.missing_is_visible { "" } else { ", nothing visible where depth is missing" };
        Some(format!("VSD below {} at tolerances of {taus}{missing}", list(&self.vsd_thresholds, 1.0)))
    }

    /// Tests every field.
    ///
    /// # Errors
    /// [`EvalError::Option`].
    pub fn check(&self) -> Result<(), EvalError> {
        let test = |ok: bool, field, found, expected| {
            if ok { Ok(()) } else { Err(EvalError::Option { field, found, expected }) }
        };
        let step = self.max_symmetry_step;
        test((1e-4..=1.0).contains(&step), "max_symmetry_step", step, "a fraction from 0.0001 to 1")?;
        let delta = self.vsd.delta;
        test(delta.is_finite() && delta >= 0.0, "vsd.delta", delta, "metres, zero or more")?;
        let taus = self.vsd.taus.values();
        test(!taus.is_empty(), "vsd.taus", 0.0, "at least one tau")?;
        for &tau in taus {
            test(
                tau.is_finite() && tau > 0.0,
                "vsd.taus",
                tau,
                "fractions of the diameter, or metres, above zero",
            )?;
        }
        test(!self.vsd_thresholds.is_empty(), "vsd_thresholds", 0.0, "at least one threshold")?;
        for &threshold in &self.vsd_thresholds {
            test((0.0..=1.0).contains(&threshold), "vsd_thresholds", threshold, "errors from 0 to 1")?;
        }
        let visible = self.visib_gt_min.unwrap_or(0.0);
        test((0.0..=1.0).contains(&visible), "visib_gt_min", visible, "a fraction from 0 to 1")?;
        let steps = self.curve_steps;
        test((1..=10_000).contains(&steps), "curve_steps", steps as f64, "from 1 to 10000")
    }
}

/// Recall against threshold.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecallCurves {
    /// Unit of the thresholds: `diameters`, `pixels (image 640 wide)` or `discrepancy`.
    pub unit: &'static str,
    /// The thresholds, ascending from zero.
    pub thresholds: Vec<f64>,
    /// Recall of each object at each threshold, by object id.
    pub objects: BTreeMap<String, Vec<f64>>,
    /// Recall over all targets.
    pub mean: Vec<f64>,
}

/// The curves of an evaluation, `None` for errors that could not be computed.
#[derive(Debug, Clone, PartialEq, Serialize, Default)]
pub struct Curves {
    /// Maximum symmetry-aware surface distance.
    pub mssd: Option<RecallCurves>,
    /// Maximum symmetry-aware projection distance.
    pub mspd: Option<RecallCurves>,
    /// Visible surface discrepancy, mean over the taus.
    pub vsd: Option<RecallCurves>,
    /// ADD, or ADI for symmetric objects.
    pub add: Option<RecallCurves>,
}

/// The scores of one object.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ObjectScores {
    /// Poses to be found.
    pub targets: usize,
    /// Average recall of VSD.
    pub ar_vsd: Option<f64>,
    /// Average recall of MSSD.
    pub ar_mssd: Option<f64>,
    /// Average recall of MSPD.
    pub ar_mspd: Option<f64>,
    /// Recall of ADD (ADI for symmetric objects) at 10 % of the diameter.
    pub add_s_recall: Option<f64>,
}

/// The scores of a result file. A score that cannot be computed is `None` and `reasons` has why, under its name.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    /// Mean of the three average recalls.
    pub ar: Option<f64>,
    /// Average recall of VSD, over taus and thresholds; of one each, the recall.
    pub ar_vsd: Option<f64>,
    /// How VSD counts, where it is not as in the BOP Challenge.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vsd_protocol: Option<String>,
    /// Average recall of MSSD, over thresholds .05 to .5 diameters.
    pub ar_mssd: Option<f64>,
    /// Average recall of MSPD, over thresholds 5 to 50 px at an image width of 640.
    pub ar_mspd: Option<f64>,
    /// Recall of ADD (ADI for symmetric objects) at 10 % of the diameter: by object id, `mean` over all targets (each
    /// pose counts the same), `mean_over_objects` (each object counts the same).
    pub add_s_recall: BTreeMap<String, Option<f64>>,
    /// Area under the accuracy-threshold curve of ADD to 10 cm, over all targets (PoseCNN, Xiang et al. 2018).
    pub add_auc: Option<f64>,
    /// The same of ADD-S, taken for every object, symmetric or not.
    pub add_s_auc: Option<f64>,
    /// Why a score is missing.
    pub reasons: BTreeMap<String, String>,
    /// Poses to be found.
    pub targets: usize,
    /// Estimates that were compared with ground truth.
    pub estimates: usize,
    /// Estimates of images or objects that are no targets, or beyond the number of instances asked for.
    pub estimates_left_out: usize,
    /// Mean seconds per image.
    pub average_time_per_image: Option<f64>,
    /// By object id.
    pub objects: BTreeMap<String, ObjectScores>,
    /// Recall against threshold.
    pub curves: Curves,
}

/// An object as the errors need it.
struct Object {
    points: ModelPoints,
    mesh: Mesh,
    diameter: f64,
    symmetries: Vec<Pose>,
    symmetric: bool,
}

/// One image and object: its targets and the best estimates for them.
struct Task<'a> {
    obj_id: u32,
    /// All ground-truth poses of the object in the image, and which of them are to be found.
    poses: Vec<GroundTruth>,
    valid: Vec<bool>,
    visible: Vec<f64>,
    /// By falling score.
    estimates: Vec<&'a Estimate>,
}

/// All errors of a task, `[estimate][ground truth]`; MSSD and ADD in diameters, MSPD scaled to a width of 640.
#[derive(Default)]
struct TaskErrors {
    mssd: Vec<Vec<f64>>,
    mspd: Vec<Vec<f64>>,
    add: Vec<Vec<f64>>,
    /// `[tau][estimate][ground truth]`.
    vsd: Option<Vec<Vec<Vec<f64>>>>,
    /// Per pose to be found, the smallest ADD and ADI in metres.
    nearest: Vec<[f64; 2]>,
}

struct ImageTasks<'a> {
    scene_id: u32,
    im_id: u32,
    tasks: Vec<Task<'a>>,
}

struct Prepared<'a> {
    scenes: BTreeMap<u32, Scene>,
    objects: BTreeMap<u32, Object>,
    /// Why an object cannot be scored.
    unusable: BTreeMap<u32, String>,
    images: Vec<ImageTasks<'a>>,
}

/// Which ground truth counts and how many estimates are scored.
enum Mode {
    Localisation { visib_gt_min: Option<f64> },
    Detection,
}

type ByObject<'a> = BTreeMap<u32, Vec<&'a Estimate>>;

fn prepare<'a>(
    dataset: &BopDataset,
    estimates: &'a [Estimate],
    targets: &[Target],
    mode: &Mode,
    models: Models,
    max_symmetry_step: f64,
) -> Result<Prepared<'a>, EvalError> {
    let mut by_image: BTreeMap<(u32, u32), ByObject<'a>> = BTreeMap::new();
    for estimate in estimates {
        let objects = by_image.entry((estimate.scene_id, estimate.im_id)).or_default();
        objects.entry(estimate.obj_id).or_default().push(estimate);
    }
    let mut wanted: BTreeMap<(u32, u32), BTreeMap<u32, usize>> = BTreeMap::new();
    for target in targets {
        let image = wanted.entry((target.scene_id, target.im_id)).or_default();
        if let Some(TargetObject { obj_id, inst_count }) = target.object {
            image.insert(obj_id, inst_count);
        }
    }
    let mut scenes: BTreeMap<u32, Scene> = BTreeMap::new();
    let mut images = Vec::new();
    for (&(scene_id, im_id), objects) in &wanted {
        let scene = match scenes.entry(scene_id) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => new.insert(dataset.scene(scene_id)?),
        };
        if !scene.has_ground_truth() {
            return Err(EvalError::Dataset(DatasetError::Missing {
                path: scene.dir().join("scene_gt.json"),
                what: "the ground truth",
                advice: "only images with ground truth can be scored",
            }));
        }
        let image = scene.image(im_id)?;
        let fractions = image.visible_fractions();
        let of_object = |obj_id: u32| {
            let of = image.ground_truth.iter().zip(&fractions).filter(move |(g, _)| g.obj_id == obj_id);
            let (poses, visible): (Vec<GroundTruth>, Vec<f64>) =
                of.map(|(g, v)| (*g, v.unwrap_or(1.0))).unzip();
            (poses, visible)
        };
        let found = by_image.get(&(scene_id, im_id));
        let sorted = |obj_id: u32| {
            let mut list = found.and_then(|f| f.get(&obj_id)).cloned().unwrap_or_default();
            by_falling_score(&mut list, |e| e.score);
            list
        };
        let mut tasks = Vec::new();
        match mode {
            Mode::Localisation { visib_gt_min } => {
                for (&obj_id, &count) in objects {
                    let (poses, visible) = of_object(obj_id);
                    let valid = match visib_gt_min {
                        Some(least) => visible.iter().map(|v| v >= least).collect(),
                        None => most_visible(&visible, count),
                    };
                    let mut estimates = sorted(obj_id);
                    estimates.truncate(count);
                    tasks.push(Task { obj_id, poses, valid, visible, estimates });
                }
            }
            Mode::Detection => {
                // Every object with ground truth in the image; estimates of others are false, but the reference
                // never computes their errors and so never counts them. Here likewise.
                let ids: BTreeSet<u32> = image.ground_truth.iter().map(|g| g.obj_id).collect();
                let best = found.map(|f| best_of_image(f, 100)).unwrap_or_default();
                for obj_id in ids {
                    let (poses, visible) = of_object(obj_id);
                    let valid = vec![true; poses.len()];
                    let estimates = best.get(&obj_id).cloned().unwrap_or_default();
                    tasks.push(Task { obj_id, poses, valid, visible, estimates });
                }
            }
        }
        images.push(ImageTasks { scene_id, im_id, tasks });
    }

    let ids: BTreeSet<u32> = images.iter().flat_map(|i| i.tasks.iter().map(|t| t.obj_id)).collect();
    let info = dataset.named_models_info(models)?;
    let mut objects = BTreeMap::new();
    let mut unusable = BTreeMap::new();
    let loaded: Vec<_> = ids.into_par_iter().map(|id| (id, dataset.model(id, models))).collect();
    for (obj_id, mesh) in loaded {
        let mesh = match mesh {
            Ok(mesh) => mesh,
            Err(error @ DatasetError::NoModel { .. }) => {
                unusable.insert(obj_id, error.to_string());
                continue;
            }
            Err(error) => return Err(error.into()),
        };
        if let Some((file, infos)) = info {
            // A symmetry that the object does not have makes wrong poses right.
            infos.check_symmetries(obj_id, &mesh, file).map_err(|e| DatasetError::Model(Box::new(e)))?;
        }
        let known: Option<&ModelInfo> = info.as_ref().and_then(|(_, i)| i.0.get(&obj_id));
        let (Some(known), Some(points)) = (known, ModelPoints::new(mesh.vertices())) else {
            let reason = format!("models_info.json has no object {obj_id}: diameter and symmetries unknown");
            unusable.insert(obj_id, reason);
            continue;
        };
        let symmetries = known.symmetry_poses(max_symmetry_step);
        let symmetric = known.is_symmetric();
        objects.insert(obj_id, Object { points, mesh, diameter: known.diameter, symmetries, symmetric });
    }
    Ok(Prepared { scenes, objects, unusable, images })
}

/// Marks the `count` most visible poses; equally visible ones in their order.
fn most_visible(visible: &[f64], count: usize) -> Vec<bool> {
    let mut order: Vec<usize> = (0..visible.len()).collect();
    by_falling_score(&mut order, |&i| visible[i]);
    let mut valid = vec![false; visible.len()];
    for &i in order.iter().take(count) {
        valid[i] = true;
    }
    valid
}

/// The `most` surest estimates of an image, by object, each list by falling score.
fn best_of_image<'a>(objects: &ByObject<'a>, most: usize) -> ByObject<'a> {
    let mut all: Vec<&Estimate> = objects.values().flatten().copied().collect();
    by_falling_score(&mut all, |e| e.score);
    all.truncate(most);
    let mut best = ByObject::new();
    for estimate in all {
        best.entry(estimate.obj_id).or_default().push(estimate);
    }
    best
}

/// Largest error of the accuracy-threshold curves, metres.
const LARGEST_AUC_ERROR: f64 = 0.1;

/// Errors of every estimate against every pose of a task.
fn surface_and_projection(task: &Task<'_>, object: &Object, camera: &Camera, with_add: bool) -> TaskErrors {
    let width = 640.0 / camera.width as f64;
    let table = |error: &dyn Fn(&Placement, &Placement) -> f64| -> Vec<Vec<f64>> {
        let truth: Vec<Placement> = task.poses.iter().map(GroundTruth::placement).collect();
        let row = |e: &&Estimate| truth.iter().map(|g| error(&e.placement(), g)).collect();
        task.estimates.iter().map(row).collect()
    };
    // Further apart than a diameter is wrong at every threshold; the reference does not look closer either.
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

/// For every pose that is to be found, the smallest ADD and the smallest ADI of the task's estimates, metres; infinite
/// where there is none.
fn nearest_errors(task: &Task<'_>, object: &Object) -> Vec<[f64; 2]> {
    let of = |g: &GroundTruth| {
        task.estimates.iter().fold([f64::INFINITY; 2], |[a, s], e| {
            let (e, g) = (e.placement(), g.placement());
            // Neither can be smaller than what separates the centres of two equal point sets by more than both radii.
            if e.distance_to(&g) >= object.diameter + LARGEST_AUC_ERROR {
                return [a, s];
            }
            [a.min(add(&object.points, e, g)), s.min(adi(&object.points, e, g))]
        })
    };
    task.poses.iter().zip(&task.valid).filter(|(_, valid)| **valid).map(|(g, _)| of(g)).collect()
}

fn visible_surface(
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

/// Recall at a threshold: found and wanted per object.
struct Counts(BTreeMap<u32, (usize, usize)>);

impl Counts {
    fn recall(&self, obj_id: u32) -> Option<f64> {
        let &(found, wanted) = self.0.get(&obj_id)?;
        (wanted > 0).then(|| found as f64 / wanted as f64)
    }

    fn overall(&self) -> Option<f64> {
        let (found, wanted) = self.0.values().fold((0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        (wanted > 0).then(|| found as f64 / wanted as f64)
    }
}

type Scored<'p, 'a> = (&'p Task<'a>, TaskErrors);

fn count(
    scored: &[Scored<'_, '_>],
    errors: impl Fn(&TaskErrors) -> &Vec<Vec<f64>>,
    threshold: f64,
) -> Counts {
    let mut counts = BTreeMap::new();
    for (task, all) in scored {
        let found = greedy_matches(errors(all), &task.valid, threshold).into_iter().flatten().count();
        let wanted = task.valid.iter().filter(|v| **v).count();
        let entry = counts.entry(task.obj_id).or_insert((0, 0));
        entry.0 += found;
        entry.1 += wanted;
    }
    Counts(counts)
}

/// Mean recall over thresholds, overall and per object.
fn average(list: &[Counts]) -> (Option<f64>, BTreeMap<u32, f64>) {
    let mean = |values: Vec<Option<f64>>| -> Option<f64> {
        let n = values.len();
        values.into_iter().sum::<Option<f64>>().filter(|_| n > 0).map(|sum| sum / n as f64)
    };
    let overall = mean(list.iter().map(Counts::overall).collect());
    let ids = list.first().map(|c| c.0.keys().copied().collect::<Vec<_>>()).unwrap_or_default();
    let of = |id: u32| mean(list.iter().map(|c| c.recall(id)).collect());
    (overall, ids.into_iter().filter_map(|id| Some((id, of(id)?))).collect())
}

fn curves(unit: &'static str, list: &[(f64, Counts)]) -> Option<RecallCurves> {
    let mean: Option<Vec<f64>> = list.iter().map(|(_, c)| c.overall()).collect();
    let ids: Vec<u32> = list.first()?.1.0.keys().copied().collect();
    let of = |id: u32| list.iter().map(|(_, c)| c.recall(id)).collect::<Option<Vec<f64>>>();
    Some(RecallCurves {
        unit,
        thresholds: list.iter().map(|(t, _)| *t).collect(),
        objects: ids.into_iter().filter_map(|id| Some((id.to_string(), of(id)?))).collect(),
        mean: mean?,
    })
}

/// Mean seconds per image, where every estimate has a time and those of an image agree.
fn average_time(estimates: &[Estimate]) -> Result<f64, String> {
    let mut times: BTreeMap<(u32, u32), f64> = BTreeMap::new();
    for estimate in estimates {
        let (scene, image) = (estimate.scene_id, estimate.im_id);
        let Some(time) = estimate.time else {
            return Err(format!("no time is given for scene {scene}, image {image}"));
        };
        let known = *times.entry((scene, image)).or_insert(time);
        if (known - time).abs() > 1e-3 {
            return Err(format!("the estimates of scene {scene}, image {image} give {known} s and {time} s"));
        }
    }
    if times.is_empty() {
        return Err("there are no estimates".to_owned());
    }
    Ok(times.values().sum::<f64>() / times.len() as f64)
}

/// Scores estimates on a dataset.
///
/// `targets` as from [`BopDataset::targets`]; those of whole images are spelled out from the ground truth. `progress`
/// receives every image. The result is the same at any number of threads.
///
/// # Errors
/// [`EvalError`] when an option is out of range or a file of the dataset is broken. What is merely not there (depth,
/// a model) leaves scores empty, with reasons. [`EvalError::Stopped`] where `progress` says so.
pub fn evaluate(
    dataset: &BopDataset,
    estimates: &[Estimate],
    targets: &[Target],
    options: &EvalOptions,
    progress: &dyn Progress,
) -> Result<Evaluation, EvalError> {
    options.check()?;
    let targets = dataset.object_targets(targets)?;
    let mode = Mode::Localisation { visib_gt_min: options.visib_gt_min };
    let prepared = prepare(dataset, estimates, &targets, &mode, options.models, options.max_symmetry_step)?;
    let Prepared { scenes, objects, unusable, images } = &prepared;

    let mut reasons = BTreeMap::new();
    let wanted: usize = images.iter().flat_map(|i| &i.tasks).flat_map(|t| &t.valid).filter(|v| **v).count();
    let nothing = if wanted == 0 {
        Some("there is no pose to be found: no target has ground truth".to_owned())
    } else if unusable.is_empty() {
        None
    } else {
        Some(unusable.values().cloned().collect::<Vec<_>>().join("; "))
    };
    let without_depth = images.iter().filter(|i| scenes[&i.scene_id].depth_path(i.im_id).is_none()).count();
    let no_vsd = if !options.compute_vsd {
        Some("VSD was not asked for".to_owned())
    } else if without_depth > 0 {
        Some(format!("{without_depth} of {} images with targets have no depth image", images.len()))
    } else {
        objects
            .iter()
            .find(|(_, o)| o.mesh.faces().is_empty())
            .map(|(id, _)| format!("the model of object {id} has no faces and cannot be rendered"))
    };

    let done = std::sync::atomic::AtomicUsize::new(0);
    let scored: Vec<Vec<Scored<'_, '_>>> = images
        .par_iter()
        .map(|image| -> Result<_, EvalError> {
            let scene = &scenes[&image.scene_id];
            let camera = scene.camera(image.im_id)?;
            let test = if no_vsd.is_none() { scene.depth(image.im_id)? } else { None };
            let mut frame = test.as_ref().map(|_| VisibilityBuffer::new(&camera));
            let mut scored = Vec::new();
            for task in &image.tasks {
                let Some(object) = objects.get(&task.obj_id) else { continue };
                let mut errors = surface_and_projection(task, object, &camera, true);
                if let (Some(test), Some(frame)) = (&test, &mut frame) {
                    errors.vsd = Some(visible_surface(task, object, &camera, test, frame, &options.vsd)?);
                }
                scored.push((task, errors));
            }
            let finished = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
            if progress.report(finished, images.len()) { Ok(scored) } else { Err(EvalError::Stopped) }
        })
        .collect::<Result<_, _>>()?;
    let scored: Vec<Scored<'_, '_>> = scored.into_iter().flatten().collect();

    let at = |errors: fn(&TaskErrors) -> &Vec<Vec<f64>>, thresholds: &[f64]| -> Vec<Counts> {
        thresholds.iter().map(|&t| count(&scored, errors, t)).collect()
    };
    let steps = options.curve_steps;
    let curve = |errors: fn(&TaskErrors) -> &Vec<Vec<f64>>, unit, largest: f64| {
        let thresholds: Vec<f64> = (0..=steps).map(|i| largest * i as f64 / steps as f64).collect();
        let counts = at(errors, &thresholds);
        curves(unit, &thresholds.into_iter().zip(counts).collect::<Vec<_>>())
    };
    let fractions = fractions_05_to_50();
    let (ar_mssd, mssd_of) = average(&at(|e| &e.mssd, &fractions));
    let (ar_mspd, mspd_of) = average(&at(|e| &e.mspd, &pixels_5_to_50()));
    let add_counts = count(&scored, |e| &e.add, 0.1);
    let (mut ar_vsd, mut vsd_of, mut vsd_curve) = (None, BTreeMap::new(), None);
    if no_vsd.is_none() && scored.iter().all(|(_, e)| e.vsd.is_some()) {
        let by_tau = |tau: usize, threshold: f64| {
            count(&scored, |e| e.vsd.as_ref().map_or(&e.mssd, |v| &v[tau]), threshold)
        };
        let taus = options.vsd.taus.values().len();
        let all: Vec<Counts> = (0..taus)
            .flat_map(|tau| options.vsd_thresholds.iter().map(move |&t| (tau, t)))
            .map(|(a, b)| by_tau(a, b))
            .collect();
        (ar_vsd, vsd_of) = average(&all);
        // Found and wanted summed over the taus: the mean recall.
        let list: Vec<(f64, Counts)> = (0..=steps)
            .map(|i| {
                let threshold = i as f64 / steps as f64;
                let mut sum: BTreeMap<u32, (usize, usize)> = BTreeMap::new();
                for tau in 0..taus {
                    for (id, (found, wanted)) in by_tau(tau, threshold).0 {
                        let entry = sum.entry(id).or_default();
                        *entry = (entry.0 + found, entry.1 + wanted);
                    }
                }
                (threshold, Counts(sum))
            })
            .collect();
        vsd_curve = curves("discrepancy", &list);
    }

    let mut per_object = BTreeMap::new();
    let mut add_s_recall = BTreeMap::new();
    let mut targets_of: BTreeMap<u32, usize> = BTreeMap::new();
    for task in images.iter().flat_map(|i| &i.tasks) {
        *targets_of.entry(task.obj_id).or_default() += task.valid.iter().filter(|v| **v).count();
    }
    for (&id, &targets) in &targets_of {
        let add = add_counts.recall(id);
        add_s_recall.insert(id.to_string(), add);
        if add.is_none() {
            let no_pose = || "no pose of this object is to be found".to_owned();
            let reason = unusable.get(&id).cloned().unwrap_or_else(no_pose);
            reasons.insert(format!("add_s_recall.{id}"), reason);
        }
        let (ar_vsd, ar_mssd, ar_mspd) =
            (vsd_of.get(&id).copied(), mssd_of.get(&id).copied(), mspd_of.get(&id).copied());
        per_object
            .insert(id.to_string(), ObjectScores { targets, ar_vsd, ar_mssd, ar_mspd, add_s_recall: add });
    }
    let of_objects: Vec<f64> = targets_of.keys().filter_map(|&id| add_counts.recall(id)).collect();
    let over_objects =
        (!of_objects.is_empty()).then(|| of_objects.iter().sum::<f64>() / of_objects.len() as f64);

    let complete = nothing.is_none();
    let keep = |value: Option<f64>| value.filter(|_| complete);
    add_s_recall.insert("mean".to_owned(), keep(add_counts.overall()));
    add_s_recall.insert("mean_over_objects".to_owned(), keep(over_objects));
    if let Some(reason) = &nothing {
        for score in ["ar", "ar_vsd", "ar_mssd", "ar_mspd", "add_s_recall"] {
            reasons.insert(score.to_owned(), reason.clone());
        }
    }
    if let Some(reason) = &no_vsd {
        reasons.insert("ar_vsd".to_owned(), reason.clone());
        reasons.entry("ar".to_owned()).or_insert_with(|| format!("needs ar_vsd: {reason}"));
    }
    let vsd_protocol = options.vsd_protocol();
    if vsd_protocol.is_some() {
        reasons.entry("ar".to_owned()).or_insert_with(|| "needs VSD as in the BOP Challenge".to_owned());
    }
    let (ar_vsd, ar_mssd, ar_mspd) = (keep(ar_vsd), keep(ar_mssd), keep(ar_mspd));
    let ar = match (ar_vsd, ar_mssd, ar_mspd) {
        (Some(a), Some(b), Some(c)) if vsd_protocol.is_none() => Some((a + b + c) / 3.0),
        _ => None,
    };
    let average_time_per_image = match average_time(estimates) {
        Ok(time) => Some(time),
        Err(reason) => {
            reasons.insert("average_time_per_image".to_owned(), reason);
            None
        }
    };
    let area = |which: usize| -> Option<f64> {
        let errors: Vec<f64> = scored.iter().flat_map(|(_, e)| &e.nearest).map(|n| n[which]).collect();
        keep(area_under_accuracy(&errors, LARGEST_AUC_ERROR))
    };
    let (add_auc, add_s_auc) = (area(0), area(1));
    let compared: usize = scored.iter().map(|(task, _)| task.estimates.len()).sum();
    Ok(Evaluation {
        ar,
        ar_vsd,
        vsd_protocol,
        ar_mssd,
        ar_mspd,
        add_s_recall,
        add_auc,
        add_s_auc,
        reasons,
        targets: wanted,
        estimates: compared,
        estimates_left_out: estimates.len() - compared,
        average_time_per_image,
        objects: per_object,
        curves: Curves {
            mssd: curve(|e| &e.mssd, "diameters", 0.5),
            mspd: curve(|e| &e.mspd, "pixels (image 640 wide)", 50.0),
            vsd: vsd_curve,
            add: curve(|e| &e.add, "diameters", 0.2),
        },
    })
}

/// Scores of 6D detection (BOP'24): every instance of every object is to be found, false detections cost.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DetectionEvaluation {
    /// Mean of the two.
    pub ap: Option<f64>,
    /// Average precision over MSSD thresholds .05 to .5 diameters, mean over objects.
    pub ap_mssd: Option<f64>,
    /// Average precision over MSPD thresholds 5 to 50 px at a width of 640, mean over objects.
    pub ap_mspd: Option<f64>,
    /// Average precision over MSSD thresholds 2 to 20 mm, mean over objects (BOP'25).
    pub ap_mssd_mm: Option<f64>,
    /// The mean of `ap_mssd` and `ap_mspd` of each object, by id.
    pub objects: BTreeMap<String, f64>,
    /// Why a score is missing.
    pub reasons: BTreeMap<String, String>,
}

/// Scores estimates as 6D detections (BOP Challenge 2024): per image the 100 surest estimates count; ground truth
/// below 10 % visibility (unknown counts as visible) is neither missed nor found.
///
/// # Errors
/// As [`evaluate`].
pub fn evaluate_detection(
    dataset: &BopDataset,
    estimates: &[Estimate],
    targets: &[Target],
    options: &EvalOptions,
) -> Result<DetectionEvaluation, EvalError> {
    options.check()?;
    let prepared =
        prepare(dataset, estimates, targets, &Mode::Detection, options.models, options.max_symmetry_step)?;
    let least = options.visib_gt_min.unwrap_or(0.1);
    let scored: Vec<Vec<Scored<'_, '_>>> = prepared
        .images
        .par_iter()
        .map(|image| -> Result<_, EvalError> {
            let camera = prepared.scenes[&image.scene_id].camera(image.im_id)?;
            let usable = image.tasks.iter().filter_map(|t| Some((t, prepared.objects.get(&t.obj_id)?)));
            Ok(usable.map(|(task, o)| (task, surface_and_projection(task, o, &camera, false))).collect())
        })
        .collect::<Result<_, _>>()?;
    let scored: Vec<Scored<'_, '_>> = scored.into_iter().flatten().collect();
    let mut by_object: BTreeMap<u32, Vec<&Scored<'_, '_>>> = BTreeMap::new();
    for item in &scored {
        by_object.entry(item.0.obj_id).or_default().push(item);
    }
    let precision = |list: &[&Scored<'_, '_>], errors: &dyn Fn(&TaskErrors) -> &Vec<Vec<f64>>, th: f64| {
        let mut positives = 0;
        let mut found: Vec<(f64, bool)> = Vec::new();
        for (task, all) in list {
            positives += task.visible.iter().filter(|v| **v >= least).count();
            let matches = greedy_matches(errors(all), &task.valid, th);
            for (estimate, matched) in task.estimates.iter().zip(matches) {
                match matched {
                    Some(g) if task.visible[g] < least => {}
                    other => found.push((estimate.score, other.is_some())),
                }
            }
        }
        by_falling_score(&mut found, |f| f.0);
        let right: Vec<bool> = found.into_iter().map(|f| f.1).collect();
        average_precision(&right, positives)
    };
    let mean_over =
        |list: &[&Scored<'_, '_>], errors: &dyn Fn(&TaskErrors) -> &Vec<Vec<f64>>, ths: &[f64]| {
            let all: Option<Vec<f64>> = ths.iter().map(|&th| precision(list, errors, th)).collect();
            all.map(|all| all.iter().sum::<f64>() / all.len() as f64)
        };
    let mut objects = BTreeMap::new();
    let (mut mssd_all, mut mspd_all, mut mm_all) = (Vec::new(), Vec::new(), Vec::new());
    for (&id, list) in &by_object {
        let diameter = prepared.objects[&id].diameter;
        let millimetres: Vec<f64> = (1..=10).map(|i| 2e-3 * f64::from(i) / diameter).collect();
        let mssd = mean_over(list, &|e| &e.mssd, &fractions_05_to_50());
        let mspd = mean_over(list, &|e| &e.mspd, &pixels_5_to_50());
        let mm = mean_over(list, &|e| &e.mssd, &millimetres);
        if let (Some(mssd), Some(mspd), Some(mm)) = (mssd, mspd, mm) {
            mssd_all.push(mssd);
            mspd_all.push(mspd);
            mm_all.push(mm);
            objects.insert(id.to_string(), 0.5 * (mssd + mspd));
        }
    }
    let mut reasons = BTreeMap::new();
    if !prepared.unusable.is_empty() {
        let reason = prepared.unusable.values().cloned().collect::<Vec<_>>().join("; ");
        reasons.insert("ap".to_owned(), reason);
    } else if mssd_all.is_empty() {
        reasons.insert("ap".to_owned(), "no visible ground truth in the target images".to_owned());
    }
    let complete = reasons.is_empty();
    let mean = |all: &[f64]| complete.then(|| all.iter().sum::<f64>() / all.len() as f64);
    let (ap_mssd, ap_mspd) = (mean(&mssd_all), mean(&mspd_all));
    let ap = ap_mssd.zip(ap_mspd).map(|(a, b)| 0.5 * (a + b));
    Ok(DetectionEvaluation { ap, ap_mssd, ap_mspd, ap_mssd_mm: mean(&mm_all), objects, reasons })
}
