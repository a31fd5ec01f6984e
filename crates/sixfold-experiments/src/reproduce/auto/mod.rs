//! `sixfold reproduce auto`: all methods search for objects that are in images and objects that are not, with depth, with colour
//! and with both. Measures how accurate the probabilities are, or fits them.
//!
//! The results of every image are stored in `rows/`, so that an interrupted run can be resumed.

mod mesh_error;
mod picture;
mod table;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};
use sixfold_align::{DepthOptions, PreparedDepth};
use sixfold_auto::{AutoEstimator, AutoMembers, AutoObject, Calibration, Fit, Numbers};
use sixfold_bop::{BopDataset, ModelPoints, Models, SceneImage, mssd};
use sixfold_estimator::{Cache, Object, PoseEstimate, PoseEstimator, Query, downcast};
use sixfold_geometry::random::stream;
use sixfold_geometry::{DepthImage, Pose, RgbImage};
use sixfold_mesh::{Mesh, ModelInfo, Unit, read_mesh};
use sixfold_runner::left_standing;
use sixfold_shell::Outcome;
use sixfold_shell::output::{JsonArguments, report, write_atomically};
use sixfold_shell::progress::{Progress, check_interrupt};
use sixfold_synth::augment::{ColorAugmentation, Patch};

use self::mesh_error::with_error;
use super::kept::{kept_or_made, same_inputs};

pub(super) const AFTER_HELP: &str = "Examples:\n  \
    sixfold simulate-scenes --families all --members 2 --toys 10 --scenes 24 --views 1 --out sim\n  \
    sixfold reproduce auto --dataset sim --absent 8 --disturb --out out/auto\n  \
    sixfold reproduce auto --dataset sim --absent 8 --disturb --fit calibration.json --out out/auto-fit\n\n\
    Finished images are kept. After a stop, the same command resumes.";

/// `sixfold reproduce auto`.
#[derive(Debug, Args)]
pub(crate) struct ReproduceAutoArguments {
    /// BOP dataset folders with ground truth
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    pub dataset: Vec<PathBuf>,
    /// Split of the datasets
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Take every N-th image
    #[arg(long, value_name = "N", default_value = "1")]
    pub every: std::num::NonZeroUsize,
    /// Number of absent objects of the dataset to search for in each image
    #[arg(long, value_name = "N", default_value = "0")]
    pub absent: usize,
    /// Meshes of objects that no image shows, to search for in every image
    #[arg(long, value_name = "MESH", num_args = 1..)]
    pub strangers: Vec<PathBuf>,
    /// Unit of these meshes
    #[arg(long, value_name = "UNIT", requires = "strangers")]
    pub unit: Option<Unit>,
    /// Images given to the methods
    #[arg(long, value_enum, num_args = 1.., default_values = ["depth", "both", "color"])]
    pub given: Vec<Given>,
    /// Vary the colours as with other lights and cameras, for rendered images
    #[arg(long)]
    pub disturb: bool,
    /// Search with meshes of the datasets whose size along each axis is wrong by this standard deviation; once with each
    #[arg(long, value_name = "FRACTION", num_args = 1.., default_value = "0", value_parser = mesh_error::parsed)]
    pub mesh_error: Vec<f64>,
    /// Run all methods, fit the probabilities to the results, and write them to this file
    #[arg(long, value_name = "FILE")]
    pub fit: Option<PathBuf>,
    /// Probabilities of this file instead of the built-in ones
    #[arg(long, value_name = "FILE", conflicts_with = "fit")]
    pub calibration: Option<PathBuf>,
    /// Use only methods on depth, not views
    #[arg(long)]
    pub without_views: bool,
    /// Seed of the choice of absent objects and of the disturbance
    #[arg(long, default_value = "0")]
    pub seed: u64,
    /// Folder for the table, its JSON, figures, and the results of finished images
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// What the methods are given of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Given {
    /// The depth image
    Depth,
    /// The colour image
    Color,
    /// Depth and colour
    Both,
}

impl Given {
    const ALL: [Given; 3] = [Given::Depth, Given::Color, Given::Both];

    fn name(self) -> &'static str {
        match self {
            Given::Depth => "depth",
            Given::Color => "colour",
            Given::Both => "depth and colour",
        }
    }
}

/// Minimum visible fraction of an object that is searched, as in BOP.
const MIN_VISIBLE: f64 = 0.1;
/// A pose is right within this fraction of the diameter (MSSD).
const RIGHT: f64 = 0.1;
/// Step at which a continuous symmetry is sampled, as a fraction of the diameter.
const SYMMETRY_STEP: f64 = 0.02;

