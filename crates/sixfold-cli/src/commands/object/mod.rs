//! `sixfold object add|list|show|symmetries|export|remove`.

pub(crate) mod arguments;
mod symmetries;

use std::path::Path;

use anyhow::{Result, anyhow};
use serde::Serialize;
use sixfold_estimator::{NewObject, ObjectRecord, ObjectStore, PoseEstimator};
use sixfold_geometry::Vec3;
use sixfold_io::write_rgb;
use sixfold_mesh::{Mesh, ModelInfo, ModelsInfo, read_mesh};
use sixfold_mttm::{MttmEstimator, ObjectTemplates, TEMPLATES_FILE, TemplateOptions};
use sixfold_ppf::PpfEstimator;
use sixfold_render::portrait;
use sixfold_shell::Outcome;
use sixfold_shell::depth_views::{LeftOut, templates_of};
#[cfg(feature = "networks")]
use sixfold_shell::folder::{Contents, DatasetFolder};
use sixfold_shell::output::{JsonArguments, report};

use self::arguments::{AddArguments, Axis, ObjectArguments, ObjectCommand};

#[derive(Serialize)]
struct Listed {
    name: String,
    #[serde(flatten)]
    record: ObjectRecord,
}

/// An object known from depth images.
#[derive(Serialize)]
struct Added<'a> {
    #[serde(flatten)]
    listed: &'a Listed,
    /// The parts removed from its masks, one entry per mask; empty with --mask-as-is.
    left_out: Vec<LeftOut>,
}

pub(crate) fn run(a: &ObjectArguments) -> Result<Outcome> {
    let store = ObjectStore::new(&a.store);
    match &a.command {
        ObjectCommand::Add(add) => match &add.mesh {
            None => add_views(&store, add, &a.json),
            Some(mesh) => add_mesh(&store, add, mesh, &a.json),
        },
        ObjectCommand::List => list(&store, &a.store, &a.json),
        ObjectCommand::Show { name, picture } => show(&store, name, picture.as_deref(), &a.json),
        ObjectCommand::Symmetries(symmetries) => symmetries::run(symmetries, &a.store, &a.json),
        #[cfg(feature = "networks")]
        ObjectCommand::Export { name, bop, id } => export(&store, name, bop, *id, &a.json),
        ObjectCommand::Remove { name } => {
            store.remove(name)?;
            report(&a.json, &serde_json::json!({ "removed": name }), || println!("removed {name}"))?;
            Ok(Outcome::Found)
        }
    }
}

/// Writes an object as a dataset.
#[cfg(feature = "networks")]
fn export(store: &ObjectStore, name: &str, bop: &Path, id: u32, json: &JsonArguments) -> Result<Outcome> {
    let object = store.load(name)?;
    let folder =
        DatasetFolder::take(bop, "object export", serde_json::json!({ "object": name, "id": id }), &[])?;
    let mut contents = Contents::default();
    if let (Some(mesh), Some(info)) = (&object.mesh, &object.info) {
        contents.add_object(name, mesh, info);
    }
    folder.begin(&contents)?;
    let images = sixfold_teach::export_bop(&object, id, bop)?;
    report(json, &serde_json::json!({ "dataset": bop, "id": id, "images": images }), || {
        println!("{}: object {id}, {images} photographs in train_real/000001", bop.display());
    })?;
    Ok(Outcome::Found)
}

/// Stores an object that is known from depth images.
fn add_views(store: &ObjectStore, a: &AddArguments, json: &JsonArguments) -> Result<Outcome> {
    let (templates, left_out) = templates_of(&a.views)?;
    let record = ObjectRecord::of_views(&a.views.depth, templates.diameter);
    let new = NewObject { mesh: None, record: &record, replace: a.replace };
    store.add(&a.name, new, |object| keep(&templates, object.file(TEMPLATES_FILE)))?;
    let listed = Listed { name: a.name.clone(), record };
    let added = Added { listed: &listed, left_out };
    report(json, &added, || {
        println!(
            "added {}: {} template(s), {:.1} mm across as seen",
            listed.name,
            templates.templates.len(),
            1000.0 * templates.diameter
        );
    })?;
    Ok(Outcome::Found)
}

