//! Example 5: a method on all targets of a BOP dataset, its result file, and the scores:
//! `cargo run --release -p sixfold --example 05_dataset_and_scores -- [DATASET [RESULTS.csv]]`.
//! A stopped run can be resumed.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use sixfold::bop::{evaluate, read_results};
use sixfold::prelude::*;
use sixfold::runner::{DatasetEvent, DatasetRun, RegionSource, RunOptions};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let demo = || concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/demo").into();
    let folder: PathBuf = std::env::args().nth(1).map_or_else(demo, PathBuf::from);
    let new = || std::env::temp_dir().join(format!("sixfold-{}_demo-test.csv", std::process::id()));
    let results: PathBuf = std::env::args().nth(2).map_or_else(new, PathBuf::from);

    let dataset = BopDataset::open(&folder, "test")?;
    let targets = dataset.object_targets(&dataset.targets(None)?)?;
    let run = DatasetRun {
        estimator: &PpfEstimator::default(),
        dataset: &dataset,
        targets: &targets,
        regions: &RegionSource::Anywhere,
        min_confidence: None,
        cache: &Cache::none(),
        options: &RunOptions::default(),
    };
    let summary = run.run(&results, &AtomicBool::new(false), &mut |event| {
        if let DatasetEvent::Image { image, .. } = event {
            println!("image {image}");
        }
        Ok(())
    })?;
    println!("{} poses of {} targets are in {}", summary.poses, summary.targets, summary.results);

    let scores = evaluate(&dataset, &read_results(&results)?, &targets, &EvalOptions::default(), &())?;
    println!("AR {:.3}", scores.ar.ok_or("a score is missing")?);
    for (object, score) in &scores.objects {
        println!("object {object}: MSSD {:.3?}, MSPD {:.3?}", score.ar_mssd, score.ar_mspd);
    }
    Ok(())
}
