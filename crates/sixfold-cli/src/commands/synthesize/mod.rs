//! `sixfold synthesize`: from a few cluttered photographs with rough poses to a training set of new views (Neural Object
//! Learning; K. Park, dissertation, chapter 4).

pub(crate) mod arguments;
mod input;
mod pictures;
mod poses;
mod views;

use std::path::Path;

use anyhow::{Context, Result, bail};
use serde::Serialize;
use serde_json::{Value, json};
use sixfold_bop::write_camera;
use sixfold_geometry::Camera;
use sixfold_geometry::stats::upper_median;
use sixfold_mesh::{PlyFormat, Unit, write_ply};
use sixfold_nol::agreement::leave_out_what_differs;
use sixfold_nol::model::NolModel;
use sixfold_nol::select::{choose_by_surface, shown_points};
use sixfold_nol::synthesis::{ViewMaker, Weighting};
use sixfold_nol::{NolError, SourceView};
use sixfold_synth::augment::{Backgrounds, PhotographOptions};

use self::arguments::WeightingKind;
pub(crate) use self::arguments::{AFTER_HELP, SynthesizeArguments};
use self::input::{Input, Subject};
use sixfold_shell::Outcome;
use sixfold_shell::output::{go_on_with, report};
use sixfold_shell::pictures::Pictures;
use sixfold_shell::progress::Progress;

/// Side of the crops that new views take their colours from, pixels.
const CROP: usize = 256;
/// A photograph is left out where its mask covers less of the object's outline.
const MIN_MASK: f64 = 0.1;
/// A further photograph of an object must add so many of its 3000 points.
const MIN_GAIN: f64 = 15.0;

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
    /// Fraction of the object's pixels in all views that no photograph shows; they are filled from what is near.
    pixels_unseen: f64,
    median_moved_mm: f64,
    median_turned_degrees: f64,
}