/// Stores a mesh and its derived data, which are computed now rather than at the first estimate.
fn add_mesh(store: &ObjectStore, a: &AddArguments, mesh: &Path, json: &JsonArguments) -> Result<Outcome> {
    let unit = a.unit.as_ref().ok_or_else(|| anyhow!("--unit UNIT is missing"))?;
    let loaded = read_mesh(mesh, *unit)?;
    let mut info = info(a, &loaded)?;
    let symmetries = symmetries::add_to(&mut info, &loaded, a)?;
    let record = ObjectRecord::of_mesh(mesh, *unit, &loaded, &info);
    let new = NewObject { mesh: Some(&loaded), record: &record, replace: a.replace };
    let mut views = None;
    store.add(&a.name, new, |object| {
        PpfEstimator::default().prepare(object)?;
        if let (Some(sides), Some(mesh)) = (a.templates, &object.mesh) {
            let options = TemplateOptions { coverage: sides.coverage(), ..TemplateOptions::default() };
            let templates = ObjectTemplates::from_mesh(mesh, &options)?;
            keep(&templates, object.file(TEMPLATES_FILE))?;
            MttmEstimator::default().prepare(object)?;
            views = Some((templates.templates.len(), templates.turns().len()));
        }
        Ok(())
    })?;
    let listed = Listed { name: a.name.clone(), record };
    report(json, &listed, || {
        println!(
            "added {}: diameter {:.1} mm, {} faces",
            listed.name,
            1000.0 * listed.record.diameter,
            listed.record.faces
        );
        if let Some((views, turns)) = views {
            println!("{views} views with {turns} rotations each");
        }
        symmetries.iter().for_each(|line| println!("  {line}"));
    })?;
    Ok(Outcome::Found)
}

/// Writes templates into an object's folder.
fn keep(
    templates: &ObjectTemplates,
    file: Option<std::path::PathBuf>,
) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    if let Some(file) = file {
        templates.write(&file)?;
    }
    Ok(())
}

/// Diameter and box of the mesh with the symmetries that the options name.
fn info(a: &AddArguments, mesh: &Mesh) -> Result<ModelInfo> {
    let mut info = ModelInfo::of_mesh(mesh);
    if let (Some(file), Some(id)) = (&a.models_info, &a.model_id) {
        let all = ModelsInfo::read(file)?;
        let found = all.0.get(id).ok_or_else(|| anyhow!("{}: no object {id}", file.display()))?;
        all.check_symmetries(*id, mesh, &file.display().to_string())?;
        info.symmetries_discrete = found.symmetries_discrete.clone();
        info.symmetries_continuous = found.symmetries_continuous.clone();
    }
    match a.symmetric_about {
        Some(Axis::X) => info.rotates_freely_about(Vec3::x()),
        Some(Axis::Y) => info.rotates_freely_about(Vec3::y()),
        Some(Axis::Z) => info.rotates_freely_about(Vec3::z()),
        None => {}
    }
    Ok(info)
}

fn list(store: &ObjectStore, folder: &Path, json: &JsonArguments) -> Result<Outcome> {
    let listed: Vec<Listed> =
        store.records()?.into_iter().map(|(name, record)| Listed { name, record }).collect();
    report(json, &listed, || {
        if listed.is_empty() {
            println!("no objects in {}", folder.display());
        }
        for l in &listed {
            println!(
                "{:<24} {:>8.1} mm {:>8} faces  {}",
                l.name,
                1000.0 * l.record.diameter,
                l.record.faces,
                l.record.source
            );
        }
    })?;
    Ok(if listed.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

fn show(store: &ObjectStore, name: &str, picture: Option<&Path>, json: &JsonArguments) -> Result<Outcome> {
    let listed = Listed { name: name.to_owned(), record: store.record(name)? };
    if let Some(file) = picture {
        let object = store.load(name)?;
        write_rgb(file, &portrait(object.needed_mesh("ppf")?))?;
    }
    report(json, &listed, || {
        let r = &listed.record;
        println!("{name}");
        println!("  diameter    {:.2} mm", 1000.0 * r.diameter);
        if r.without_mesh {
            println!("  mesh        none: known from depth images");
        } else {
            println!("  mesh        {} vertices, {} faces", r.vertices, r.faces);
        }
        println!(
            "  symmetries  {} discrete, {} continuous",
            r.symmetries_discrete.len(),
            r.symmetries_continuous.len()
        );
        println!("  source      {} ({})", r.source, r.source_unit);
    })?;
    Ok(Outcome::Found)
}
