//! `sixfold object add|list|show|remove`.

use anyhow::{Result, anyhow};
use serde::Serialize;
use sixfold_geometry::Vec3;
use sixfold_io::write_rgb;
use sixfold_mesh::{ContinuousSymmetry, ModelInfo, ModelsInfo, read_mesh};

use crate::commands::mttm::onboard;
use crate::commands::object_arguments::{Axis, ObjectArguments, ObjectCommand};
use sixfold_shell::Outcome;
use sixfold_shell::objects::{Record, Store, new_record, new_record_of_views};
use sixfold_shell::output::report;

#[derive(Serialize)]
struct Listed {
    name: String,
    #[serde(flatten)]
    record: Record,
}

pub(crate) fn run(a: &ObjectArguments) -> Result<Outcome> {
    let store = Store { folder: &a.store };
    match &a.command {
        ObjectCommand::Add { name, mesh: None, views, replace, .. } => {
            let templates = onboard::of_depth(views)?;
            let record = new_record_of_views(&views.depth, &templates);
            store.add(name, None, Some(&templates), &record, *replace)?;
            let listed = Listed { name: name.clone(), record };
            report(&a.json, &listed, || {
                println!(
                    "added {name}: {} template(s), {:.1} mm across as seen",
                    templates.templates.len(),
                    1000.0 * templates.diameter
                );
            })?;
            Ok(Outcome::Found)
        }
        ObjectCommand::Add {
            name,
            mesh: Some(mesh),
            unit,
            templates,
            models_info,
            model_id,
            turns_about,
            replace,
            ..
        } => {
            let unit = unit.as_ref().ok_or_else(|| anyhow!("--unit UNIT is missing"))?;
            let loaded = read_mesh(mesh, *unit)?;
            let mut info = ModelInfo::of_mesh(&loaded);
            if let (Some(file), Some(id)) = (models_info, model_id) {
                let all = ModelsInfo::read(file)?;
                let found = all.0.get(id).ok_or_else(|| anyhow!("{}: no object {id}", file.display()))?;
                info.symmetries_discrete = found.symmetries_discrete.clone();
                info.symmetries_continuous = found.symmetries_continuous.clone();
            }
            if let Some(axis) = turns_about {
                let axis = match axis {
                    Axis::X => Vec3::x(),
                    Axis::Y => Vec3::y(),
                    Axis::Z => Vec3::z(),
                };
                // The axis runs through the middle of the bounding box: a file's origin may be anywhere.
                let offset = info.min + info.size * 0.5;
                info.symmetries_continuous.push(ContinuousSymmetry { axis, offset });
            }
            let record = new_record(mesh, *unit, &loaded, &info);
            store.add(name, Some(&loaded), None, &record, *replace)?;
            // What methods learn about it is learnt now, not at the first estimate.
            let object = store.load(name)?;
            object.ppf_model()?;
            // From the stored mesh, whose numbers are rounded: that is what later runs compare them with.
            let templates = templates.map(|views| onboard::of_mesh(&object.mesh, views)).transpose()?;
            if let Some(templates) = &templates {
                templates.write(&store.templates_file(name)?)?;
            }
            let listed = Listed { name: name.clone(), record };
            report(&a.json, &listed, || {
                println!(
                    "added {name}: diameter {:.1} mm, {} faces",
                    1000.0 * listed.record.diameter,
                    listed.record.faces
                );
                if let Some(t) = &templates {
                    println!("{} views with {} turns each", t.templates.len(), t.turns().len());
                }
            })?;
            Ok(Outcome::Found)
        }
        ObjectCommand::List => {
            let listed = store
                .names()?
                .into_iter()
                .map(|name| Ok(Listed { record: store.record(&name)?, name }))
                .collect::<Result<Vec<_>>>()?;
            report(&a.json, &listed, || {
                if listed.is_empty() {
                    println!("no objects in {}", a.store.display());
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
        ObjectCommand::Show { name, picture } => {
            let listed = Listed { name: name.clone(), record: store.record(name)? };
            if let Some(file) = picture {
                let object = store.load(name)?;
                write_rgb(file, &super::render::portrait(&object.mesh))?;
            }
            report(&a.json, &listed, || {
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
        ObjectCommand::Remove { name } => {
            store.remove(name)?;
            report(&a.json, &serde_json::json!({ "removed": name }), || println!("removed {name}"))?;
            Ok(Outcome::Found)
        }
    }
}
