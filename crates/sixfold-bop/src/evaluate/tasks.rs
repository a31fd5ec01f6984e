//! The comparisons of each image: the target poses of each object, and the best estimates for them.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};

use rayon::prelude::*;
use sixfold_geometry::Pose;
use sixfold_mesh::{Mesh, ModelInfo};

use super::options::EvalError;
use crate::dataset::{BopDataset, Models, Scene, SceneImage};
use crate::dataset_error::DatasetError;
use crate::points::ModelPoints;
use crate::results::Estimate;
use crate::scene_files::{GroundTruth, Target, TargetObject};
use crate::score::by_falling_score;

/// An object's data for the errors.
pub(super) struct Object {
    pub points: ModelPoints,
    pub mesh: Mesh,
    pub diameter: f64,
    pub symmetries: Vec<Pose>,
    pub symmetric: bool,
}

/// One image and object: its targets and the best estimates for them.
pub(super) struct Task<'a> {
    pub obj_id: u32,
    /// All ground-truth poses of the object in the image, and which of them are to be found.
    pub poses: Vec<GroundTruth>,
    pub valid: Vec<bool>,
    pub visible: Vec<f64>,
    /// By falling score.
    pub estimates: Vec<&'a Estimate>,
}

pub(super) struct ImageTasks<'a> {
    pub scene_id: u32,
    pub im_id: u32,
    pub tasks: Vec<Task<'a>>,
}

pub(super) struct Prepared<'a> {
    pub scenes: BTreeMap<u32, Scene>,
    pub objects: BTreeMap<u32, Object>,
    /// Why an object cannot be scored.
    pub unusable: BTreeMap<u32, String>,
    pub images: Vec<ImageTasks<'a>>,
}

impl Task<'_> {
    /// Poses that are to be found.
    pub(super) fn wanted(&self) -> usize {
        self.valid.iter().filter(|v| **v).count()
    }
}

impl Prepared<'_> {
    /// Poses that are to be found.
    pub(super) fn wanted(&self) -> usize {
        self.wanted_of_objects().values().sum()
    }

    /// Number of target poses of each object.
    pub(super) fn wanted_of_objects(&self) -> BTreeMap<u32, usize> {
        let mut wanted = BTreeMap::new();
        for task in self.images.iter().flat_map(|i| &i.tasks) {
            *wanted.entry(task.obj_id).or_default() += task.wanted();
        }
        wanted
    }
}

/// Which ground truth counts and how many estimates are scored.
pub(super) enum Mode {
    Localisation { visib_gt_min: Option<f64> },
    Detection,
}

pub(super) type ByObject<'a> = BTreeMap<u32, Vec<&'a Estimate>>;

/// The tasks of all images with targets, and their objects.
pub(super) fn prepare<'a>(
    dataset: &BopDataset,
    estimates: &'a [Estimate],
    targets: &[Target],
    mode: &Mode,
    models: Models,
    max_symmetry_step: f64,
) -> Result<Prepared<'a>, EvalError> {
    let (scenes, images) = tasks_of_images(dataset, estimates, targets, mode)?;
    let ids: BTreeSet<u32> = images.iter().flat_map(|i| i.tasks.iter().map(|t| t.obj_id)).collect();
    let (objects, unusable) = load_objects(dataset, ids, models, max_symmetry_step)?;
    Ok(Prepared { scenes, objects, unusable, images })
}

type Images<'a> = (BTreeMap<u32, Scene>, Vec<ImageTasks<'a>>);

fn tasks_of_images<'a>(
    dataset: &BopDataset,
    estimates: &'a [Estimate],
    targets: &[Target],
    mode: &Mode,
) -> Result<Images<'a>, EvalError> {
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
    let none = ByObject::new();
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
        let found = by_image.get(&(scene_id, im_id)).unwrap_or(&none);
        let tasks = match mode {
            Mode::Localisation { visib_gt_min } => localisation_tasks(image, objects, found, *visib_gt_min),
            Mode::Detection => detection_tasks(image, found),
        };
        images.push(ImageTasks { scene_id, im_id, tasks });
    }
    Ok((scenes, images))
}

/// The poses of an object in an image, and the visible fraction of each; unknown counts as visible.
fn poses_of(image: &SceneImage, obj_id: u32) -> (Vec<GroundTruth>, Vec<f64>) {
    let fractions = image.visible_fractions();
    let of = image.ground_truth.iter().zip(&fractions).filter(|(g, _)| g.obj_id == obj_id);
    of.map(|(g, v)| (*g, v.unwrap_or(1.0))).unzip()
}

/// Every target object, with as many estimates as instances are requested.
fn localisation_tasks<'a>(
    image: &SceneImage,
    objects: &BTreeMap<u32, usize>,
    found: &ByObject<'a>,
    visib_gt_min: Option<f64>,
) -> Vec<Task<'a>> {
    let task = |(&obj_id, &count): (&u32, &usize)| {
        let (poses, visible) = poses_of(image, obj_id);
        let valid = match visib_gt_min {
            Some(minimum) => visible.iter().map(|v| *v >= minimum).collect(),
            None => most_visible(&visible, count),
        };
        let mut estimates = found.get(&obj_id).cloned().unwrap_or_default();
        by_falling_score(&mut estimates, |e| e.score);
        estimates.truncate(count);
        Task { obj_id, poses, valid, visible, estimates }
    };
    objects.iter().map(task).collect()
}

/// Every object with ground truth in the image. Estimates of other objects are false, but the reference implementation does not
/// compute their errors and so does not count them; neither does this one.
fn detection_tasks<'a>(image: &SceneImage, found: &ByObject<'a>) -> Vec<Task<'a>> {
    let ids: BTreeSet<u32> = image.ground_truth.iter().map(|g| g.obj_id).collect();
    let mut best = best_of_image(found, 100);
    let task = |obj_id| {
        let (poses, visible) = poses_of(image, obj_id);
        let valid = vec![true; poses.len()];
        let estimates = best.remove(&obj_id).unwrap_or_default();
        Task { obj_id, poses, valid, visible, estimates }
    };
    ids.into_iter().map(task).collect()
}

/// Objects that can be scored, and why the others cannot.
type Loaded = (BTreeMap<u32, Object>, BTreeMap<u32, String>);

fn load_objects(
    dataset: &BopDataset,
    ids: BTreeSet<u32>,
    models: Models,
    max_symmetry_step: f64,
) -> Result<Loaded, EvalError> {
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
            // A symmetry that the object does not have would make wrong poses count as right.
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
    Ok((objects, unusable))
}

/// Marks the `count` most visible poses; ties are broken by their order.
fn most_visible(visible: &[f64], count: usize) -> Vec<bool> {
    let mut order: Vec<usize> = (0..visible.len()).collect();
    by_falling_score(&mut order, |&i| visible[i]);
    let mut valid = vec![false; visible.len()];
    for &i in order.iter().take(count) {
        valid[i] = true;
    }
    valid
}

/// The `most` most confident estimates of an image, by object, each list by falling score.
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
