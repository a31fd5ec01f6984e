//! `sixfold estimate --method mttm`: poses by templates, in one image here, in a dataset through `estimate_dataset`.

pub(crate) mod arguments;
pub(crate) mod network;
pub(crate) mod onboard;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use serde::Serialize;
use sixfold_io::{write_mask, write_rgb};
use sixfold_match::{Scene, VerificationScore};
use sixfold_mesh::Mesh;
use sixfold_mttm::mask::to_image;
use sixfold_mttm::model::MttmModel;
use sixfold_mttm::{Estimate, EstimateOptions, KnownObject, ObjectTemplates, Search, Source, Stages, TemplateOptions};

use self::network::{network, with_network};
use super::estimate::Input;
use crate::commands::estimate_arguments::EstimateArguments;
use sixfold_shell::Outcome;
use sixfold_shell::objects::{Object, Store, self};
use sixfold_shell::output::{pose_rows, report, write_atomically};
use sixfold_shell::overlay::{Drawn, self};
use sixfold_shell::progress::{Progress, check_interrupt};

/// Least confidence of a pose in one image.
const SURE_ENOUGH: f64 = 0.45;

/// An object as templates know it.
pub(crate) struct Known {
    pub name: String,
    pub object: KnownObject,
    /// For pictures.
    pub mesh: Option<Mesh>,
}

/// Templates and mesh of an object with a mesh: templates from `file`, or made and kept there.
pub(crate) fn known_by_mesh(
    object: Object,
    file: &Path,
    templates_only: bool,
    model: Option<&Arc<MttmModel>>,
) -> Result<Known> {
    let (templates, note) = ObjectTemplates::cached(file, &object.mesh, &TemplateOptions::default())
        .with_context(|| format!("object {}", object.name))?;
    if let Some(note) = note {
        eprintln!("note: templates of {} not kept or renewed: {note}", object.name);
    }
    let mesh = if templates_only { None } else { Some(object.ppf_model()?) };
    let known = with_network(KnownObject::new(templates, mesh), model, file, &object.name);
    Ok(Known { name: object.name, object: known, mesh: Some(object.mesh) })
}

/// A mesh file, a stored object with a mesh, or one that is stored as templates alone.
fn find(a: &EstimateArguments, name: &str, model: Option<&Arc<MttmModel>>) -> Result<Known> {
    let store = Store { folder: &a.store };
    if store.contains(name) {
        let file = store.templates_file(name)?;
        if store.record(name)?.without_mesh {
            let templates = ObjectTemplates::read(&file).with_context(|| format!("object {name}"))?;
            let object = with_network(KnownObject::new(templates, None), model, &file, name);
            return Ok(Known { name: name.into(), object, mesh: None });
        }
        // Templates that were asked for with other views stay as they are.
        if let Ok(templates) = ObjectTemplates::read(&file) {
            let object = store.load(name)?;
            let (templates, note) = ObjectTemplates::cached(&file, &object.mesh, &templates.options)
                .with_context(|| format!("object {name}"))?;
            if let Some(note) = note {
                eprintln!("note: templates of {name} not kept or renewed: {note}");
            }
            let mesh = if a.templates_only { None } else { Some(object.ppf_model()?) };
            let object_with = with_network(KnownObject::new(templates, mesh), model, &file, name);
            return Ok(Known { name: object.name, object: object_with, mesh: Some(object.mesh) });
        }
        return known_by_mesh(store.load(name)?, &file, a.templates_only, model);
    }
    let object = objects::find(name, a.unit, &a.store)?;
    let file = templates_beside(Path::new(name));
    known_by_mesh(object, &file, a.templates_only, model)
}

/// `mug.ply` keeps its templates in `mug.sixfold-templates`.
pub(crate) fn templates_beside(mesh: &Path) -> PathBuf {
    mesh.with_extension("sixfold-templates")
}

/// The options that the command line sets.
pub(crate) fn options(a: &EstimateArguments, instances: usize, min_score: f64) -> EstimateOptions {
    EstimateOptions {
        matched_by: a.matcher.matched_by(),
        max_instances: instances,
        min_score: a.min_score.unwrap_or(min_score),
        ..EstimateOptions::default()
    }
}

/// What template matching has no use for.
pub(crate) fn check(a: &EstimateArguments) -> Result<()> {
    let pix2pose = a.object_id.is_some() || a.icp || a.no_refine || a.looks.is_some();
    if pix2pose || a.detector.is_some() {
        bail!(
            "--object-id, --icp, --no-refine, --looks and --detector belong to --method pix2pose; template matching needs none of them"
        );
    }
    Ok(())
}

