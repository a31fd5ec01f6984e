//! `sixfold eval`: scores on the screen, curves as a figure, JSON for scripts.

use std::path::PathBuf;

use anyhow::{Result, anyhow};
use clap::Args;
use serde::Serialize;
use sixfold_bop::{
    Adjustment, BopDataset, DetectionEvaluation, EvalOptions, Evaluation, Taus, VisibleTruth,
    detection_score_table, evaluate, evaluate_detection, read_results, read_results_lenient,
    score_detections, score_table, write_recall_curves,
};

use sixfold_shell::Outcome;
use sixfold_shell::datasets;
use sixfold_shell::frames::excepted;
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::pictures::Pictures;
use sixfold_shell::progress::Bar;
use sixfold_shell::ranges::{folder_name, in_range};

#[derive(Debug, Args)]
pub(crate) struct EvalArguments {
    /// BOP dataset folder
    #[arg(long, value_name = "DIR")]
    pub dataset: PathBuf,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Folder of the dataset's models, such as models_cad or models_reconst of T-LESS (default: models_eval, or models without it)
    #[arg(long, value_name = "FOLDER", value_parser = folder_name)]
    pub models: Option<String>,
    /// Targets file, or all: every annotated pose that is at least 10 % visible (default: the dataset's test_targets_bop19.json, or
    /// all without it; with --preset published all)
    #[arg(long, value_name = "FILE|all")]
    pub targets: Option<PathBuf>,
    /// Score only these objects (default: all)
    #[arg(long, value_name = "ID", value_delimiter = ',', conflicts_with_all = ["detections", "detection_ap"])]
    pub ids: Vec<u32>,
    /// Results in the BOP CSV format
    #[arg(long, value_name = "FILE.csv", required_unless_present = "detections")]
    pub results: Option<PathBuf>,
    /// COCO detections to score by box AP (and mask AP where they have masks)
    #[arg(long, value_name = "FILE.json", conflicts_with = "results")]
    pub detections: Option<PathBuf>,
    /// Leave out these frames, such as those used for training: JSON, [{"scene_id": 2, "im_id": 36}, ...]
    #[arg(long, value_name = "FILE")]
    pub except: Option<PathBuf>,
    /// With --detections: minimum score of detections that count for recall and false detections, 0 to 1
    #[arg(long, value_name = "SCORE", default_value = "0.4", value_parser = score)]
    pub min_score: f64,
    /// With --detections: ignore object ids, for a class-agnostic detector
    #[arg(long, requires = "detections", conflicts_with = "results")]
    pub one_class: bool,
    /// With --detections: write the ground truth as a COCO file
    #[arg(long, value_name = "FILE.json", requires = "detections", conflicts_with = "results")]
    pub write_truth: Option<PathBuf>,
    /// Also score as 6D detection (BOP'24: AP of MSSD and MSPD)
    #[arg(long)]
    pub detection_ap: bool,
    /// Skip broken rows of the result file, report them and score the rest (exit status 2)
    #[arg(long)]
    pub lenient: bool,
    /// Leave out VSD, which renders every pose
    #[arg(long)]
    pub no_vsd: bool,
    /// VSD as in the dissertation (table 3.6) and the benchmark of 2018: recall at an error below 0.3, tolerance 20 mm, nothing
    /// visible where depth is missing, every pose that is at least 10 % visible
    #[arg(long, value_parser = ["published"], conflicts_with_all = ["no_vsd", "detections"])]
    pub preset: Option<String>,
    /// VSD's tolerance of depth between the two poses, millimetres (default: 5 to 50 % of the diameter in ten steps; with --preset
    /// published: 20)
    #[arg(long, value_name = "MM", value_parser = vsd_tau, conflicts_with_all = ["no_vsd", "detections"])]
    pub vsd_tau: Option<f64>,
    /// VSD's error below which a pose is right, 0 to 1 (default: 0.05 to 0.5 in ten steps; with --preset published: 0.3)
    #[arg(long, value_name = "ERROR", value_parser = score, conflicts_with_all = ["no_vsd", "detections"])]
    pub vsd_threshold: Option<f64>,
    /// VSD's tolerance of depth in visibility, millimetres (default: as in the BOP Challenge, 5 for a dataset folder named itodd,
    /// 15 for all others)
    #[arg(long, value_name = "MM", conflicts_with_all = ["no_vsd", "detections"])]
    pub vsd_delta: Option<f64>,
    /// Plot of the recall curves
    #[arg(long, value_name = "FILE.png")]
    pub curves: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArguments,
}

/// A score from 0 to 1.
fn score(text: &str) -> Result<f64, String> {
    let score: f64 = text.parse().map_err(|error| format!("{error}"))?;
    if (0.0..=1.0).contains(&score) { Ok(score) } else { Err(format!("found {score}, expected 0 to 1")) }
}

/// A tolerance of VSD in millimetres.
fn vsd_tau(text: &str) -> Result<f64, String> {
    let tau = text.parse().ok().filter(|tau: &f64| *tau > 0.0 && *tau <= 1000.0);
    tau.ok_or_else(|| format!("found {text}, expected millimetres above 0, at most 1000"))
}