/// An object that was searched in an image.
#[derive(Debug, Serialize, Deserialize)]
struct Search {
    object: String,
    given: Given,
    /// Whether the image shows it.
    present: bool,
    /// All poses found, the most probable first.
    poses: Vec<FoundPose>,
    /// The most probable pose together with its alternatives.
    together: Option<Together>,
    /// Whether the most probable pose is reported, but not when all these objects are searched at once: most of its pixels belong to a
    /// more probable pose of another.
    overruled: bool,
    seconds: f64,
}

/// A pose that was found.
#[derive(Debug, Serialize, Deserialize)]
struct FoundPose {
    method: String,
    numbers: Numbers,
    probability: f64,
    right: bool,
}

/// A pose together with its alternatives.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Together {
    /// The probability that one of them is right.
    probability: f64,
    /// Whether one of them is.
    right: bool,
}

#[derive(Serialize)]
struct Inputs {
    datasets: Vec<String>,
    split: String,
    every: usize,
    absent: usize,
    strangers: Vec<String>,
    given: Vec<Given>,
    disturb: bool,
    mesh_error: Vec<f64>,
    ask_all: bool,
    without_views: bool,
    calibration: Option<String>,
    seed: u64,
}

/// A dataset's object, prepared for search and scoring.
struct Known {
    prepared: Box<dyn sixfold_estimator::PreparedObject>,
    points: ModelPoints,
    symmetries: Vec<Pose>,
    diameter: f64,
    name: String,
}

pub(super) fn run(a: &ReproduceAutoArguments, json: &JsonArguments) -> Result<Outcome> {
    let text_of = |p: &PathBuf| p.display().to_string();
    same_inputs(
        &a.out,
        &Inputs {
            datasets: a.dataset.iter().map(text_of).collect(),
            split: a.split.clone(),
            every: a.every.get(),
            absent: a.absent,
            strangers: a.strangers.iter().map(text_of).collect(),
            given: a.given.clone(),
            disturb: a.disturb,
            mesh_error: a.mesh_error.clone(),
            ask_all: a.fit.is_some(),
            without_views: a.without_views,
            calibration: a.calibration.as_ref().map(text_of),
            seed: a.seed,
        },
    )?;
    let members = AutoMembers { without_views: a.without_views, seed: a.seed, ..AutoMembers::default() };
    let mut auto = members.estimator()?;
    auto.ask_all = a.fit.is_some();
    if let Some(file) = &a.calibration {
        auto = auto.with_calibration(Calibration::read(file).context("--calibration")?);
    }
    let strangers = strangers(a, &auto)?;
    let mut searches: Vec<Search> = vec![];
    for (number, root) in a.dataset.iter().enumerate() {
        for (pass, error) in a.mesh_error.iter().enumerate() {
            searches.extend(of_dataset(a, &auto, &strangers, [number, pass], *error, root)?);
        }
    }
    if let Some(file) = &a.fit {
        let fitted = fitted(&searches)?;
        write_atomically(file, fitted.to_text().as_bytes())?;
        for pose in searches.iter_mut().flat_map(|s| &mut s.poses) {
            pose.probability = fitted.probability(&pose.numbers);
        }
        searches.iter_mut().for_each(|s| s.poses.sort_by(|a, b| b.probability.total_cmp(&a.probability)));
    }
    let whole = table::Whole::of(&searches);
    let text = table::markdown(&whole);
    write_atomically(&a.out.join("table.md"), text.as_bytes())?;
    write_atomically(&a.out.join("reproduce.json"), serde_json::to_string_pretty(&whole)?.as_bytes())?;
    let picture = picture::reliability(&whole);
    sixfold_io::write_rgb(&a.out.join("reliability.png"), &picture)?;
    report(json, &whole, || {
        println!("{text}");
        println!("table.md, reproduce.json and reliability.png are in {}", a.out.display());
    })?;
    Ok(if searches.iter().any(|s| !s.poses.is_empty()) { Outcome::Found } else { Outcome::NothingFound })
}

/// The objects that no image shows.
fn strangers(a: &ReproduceAutoArguments, auto: &AutoEstimator) -> Result<Vec<Known>> {
    let mut known = vec![];
    for path in &a.strangers {
        let unit = a.unit.with_context(|| "--strangers needs --unit: meshes do not say theirs")?;
        let mesh = read_mesh(path, unit)?;
        let info = ModelInfo::of_mesh(&mesh);
        let name = path.display().to_string();
        known.push(know(auto, name, None, (mesh.clone(), info.clone()), (&mesh, &info))?);
    }
    Ok(known)
}

