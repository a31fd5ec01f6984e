//! `sixfold train`: posed photographs and meshes in, a model file out; interrupted at any time, it goes on.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, bail};
use burn::tensor::Device;
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::ModelCard;
use sixfold_outline::outline_mesh;
use sixfold_pix2pose::adversarial::{AdversarialOptions, train_adversarial};
use sixfold_pix2pose::aligned::measure_corrections;
use sixfold_pix2pose::model::{ImageSizes, Network, Pix2PoseModel};
use sixfold_pix2pose::networks::{CompactConfig, PaperGeneratorConfig, ResNet50GeneratorConfig};
use sixfold_pix2pose::object::{ObjectEntry, SymmetryMap, lmo_threshold};
use sixfold_pix2pose::samples::{RealCrop, SampleOptions, SampleSource, TrainingObject};
use sixfold_pix2pose::training::{TrainingOptions, TrainingOutcome, last_checkpoint, train};

use super::material::{Material, Summary, backgrounds, command_line, continued_from, material};
use super::train_detector::train_detector;
use crate::Outcome;
use crate::arguments::{NetworkKind, TrainArguments, TrainCommand, TrainPix2PoseArguments};
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
        TrainCommand::Detector(detector) => {
            let summary = train_detector(detector)?;
            report(&a.json, &summary, || match summary.seconds {
                Some(seconds) => {
                    println!("{} steps in {seconds:.0} s: {}", summary.steps, summary.model);
                    println!("learning curves: {}", detector.out.join("training/curves.png").display());
                }
                None => println!("the model after {} steps: {}", summary.steps, summary.model),
            })?;
            Ok(Outcome::Found)
        }
        TrainCommand::Nol(nol) => {
            let summary = super::train_nol::train_nol(nol)?;
            report(&a.json, &summary, || {
                match summary.seconds {
                    Some(seconds) => {
                        println!("{} steps in {seconds:.0} s: {}", summary.steps, summary.model);
                        println!("learning curves: {}", nol.out.join("training/curves.png").display());
                    }
                    None => println!("the model after {} steps: {}", summary.steps, summary.model),
                }
                let q = &summary.quality;
                println!("like the truth, on new made-up objects:");
                for (name, score) in q.scores() {
                    println!("  {name}: {score:.3}");
                }
            })?;
            Ok(Outcome::Found)
        }
        #[cfg(feature = "physics")]
        TrainCommand::Mttm(mttm) => {
            let summary = super::train_mttm::train_mttm(mttm)?;
            report(&a.json, &summary, || {
                match summary.seconds {
                    Some(seconds) => {
                        println!("{} steps in {seconds:.0} s: {}", summary.steps, summary.model);
                        println!("learning curves: {}", mttm.out.join("training/curves.png").display());
                    }
                    None => println!("the model after {} steps: {}", summary.steps, summary.model),
                }
                println!("on {} regions of made-up objects it was not trained on:", summary.quality.regions);
                for (name, score) in summary.quality.scores() {
                    println!("  {name}: {score:.3}");
                }
            })?;
            Ok(Outcome::Found)
        }
        #[cfg(feature = "experience")]
        TrainCommand::Dgcm(dgcm) => {
            let summary = super::train_dgcm::train_dgcm(dgcm)?;
            report(&a.json, &summary, || match summary.seconds {
                Some(seconds) => {
                    println!("{} steps in {seconds:.0} s: {}", summary.steps, summary.model);
                    println!("learning curves: {}", dgcm.out.join("training/curves.png").display());
                }
                None => println!("the model after {} steps: {}", summary.steps, summary.model),
            })?;
            Ok(Outcome::Found)
        }
    }
}

/// Trains, or goes on with a training, and writes the model.
pub(super) fn train_pix2pose(a: &TrainPix2PoseArguments) -> Result<Summary> {
    let Material { mut objects, real, mut description, .. } = material(&a.material, LEAST_VISIBLE)?;
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
    let backgrounds = backgrounds(&a.material, &real, &objects)?;
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
    let photographs = real.clone();
    let outlines: BTreeMap<u32, (Mesh, ModelInfo)> = if photographs.is_empty() {
        BTreeMap::new()
    } else {
        objects.iter().map(|o| (o.id, (outline_mesh(&o.mesh), o.info.clone()))).collect()
    };
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
    card.extra =
        serde_json::json!({ "training": options, "continued_from": continued_from(a.init.as_deref())? });
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
        let model = Pix2PoseModel::new(Network::Compact(Box::new(network)), entries, sizes, card);
        save_corrected(model, &path, &photographs, &outlines)?;
        let (seconds, losses) = (None, BTreeMap::new());
        let model = path.display().to_string();
        let photographs = photographs.len();
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
    eprintln!("making {} objects and {} photographed instances ready", objects.len(), photographs.len());
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
                .map(|n| Network::Paper(Box::new(n)))
        }
        NetworkKind::Resnet50 => {
            let config = ResNet50GeneratorConfig { seed: a.seed };
            let generator = match &a.encoder {
                Some(file) => config.from_pytorch(file, &device)?,
                None => config.init(&device),
            };
            train_adversarial(&source, &pools[0], generator, &device, &folder, &dissertation, stop, shown)?
                .map(|n| Network::ResNet50(Box::new(n)))
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
    let model = Pix2PoseModel::new(network, entries, sizes, card);
    save_corrected(model, &path, &photographs, &outlines)?;
    Ok(Summary {
        model: path.display().to_string(),
        objects: ids,
        photographs: photographs.len(),
        steps,
        seconds: Some(last.seconds),
        losses: last.losses,
    })
}

/// Writes the model with what its aligned poses are off by on the photographs that it learnt from.
fn save_corrected(
    mut model: Pix2PoseModel,
    path: &Path,
    photographs: &[RealCrop],
    outlines: &BTreeMap<u32, (Mesh, ModelInfo)>,
) -> Result<()> {
    // First without: nothing that was trained may be lost.
    model.save(path)?;
    if photographs.is_empty() {
        return Ok(());
    }
    let mut progress = Progress::new("alignment measured on the photographs", photographs.len());
    let corrections = measure_corrections(&model, photographs, outlines, || progress.step(String::new()))?;
    progress.finish();
    model.set_corrections(&corrections);
    Ok(model.save(path)?)
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
