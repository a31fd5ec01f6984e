//! `sixfold eval`: scores on the screen, curves as a figure, JSON for scripts.

use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::{Context, Result, anyhow};
use clap::Args;
use serde::Serialize;
use sixfold_bop::{
    Adjustment, BopDataset, CocoGroundTruth, DetectionEvaluation, EvalOptions, Evaluation, IouType,
    ReadDetections, VisibleTruth, evaluate, evaluate_coco, evaluate_detection, found_at_half,
    read_detections, read_results, read_results_lenient, write_recall_curves,
};

use sixfold_shell::Outcome;
use sixfold_shell::frames::excepted;
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::progress::Progress;
use sixfold_shell::ranges::in_range;

#[derive(Debug, Args)]
pub(crate) struct EvalArguments {
    /// BOP dataset folder
    #[arg(long, value_name = "DIR")]
    pub dataset: PathBuf,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Targets file (default: the dataset's test_targets_bop19.json, or all ground truth)
    #[arg(long, value_name = "FILE")]
    pub targets: Option<PathBuf>,
    /// Results in the BOP CSV format
    #[arg(long, value_name = "FILE.csv", required_unless_present = "detections")]
    pub results: Option<PathBuf>,
    /// COCO detections to score by box AP (and mask AP where they have masks)
    #[arg(long, value_name = "FILE.json", conflicts_with = "results")]
    pub detections: Option<PathBuf>,
    /// Leave out these frames, such as those of a training: JSON, [{"scene_id": 2, "im_id": 36}, ...]
    #[arg(long, value_name = "FILE")]
    pub except: Option<PathBuf>,
    /// With --detections: score from which on detections count for recall and false detections, 0 to 1
    #[arg(long, value_name = "SCORE", default_value = "0.4")]
    pub min_score: f64,
    /// With --detections: write the ground truth that they were scored with as a COCO file
    #[arg(long, value_name = "FILE.json", requires = "detections")]
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
    /// Plot of the recall curves
    #[arg(long, value_name = "FILE.png")]
    pub curves: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Serialize)]
struct Whole {
    #[serde(flatten)]
    localisation: Evaluation,
    #[serde(skip_serializing_if = "Option::is_none")]
    detection: Option<DetectionEvaluation>,
}

pub(crate) fn run(a: &EvalArguments) -> Result<Outcome> {
    in_range("--min-score", a.min_score, 0.0..=1.0)?;
    let dataset = BopDataset::open(&a.dataset, &a.split)?;
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
    let mut targets = dataset.targets(a.targets.as_deref())?;
    let left_out = excepted(&dataset, a.except.as_deref())?;
    targets.retain(|t| !left_out.contains(&(t.scene_id, t.im_id)));
    let options = EvalOptions { compute_vsd: !a.no_vsd, ..EvalOptions::default() };
    let progress = std::sync::Mutex::new(None);
    let localisation = evaluate(&dataset, &estimates, &targets, &options, &|p| {
        if let Ok(mut bar) = progress.lock() {
            bar.get_or_insert_with(|| Progress::new("images", p.total)).set(p.done);
        }
    })?;
    if let Ok(Some(bar)) = progress.into_inner() {
        bar.finish();
    }
    let detection =
        a.detection_ap.then(|| evaluate_detection(&dataset, &estimates, &targets, &options)).transpose()?;
    if let Some(picture) = &a.curves {
        write_recall_curves(picture, &localisation)?;
    }
    let any = localisation.estimates > 0;
    let whole = Whole { localisation, detection };
    report(&a.json, &whole, || print_table(&whole))?;
    Ok(if !bad.is_empty() {
        Outcome::Incomplete
    } else if any {
        Outcome::Found
    } else {
        Outcome::NothingFound
    })
}

/// A score with three digits, `-` where it cannot be computed.
fn digits(score: Option<f64>) -> String {
    score.map_or_else(|| "-".into(), |s| format!("{s:.3}"))
}

pub(super) fn print_evaluation(e: &Evaluation) {
    println!(
        "{:>8} {:>8} {:>8} {:>8} {:>8} {:>12}",
        "object", "targets", "AR_VSD", "AR_MSSD", "AR_MSPD", "ADD(-S)<0.1d"
    );
    let mut objects: Vec<_> = e.objects.iter().collect();
    objects.sort_by_key(|(id, _)| id.parse::<u32>().unwrap_or(u32::MAX));
    for (id, o) in objects {
        println!(
            "{id:>8} {:>8} {:>8} {:>8} {:>8} {:>12}",
            o.targets,
            digits(o.ar_vsd),
            digits(o.ar_mssd),
            digits(o.ar_mspd),
            digits(o.add_s_recall)
        );
    }
    println!(
        "{:>8} {:>8} {:>8} {:>8} {:>8} {:>12}",
        "all",
        e.targets,
        digits(e.ar_vsd),
        digits(e.ar_mssd),
        digits(e.ar_mspd),
        digits(e.add_s_recall.get("mean").copied().flatten())
    );
    println!(
        "AR {}   AUC of ADD {}, of ADD-S {} (to 10 cm)",
        digits(e.ar),
        digits(e.add_auc),
        digits(e.add_s_auc)
    );
    for (score, reason) in &e.reasons {
        println!("{score} not computed: {reason}");
    }
    if let Some(t) = e.average_time_per_image {
        println!("{t:.2} s per image");
    }
}

