//! What is dropped: meshes, the models of a dataset, synthetic household objects and toys.

use std::path::Path;

use anyhow::{Context, Result, bail};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::random::stream;
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::{ContinuousSymmetry, Mesh, ModelInfo, ModelsInfo, PlyFormat, Unit, read_mesh, write_ply};
use sixfold_simulation::{ConvexParts, PartsOptions};
use sixfold_synth::shapes::{Family, member, toy};

use super::arguments::SimulateScenesArguments;
use sixfold_shell::objects::find;
use sixfold_shell::output::write_atomically;
use sixfold_shell::progress::{Progress, check_interrupt};

/// One of the objects that scenes are made of.
pub(super) struct Thing {
    pub id: u32,
    pub name: String,
    pub mesh: Mesh,
    pub info: ModelInfo,
    pub parts: ConvexParts,
}

/// What is known of an object before its parts are.
struct Described {
    name: String,
    mesh: Mesh,
    info: ModelInfo,
}

/// All objects, by ascending id.
pub(super) fn collect(a: &SimulateScenesArguments) -> Result<Vec<Thing>> {
    let mut described: Vec<(u32, Described)> = vec![];
    if let Some(dataset) = &a.dataset {
        described = of_dataset(dataset, &a.ids)?;
    }
    let mut next = described.iter().map(|(id, _)| *id).max().unwrap_or(0);
    let mut add = |list: &mut Vec<(u32, Described)>, object: Described| {
        next += 1;
        list.push((next, object));
    };
    for name in &a.objects {
        let object = find(name, a.unit, &a.store)?;
        add(&mut described, Described { name: object.name, mesh: object.mesh, info: object.info });
    }
    for family in a.chosen_families()? {
        for number in 0..a.members {
            let number_of_all = (family as u64) << 32 | number as u64;
            add(&mut described, of_family(family, number, &mut stream(a.seed, number_of_all))?);
        }
    }
    for number in 0..a.toys {
        let mesh = toy(&mut stream(a.seed, 1 << 40 | number as u64))?;
        let info = ModelInfo::of_mesh(&mesh);
        add(&mut described, Described { name: format!("toy-{number}"), mesh, info });
    }
    let mut progress = Progress::new("objects", described.len());
    let mut things = vec![];
    for (id, Described { name, mesh, info }) in described {
        check_interrupt("give the same command again to continue")?;
        let parts = if a.exact {
            ConvexParts::of_mesh(&mesh, &PartsOptions::default())
        } else {
            ConvexParts::of_convex(&mesh)
        };
        let parts = parts.with_context(|| format!("object {name}"))?;
        let mesh = coloured(mesh, id)?;
        progress.step(name.clone());
        things.push(Thing { id, name, mesh, info, parts });
    }
    progress.finish();
    Ok(things)
}

fn of_dataset(dataset: &Path, wanted: &[u32]) -> Result<Vec<(u32, Described)>> {
    let folder = dataset.join("models");
    let infos = ModelsInfo::read(folder.join("models_info.json"))
        .with_context(|| format!("--dataset {}: its models", dataset.display()))?;
    if let Some(id) = wanted.iter().find(|id| !infos.0.contains_key(id)) {
        let there: Vec<String> = infos.0.keys().map(u32::to_string).collect();
        bail!("--ids: found {id}, expected some of {} ({})", there.join(", "), folder.display());
    }
    infos
        .0
        .into_iter()
        .filter(|(id, _)| wanted.is_empty() || wanted.contains(id))
        .map(|(id, info)| {
            let name = format!("obj_{id:06}");
            let mesh = read_mesh(folder.join(format!("{name}.ply")), Unit::Millimetre)?;
            if mesh.faces().is_empty() {
                bail!("{}/{name}.ply: found points without faces, expected a surface", folder.display());
            }
            Ok((id, Described { name, mesh, info }))
        })
        .collect()
}

/// A member of a family with the symmetries that it has by the way it is made.
fn of_family(family: Family, number: usize, random: &mut ChaCha8Rng) -> Result<Described> {
    let mesh = member(family, random)?.mesh;
    let mut info = ModelInfo::of_mesh(&mesh);
    let (low, high) = mesh.bounding_box();
    let (size, middle) = (high - low, (low + high) * 0.5);
    let half_turn = |axis: Vec3| {
        let turn = UnitQuaternion::from_axis_angle(
            &sixfold_geometry::nalgebra::Unit::new_normalize(axis),
            std::f64::consts::PI,
        );
        Pose::new(turn, middle - turn * middle)
    };
    match family {
        Family::Can | Family::Cup | Family::Bottle | Family::Bowl if (size.x - size.y).abs() < 1e-6 => {
            info.symmetries_continuous.push(ContinuousSymmetry { axis: Vec3::z(), offset: Vec3::zeros() });
        }
        Family::Can | Family::Cup | Family::Bottle | Family::Bowl => {
            info.symmetries_discrete.push(half_turn(Vec3::z()));
        }
        Family::Box => {
            info.symmetries_discrete.extend([Vec3::x(), Vec3::y(), Vec3::z()].map(half_turn));
        }
        Family::Mug | Family::Clamp | Family::Drill => {}
    }
    Ok(Described { name: format!("{}-{number}", family.name()), mesh, info })
}

/// A mesh without colours gets one of its own.
fn coloured(mesh: Mesh, id: u32) -> Result<Mesh> {
    if mesh.colors().is_some() || mesh.texture().is_some() {
        return Ok(mesh);
    }
    let mut random = stream(u64::from(id), 2 << 40);
    // Hues a golden section apart: neighbours in number differ most.
    let hue = f64::from(id) * 0.618_033_988_749_895;
    let (pale, bright) = (0.15 + 0.5 * random.random::<f64>(), 110.0 + 120.0 * random.random::<f64>());
    let channel = |shift: f64| {
        let wave = 0.5 + 0.5 * (std::f64::consts::TAU * (hue + shift)).cos();
        (bright * (pale + (1.0 - pale) * wave)).round() as u8
    };
    let color = [channel(0.0), channel(1.0 / 3.0), channel(2.0 / 3.0)];
    let count = mesh.vertices().len();
    Ok(mesh.with_colors(vec![color; count])?)
}

#[derive(Serialize)]
struct Listed<'a> {
    id: u32,
    name: &'a str,
    diameter: f64,
}

/// The models with `models_info.json`, and a list of their names.
pub(super) fn write(out: &Path, things: &[Thing]) -> Result<()> {
    let folder = out.join("models");
    std::fs::create_dir_all(&folder).with_context(|| format!("folder {}", folder.display()))?;
    let mut infos = ModelsInfo::default();
    for thing in things {
        let path = folder.join(format!("obj_{:06}.ply", thing.id));
        write_ply(&path, &thing.mesh, Unit::Millimetre, PlyFormat::BinaryLittleEndian)?;
        infos.0.insert(thing.id, thing.info.clone());
    }
    infos.write(folder.join("models_info.json"))?;
    let list: Vec<Listed<'_>> =
        things.iter().map(|t| Listed { id: t.id, name: &t.name, diameter: t.info.diameter }).collect();
    write_atomically(&out.join("objects.json"), serde_json::to_string_pretty(&list)?.as_bytes())
}