pub(crate) fn run(a: &SynthesizeArguments) -> Result<Outcome> {
    check(a)?;
    let start = std::time::Instant::now();
    let mut input = input::read(a)?;
    if input.subjects.is_empty() {
        bail!("no photograph shows any of the objects; choose other --frames or a lower --least-visible");
    }
    keep_options(a)?;
    for subject in &mut input.subjects {
        choose_sources(a, subject)?;
    }
    let counts: Vec<usize> = input.subjects.iter().map(|s| s.photographs.len()).collect();
    let Some(poses) = poses::refine(a, &input, &a.out.join("poses.json"))? else {
        bail!("interrupted; give the same command again");
    };
    let mut sheets = Pictures::default();
    sheets.did(picture_of_poses(a, &input, &poses));
    poses::apply(&mut input, &poses)?;
    let model = match (a.weighting, &a.weights) {
        (WeightingKind::Network, Some(file)) => Some(NolModel::load(file)?),
        (WeightingKind::Network, None) => Some(NolModel::shipped()?),
        _ => None,
    };
    let weighting = match (&model, a.weighting) {
        (Some(model), _) => Weighting::Network(model),
        (None, WeightingKind::Best) => Weighting::Best,
        (None, _) => Weighting::Average,
    };
    let backgrounds = match &a.backgrounds {
        Some(folder) => Backgrounds::from_folder(folder, &PhotographOptions::default())?,
        None => Backgrounds::procedural(),
    };
    write_models(a, &input)?;
    let per_object = views::grid(a).count();
    let mut progress = Progress::new("views", per_object * input.subjects.len());
    let (mut rows, mut objects) = (vec![], vec![]);
    for (subject, count) in input.subjects.iter().zip(&counts) {
        if subject.photographs.is_empty() {
            eprintln!("note: object {}: none of its photographs can be used; left out", subject.id);
            continue;
        }
        let mut sources: Vec<SourceView> = subject
            .photographs
            .iter()
            .map(|s| SourceView::new(&s.photograph, &subject.mesh, CROP))
            .collect::<Result<_, _>>()?;
        let differing = leave_out_what_differs(&mut sources, &subject.mesh);
        let maker = ViewMaker::new(&subject.mesh, sources, weighting, a.per_view)
            .with_context(|| format!("object {}", subject.id))?;
        let written = views::write(a, subject, &maker, &backgrounds, &mut progress)?;
        let of_object = || poses.photographs.iter().filter(|p| p.object == subject.id);
        objects.push(ObjectSummary {
            id: subject.id,
            photographs: subject.photographs.len(),
            dropped: count - subject.photographs.len(),
            images: written.images,
            pixels_differing: differing.iter().sum::<f64>() / differing.len().max(1) as f64,
            surface_unseen: maker.unseen_fraction(),
            pixels_unseen: written.unseen,
            median_moved_mm: median(of_object().map(|p| p.moved_mm)),
            median_turned_degrees: median(of_object().map(|p| p.turned_degrees)),
        });
        rows.push(written.preview);
    }
    progress.finish();
    sheets.did(pictures::sheet(&a.out.join("preview.png"), &rows));
    write_size(a, &input)?;
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

/// The dataset's camera file. Every image has its own camera; this one gives the size.
fn write_size(a: &SynthesizeArguments, input: &Input) -> Result<()> {
    let camera = Camera::new(1.0, 1.0, 0.0, 0.0, a.size, a.size)?;
    if let Some(first) = input.subjects.iter().flat_map(|s| &s.photographs).next() {
        let photograph = first.photograph.camera();
        write_camera(&a.out, &Camera { fx: photograph.fx, fy: photograph.fy, ..camera }, 1e-3)?;
    }
    Ok(())
}

fn table(a: &SynthesizeArguments, summary: &Summary) {
    println!("object  photographs  moved     turned    surface unseen  views  pixels unseen");
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
            println!("the objects stood still in all photographs, so these share their cameras")
        }
        places if places > summary.objects.len() => {
            println!("between photographs objects were moved: they stood at {places} places");
        }
        _ => {}
    }
    let out = a.out.display();
    println!("{out}/preview.png: new views; {out}/poses.png: outlines at the given and the refined poses");
    println!(
        "next: sixfold train pix2pose --dataset {out} --split {} --render-share 0 --out DIR",
        a.new_split
    );
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    upper_median(&mut values).unwrap_or(0.0)
}

fn check(a: &SynthesizeArguments) -> Result<()> {
    for (option, values) in [("--elevation", &a.elevation), ("--rough", &a.rough), ("--disturb", &a.disturb)]
    {
        if values.len() != 2 && !(values.is_empty() && option == "--disturb") {
            bail!("{option}: found {}, expected two numbers with a comma between them", values.len());
        }
    }
    if !(1.0..=90.0).contains(&a.step) {
        bail!("--step: found {}, expected degrees from 1 to 90", a.step);
    }
    let [low, high] = [a.elevation[0], a.elevation[1]];
    if !(-90.0 <= low && low <= high && high <= 90.0) {
        bail!(
            "--elevation: found {low},{high}, expected two angles from -90 to 90 degrees, the lower one first"
        );
    }
    if !(1..=72).contains(&a.turns) {
        bail!("--turns: found {}, expected 1 to 72", a.turns);
    }
    if !(32..=1024).contains(&a.size) {
        bail!("--size: found {}, expected 32 to 1024 pixels", a.size);
    }
    if a.sources == 0 {
        bail!("--sources: found 0, expected at least 1");
    }
    if !(0.0..=1.0).contains(&a.least_visible) {
        bail!("--least-visible: found {}, expected a fraction from 0 to 1", a.least_visible);
    }
    if a.weights.is_some() && a.weighting != WeightingKind::Network {
        bail!("--weights belongs to --weighting network");
    }
    if !a.rough.iter().all(|v| *v > 0.0 && v.is_finite()) {
        bail!("--rough: found {:?}, expected millimetres and degrees above 0", a.rough);
    }
    Ok(())
}

