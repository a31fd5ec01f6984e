//! `sixfold synthesize`: makes a training set of new views from a few cluttered photographs with approximate poses (Neural
//! Object Learning; K. Park, dissertation, chapter 4).

pub(crate) mod arguments;
mod input;

use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::Ordering;

use anyhow::{Context, Result, anyhow, bail};
use serde::Serialize;
use sixfold_bop::write_camera;
use sixfold_data::{RoughImages, RoughObject};
use sixfold_geometry::Progress as _;
use sixfold_geometry::stats::upper_median;
use sixfold_nol::agreement::leave_out_what_differs;
use sixfold_nol::model::NolModel;
use sixfold_nol::pose_file::PoseFile;
use sixfold_nol::select::{choose_images, choose_images_by_pose};
use sixfold_nol::synthesis::{ViewMaker, Weighting};
use sixfold_nol::{SourceView, ViewSplit, WrittenViews};
use sixfold_synth::augment::{Backgrounds, PhotographOptions};

pub(crate) use self::arguments::{AFTER_HELP, SynthesizeArguments};
use self::arguments::{RefinementKind, SelectKind, WeightingKind};
use sixfold_shell::Outcome;
use sixfold_shell::folder::DatasetFolder;
use sixfold_shell::output::report;
use sixfold_shell::pictures::Pictures;
use sixfold_shell::progress::{Bar, Progress, interrupted};
use sixfold_shell::sheets::write_sheet;

/// Side of the crops that provide the colours of new views, pixels.
const CROP: usize = 256;

#[derive(Serialize)]
struct Summary {
    out: String,
    split: String,
    objects: Vec<ObjectSummary>,
    refined: bool,
    still: bool,
    places: usize,
    disagreement: Option<f64>,
    seconds: f64,
}

#[derive(Serialize)]
struct ObjectSummary {
    id: u32,
    photographs: usize,
    dropped: usize,
    images: usize,
    /// Fraction of the visible parts that was left out because other photographs show another colour there.
    pixels_differing: f64,
    /// Fraction of the surface that no photograph shows.
    surface_unseen: f64,
    /// Fraction of the object's pixels in all views that no photograph shows; they are filled from their surroundings.
    pixels_unseen: f64,
    median_moved_mm: f64,
    median_turned_degrees: f64,
}

pub(crate) fn run(a: &SynthesizeArguments) -> Result<Outcome> {
    a.check()?;
    let start = std::time::Instant::now();
    let inputs = [&a.dataset, &a.photographs, &a.frames, &a.weights, &a.detector, &a.backgrounds];
    let inputs: Vec<&Path> = inputs.into_iter().flatten().map(|p| p.as_path()).collect();
    let folder = DatasetFolder::take(&a.out, "synthesize", a.deciding(), &inputs)?;
    let mut images = input::read(a)?;
    if images.objects.is_empty() {
        bail!("no photograph shows any of the objects; choose other --frames or a lower --min-visible");
    }
    folder.begin(&input::contents(a, &images)?)?;
    for object in &mut images.objects {
        match a.select() {
            SelectKind::Surface => {
                choose_images(object, a.sources)?.iter().for_each(|note| eprintln!("note: {note}"));
            }
            SelectKind::Pose => choose_images_by_pose(object, a.sources, a.seed),
        }
    }
    let counts: Vec<usize> = images.objects.iter().map(|o| o.images.len()).collect();
    let mut sheets = Pictures::default();
    let model = match (a.weighting, &a.weights) {
        (WeightingKind::Network, Some(file)) => Some(NolModel::load(file)?),
        (WeightingKind::Network, None) => Some(NolModel::shipped()?),
        _ => None,
    };
    let poses = refined_poses(a, &mut images, model.as_ref(), &mut sheets)?;
    folder.write_models(images.objects.iter().map(|o| (o.id, &o.mesh, &o.info)))?;
    let views = Views { a, backgrounds: backgrounds(a)?, model };
    let mut progress = Progress::new("views", a.grid().count() * images.objects.len());
    let (mut rows, mut objects, mut first_camera) = (vec![], vec![], None);
    for (object, count) in images.objects.iter().zip(&counts) {
        if object.images.is_empty() {
            eprintln!("note: object {}: none of its photographs can be used; left out", object.id);
            continue;
        }
        let (summary, written) = views.of_object(object, *count, &poses, &mut progress)?;
        objects.push(summary);
        rows.push(written.preview);
        first_camera = first_camera.or(written.camera);
    }
    progress.finish();
    sheets.did(write_sheet(&a.out.join("preview.png"), &rows));
    // BOP has one such file per dataset, for tools that need any camera: it holds that of the first image. Each image's own
    // intrinsics are in scene_camera.json.
    if let Some(camera) = first_camera {
        write_camera(&a.out, &camera, 1e-3)?;
    }
    let found = !objects.is_empty();
    let summary = Summary {
        out: a.out.display().to_string(),
        split: a.new_split.clone(),
        objects,
        refined: poses.refined,
        still: poses.still,
        places: poses.places,
        disagreement: poses.disagreement,
        seconds: start.elapsed().as_secs_f64(),
    };
    report(&a.json, &summary, || table(a, &summary))?;
    Ok(sheets.outcome(if found { Outcome::Found } else { Outcome::NothingFound }))
}

