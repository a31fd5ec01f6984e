//! `sixfold reproduce loss-curve`: the coordinate losses of symmetric objects against their rotation (dissertation, figure 3.3).

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::Args;
use serde::Serialize;
use sixfold_bop::Models;
use sixfold_geometry::RgbImage;
use sixfold_pix2pose::loss_curve::{LossCurve, loss_curve};
use sixfold_plot::{COLORS, Canvas, FAINT, INK, ticks};
use sixfold_shell::Outcome;
use sixfold_shell::datasets;
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::progress::{Progress, check_interrupt};
use sixfold_shell::ranges::{folder_name, without_duplicates};

pub(super) const AFTER_HELP: &str = "Example:\n  \
    sixfold reproduce loss-curve --dataset lmo --ids 10 --out out/loss-curve";

/// Steps of the rotation: two degrees each.
const STEPS: usize = 180;

#[derive(Debug, Args)]
pub(crate) struct LossCurveArguments {
    /// BOP dataset folder
    #[arg(long, value_name = "DIR")]
    dataset: PathBuf,
    /// Split of the dataset
    #[arg(long, value_name = "SPLIT", default_value = "test")]
    split: String,
    /// Folder of the dataset's models, such as models_cad or models_reconst of T-LESS (default: models, or models_eval without it)
    #[arg(long, value_name = "FOLDER", value_parser = folder_name)]
    models: Option<String>,
    /// Only these objects (default: all with a discrete symmetry)
    #[arg(long, value_name = "ID", num_args = 1..)]
    ids: Vec<u32>,
    /// Folder for losses.json and a plot of each object
    #[arg(long, value_name = "DIR", default_value = "out/loss-curve")]
    out: PathBuf,
}

#[derive(Serialize)]
struct Whole {
    /// Curves by the objects' ids.
    objects: BTreeMap<u32, LossCurve>,
}

pub(super) fn run(a: &LossCurveArguments, json: &JsonArguments) -> Result<Outcome> {
    without_duplicates("--ids", &a.ids)?;
    let dataset = datasets::open(&a.dataset, &a.split, a.models.as_deref())?;
    let infos = dataset.models_info(Models::Rendering)?;
    let infos = infos.with_context(|| {
        format!("{}: its models have no models_info.json, which states their symmetries", a.dataset.display())
    })?;
    if let Some(id) = a.ids.iter().find(|id| !infos.0.contains_key(*id)) {
        let known: Vec<String> = infos.0.keys().map(u32::to_string).collect();
        bail!("--ids {id}: {} has no such object, its models are {}", a.dataset.display(), known.join(", "));
    }
    let chosen: Vec<u32> = if a.ids.is_empty() { infos.0.keys().copied().collect() } else { a.ids.clone() };
    let mut folder = OutputFolder::take(&a.out)?;
    let mut objects = BTreeMap::new();
    let mut progress = Progress::new("objects", chosen.len());
    for id in chosen {
        check_interrupt("run the same command again")?;
        let info = &infos.0[&id];
        progress.step(format!("object {id}"));
        if info.symmetries_discrete.is_empty() && a.ids.is_empty() {
            continue;
        }
        let Some(curve) = loss_curve(&dataset.model(id, Models::Rendering)?, info, STEPS) else {
            eprintln!(
                "note: object {id} has no curve: it needs a discrete symmetry that is a rotation, and no continuous one"
            );
            continue;
        };
        folder.write_rgb(&format!("obj_{id:06}.png"), &plot(id, &curve))?;
        objects.insert(id, curve);
    }
    progress.finish();
    let whole = Whole { objects };
    folder.write_text("losses.json", &serde_json::to_string_pretty(&whole)?)?;
    report(json, &whole, || {
        if whole.objects.is_empty() {
            println!("no object has a discrete symmetry alone");
            return;
        }
        println!(
            "| object | loss | at 90 degrees | at 180 degrees | largest step of 2 degrees |\n|---|---|---:|---:|---:|"
        );
        for (id, curve) in &whole.objects {
            for (name, values) in lines(curve) {
                let step = values.windows(2).map(|w| (w[1] - w[0]).abs()).fold(0.0, f64::max);
                println!(
                    "| {id} | {name} | {:.3} | {:.3} | {step:.3} |",
                    values[STEPS / 4],
                    values[STEPS / 2]
                );
            }
        }
        println!("\nlosses.json and the plots are in {}", a.out.display());
    })?;
    Ok(if whole.objects.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

/// The three losses with their names.
fn lines(curve: &LossCurve) -> [(&'static str, &[f64]); 3] {
    [("L1", &curve.l1), ("L1 with view limits", &curve.view_limits), ("transformer loss", &curve.transformer)]
}

/// Losses against the angle.
fn plot(id: u32, curve: &LossCurve) -> RgbImage {
    let (left, top, width, height) = (70.0, 40.0, 430.0, 280.0);
    let mut canvas = Canvas::new(740, 390);
    canvas.text(left, 12.0, 2.0, &format!("object {id}: loss against rotation"), INK);
    let largest = lines(curve).iter().flat_map(|(_, values)| values.iter()).copied().fold(0.0, f64::max);
    let axis = ticks(0.0, largest);
    let y = |value: f64| top + height * (1.0 - value / axis.high);
    for (value, label) in &axis.marks {
        canvas.line((left, y(*value)), (left + width, y(*value)), 1.0, FAINT);
        canvas.text(left - 46.0, y(*value) - 6.0, 2.0, label, INK);
    }
    let x = |degrees: f64| left + width * degrees / 360.0;
    for degrees in [0u32, 90, 180, 270, 360] {
        let at = x(f64::from(degrees));
        canvas.line((at, top), (at, top + height), 1.0, FAINT);
        canvas.text(at - 14.0, top + height + 10.0, 2.0, &degrees.to_string(), INK);
    }
    canvas.text(left + 150.0, top + height + 34.0, 2.0, "rotation in degrees", INK);
    for (number, (name, values)) in lines(curve).into_iter().enumerate() {
        let color = COLORS[number];
        let at = |i: usize| (x(curve.degrees[i]), y(values[i]));
        for i in 1..values.len() {
            canvas.line(at(i - 1), at(i), 2.5, color);
        }
        canvas.text(left + width + 14.0, top + 26.0 * number as f64, 1.8, name, color);
    }
    canvas.finish()
}
