//! `sixfold train pix2pose`: posed photographs and meshes in, a model file out; interrupted at any time, it goes on.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use burn::tensor::Device;
use serde::Serialize;
use sixfold_augment::{Backgrounds, PhotographOptions};
use sixfold_bop::{BopDataset, Models};
use sixfold_geometry::Rect;
use sixfold_mesh::ModelInfo;
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::ModelCard;
use sixfold_pix2pose::adversarial::{AdversarialOptions, train_adversarial};
use sixfold_pix2pose::model::{ImageSizes, Network, Pix2PoseModel};
use sixfold_pix2pose::networks::{CompactConfig, PaperGeneratorConfig, ResNet50GeneratorConfig};
use sixfold_pix2pose::object::{ObjectEntry, SymmetryMap, lmo_threshold};
use sixfold_pix2pose::samples::{RealCrop, SampleOptions, SampleSource, TrainingObject, read_real_crops};
use sixfold_pix2pose::training::{TrainingOptions, TrainingOutcome, last_checkpoint, train};
use sixfold_render::BoundingBoxScale;

use crate::Outcome;
use crate::arguments::{NetworkKind, TrainArguments, TrainCommand, TrainPix2PoseArguments};
use crate::objects;
use crate::output::report;
use crate::progress::{Progress, interrupted};

/// Instances of a photograph that are less visible teach more confusion than shape.
const LEAST_VISIBLE: f64 = 0.25;

pub(crate) fn run(a: &TrainArguments) -> Result<Outcome> {
    match &a.command {
        TrainCommand::Pix2pose(pix2pose) => {
            let summary = train_pix2pose(pix2pose)?;
            report(&a.json, &summary, || match summary.seconds {
                Some(seconds) => {
                    println!("{} steps in {seconds:.0} s: {}", summary.steps, summary.model);
                    println!("learning curves: {}", pix2pose.out.join("training/curves.png").display());
                }
                None => println!("the model after {} steps: {}", summary.steps, summary.model),
            })?;
            Ok(Outcome::Found)
        }
    }
}

/// What a training came to.
#[derive(Serialize)]
pub(super) struct Summary {
    pub model: String,
    objects: Vec<u32>,
    photographs: usize,
    steps: u64,
    /// Of training; `None` where a model was only exported.
    seconds: Option<f64>,
    losses: std::collections::BTreeMap<String, f64>,
}

/// Objects, their photographs, and where they came from in words.
struct Material {
    objects: Vec<TrainingObject>,
    real: Vec<RealCrop>,
    description: String,
}

