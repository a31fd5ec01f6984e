//! `sixfold reproduce pix2pose`: the method's tables on a dataset from one command, row by row, resumable.
//!
//! Test targets are those of the dataset outside the frames on which the model was trained. Every row is one variant of using the
//! model; its poses (`rows/KEY.csv`, BOP's format) and scores (`rows/KEY.json`) stay in the output folder and are not computed
//! again.

mod fourfold;
mod model;
mod row;
mod table;
mod trainings;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use serde::Serialize;
use sixfold_bop::{BopDataset, Models, Target, read_results};
use sixfold_geometry::{FrameId, Rect};
use sixfold_mesh::Mesh;
use sixfold_pix2pose::estimate::{Pix2PoseOptions, Quirks};

use self::model::Pix2Pose;
use self::row::{Row, Setting};
use super::kept::{kept_or_made, same_inputs, write_table};
use sixfold_runner::RegionSource;
use sixfold_shell::Outcome;
use sixfold_shell::datasets;
use sixfold_shell::output::JsonArguments;
use sixfold_shell::progress::check_interrupt;
use sixfold_shell::ranges::folder_name;
use sixfold_shell::training::was_trained_on;

#[derive(Debug, Args)]
pub(crate) struct ReproducePix2PoseArguments {
    /// BOP dataset folder with ground truth
    #[arg(long, value_name = "DIR")]
    pub dataset: PathBuf,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Folder of the dataset's models, such as models_cad or models_reconst of T-LESS (default: models, or models_eval without it;
    /// for scores the reverse)
    #[arg(long, value_name = "FOLDER", value_parser = folder_name)]
    pub models: Option<String>,
    /// Frames that the model was trained on, which are left out: JSON as for `sixfold train pix2pose`
    #[arg(long, value_name = "FILE")]
    pub frames: PathBuf,
    /// Trained model
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: PathBuf,
    /// Folder for the table, its JSON, and the finished rows
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Also evaluate with the boxes of this file of COCO detections; may be given several times
    #[arg(long, value_name = "FILE.json")]
    pub detections: Vec<PathBuf>,
    /// Score these published results (BOP's CSV) on the same targets, for comparison
    #[arg(long, value_name = "FILE.csv")]
    pub published: Option<PathBuf>,
    /// Every eighth frame only
    #[arg(long)]
    pub quick: bool,
    /// Also train the networks of the training ablations (hours)
    #[arg(long)]
    pub train: bool,
    /// Steps of these trainings
    #[arg(long, value_name = "N", default_value = "1500", requires = "train")]
    pub steps: u64,
    /// Side of these networks' input in pixels
    #[arg(long, value_name = "PIXELS", default_value = "96", requires = "train")]
    pub size: usize,
    /// Folder of photographs for the backgrounds of these trainings (default: procedural textures)
    #[arg(long, value_name = "DIR", requires = "train")]
    pub backgrounds: Option<PathBuf>,
    /// Seed of the boxes' noise, of RANSAC and of the trainings
    #[arg(long, default_value = "0")]
    pub seed: u64,
}

/// The inputs of all rows. Rows made from other inputs are not mixed with these.
#[derive(Debug, PartialEq, Serialize)]
struct Inputs {
    version: &'static str,
    dataset: String,
    split: String,
    models: Option<String>,
    weights: String,
    /// FNV-1a of the weight file.
    weights_hash: String,
    /// Frames left out, `scene/image`.
    trained_on: Vec<String>,
    published: Option<String>,
    quick: bool,
    seed: u64,
}

#[derive(Serialize)]
struct Whole {
    inputs: Inputs,
    frames: usize,
    targets: usize,
    rows: Vec<Row>,
    /// Values from the dissertation and the challenge, not measured here.
    literature: BTreeMap<&'static str, f64>,
}

/// Dataset, test targets and boxes.
struct Bench {
    dataset: BopDataset,
    targets: Vec<Target>,
    meshes: BTreeMap<u32, Mesh>,
    /// Visible ground-truth boxes by scene, image and object.
    truth: Regions,
    detections: Vec<Detections>,
    seed: u64,
}

/// A file of detections.
struct Detections {
    /// The file's name without its extension.
    name: String,
    /// FNV-1a of the file, which distinguishes the rows of different files.
    hash: u64,
    regions: Regions,
}

/// Boxes and their scores by scene, image and object.
type Regions = BTreeMap<(u32, u32, u32), Vec<(Rect, f64)>>;

/// The boxes of all targets.
fn regions(
    dataset: &BopDataset,
    targets: &[Target],
    meshes: &BTreeMap<u32, Mesh>,
    boxes: &RegionSource,
) -> Result<Regions> {
    let mut all = Regions::new();
    let mut scenes = BTreeMap::new();
    for t in targets {
        let Some(o) = t.object else { continue };
        if let std::collections::btree_map::Entry::Vacant(place) = scenes.entry(t.scene_id) {
            place.insert(dataset.scene(t.scene_id)?);
        }
        let Some(scene) = scenes.get(&t.scene_id) else { continue };
        let found = boxes.of_target(scene, t, &o, |id| meshes.get(&id))?;
        let found = found.into_iter().map(|r| (r.bbox, r.score)).collect();
        all.insert((t.scene_id, t.im_id, o.obj_id), found);
    }
    Ok(all)
}

