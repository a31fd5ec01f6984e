//! What trainings have in common: what they learn from (photographs and models of a dataset, or meshes; backgrounds), and what
//! they say in the end.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Result, bail};
use serde::Serialize;
use sixfold_augment::{Backgrounds, PhotographOptions};
use sixfold_bop::{BopDataset, Models};
use sixfold_geometry::Rect;
use sixfold_mesh::ModelInfo;
use sixfold_nn::weights::{ModelCard, read_card};
use sixfold_pix2pose::samples::{RealCrop, TrainingObject, read_real_crops};
use sixfold_render::BoundingBoxScale;

use crate::arguments::MaterialArguments;
use crate::objects;

/// Objects, their photographs, and where they came from in words.
pub(super) struct Material {
    pub objects: Vec<TrainingObject>,
    pub real: Vec<RealCrop>,
    pub description: String,
    /// The dataset and its frames, if it is one.
    pub frames: Option<(BopDataset, Vec<(u32, u32)>)>,
}

/// What a training came to.
#[derive(Serialize)]
pub(super) struct Summary {
    pub model: String,
    pub objects: Vec<u32>,
    pub photographs: usize,
    pub steps: u64,
    /// Of training; `None` where a model was only exported.
    pub seconds: Option<f64>,
    pub losses: BTreeMap<String, f64>,
}

/// What `a` names: all its objects, and the photographed instances of which at least the share `least_visible` is seen.
pub(super) fn material(a: &MaterialArguments, least_visible: f64) -> Result<Material> {
    match &a.dataset {
        Some(root) => from_dataset(a, root, least_visible),
        None => from_objects(a),
    }
}

fn from_dataset(a: &MaterialArguments, root: &Path, least_visible: f64) -> Result<Material> {
    let dataset = BopDataset::open(root, &a.split)?;
    let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let ids: Vec<u32> = if a.ids.is_empty() { infos.0.keys().copied().collect() } else { a.ids.clone() };
    if ids.is_empty() {
        bail!("{}: no objects: its models have no models_info.json; name them with --ids", root.display());
    }
    let mut objects = vec![];
    for &id in &ids {
        let mesh = dataset.model(id, Models::Rendering)?;
        let (low, high) = mesh.bounding_box();
        let info = infos.0.get(&id).cloned().unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
        objects.push(TrainingObject { id, scale: BoundingBoxScale::of_corners(&low, &high), mesh, info });
    }
    let frames: Vec<(u32, u32)> = match &a.frames {
        Some(file) => dataset.targets(Some(file))?.iter().map(|t| (t.scene_id, t.im_id)).collect(),
        None if a.renders_only => vec![],
        None => {
            let mut all = vec![];
            for scene_id in dataset.scene_ids() {
                let scene = dataset.scene(scene_id)?;
                let shown = scene.image_ids().into_iter().filter(|id| scene.rgb_path(*id).is_some());
                all.extend(shown.map(|im_id| (scene_id, im_id)));
            }
            if all.is_empty() {
                bail!(
                    "{}: split {} has no colour images to learn from; give another --split, or train with --renders-only",
                    root.display(),
                    a.split
                );
            }
            all
        }
    };
    let mut frames = frames;
    frames.sort_unstable();
    frames.dedup();
    let real = read_real_crops(&dataset, &frames, &ids, least_visible)?;
    if real.is_empty() && !a.renders_only {
        bail!(
            "{}: none of the {} frames shows an object at least {:.0} % visible; choose other --frames, or train with --renders-only",
            root.display(),
            frames.len(),
            100.0 * least_visible
        );
    }
    let name = root.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let images = frames.iter().map(|(scene, image)| format!("{scene}/{image}")).collect::<Vec<_>>().join(" ");
    let description = format!(
        "dataset {name}, split {}: {} real frames ({images}) with {} instances, and renders of its models",
        a.split,
        frames.len(),
        real.len()
    );
    let frames = Some((dataset, frames));
    Ok(Material { objects, real, description, frames })
}

