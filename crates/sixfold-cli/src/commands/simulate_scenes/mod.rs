//! `sixfold simulate-scenes`: objects dropped on a plane in a physics engine and seen by a simulated depth camera, as a BOP
//! dataset (K. Park, dissertation, section 5.2.1, and its data sets of several objects).

pub(crate) mod arguments;

use std::path::Path;

use anyhow::Result;
use serde::Serialize;
use sixfold_bop::{BopDataset, write_camera, write_targets};
use sixfold_io::write_rgb;
use sixfold_synth::augment::{Backgrounds, PhotographOptions};

use self::arguments::SimulateScenesArguments;
use sixfold_shell::Outcome;
use sixfold_shell::folder::DatasetFolder;
use sixfold_shell::output::report;
use sixfold_shell::pictures::Pictures;
use sixfold_shell::scenes::{Counts, DEPTH_SCALE, SceneMaker, pinhole, write_objects};
use sixfold_shell::sheets::first_scenes;

/// Photographs for backgrounds are reduced to this length, pixels.
const LONGEST_SIDE: usize = 1280;

#[derive(Serialize)]
struct Summary {
    out: String,
    split: String,
    objects: usize,
    scenes: usize,
    images: usize,
    /// Ground-truth poses in all images.
    instances: usize,
    /// The mean of their visible fractions.
    mean_visible: f64,
    /// Scenes made in this run (the others existed already) and the time they took, without the preparation of the objects.
    new_scenes: usize,
    /// Objects that were dropped in them, and those that came to rest within reach.
    dropped: usize,
    resting: usize,
    seconds: f64,
    scenes_per_second: f64,
}

pub(crate) fn run(a: &SimulateScenesArguments) -> Result<Outcome> {
    a.check()?;
    let camera = pinhole(a.camera.as_deref())?;
    // Other options are refused before the slow preparation of the objects.
    let inputs: Vec<&Path> =
        [&a.dataset, &a.camera, &a.backgrounds].into_iter().flatten().map(|p| p.as_path()).collect();
    let folder = DatasetFolder::take(&a.out, "simulate-scenes", a.deciding(), &inputs)?;
    let photographs = PhotographOptions { longest_side: LONGEST_SIDE, ..PhotographOptions::default() };
    let backgrounds =
        a.backgrounds.as_ref().map(|dir| Backgrounds::from_folder(dir, &photographs)).transpose()?;
    let models = a.models()?;
    folder.begin(&a.contents(&models)?)?;
    let objects = models.ready(a.exact)?;
    write_objects(&folder, &a.out, &objects)?;
    write_camera(&a.out, &camera, DEPTH_SCALE)?;
    let maker = SceneMaker {
        dataset: (&a.out, &a.split),
        objects: &objects,
        tabletop: a.tabletop(),
        camera,
        sensor: a.sensor.model(),
        views: a.views,
        rgb: !a.no_rgb,
        backgrounds,
        masks: !a.no_masks,
    };
    let start = std::time::Instant::now();
    let missing: Vec<u32> = (0..a.scenes as u32).filter(|id| !maker.is_whole(*id)).collect();
    let made = maker.write_all(&missing)?;
    let seconds = start.elapsed().as_secs_f64();
    let dataset = BopDataset::open(&a.out, &a.split)?;
    let targets_file = a.out.join("test_targets_bop19.json");
    if !targets_file.exists() {
        write_targets(&targets_file, &dataset.targets(None)?)?;
    }
    let mut pictures = Pictures::default();
    if !a.no_rgb {
        pictures.did(preview(&a.out, &dataset));
    }
    let Counts { images, instances, visible } = Counts::of(&dataset)?;
    let summary = Summary {
        out: a.out.display().to_string(),
        split: a.split.clone(),
        objects: objects.len(),
        scenes: a.scenes,
        images,
        instances,
        mean_visible: visible / instances.max(1) as f64,
        new_scenes: missing.len(),
        dropped: made.dropped,
        resting: made.resting,
        seconds,
        scenes_per_second: missing.len() as f64 / seconds.max(1e-9),
    };
    report(&a.json, &summary, || table(&a.out, &summary))?;
    Ok(pictures.outcome(if instances > 0 { Outcome::Found } else { Outcome::NothingFound }))
}

fn preview(out: &Path, dataset: &BopDataset) -> Result<()> {
    match first_scenes(dataset)? {
        Some(sheet) => Ok(write_rgb(&out.join("preview.png"), &sheet)?),
        None => Ok(()),
    }
}

fn table(out: &Path, s: &Summary) {
    println!(
        "{} objects, {} scenes, {} images, {} poses, {:.0} % of the objects visible on average",
        s.objects,
        s.scenes,
        s.images,
        s.instances,
        100.0 * s.mean_visible
    );
    if s.new_scenes > 0 {
        println!(
            "{} scenes made in {:.1} s ({:.2} a second); {} of {} dropped objects came to rest",
            s.new_scenes, s.seconds, s.scenes_per_second, s.resting, s.dropped
        );
    }
    println!("{}: a BOP dataset; preview.png shows its first scenes", out.display());
}