/// One image.
pub(crate) fn run(a: &EstimateArguments) -> Result<Outcome> {
    check(a)?;
    let Input { depth, rgb, camera, scene } = Input::read(a)?;
    let background = rgb.unwrap_or_else(|| overlay::depth_picture(&depth));
    warn_about(&scene, a.keep_plane);
    let model = network(a.matcher, a.weights.as_deref())?;
    let options = options(a, a.instances.get(), SURE_ENOUGH);
    let mut progress = Progress::new("objects", a.objects.len());
    let mut found: Vec<(Known, Vec<Estimate>, Stages)> = vec![];
    let search = Search::new(&scene);
    for name in &a.objects {
        check_interrupt("nothing was written")?;
        let known = find(a, name, model.as_ref())?;
        let (estimates, stages) = search.estimate(&known.object, &options);
        progress.step(known.name.clone());
        found.push((known, estimates, stages));
    }
    progress.finish();
    let mut pictures = None;
    if let Some(folder) = &a.out {
        let path = folder.join("overlay.png");
        write_rgb(&path, &picture(&background, &camera, &found))?;
        for (i, (known, estimates, _)) in found.iter().enumerate() {
            for (k, e) in estimates.iter().enumerate() {
                let path =
                    folder.join("masks").join(format!("{}-{}-{}.png", i + 1, file_name(&known.name), k + 1));
                write_mask(&path, &to_image(&e.mask, camera.width, camera.height))?;
            }
        }
        pictures = Some(path);
    }
    let poses: Vec<Found> = found
        .iter()
        .flat_map(|(known, estimates, stages)| estimates.iter().map(|e| Found::new(known, e, stages)))
        .collect();
    let not_found = found.iter().filter(|f| f.1.is_empty()).map(|f| f.0.name.clone()).collect();
    let whole = Whole { poses, not_found, overlay: pictures };
    if let Some(folder) = &a.out {
        let text = serde_json::to_string_pretty(&whole)?;
        write_atomically(&folder.join("poses.json"), text.as_bytes())?;
    }
    report(&a.json, &whole, || print_table(&whole, a.out.as_deref()))?;
    Ok(if whole.poses.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

/// Says what makes a search hopeless or slow.
fn warn_about(scene: &Scene, keep_plane: bool) {
    let pixels = scene.depth().as_slice();
    let measured = pixels.iter().filter(|&&z| z > 0.0).count();
    if 10 * measured < pixels.len() {
        eprintln!(
            "note: only {} % of the depth image is measured",
            (100.0 * measured as f64 / pixels.len() as f64).round()
        );
    }
    if scene.plane().is_none() && !keep_plane {
        eprintln!("note: no table plane was found; all of the image is searched");
    }
}

fn file_name(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() || c == '-' || c == '_' { c } else { '_' }).collect()
}

fn picture(
    background: &sixfold_geometry::RgbImage,
    camera: &sixfold_geometry::Camera,
    found: &[(Known, Vec<Estimate>, Stages)],
) -> sixfold_geometry::RgbImage {
    let mut background = background.clone();
    let mut drawn = vec![];
    for (i, (known, estimates, _)) in found.iter().enumerate() {
        for e in estimates {
            match &known.mesh {
                Some(mesh) => drawn.push(Drawn {
                    mesh,
                    camera_from_object: e.camera_from_object,
                    color: overlay::color(i),
                }),
                None => overlay::tint(&mut background, &e.mask, overlay::color(i)),
            }
        }
    }
    overlay::draw(&background, camera, &drawn)
}

#[derive(Serialize)]
struct Found {
    object: String,
    camera_from_object: [[f64; 4]; 4],
    confidence: f64,
    /// Number of the matched template from 0 on; with views without poses the pose is that of this view's frame.
    template: usize,
    /// Whether the frame is that of the object (a mesh, or views with poses) or only of the matched view.
    frame: &'static str,
    /// By the mesh, or by the template where there is none.
    verification: VerificationScore,
    verified_by: &'static str,
    mask_pixels: usize,
    seconds: Stages,
}

impl Found {
    fn new(known: &Known, e: &Estimate, stages: &Stages) -> Found {
        let of_view = known.object.templates().source == Source::Depth;
        Found {
            object: known.name.clone(),
            camera_from_object: pose_rows(&e.camera_from_object),
            confidence: e.confidence,
            template: e.template,
            frame: if of_view { "view" } else { "object" },
            verification: e.score,
            verified_by: if known.object.has_mesh() { "mesh" } else { "template" },
            mask_pixels: e.mask.len(),
            seconds: *stages,
        }
    }
}

#[derive(Serialize)]
struct Whole {
    poses: Vec<Found>,
    not_found: Vec<String>,
    overlay: Option<PathBuf>,
}

fn print_table(whole: &Whole, folder: Option<&Path>) {
    println!(
        "{:<24} {:>10} {:>8} {:>26} {:>11} {:>8}",
        "object", "confidence", "visible", "translation (m)", "verified by", "seconds"
    );
    for f in &whole.poses {
        let t: Vec<String> = f.camera_from_object[..3].iter().map(|r| format!("{:8.4}", r[3])).collect();
        println!(
            "{:<24} {:>10.3} {:>7.0}% {:>26} {:>11} {:>8.2}",
            f.object,
            f.confidence,
            100.0 * f.verification.visible_share(),
            t.join(" "),
            f.verified_by,
            f.seconds.hypotheses() + f.seconds.verification
        );
    }
    for name in &whole.not_found {
        println!("{name:<24} not found");
    }
    if let Some(folder) = folder {
        println!("poses.json, overlay.png and masks are in {}", folder.display());
    }
}