fn know(
    auto: &AutoEstimator,
    name: String,
    id: Option<u32>,
    (mesh, info): (Mesh, ModelInfo),
    (vertices, truth): (&Mesh, &ModelInfo),
) -> Result<Known> {
    let points = ModelPoints::new(vertices.vertices()).with_context(|| format!("{name}: no vertices"))?;
    let symmetries = truth.symmetry_poses(SYMMETRY_STEP);
    let diameter = truth.diameter;
    let folder = Cache::of_user().of_mesh(&mesh, &info)?;
    let prepared = auto.prepare(&Object { id, folder, ..Object::of_mesh(name.clone(), mesh, info) })?;
    Ok(Known { prepared, points, symmetries, diameter, name })
}

/// All searches in the images of dataset `number`; `pass` counts the errors of meshes.
fn of_dataset(
    a: &ReproduceAutoArguments,
    auto: &AutoEstimator,
    strangers: &[Known],
    [number, pass]: [usize; 2],
    mesh_error: f64,
    root: &std::path::Path,
) -> Result<Vec<Search>> {
    let dataset = BopDataset::open(root, &a.split)?;
    let Some(infos) = dataset.models_info(Models::Rendering)? else {
        bail!("{}: models/models_info.json is missing", root.display())
    };
    let mut images = vec![];
    for scene_id in dataset.scene_ids() {
        images.extend(dataset.scene(scene_id)?.image_ids().into_iter().map(|im_id| (scene_id, im_id)));
    }
    let images: Vec<(u32, u32)> = images.into_iter().step_by(a.every.get()).collect();
    let mut known: BTreeMap<u32, Known> = BTreeMap::new();
    let mut progress = Progress::new("images", images.len());
    let mut searches = vec![];
    for (scene_id, im_id) in images {
        check_interrupt("the results of finished images are kept; run the same command again to continue")?;
        let name = if pass == 0 { number.to_string() } else { format!("{number}-error{pass}") };
        let key = format!("{name}-{scene_id:06}-{im_id:06}");
        let scene = dataset.scene(scene_id)?;
        let image = scene.image(im_id)?;
        let made: Vec<Search> = kept_or_made(&a.out, &key, || {
            let shown: BTreeSet<u32> = image.ground_truth.iter().map(|g| g.obj_id).collect();
            let mut others: Vec<u32> = infos.0.keys().copied().filter(|id| !shown.contains(id)).collect();
            let seed = a.seed ^ (number as u64) << 48;
            let mut random = stream(seed, u64::from(scene_id) << 32 | u64::from(im_id));
            others.shuffle(&mut random);
            others.truncate(a.absent);
            let visible = visible(image);
            for id in visible.iter().chain(&others) {
                if !known.contains_key(id) {
                    let mesh = dataset.model(*id, Models::Rendering)?;
                    let info = infos.0.get(id).cloned().unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
                    let vertices = dataset.model(*id, Models::Evaluation)?;
                    let used = with_error(mesh, info.clone(), mesh_error, (seed, u64::from(*id)))?;
                    let name = format!("object {id}");
                    known.insert(*id, know(auto, name, Some(*id), used, (&vertices, &info))?);
                }
            }
            let mut rgb = scene.rgb(im_id)?;
            if let Some(image) = rgb.as_mut().filter(|_| a.disturb) {
                let mut patch = Patch::from_rgb(image);
                ColorAugmentation::renders().apply(&mut patch, &mut random);
                *image = patch.to_rgb();
            }
            let depth = scene.depth(im_id)?;
            let mut made = vec![];
            for given in a.given.iter().copied() {
                let objects = visible.iter().map(|id| (Some(*id), &known[id]));
                let objects = objects.chain(others.iter().map(|id| (None, &known[id])));
                let objects = objects.chain(strangers.iter().map(|k| (None, k)));
                let camera = scene.camera(im_id)?;
                made.extend(search(auto, given, &camera, (rgb.as_ref(), depth.as_ref()), image, objects)?);
            }
            Ok(made)
        })?;
        searches.extend(made);
        progress.step(format!("{scene_id}/{im_id}"));
    }
    progress.finish();
    Ok(searches)
}

/// The objects that an image shows well enough.
fn visible(image: &SceneImage) -> BTreeSet<u32> {
    let fractions = image.visible_fractions();
    let seen = |(_, v): &(_, Option<f64>)| v.is_none_or(|v| v >= MIN_VISIBLE);
    image.ground_truth.iter().zip(fractions).filter(seen).map(|(g, _)| g.obj_id).collect()
}