/// The id of all objects when object ids are ignored.
const ANY_OBJECT: u32 = 0;

#[derive(Serialize)]
struct Whole {
    #[serde(flatten)]
    localisation: Evaluation,
    #[serde(skip_serializing_if = "Option::is_none")]
    detection: Option<DetectionEvaluation>,
}

pub(crate) fn run(a: &EvalArguments) -> Result<Outcome> {
    let dataset = datasets::open(&a.dataset, &a.split, a.models.as_deref())?;
    if a.detections.is_some() {
        return coco(a, &dataset);
    }
    let path = a.results.as_deref().ok_or_else(|| anyhow!("--results FILE.csv is missing"))?;
    let (estimates, bad) =
        if a.lenient { read_results_lenient(path)? } else { (read_results(path)?, vec![]) };
    for row in &bad {
        eprintln!(
            "skipped {}: line {}, column {}: found {:?}, expected {}",
            path.display(),
            row.line,
            row.column,
            row.found,
            row.expected
        );
    }
    let mut targets = match (&a.targets, &a.preset) {
        (None, Some(_)) => dataset.all_targets()?,
        (file, _) => datasets::targets(&dataset, file.as_deref())?,
    };
    let left_out = excepted(&dataset, a.except.as_deref())?;
    targets.retain(|t| !left_out.contains(&(t.scene_id, t.im_id)));
    let targets = datasets::of_objects(&dataset, targets, &a.ids)?;
    let options = options(a)?;
    let bar = Bar::new("images");
    let localisation = evaluate(&dataset, &estimates, &targets, &options, &bar)?;
    bar.finish();
    let detection =
        a.detection_ap.then(|| evaluate_detection(&dataset, &estimates, &targets, &options)).transpose()?;
    let whole = Whole { localisation, detection };
    report(&a.json, &whole, || {
        print!("{}", score_table(&whole.localisation));
        if let Some(detection) = &whole.detection {
            print!("{}", detection_score_table(detection));
        }
    })?;
    let mut pictures = Pictures::default();
    if let Some(picture) = &a.curves {
        pictures.did(write_recall_curves(picture, &whole.localisation));
    }
    Ok(pictures.outcome(if !bad.is_empty() {
        Outcome::Incomplete
    } else if whole.localisation.estimates > 0 {
        Outcome::Found
    } else {
        Outcome::NothingFound
    }))
}

/// The evaluation options from the command line.
fn options(a: &EvalArguments) -> Result<EvalOptions> {
    let usual = EvalOptions::for_dataset(&a.dataset);
    let mut options = if a.preset.is_some() { EvalOptions::published() } else { usual };
    options.compute_vsd = !a.no_vsd;
    if let Some(millimetres) = a.vsd_delta {
        in_range("--vsd-delta", millimetres, 0.0..=1000.0)?;
        options.vsd.delta = 1e-3 * millimetres;
    }
    if let Some(millimetres) = a.vsd_tau {
        options.vsd.taus = Taus::Metres(vec![1e-3 * millimetres]);
    }
    if let Some(threshold) = a.vsd_threshold {
        options.vsd_thresholds = vec![threshold];
    }
    Ok(options)
}

/// COCO's box and mask AP of detections.
fn coco(a: &EvalArguments, dataset: &BopDataset) -> Result<Outcome> {
    let path = a.detections.as_deref().ok_or_else(|| anyhow!("--detections FILE.json is missing"))?;
    let mut read = dataset.detections(path, a.lenient)?;
    let mut incomplete = false;
    for changed in &read.adjusted {
        let kept = matches!(changed.adjustment, Adjustment::Clipped | Adjustment::Scene);
        eprintln!("{} {}", if kept { "note:" } else { "skipped" }, changed.message);
        incomplete |= !kept;
    }
    let mut images = dataset.images(a.targets.as_deref())?;
    for image in excepted(dataset, a.except.as_deref())? {
        images.remove(&image);
    }
    let mut truth = VisibleTruth::of_images(dataset, &images)?;
    if a.one_class {
        read.detections.iter_mut().for_each(|d| d.category_id = ANY_OBJECT);
        truth.truth.annotations.iter_mut().for_each(|t| t.category_id = ANY_OBJECT);
    }
    if !read.detections.is_empty()
        && !read.detections.iter().any(|d| images.contains(&(d.scene_id, d.image_id)))
    {
        eprintln!("note: none of the {} detections is of a scored image", read.detections.len());
    }
    if let Some(file) = &a.write_truth {
        truth.truth.write(file)?;
    }
    let value = serde_json::to_value(score_detections(&truth, &read.detections, a.min_score))?;
    report(&a.json, &value, || println!("{}", serde_json::to_string_pretty(&value).unwrap_or_default()))?;
    Ok(if incomplete {
        Outcome::Incomplete
    } else if read.detections.is_empty() {
        Outcome::NothingFound
    } else {
        Outcome::Found
    })
}