/// Every n-th frame with `--quick`.
const QUICK: usize = 8;

pub(crate) fn run(a: &ReproducePix2PoseArguments, json: &JsonArguments) -> Result<Outcome> {
    let pix2pose = Pix2Pose::load(&a.weights)?;
    let dataset = datasets::open(&a.dataset, &a.split, a.models.as_deref())?;
    let trained_on: BTreeSet<(u32, u32)> =
        dataset.targets(Some(&a.frames))?.iter().map(|t| (t.scene_id, t.im_id)).collect();
    let targets = test_targets(a, &dataset, &trained_on, &pix2pose)?;
    let inputs = Inputs {
        version: env!("CARGO_PKG_VERSION"),
        dataset: a.dataset.display().to_string(),
        split: a.split.clone(),
        models: a.models.clone(),
        weights: a.weights.display().to_string(),
        weights_hash: format!(
            "{:016x}",
            sixfold_io::fnv1a(&std::fs::read(&a.weights).with_context(|| a.weights.display().to_string())?)
        ),
        trained_on: trained_on.iter().map(|(scene, image)| format!("{scene}/{image}")).collect(),
        published: a.published.as_ref().map(|f| f.display().to_string()),
        quick: a.quick,
        seed: a.seed,
    };
    same_inputs(&a.out, &inputs)?;
    let bench = Bench::new(a, dataset, targets, &pix2pose)?;
    let mut rows = vec![];
    for setting in settings(&bench) {
        check_interrupt("the finished rows are kept; run the same command again to continue")?;
        let used = setting.of(&pix2pose, a.seed);
        rows.push(kept_or_made(&a.out, &setting.key, || bench.measure(&used, &setting, &a.out))?);
    }
    if let Some(file) = &a.published {
        rows.push(kept_or_made(&a.out, "published", || {
            let name = file.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            bench.scored(
                "published",
                &format!("published: {name}"),
                "its own",
                &read_results(file)?,
                vec![],
                0,
            )
        })?);
    }
    if a.train {
        rows.extend(trainings::rows(a, &bench)?);
    }
    let frames: BTreeSet<(u32, u32)> = bench.targets.iter().map(|t| (t.scene_id, t.im_id)).collect();
    let literature = BTreeMap::from([
        ("dissertation, LM-O, Pix2Pose: mean over objects of ADD(-S) recall", 0.320),
        ("BOP Challenge 2020, LM-O, Pix2Pose from RGB: AR (VSD, MSSD, MSPD)", 0.363),
    ]);
    let result = Whole { inputs, frames: frames.len(), targets: bench.targets.len(), rows, literature };
    write_table(
        &a.out,
        &table::markdown(&result),
        &result,
        "table.md, reproduce.json and the rows are",
        json,
    )?;
    let any = result.rows.first().is_some_and(|r| r.found > 0);
    Ok(if any { Outcome::Found } else { Outcome::NothingFound })
}

/// The compared variants of using the model.
fn settings(bench: &Bench) -> Vec<Setting> {
    let plain = Setting::plain;
    let mut all = vec![
        Setting { refine: true, ..plain("default", "two stages, PnP, outline aligned, refined (default)") },
        Setting { refine: true, refiner: false, ..plain("no-refiner", "default, without the refiner") },
        Setting {
            refine: true,
            correct: false,
            ..plain("uncorrected", "default, without the training photographs' correction")
        },
        Setting {
            refine: true,
            edges: false,
            ..plain("no-edges", "default, borders by network and colour histograms alone, not by edges")
        },
        Setting {
            refine: true,
            passes: 2,
            ..plain("two-passes", "default, with a second pass into the box of the aligned pose")
        },
        plain("no-refinement", "two stages, PnP"),
    ];
    let mut published =
        plain("as-published", "as published: theta_i 0.1, theta_re 3 px, EPnP, centroid, no open candidate");
    (published.options, published.correct) = (Pix2PoseOptions::published(), false);
    all.push(published);
    let mut one_stage = plain("one-stage", "one stage, PnP");
    one_stage.options.two_stages = false;
    all.push(one_stage);
    let none = Quirks::default();
    let quirks = [
        (
            "bug-recentring",
            "two stages, PnP, author's code: shift of the second crop not scaled",
            Quirks { unscaled_recentring: true, ..none },
        ),
        (
            "bug-eight-bits",
            "two stages, PnP, author's code: coordinates in 8 bits",
            Quirks { eight_bits: true, ..none },
        ),
        (
            "bug-centre-choice",
            "two stages, PnP, author's code: candidate chosen by its centre",
            Quirks { centre_choice: true, ..none },
        ),
        (
            "bug-plain-pnp",
            "two stages, author's code: EPnP, 5 px, 100 iterations",
            Quirks { plain_pnp: true, ..none },
        ),
        ("bugs-all", "two stages, author's code: all four", Quirks::all()),
    ];
    for (key, title, quirks) in quirks {
        let mut setting = plain(key, title);
        setting.options.quirks = quirks;
        all.push(setting);
    }
    for (key, percent) in [("noise-05", 5), ("noise-10", 10), ("noise-20", 20)] {
        let title = format!("default, boxes moved and scaled by up to {percent} % of their size");
        all.push(Setting { refine: true, noise: Some(f64::from(percent) / 100.0), ..plain(key, &title) });
    }
    for (number, d) in bench.detections.iter().enumerate() {
        let key = format!("detections-{}-{:08x}", d.name, d.hash as u32);
        let title = format!("default, boxes of {}", d.name);
        all.push(Setting { refine: true, detections: Some(number), ..plain(&key, &title) });
        let title = format!("two stages, PnP, boxes of {}", d.name);
        let key = format!("{key}-no-refinement");
        all.push(Setting { detections: Some(number), ..plain(&key, &title) });
    }
    all
}