/// Trains, or goes on with a training, and writes the model.
pub(super) fn train_pix2pose(a: &TrainPix2PoseArguments) -> Result<Summary> {
    let material = match &a.dataset {
        Some(root) => from_dataset(a, root)?,
        None => from_objects(a)?,
    };
    let Material { mut objects, real, mut description } = material;
    for object in &objects {
        warn_of_symmetry(object);
    }
    if a.convex_hull {
        for object in &mut objects {
            object.mesh = object
                .mesh
                .convex_hull()
                .with_context(|| format!("object {}: its vertices have no convex hull", object.id))?;
        }
        description += "; convex hulls in place of the meshes";
    }
    let backgrounds = backgrounds(a, &real, &objects)?;
    let compact = a.network == NetworkKind::Compact;
    let options = TrainingOptions {
        steps: a.steps.unwrap_or(8000),
        per_object: a.per_object.unwrap_or(4),
        learning_rate: a.learning_rate.unwrap_or(0.002),
        frozen_stages: a.frozen_stages,
        transformer_loss: !a.no_transformer_loss && !a.view_limits,
        seed: a.seed,
        ..TrainingOptions::default()
    };
    if !a.size.is_multiple_of(32) || !(32..=512).contains(&a.size) {
        bail!("--size: found {}, expected a multiple of 32 from 32 to 512", a.size);
    }
    if !(0.0..=180.0).contains(&a.rotation) {
        bail!("--rotation: found {}, expected degrees from 0 to 180", a.rotation);
    }
    if !compact && (objects.len() != 1 || a.size != 128 || a.init.is_some() || a.export) {
        bail!(
            "--network {}: it learns one object (found {}; choose it with --ids) from images of 128 pixels, and --init \
             and --export are for the compact network",
            a.network.name(),
            objects.len()
        );
    }
    let sizes = ImageSizes { input: a.size, output: if compact { a.size / 2 } else { a.size } };
    let photographs = real.len();
    let entries: Vec<ObjectEntry> = objects
        .iter()
        .map(|o| {
            let mut entry = ObjectEntry::new(o.id, &o.info, &o.scale);
            if let (true, Some(threshold)) = (a.lmo_thresholds, lmo_threshold(o.id)) {
                entry.thresholds = vec![threshold];
            }
            entry
        })
        .collect();
    let pools: Vec<Vec<SymmetryMap>> = objects.iter().map(|o| SymmetryMap::pool(&o.info, &o.scale)).collect();
    let ids: Vec<u32> = entries.iter().map(|e| e.id).collect();
    // Tells of wrong weights before anything else begins.
    let device = Device::flex().autodiff();
    let network = match &a.init {
        Some(file) => Pix2PoseModel::network_for_training(file, &ids, &device)?,
        None => CompactConfig { objects: ids.len() }.init(imagenet_encoder(&device)?, a.seed, &device),
    };
    let folder = a.out.join("training");
    let mut card = ModelCard::new("", "Pix2Pose, compact network");
    card.data = description;
    card.seed = options.seed;
    card.command = command_line();
    card.extra = serde_json::json!({ "training": options });
    let dissertation = AdversarialOptions {
        steps: a.steps.unwrap_or(25_000),
        batch: a.per_object.unwrap_or(50),
        learning_rate: a.learning_rate.unwrap_or(1e-4),
        adversarial: !a.no_adversarial,
        transformer_loss: !a.no_transformer_loss && !a.view_limits,
        seed: a.seed,
        ..AdversarialOptions::default()
    };
    if !compact {
        card.title = format!("Pix2Pose, the dissertation's schedule, {} network", a.network.name());
        card.extra = serde_json::json!({ "training": dissertation });
    }
    let steps = if compact { options.steps } else { dissertation.steps };
    let path = a.out.join("model.safetensors");
    if a.export {
        let Some((network, step)) = last_checkpoint(&folder, network)? else {
            bail!("{}: holds no checkpoint; train first", folder.display());
        };
        card.steps = step;
        Pix2PoseModel::new(Network::Compact(Box::new(network)), entries, sizes, card).save(&path)?;
        let (seconds, losses) = (None, std::collections::BTreeMap::new());
        let model = path.display().to_string();
        return Ok(Summary { model, objects: ids, photographs, steps: step, seconds, losses });
    }
    let sample_options = SampleOptions {
        size: sizes.input,
        target_size: Some(sizes.output),
        render_share: a.render_share,
        near_real_share: a.near_photographs,
        rotation: a.rotation.to_radians(),
        random_color_chance: if a.no_mesh_colors { 1.0 } else { 0.0 },
        view_limits: a.view_limits,
        seed: a.seed,
        ..SampleOptions::default()
    };
    eprintln!("making {} objects and {photographs} photographed instances ready", objects.len());
    let source = SampleSource::new(objects, real, backgrounds, sample_options)?;
    let mut progress = Progress::new("steps", steps as usize);
    let mut last = TrainingRecord::default();
    let shown = |record: &TrainingRecord| {
        progress.set(record.step as usize);
        progress.message(format!(
            "L1 {:.4}, {:.0} images/s",
            record.losses.get("coordinates").copied().unwrap_or(f64::NAN),
            record.samples_per_second
        ));
        last = record.clone();
    };
    let stop = interrupted();
    let outcome = match a.network {
        NetworkKind::Compact => train(&source, &pools, network, &device, &folder, &options, stop, shown)?,
        NetworkKind::Paper => {
            let generator = PaperGeneratorConfig { seed: a.seed }.init(&device);
            train_adversarial(&source, &pools[0], generator, &device, &folder, &dissertation, stop, shown)?
        }
        NetworkKind::Resnet50 => {
            let config = ResNet50GeneratorConfig { seed: a.seed };
            let generator = match &a.encoder {
                Some(file) => config.from_pytorch(file, &device)?,
                None => config.init(&device),
            };
            train_adversarial(&source, &pools[0], generator, &device, &folder, &dissertation, stop, shown)?
        }
    };
    progress.finish();
    let network = match outcome {
        TrainingOutcome::Finished(network) => network,
        TrainingOutcome::Interrupted { step } => {
            bail!("interrupted after step {step}, which is kept; run the same command again to go on")
        }
    };
    card.steps = steps;
    Pix2PoseModel::new(network, entries, sizes, card).save(&path)?;
    Ok(Summary {
        model: path.display().to_string(),
        objects: ids,
        photographs,
        steps,
        seconds: Some(last.seconds),
        losses: last.losses,
    })
}

fn from_dataset(a: &TrainPix2PoseArguments, root: &Path) -> Result<Material> {
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
    let real = read_real_crops(&dataset, &frames, &ids, LEAST_VISIBLE)?;
    if real.is_empty() && !a.renders_only {
        bail!(
            "{}: none of the {} frames shows an object at least {:.0} % visible; choose other --frames, or train with --renders-only",
            root.display(),
            frames.len(),
            100.0 * LEAST_VISIBLE
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
    Ok(Material { objects, real, description })
}

fn from_objects(a: &TrainPix2PoseArguments) -> Result<Material> {
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
    Ok(Material { objects, real: vec![], description })
}

/// Photographs of the user's folder if there is one, else procedural textures; and always the training frames themselves
/// away from their objects.
fn backgrounds(
    a: &TrainPix2PoseArguments,
    real: &[RealCrop],
    objects: &[TrainingObject],
) -> Result<Backgrounds> {
    let (mut backgrounds, share) = match &a.backgrounds {
        Some(folder) => (Backgrounds::from_folder(folder, &PhotographOptions::default())?, 0.1),
        None => (Backgrounds::procedural(), 0.6),
    };
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

/// A symmetry that the mesh does not have misleads the training: say how far the surface is off.
fn warn_of_symmetry(object: &TrainingObject) {
    for pose in object.info.symmetry_poses(0.1).iter().skip(1) {
        let deviation = sixfold_pix2pose::object::symmetry_deviation(&object.mesh, pose);
        if deviation > 0.05 * object.info.diameter {
            eprintln!(
                "warning: object {}: under a declared symmetry its surface moves by {:.1} mm ({:.0} % of the diameter); \
                 check symmetries in models_info.json",
                object.id,
                1000.0 * deviation,
                100.0 * deviation / object.info.diameter
            );
            return;
        }
    }
}

/// What the user typed, for the card.
fn command_line() -> String {
    let words = std::env::args().skip(1);
    std::iter::once("sixfold".to_string()).chain(words).collect::<Vec<_>>().join(" ")
}
