//! `sixfold estimate --dataset`: estimates all targets of a BOP dataset and writes a result CSV, image by image,
//! resumable.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::{Result, anyhow, bail};
use sixfold_bop::{BopDataset, Target};
use sixfold_runner::{DatasetEvent, DatasetRun, ImageResult, RegionSource, RunError};
use sixfold_shell::Outcome;
use sixfold_shell::datasets;
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::found::overlay_of;
use sixfold_shell::frames::excepted;
use sixfold_shell::output::report;
use sixfold_shell::progress::{Progress, interrupted};

use super::arguments::{CommonArguments, EstimateArguments};
use super::networks;

pub(super) fn run(a: &EstimateArguments, root: &Path) -> Result<Outcome> {
    let common = &a.common;
    let out = common.out.as_deref().ok_or_else(|| anyhow!("--out FILE.csv is missing"))?;
    if out.extension().is_none_or(|e| e != "csv") {
        bail!("--out: found {}, expected a file that ends in .csv", out.display());
    }
    // The files that they name are hashed before they are read, so that a change in between is noticed.
    let options = a.run_options();
    let dataset = datasets::open(root, &common.split, common.models.as_deref())?;
    let mut targets = datasets::targets(&dataset, common.targets.as_deref())?;
    let left_out = excepted(&dataset, common.except.as_deref())?;
    targets.retain(|t| !left_out.contains(&(t.scene_id, t.im_id)));
    let targets = dataset.object_targets(&datasets::of_objects(&dataset, targets, &common.ids)?)?;
    let (regions, mut skipped) = regions(common, &dataset, &targets)?;
    let estimator = a.method.build(a.of_method(), common)?;
    let images: BTreeSet<(u32, u32)> = targets.iter().map(|t| (t.scene_id, t.im_id)).collect();
    let cache = common.cache.cache();
    let run = DatasetRun {
        estimator: estimator.as_ref(),
        dataset: &dataset,
        targets: &targets,
        regions: &regions,
        min_confidence: common.min_score,
        cache: &cache,
        options: &options,
    };
    let mut overlays = common.overlays.as_deref().map(OutputFolder::take).transpose()?;
    let mut progress = Progress::new("images", images.len());
    // If an overlay cannot be written, the poses are kept.
    let mut undrawn = vec![];
    let summary = run.run(out, interrupted(), &mut |event| {
        match event {
            DatasetEvent::Image { image, earlier: true } => progress.step(format!("{image} was done")),
            DatasetEvent::Image { image, earlier: false } => progress.step(image),
            DatasetEvent::Note(note) => eprintln!("note: {note}"),
            DatasetEvent::Result(result) => {
                if let Some(folder) = &mut overlays
                    && let Err(error) = draw(folder, result)
                {
                    let image = format!("{}/{}", result.scene_id, result.im_id);
                    undrawn.push(format!("overlay of image {image}: {}", sixfold_shell::describe(&error)));
                }
            }
        }
        Ok::<(), RunError>(())
    });
    progress.finish();
    let mut summary = summary?;
    skipped.append(&mut summary.skipped);
    skipped.append(&mut undrawn);
    summary.skipped = skipped;
    for s in &summary.skipped {
        eprintln!("skipped {s}");
    }
    report(&common.json, &summary, || {
        println!(
            "{} poses for {} targets in {} images: {}",
            summary.poses, summary.targets, summary.images, summary.results
        );
        if let Some(mean) = summary.seconds_per_image {
            println!("{mean:.2} s per image");
        }
    })?;
    Ok(match (summary.skipped.is_empty(), summary.poses) {
        (false, _) => Outcome::Incomplete,
        (true, 0) => Outcome::NothingFound,
        (true, _) => Outcome::Found,
    })
}

/// The regions of the targets according to the options, and what was left out of a file of detections.
fn regions(
    a: &CommonArguments,
    dataset: &BopDataset,
    targets: &[Target],
) -> Result<(RegionSource, Vec<String>)> {
    let ids: BTreeSet<u32> = targets.iter().filter_map(|t| t.object).map(|o| o.obj_id).collect();
    Ok(match (a.boxes.as_deref(), &a.detector) {
        (Some("gt"), _) => (RegionSource::GroundTruth, vec![]),
        (None | Some("detect"), Some(weights)) => (networks::regions(weights, ids)?, vec![]),
        (Some("detect"), None) => {
            bail!("--boxes detect needs --detector FILE.safetensors, which `sixfold train detector` writes")
        }
        (None, None) => (RegionSource::Anywhere, vec![]),
        (Some(file), _) => {
            let (source, changed, left_out) = RegionSource::read(dataset, Path::new(file))?;
            changed.iter().for_each(|note| eprintln!("note: {note}"));
            (source, left_out)
        }
    })
}

/// Draws the poses of an image over it.
fn draw(folder: &mut OutputFolder, result: &ImageResult<'_>) -> Result<()> {
    if let Some(overlay) = overlay_of(result)? {
        folder.write_rgb(&format!("{:06}_{:06}.png", result.scene_id, result.im_id), &overlay)?;
    }
    Ok(())
}
