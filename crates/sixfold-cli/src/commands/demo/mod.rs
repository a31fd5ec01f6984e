//! `sixfold demo`: the whole way on the sample frames, from files to scored poses and images. Here poses from depth and the
//! report; `colour_poses.rs` adds poses from colour, `samples.rs` is what both know of the samples.

pub(crate) mod arguments;
mod colour;
#[cfg(feature = "networks")]
mod colour_poses;
#[cfg(not(feature = "networks"))]
#[path = "without_networks.rs"]
mod colour_poses;
mod samples;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use serde::Serialize;
use sixfold_align::{DepthOptions, DepthRegion};
use sixfold_bop::{BopDataset, EvalOptions, Evaluation, Models, evaluate, score_table, write_recall_curves};
use sixfold_geometry::Pose;
use sixfold_ppf::{PpfOptions, estimate};

use self::arguments::DemoArguments;
use self::colour::Colour;
use self::samples::{Known, add_s};
use sixfold_shell::Outcome;
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::output::report;
use sixfold_shell::overlay::{self, Drawn};
use sixfold_shell::pictures::Pictures;
use sixfold_shell::progress::Progress;
use sixfold_shell::shipped::DEMO;

#[derive(Serialize)]
struct Row {
    image: String,
    depth: &'static str,
    object: u32,
    /// Mean distance of the model's points (nearest points for symmetric objects), millimetres.
    add_s_mm: f64,
    /// The same as a fraction of the diameter.
    add_s_of_diameter: f64,
    confidence: f64,
    seconds: f64,
}

#[derive(Serialize)]
struct Whole {
    poses: Vec<Row>,
    correct: usize,
    targets: usize,
    seconds: f64,
    pictures: Vec<PathBuf>,
    evaluation: Evaluation,
    /// Poses from colour alone.
    colour: Colour,
}

pub(crate) fn run(a: &DemoArguments) -> Result<Outcome> {
    let start = Instant::now();
    let mut out = Pictures::of(Some(OutputFolder::take(&a.out)?));
    let folder = a.data.clone().map_or_else(|| DEMO.find(), Ok)?;
    let dataset = BopDataset::open(&folder, "test")?;
    let targets = dataset.object_targets(&dataset.targets(None)?)?;
    let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let mut known: BTreeMap<u32, Known> = BTreeMap::new();
    let mut progress = Progress::new("poses", targets.len());
    let mut rows = vec![];
    let mut results = vec![];
    let mut pictures = vec![];
    for scene_id in dataset.scene_ids() {
        let scene = dataset.scene(scene_id)?;
        for im_id in scene.image_ids() {
            let camera = scene.camera(im_id)?;
            let Some(depth) = scene.depth(im_id)? else { continue };
            let prepared = DepthRegion::from_depth(&depth, &camera, None, &DepthOptions::default())?;
            let mut found = vec![];
            for t in targets.iter().filter(|t| (t.scene_id, t.im_id) == (scene_id, im_id)) {
                let Some(o) = t.object else { continue };
                let began = Instant::now();
                if let std::collections::btree_map::Entry::Vacant(place) = known.entry(o.obj_id) {
                    place.insert(Known::new(&dataset, &infos, o.obj_id, &a.out.join("objects"))?);
                }
                let Some(k) = known.get(&o.obj_id) else { continue };
                let estimates = estimate(&prepared, &k.model, &PpfOptions::default());
                let seconds = began.elapsed().as_secs_f64();
                progress.step(format!("image {im_id}, object {}", o.obj_id));
                let truth = scene.image(im_id)?.ground_truth.iter().find(|g| g.obj_id == o.obj_id);
                for e in estimates {
                    results.push(sixfold_bop::Estimate::new(
                        scene_id,
                        im_id,
                        o.obj_id,
                        e.confidence,
                        e.camera_from_object,
                    ));
                    found.push((o.obj_id, e.camera_from_object, e.confidence));
                    if let Some(truth) = truth {
                        let error = add_s(k, e.camera_from_object, truth);
                        rows.push(Row {
                            image: format!("{scene_id}/{im_id}"),
                            depth: if scene_id >= SIMULATED { "simulated" } else { "real" },
                            object: o.obj_id,
                            add_s_mm: 1000.0 * error,
                            add_s_of_diameter: error / k.model.diameter(),
                            confidence: e.confidence,
                            seconds,
                        });
                    }
                }
            }
            let background = scene.rgb(im_id)?.unwrap_or_else(|| overlay::depth_picture(&depth));
            let picture = overlay::draw(&background, &camera, &drawn(&found, &known));
            pictures.extend(out.write(&format!("{scene_id:06}_{im_id:06}.png"), &picture));
        }
    }
    progress.finish();
    let evaluation = evaluate(&dataset, &results, &dataset.targets(None)?, &EvalOptions::default(), &())?;
    pictures.extend(out.with("recall.png", |curves| write_recall_curves(curves, &evaluation)));
    let colour = colour_poses::run(a, &mut out, &dataset, &targets, &known)?;
    let correct = rows.iter().filter(|r| r.add_s_of_diameter < 0.1).count();
    let whole = Whole {
        poses: rows,
        correct,
        targets: targets.len(),
        seconds: start.elapsed().as_secs_f64(),
        pictures,
        evaluation,
        colour,
    };
    report(&a.json, &whole, || print_table(&whole))?;
    Ok(out.outcome(if whole.poses.is_empty() { Outcome::NothingFound } else { Outcome::Found }))
}

/// Poses by object with their confidence, to be drawn.
fn drawn<'a>(found: &[(u32, Pose, f64)], known: &'a BTreeMap<u32, Known>) -> Vec<Drawn<'a>> {
    found
        .iter()
        .filter_map(|(id, pose, confidence)| {
            Some(Drawn::of_dataset(*id, known.get(id)?.mesh()?, *pose, *confidence))
        })
        .collect()
}

/// Scenes of the sample data from this id on have simulated depth.
const SIMULATED: u32 = 1000;

fn print_table(whole: &Whole) {
    println!(
        "{:>10} {:>10} {:>7} {:>12} {:>10} {:>11} {:>8}",
        "image", "depth", "object", "error (mm)", "of diam.", "confidence", "seconds"
    );
    for r in &whole.poses {
        println!(
            "{:>10} {:>10} {:>7} {:>12.1} {:>9.1}% {:>11.3} {:>8.2}",
            r.image,
            r.depth,
            r.object,
            r.add_s_mm,
            100.0 * r.add_s_of_diameter,
            r.confidence,
            r.seconds
        );
    }
    println!();
    print!("{}", score_table(&whole.evaluation));
    println!("\n{} of {} poses within 10 % of the diameter", whole.correct, whole.targets);
    colour::print_table(&whole.colour, |image, object| {
        whole.poses.iter().find(|r| r.image == image && r.object == object).map(|r| r.add_s_of_diameter)
    });
    println!("\n{:.1} s in all. Images:", whole.seconds);
    for p in whole.pictures.iter().chain(&whole.colour.pictures) {
        println!("  {}", p.display());
    }
}