/// Options that decide about the result; a folder made with others is not gone on with.
fn keep_options(a: &SynthesizeArguments) -> Result<()> {
    let options: Value = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "dataset": a.dataset, "split": a.split, "frames": a.frames, "ids": a.ids,
        "photographs": a.photographs, "new_split": a.new_split, "sources": a.sources, "per_view": a.per_view,
        "least_visible": a.least_visible, "weighting": format!("{:?}", a.weighting), "weights": a.weights,
        "detector": a.detector, "no_refine": a.no_refine, "scene": format!("{:?}", a.scene), "rough": a.rough, "disturb": a.disturb,
        "step": a.step, "elevation": a.elevation, "turns": a.turns, "size": a.size,
        "backgrounds": a.backgrounds, "with_photographs": a.with_photographs, "seed": a.seed,
    });
    go_on_with(&a.out.join("options.json"), &options)
}

/// Leaves the photographs that add most of the surface, at most `--sources` of them.
fn choose_sources(a: &SynthesizeArguments, subject: &mut Subject) -> Result<()> {
    let surface = subject.mesh.sample_surface(3000, 0);
    let mut shown = vec![];
    for source in &subject.photographs {
        let view = SourceView::new(&source.photograph, &subject.mesh, 96)?;
        let share = view.visible_fraction();
        if share < MIN_MASK {
            let name = source.photograph.name().to_owned();
            let wrong = NolError::Mask { name, share: 100.0 * share, least: 100.0 * MIN_MASK };
            eprintln!("note: {wrong}; left out");
            shown.push(vec![]);
            continue;
        }
        shown.push(shown_points(&view, &surface.points, &surface.normals));
    }
    let points = surface.points.len();
    shown.iter_mut().for_each(|s| s.resize(points, 0.0));
    let least = if subject.photographs.len() > a.sources { 0.0 } else { MIN_GAIN * 0.01 };
    let mut chosen = choose_by_surface(&shown, None, a.sources, least);
    chosen.sort_unstable();
    let mut number = 0;
    subject.photographs.retain(|_| {
        number += 1;
        chosen.contains(&(number - 1))
    });
    if subject.photographs.is_empty() {
        eprintln!("note: object {}: its photographs and masks show nothing of its surface", subject.id);
    }
    Ok(())
}

fn picture_of_poses(a: &SynthesizeArguments, input: &Input, poses: &poses::PoseFile) -> Result<()> {
    let mut records = poses.photographs.iter();
    let mut rows = vec![];
    for subject in &input.subjects {
        let mut row = vec![];
        for source in &subject.photographs {
            let Some(record) = records.next() else { break };
            let rows = record.camera_from_object;
            let matrix = sixfold_geometry::nalgebra::Matrix4::from_fn(|i, j| rows[i][j]);
            row.push((source.photograph.clone(), sixfold_geometry::Pose::from_matrix(&matrix)?));
        }
        rows.push((&subject.mesh, row));
    }
    pictures::refinement(&a.out.join("poses.png"), &rows)
}

/// The meshes and what is known of them, so that the new folder is a dataset of its own.
fn write_models(a: &SynthesizeArguments, input: &Input) -> Result<()> {
    let folder = a.out.join("models");
    std::fs::create_dir_all(&folder).with_context(|| format!("folder {}", folder.display()))?;
    let mut infos = sixfold_mesh::ModelsInfo::default();
    for subject in &input.subjects {
        let path: &Path = &folder.join(format!("obj_{:06}.ply", subject.id));
        write_ply(path, &subject.mesh, Unit::Millimetre, PlyFormat::BinaryLittleEndian)?;
        infos.0.insert(subject.id, subject.info.clone());
    }
    let path = folder.join("models_info.json");
    Ok(infos.write(&path)?)
}
