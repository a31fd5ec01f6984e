//! `sixfold train detector`: photographs with their ground truth, and models, in; a detector's file out.

use anyhow::{Result, bail};
use burn::tensor::Device;
use sixfold_detect::model::{ClassEntry, DetectorModel, DetectorUse};
use sixfold_detect::network::{DetectorConfig, Encoder};
use sixfold_detect::samples::{SceneObject, SceneOptions, SceneSource};
use sixfold_detect::training::{Ending, TrainingOptions, TrainingPace, last_checkpoint, train};
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::resnet::ResNet50Config;
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::ModelCard;
use sixfold_pix2pose::samples::read_real_crops;

use super::material::{Summary, command_line, continued_from, material, plain_backgrounds};
use crate::arguments::{DetectorKind, TrainDetectorArguments};
use crate::progress::{Progress, interrupted};

/// Less complete instances are not cut out to be pasted elsewhere.
const CUT_VISIBLE: f64 = 0.6;

/// Trains, or goes on with a training, and writes the model.
pub(super) fn train_detector(a: &TrainDetectorArguments) -> Result<Summary> {
    if !(0.0..=1.0).contains(&a.threshold) {
        bail!("--threshold: found {}, expected 0 to 1", a.threshold);
    }
    if !(32..=16_384).contains(&a.longest_side) {
        bail!("--longest-side: found {}, expected 32 to 16384 pixels", a.longest_side);
    }
    if !(0.0..=180.0).contains(&a.rotation) {
        bail!("--rotation: found {}, expected degrees from 0 to 180", a.rotation);
    }
    if a.encoder.is_some() && a.network == DetectorKind::Compact {
        bail!(
            "--encoder: the compact network brings its ImageNet encoder along; it belongs to --network retinanet"
        );
    }
    let material = material(&a.material, 0.0)?;
    let ids: Vec<u32> = material.objects.iter().map(|o| o.id).collect();
    let photographs = material.real.len();
    let device = Device::flex().autodiff();
    let (network, config) = match (&a.init, a.network) {
        (Some(file), _) => DetectorModel::network_for_training(file, &ids, &device)?,
        (None, DetectorKind::Compact) => {
            let config = DetectorConfig::compact(ids.len());
            (config.init_with(Encoder::Lite0(imagenet_encoder(&device)?), a.seed, &device), config)
        }
        (None, DetectorKind::Retinanet) => {
            let config = DetectorConfig::retinanet(ids.len());
            let encoder = match &a.encoder {
                Some(file) => ResNet50Config::features(4).from_pytorch(file, &device)?,
                None => ResNet50Config::features(4).init(a.seed, &device),
            };
            (config.init_with(Encoder::ResNet50(encoder), a.seed, &device), config)
        }
    };
    let options = TrainingOptions {
        steps: a.steps,
        batch: a.batch,
        learning_rate: a.learning_rate,
        encoder_share: a.encoder_share,
        frozen_stages: a.frozen_stages,
        seed: a.seed,
        ..TrainingOptions::default()
    };
    let folder = a.out.join("training");
    let mut card = ModelCard::new("", &format!("Detector, {} network", a.network.name()));
    card.data = material.description;
    card.seed = a.seed;
    card.command = command_line();
    card.extra =
        serde_json::json!({ "training": options, "continued_from": continued_from(a.init.as_deref())? });
    let usage = DetectorUse { longest_side: a.longest_side, threshold: a.threshold };
    let classes: Vec<ClassEntry> = ids.iter().map(|id| ClassEntry { id: *id }).collect();
    let path = a.out.join("model.safetensors");
    let summary = |steps, seconds, losses| Summary {
        model: path.display().to_string(),
        objects: ids.clone(),
        photographs,
        steps,
        seconds,
        losses,
    };
    if a.export {
        let Some((network, step)) = last_checkpoint(&folder, network)? else {
            bail!("{}: holds no checkpoint; train first", folder.display());
        };
        card.steps = step;
        DetectorModel::new(network, config, classes, usage, card).save(&path)?;
        return Ok(summary(step, None, Default::default()));
    }
    let scene_options = SceneOptions {
        size: a.size,
        photograph_share: a.photograph_share,
        render_share: a.render_share,
        rotation: a.rotation.to_radians(),
        random_color_chance: if a.no_mesh_colors { 1.0 } else { 0.0 },
        ..SceneOptions::default()
    };
    eprintln!("making {} objects and {photographs} photographed instances ready", ids.len());
    let cut = match &material.frames {
        Some((dataset, frames)) => read_real_crops(dataset, frames, &ids, CUT_VISIBLE)?,
        None => vec![],
    };
    let objects = material
        .objects
        .into_iter()
        .map(|o| SceneObject { id: o.id, mesh: o.mesh, diameter: o.info.diameter })
        .collect();
    let (backgrounds, share) = plain_backgrounds(&a.material)?;
    let backgrounds = backgrounds.with_procedural_share(share);
    let source = SceneSource::new(objects, &material.real, &cut, backgrounds, scene_options)?;
    let mut progress = Progress::new("steps", a.steps as usize);
    let mut last = TrainingRecord::default();
    let shown = |record: &TrainingRecord| {
        progress.set(record.step as usize);
        let loss = |name: &str| record.losses.get(name).copied().unwrap_or(f64::NAN);
        progress.message(format!(
            "scores {:.3}, boxes {:.3}, masks {:.3}, {:.1} images/s",
            loss("scores"),
            loss("boxes"),
            loss("masks"),
            record.samples_per_second
        ));
        last = record.clone();
    };
    let pace = TrainingPace::default();
    let ending = train(&source, network, &config, &device, &folder, &options, &pace, interrupted(), shown)?;
    progress.finish();
    let network = match ending {
        Ending::Finished(network) => network,
        Ending::Interrupted { step } => {
            bail!("interrupted after step {step}, which is kept; run the same command again to go on")
        }
    };
    card.steps = a.steps;
    DetectorModel::new(network, config, classes, usage, card).save(&path)?;
    Ok(summary(a.steps, Some(last.seconds), last.losses))
}