/// The dataset's targets outside the training frames, for the objects of the model.
fn test_targets(
    a: &ReproducePix2PoseArguments,
    dataset: &BopDataset,
    trained_on: &BTreeSet<(u32, u32)>,
    pix2pose: &Pix2Pose,
) -> Result<Vec<Target>> {
    let mut targets = dataset.object_targets(&dataset.targets(None)?)?;
    targets.retain(|t| !trained_on.contains(&(t.scene_id, t.im_id)));
    let known = |t: &Target| t.object.is_some_and(|o| pix2pose.model().object(o.obj_id).is_ok());
    let others = targets.iter().filter(|t| !known(t)).count();
    if others > 0 {
        eprintln!("note: {others} targets are left out: the model was not trained on their objects");
        targets.retain(known);
    }
    // The model's card states its training frames: scores on them would be meaningless.
    let card = pix2pose.model().card();
    for t in &targets {
        let frame = FrameId::new(t.scene_id, t.im_id);
        if was_trained_on(card, &a.weights, frame)? {
            let all: Vec<String> = card.training_frames.iter().flatten().map(FrameId::to_string).collect();
            bail!(
                "{}: the model was trained on frame {frame}, which {} does not list; give the frames of its training (its card says: {})",
                a.weights.display(),
                a.frames.display(),
                all.join(" ")
            );
        }
    }
    if a.quick {
        let frames: BTreeSet<(u32, u32)> = targets.iter().map(|t| (t.scene_id, t.im_id)).collect();
        let some: BTreeSet<(u32, u32)> = frames.into_iter().step_by(QUICK).collect();
        targets.retain(|t| some.contains(&(t.scene_id, t.im_id)));
    }
    if targets.is_empty() {
        bail!(
            "{}: no target is left to test on: all frames are in {}, or none shows an object of the model",
            a.dataset.display(),
            a.frames.display()
        );
    }
    Ok(targets)
}

impl Bench {
    /// All targets of a dataset, in their ground-truth boxes.
    fn of_dataset(root: &Path, seed: u64) -> Result<Bench> {
        let dataset = BopDataset::open(root, "test")?;
        let targets = dataset.object_targets(&dataset.targets(None)?)?;
        let mut meshes = BTreeMap::new();
        for id in targets.iter().filter_map(|t| t.object).map(|o| o.obj_id).collect::<BTreeSet<_>>() {
            meshes.insert(id, dataset.model(id, Models::Rendering)?);
        }
        let truth = regions(&dataset, &targets, &meshes, &RegionSource::GroundTruth)?;
        Ok(Bench { dataset, targets, meshes, truth, detections: vec![], seed })
    }

    fn new(
        a: &ReproducePix2PoseArguments,
        dataset: BopDataset,
        targets: Vec<Target>,
        pix2pose: &Pix2Pose,
    ) -> Result<Bench> {
        let mut meshes = BTreeMap::new();
        for id in targets.iter().filter_map(|t| t.object).map(|o| o.obj_id).collect::<BTreeSet<_>>() {
            let mesh = dataset.model(id, Models::Rendering)?;
            pix2pose.check_mesh(id, &mesh, &format!("{}: model {id}", a.dataset.display()))?;
            meshes.insert(id, mesh);
        }
        let truth = regions(&dataset, &targets, &meshes, &RegionSource::GroundTruth)?;
        let mut detections = vec![];
        for file in &a.detections {
            let (boxes, changed, skipped) = RegionSource::read(&dataset, file)?;
            changed.iter().for_each(|note| eprintln!("note: {note}"));
            for s in skipped {
                eprintln!("skipped {s}");
            }
            let hash = sixfold_io::fnv1a(&std::fs::read(file).with_context(|| file.display().to_string())?);
            let name = file.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            detections.push(Detections {
                name,
                hash,
                regions: regions(&dataset, &targets, &meshes, &boxes)?,
            });
        }
        Ok(Bench { dataset, targets, meshes, truth, detections, seed: a.seed })
    }
}