/// Searches objects in one image; those with a number are in it.
fn search<'k>(
    auto: &AutoEstimator,
    given: Given,
    camera: &sixfold_geometry::Camera,
    (rgb, depth): (Option<&RgbImage>, Option<&DepthImage>),
    image: &SceneImage,
    objects: impl Iterator<Item = (Option<u32>, &'k Known)>,
) -> Result<Vec<Search>> {
    let depth = depth.filter(|_| given != Given::Color);
    let rgb = rgb.filter(|_| given != Given::Depth);
    if (given != Given::Color && depth.is_none()) || (given != Given::Depth && rgb.is_none()) {
        return Ok(vec![]);
    }
    let options = DepthOptions::default();
    let prepared = depth.map(|d| PreparedDepth::new(d, camera, &options)).transpose()?;
    let prepared: Option<Arc<PreparedDepth>> = prepared;
    let query = Query { rgb, depth: prepared.as_ref(), ..Query::new(camera) };
    let mut searches: Vec<Search> = vec![];
    // The poses that would be reported, and the numbers of their searches.
    let (mut reported, mut of): (Vec<PoseEstimate>, Vec<usize>) = (vec![], vec![]);
    for (id, known) in objects {
        check_interrupt("the results of finished images are kept; run the same command again to continue")?;
        let truths: Vec<Pose> = image
            .ground_truth
            .iter()
            .filter(|g| Some(g.obj_id) == id)
            .map(|g| g.camera_from_object)
            .collect();
        let start = std::time::Instant::now();
        let object: &AutoObject = downcast(known.prepared.as_ref(), "auto")?;
        let (found, estimates) = auto.hypotheses(object, &query)?;
        let seconds = start.elapsed().as_secs_f64();
        let right = |pose: &Pose| {
            let off = |t: &Pose| mssd(&known.points, pose, t, &known.symmetries);
            truths.iter().any(|t| off(t) < RIGHT * known.diameter)
        };
        let best = estimates.into_iter().next();
        let together = best.as_ref().and_then(|best| {
            let mut all = std::iter::once(best).chain(&best.alternatives);
            let right = all.any(|e| right(&e.camera_from_object));
            Some(Together { probability: best.probability_with_alternatives()?, right })
        });
        if let Some(best) = best.filter(|_| together.is_some_and(|t| t.probability >= table::REPORTED)) {
            reported.push(best);
            of.push(searches.len());
        }
        let poses = found
            .iter()
            .map(|h| FoundPose {
                method: h.method.to_owned(),
                numbers: h.numbers,
                probability: h.probability,
                right: right(&h.estimate.camera_from_object),
            })
            .collect();
        let object = known.name.clone();
        searches.push(Search {
            object,
            given,
            present: id.is_some(),
            poses,
            together,
            overruled: false,
            seconds,
        });
    }
    let stands = left_standing(&reported.iter().collect::<Vec<_>>());
    for (number, stands) in of.into_iter().zip(stands) {
        searches[number].overruled = !stands;
    }
    Ok(searches)
}

/// The probabilities fitted to all poses, scaled to those that would be reported.
fn fitted(searches: &[Search]) -> Result<Calibration> {
    let rows = |given: Given| -> Vec<Fit<'_>> {
        let of = searches.iter().filter(move |s| s.given == given);
        of.flat_map(|s| &s.poses).map(|p| Fit { numbers: &p.numbers, right: p.right }).collect()
    };
    let all = [rows(Given::Depth), rows(Given::Color), rows(Given::Both)];
    let first = Calibration::fitted([(&all[0], &all[0]), (&all[1], &all[1]), (&all[2], &all[2])])?;
    let reported = |given: Given| -> Vec<Fit<'_>> {
        let best = |s: &'_ Search| -> Option<usize> {
            let of = |k: usize| first.probability(&s.poses[k].numbers);
            (0..s.poses.len()).max_by(|a, b| of(*a).total_cmp(&of(*b)))
        };
        let of = searches.iter().filter(move |s| s.given == given);
        of.filter_map(|s| best(s).map(|k| &s.poses[k]))
            .map(|p| Fit { numbers: &p.numbers, right: p.right })
            .collect()
    };
    let best = [reported(Given::Depth), reported(Given::Color), reported(Given::Both)];
    Ok(Calibration::fitted([(&all[0], &best[0]), (&all[1], &best[1]), (&all[2], &best[2])])?)
}