/// Refines the poses, draws them, and replaces the given ones.
fn refined_poses(
    a: &SynthesizeArguments,
    images: &mut RoughImages,
    model: Option<&NolModel>,
    sheets: &mut Pictures,
) -> Result<PoseFile> {
    let file = a.out.join("poses.json");
    let bar = Bar::stopped_by_interrupts("poses, per cent");
    let options = a.refinement();
    let disturbed = !a.disturb.is_empty();
    let poses = if options.is_some() && a.refinement_kind() == RefinementKind::Published {
        Some(PoseFile::refined_as_published(images, model, disturbed, &file)?)
    } else {
        PoseFile::refined(images, options.as_ref(), disturbed, &file, &|done, total| {
            bar.report(100 * done / total, 100)
        })?
    };
    bar.finish();
    let Some(poses) = poses else { bail!("interrupted; give the same command again") };
    sheets.did(write_sheet(&a.out.join("poses.png"), &poses.outlines(images, &file)?));
    poses.apply(images, &file)?.iter().for_each(|note| eprintln!("note: {note}"));
    Ok(poses)
}

fn backgrounds(a: &SynthesizeArguments) -> Result<Backgrounds> {
    Ok(match &a.backgrounds {
        Some(folder) => Backgrounds::from_folder(folder, &PhotographOptions::default())?,
        None => Backgrounds::procedural(),
    })
}

/// The data for new views.
struct Views<'a> {
    a: &'a SynthesizeArguments,
    backgrounds: Backgrounds,
    model: Option<NolModel>,
}

impl Views<'_> {
    /// Writes the views of one object; returns their report and the written entries.
    fn of_object(
        &self,
        object: &RoughObject,
        count: usize,
        poses: &PoseFile,
        progress: &mut Progress,
    ) -> Result<(ObjectSummary, WrittenViews)> {
        let weighting = match (&self.model, self.a.weighting) {
            (Some(model), _) => Weighting::Network(model),
            (None, WeightingKind::Best) => Weighting::Best,
            (None, _) => Weighting::Average,
        };
        let mut sources: Vec<SourceView> = object
            .images
            .iter()
            .map(|i| SourceView::new(&i.posed, &object.mesh, CROP))
            .collect::<Result<_, _>>()?;
        let differing = leave_out_what_differs(&mut sources, &object.mesh);
        let maker = ViewMaker::new(&object.mesh, sources, weighting, self.a.per_view)
            .with_context(|| format!("object {}", object.id))?;
        let split = ViewSplit {
            dataset: &self.a.out,
            split: &self.a.new_split,
            grid: self.a.grid(),
            backgrounds: &self.backgrounds,
            with_photographs: self.a.with_photographs,
        };
        let (stop, progress) = (interrupted(), Mutex::new(progress));
        let written = split.write(object, &maker, &|_, _| {
            if let Ok(mut progress) = progress.lock() {
                progress.step(format!("object {}", object.id));
            }
            !stop.load(Ordering::Relaxed)
        })?;
        let written =
            written.ok_or_else(|| anyhow!("interrupted; give the same command again to continue"))?;
        let of_object = || poses.photographs.iter().filter(|p| p.object == object.id);
        let summary = ObjectSummary {
            id: object.id,
            photographs: object.images.len(),
            dropped: count - object.images.len(),
            images: written.images,
            pixels_differing: differing.iter().sum::<f64>() / differing.len().max(1) as f64,
            surface_unseen: maker.unseen_fraction(),
            pixels_unseen: written.unseen,
            median_moved_mm: median(of_object().map(|p| p.moved_mm)),
            median_turned_degrees: median(of_object().map(|p| p.turned_degrees)),
        };
        Ok((summary, written))
    }
}

fn table(a: &SynthesizeArguments, summary: &Summary) {
    println!("object  photographs  moved     rotated   surface unseen  views  pixels unseen");
    for o in &summary.objects {
        println!(
            "{:6}  {:11}  {:5.1} mm  {:5.2} deg {:13.1} %  {:5}  {:11.1} %",
            o.id,
            o.photographs,
            o.median_moved_mm,
            o.median_turned_degrees,
            100.0 * o.surface_unseen,
            o.images,
            100.0 * o.pixels_unseen
        );
    }
    match summary.places {
        _ if summary.still => {
            println!("the objects did not move: each photograph has one camera pose for all of them")
        }
        places if places > summary.objects.len() => {
            println!("between photographs objects were moved: they stood at {places} places");
        }
        _ => {}
    }
    let out = a.out.display();
    println!("{out}/preview.png: new views; {out}/poses.png: outlines at the given and the refined poses");
    println!(
        "next: sixfold train pix2pose --dataset {out} --split {} --render-fraction 0 --out DIR",
        a.new_split
    );
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    upper_median(&mut values).unwrap_or(0.0)
}
