//! `sixfold simulate-scenes`: objects dropped on a plane in a physics engine and seen by a simulated depth camera, as a BOP
//! dataset (K. Park, dissertation, section 5.2.1, and its data sets of several objects).

pub(crate) mod arguments;
mod objects;
mod preview;
mod scene;

use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::{Result, bail};
use rayon::prelude::*;
use serde::Serialize;
use sixfold_bop::{BopDataset, write_camera, write_targets};

use self::arguments::SimulateScenesArguments;
use sixfold_shell::Outcome;
use sixfold_shell::output::{go_on_with, report};
use sixfold_shell::pictures::Pictures;
use sixfold_shell::progress::{Progress, check_interrupt};

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
    /// Scenes made now (the others were there) and how long they took, without the time to prepare the objects.
    new_scenes: usize,
    /// Objects that were dropped in them, and those of them that came to rest within reach.
    dropped: usize,
    resting: usize,
    seconds: f64,
    scenes_per_second: f64,
}

pub(crate) fn run(a: &SimulateScenesArguments) -> Result<Outcome> {
    a.check()?;
    let camera = a.pinhole()?;
    let options = a.out.join("options.json");
    if options.exists() {
        // Other options are refused before the objects take their time.
        go_on_with(&options, &a.deciding())?;
    } else if a.out.join(&a.split).exists() || a.out.join("models").exists() {
        bail!("{} holds another dataset: choose another --out", a.out.display());
    }
    let things = objects::collect(a)?;
    go_on_with(&options, &a.deciding())?;
    objects::write(&a.out, &things)?;
    write_camera(&a.out, &camera, scene::DEPTH_SCALE)?;
    let start = std::time::Instant::now();
    let missing: Vec<u32> = (0..a.scenes as u32).filter(|id| !is_whole(a, *id)).collect();
    let progress = Mutex::new(Progress::new("scenes", missing.len()));
    let (dropped, resting) = (AtomicUsize::new(0), AtomicUsize::new(0));
    missing.par_iter().try_for_each(|&scene_id| -> Result<()> {
        check_interrupt("give the same command again to continue")?;
        let made = scene::write(a, &camera, &things, scene_id)?;
        dropped.fetch_add(made.dropped, Ordering::Relaxed);
        resting.fetch_add(made.resting, Ordering::Relaxed);
        if let Ok(mut progress) = progress.lock() {
            progress.step(format!("scene {scene_id}: {} objects", made.resting));
        }
        Ok(())
    })?;
    let seconds = start.elapsed().as_secs_f64();
    if let Ok(progress) = progress.into_inner() {
        progress.finish();
    }
    let dataset = BopDataset::open(&a.out, &a.split)?;
    let targets_file = a.out.join("test_targets_bop19.json");
    if !targets_file.exists() {
        write_targets(&targets_file, &dataset.targets(None)?)?;
    }
    let mut pictures = Pictures::default();
    if !a.no_rgb {
        pictures.did(preview::write(&a.out.join("preview.png"), &dataset));
    }
    let (images, instances, visible) = count(&dataset)?;
    let summary = Summary {
        out: a.out.display().to_string(),
        split: a.split.clone(),
        objects: things.len(),
        scenes: a.scenes,
        images,
        instances,
        mean_visible: visible / instances.max(1) as f64,
        new_scenes: missing.len(),
        dropped: dropped.into_inner(),
        resting: resting.into_inner(),
        seconds,
        scenes_per_second: missing.len() as f64 / seconds.max(1e-9),
    };
    report(&a.json, &summary, || table(&a.out, &summary))?;
    Ok(pictures.outcome(if instances > 0 { Outcome::Found } else { Outcome::NothingFound }))
}

/// The text file that is written last stands for the whole scene.
fn is_whole(a: &SimulateScenesArguments, scene_id: u32) -> bool {
    a.out.join(&a.split).join(format!("{scene_id:06}")).join("scene_gt_info.json").exists()
}

/// Images, ground-truth poses and the sum of their visible fractions.
fn count(dataset: &BopDataset) -> Result<(usize, usize, f64)> {
    let (mut images, mut instances, mut visible) = (0, 0, 0.0);
    for scene_id in dataset.scene_ids() {
        let scene = dataset.scene(scene_id)?;
        for im_id in scene.image_ids() {
            let image = scene.image(im_id)?;
            images += 1;
            instances += image.ground_truth.len();
            visible += image.visible_fractions().into_iter().flatten().sum::<f64>();
        }
    }
    Ok((images, instances, visible))
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