fn print_table(whole: &Whole) {
    print_evaluation(&whole.localisation);
    if let Some(d) = &whole.detection {
        println!(
            "6D detection (BOP'24): AP {} AP_MSSD {} AP_MSPD {}",
            digits(d.ap),
            digits(d.ap_mssd),
            digits(d.ap_mspd)
        );
        for (score, reason) in &d.reasons {
            println!("{score} not computed: {reason}");
        }
    }
}

/// Box and mask AP of detections, in COCO's terms.
fn coco(a: &EvalArguments, dataset: &BopDataset) -> Result<Outcome> {
    let path = a.detections.as_deref().ok_or_else(|| anyhow!("--detections FILE.json is missing"))?;
    let read =
        read_detections(path, &ReadDetections { lenient: a.lenient, image_size: dataset.image_size() })?;
    let mut incomplete = false;
    for changed in &read.adjusted {
        let clipped = changed.adjustment == Adjustment::Clipped;
        eprintln!("{} {}", if clipped { "note:" } else { "skipped" }, changed.message);
        incomplete |= !clipped;
    }
    let truth = coco_truth(a, dataset)?;
    if let Some(file) = &a.write_truth {
        truth.truth.write(file)?;
    }
    let boxes = evaluate_coco(&truth.truth, &read.detections, IouType::Box);
    let with_masks = read.detections.iter().any(|d| d.segmentation.is_some())
        && truth.truth.annotations.iter().any(|a| a.segmentation.is_some());
    let masks = with_masks.then(|| evaluate_coco(&truth.truth, &read.detections, IouType::Mask));
    let known = truth.visible.len() == truth.truth.annotations.len();
    let min_visibility: &[f64] = if known { &[0.1, 0.4] } else { &[] };
    let found: Vec<_> =
        min_visibility.iter().map(|v| found_at_half(&truth, &read.detections, a.min_score, *v)).collect();
    let value = serde_json::json!({
        "images": truth.truth.images.len(),
        "box": boxes,
        "mask": masks,
        "found_at_half": found,
    });
    report(&a.json, &value, || println!("{}", serde_json::to_string_pretty(&value).unwrap_or_default()))?;
    Ok(if incomplete {
        Outcome::Incomplete
    } else if read.detections.is_empty() {
        Outcome::NothingFound
    } else {
        Outcome::Found
    })
}

/// The ground truth of the dataset's images, or of those of the targets but `--except`: as its `scene_gt_coco.json` says,
/// or from poses where a scene has none.
fn coco_truth(a: &EvalArguments, dataset: &BopDataset) -> Result<VisibleTruth> {
    let mut images: BTreeSet<(u32, u32)> = BTreeSet::new();
    match &a.targets {
        Some(file) => images.extend(dataset.targets(Some(file))?.iter().map(|t| (t.scene_id, t.im_id))),
        None => {
            for scene_id in dataset.scene_ids() {
                images
                    .extend(dataset.scene(scene_id)?.image_ids().into_iter().map(|im_id| (scene_id, im_id)));
            }
        }
    }
    for image in excepted(dataset, a.except.as_deref())? {
        images.remove(&image);
    }
    let mut files = vec![];
    for scene_id in dataset.scene_ids() {
        files.push((scene_id, dataset.scene(scene_id)?.dir().join("scene_gt_coco.json")));
    }
    if !files.iter().all(|(_, file)| file.is_file()) {
        let images: Vec<(u32, u32)> = images.into_iter().collect();
        return Ok(VisibleTruth::of_poses(dataset, &images)?);
    }
    let mut truth = CocoGroundTruth::default();
    for (scene_id, file) in files {
        let text = std::fs::read(&file).with_context(|| file.display().to_string())?;
        truth.add_scene(scene_id, &text, &file)?;
    }
    truth.images.retain(|image| images.contains(image));
    truth.annotations.retain(|a| images.contains(&(a.scene_id, a.image_id)));
    Ok(VisibleTruth { truth, visible: vec![] })
}