fn from_objects(a: &MaterialArguments) -> Result<Material> {
    if a.objects.is_empty() {
        bail!("what is to be learnt? Give --dataset DIR, or --object NAME_OR_MESH for training on renders");
    }
    let mut objects = vec![];
    for (index, name) in a.objects.iter().enumerate() {
        let object = objects::find(name, a.unit, &a.store)?;
        let (low, high) = object.mesh.bounding_box();
        let scale = BoundingBoxScale::of_corners(&low, &high);
        objects.push(TrainingObject { id: index as u32 + 1, scale, mesh: object.mesh, info: object.info });
    }
    let description = format!("renders of {}", a.objects.join(", "));
    Ok(Material { objects, real: vec![], description, frames: None })
}

/// Photographs of the user's folder if there is one, else procedural textures; and the share of textures that goes well
/// with them.
pub(super) fn plain_backgrounds(a: &MaterialArguments) -> Result<(Backgrounds, f32)> {
    Ok(match &a.backgrounds {
        Some(folder) => (Backgrounds::from_folder(folder, &PhotographOptions::default())?, 0.1),
        None => (Backgrounds::procedural(), 0.6),
    })
}

/// Photographs of the user's folder if there is one, else procedural textures; and always the training frames themselves
/// away from their objects.
pub(super) fn backgrounds(
    a: &MaterialArguments,
    real: &[RealCrop],
    objects: &[TrainingObject],
) -> Result<Backgrounds> {
    let (mut backgrounds, share) = plain_backgrounds(a)?;
    let mut frames: Vec<(&Arc<_>, Vec<Rect>)> = vec![];
    for crop in real {
        let Some(object) = objects.iter().find(|o| o.id == crop.object_id()) else { continue };
        let (low, high) = object.mesh.bounding_box();
        let corners = (0..8).filter_map(|i| {
            let pick = |axis: usize| if i >> axis & 1 == 0 { low[axis] } else { high[axis] };
            let corner = sixfold_geometry::Vec3::new(pick(0), pick(1), pick(2));
            crop.camera().project(&crop.camera_from_object().transform_point(&corner))
        });
        let (x, y): (Vec<f64>, Vec<f64>) = corners.map(|c| (c.x, c.y)).unzip();
        let least = |v: &[f64]| v.iter().copied().fold(f64::INFINITY, f64::min);
        let most = |v: &[f64]| v.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if x.is_empty() {
            continue;
        }
        let rect =
            Rect { x: least(&x), y: least(&y), width: most(&x) - least(&x), height: most(&y) - least(&y) };
        match frames.iter_mut().find(|(image, _)| Arc::ptr_eq(image, crop.image())) {
            Some((_, rects)) => rects.push(rect),
            None => frames.push((crop.image(), vec![rect])),
        }
    }
    for (image, rects) in frames {
        backgrounds = backgrounds.with_image(image.clone(), rects)?;
    }
    Ok(backgrounds.with_procedural_share(share))
}

/// What a card says of the weights that a training began with: how they came about, and theirs in turn.
pub(super) fn continued_from(init: Option<&Path>) -> Result<serde_json::Value> {
    let Some(file) = init else { return Ok(serde_json::Value::Null) };
    let card = read_card(file)?;
    Ok(serde_json::json!({
        "file": file.display().to_string(),
        "command": card.command,
        "data": card.data,
        "steps": card.steps,
        "seed": card.seed,
        "continued_from": card.extra["continued_from"],
    }))
}

/// What the user typed, for the card.
pub(super) fn command_line() -> String {
    let words = std::env::args().skip(1).filter(|word| word != "--export");
    std::iter::once("sixfold".to_string()).chain(words).collect::<Vec<_>>().join(" ")
}

/// Whether a model's card names a frame (`scene/image`) among those of its training.
pub(crate) fn was_trained_on(card: &ModelCard, scene_id: u32, im_id: u32) -> bool {
    let name = format!("{scene_id}/{im_id}");
    card.data.split(|c: char| !(c.is_ascii_digit() || c == '/')).any(|word| word == name)
}
