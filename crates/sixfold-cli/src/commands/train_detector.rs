//! `sixfold train detector`: photographs with their ground truth, and models, in; a detector's file out.

use anyhow::{Result, bail};
use sixfold_detect::recipe::{LEAST_VISIBLE, Recipe};
use sixfold_nn::training::Ending;

use super::material::{Shown, Summary, command_line, interrupted_after, loss, material};
use crate::arguments::{DetectorKind, TrainDetectorArguments};
use sixfold_shell::progress::interrupted;

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
    let recipe = Recipe {
        network: a.network.kind(),
        steps: a.steps,
        batch: a.batch,
        learning_rate: a.learning_rate,
        encoder_share: a.encoder_share,
        frozen_stages: a.frozen_stages,
        encoder: a.encoder.clone(),
        size: a.size,
        photograph_share: a.photograph_share,
        render_share: a.render_share,
        rotation: a.rotation.to_radians(),
        mesh_colors: !a.no_mesh_colors,
        longest_side: a.longest_side,
        threshold: a.threshold,
        init: a.init.clone(),
        backgrounds: a.material.backgrounds.clone(),
        seed: a.seed,
        command: command_line(),
    };
    let material = material(&a.material, LEAST_VISIBLE)?;
    let objects = material.objects.iter().map(|o| o.id).collect();
    let photographs = material.real.len();
    let mut shown = Shown::new(|record| {
        format!(
            "scores {:.3}, boxes {:.3}, masks {:.3}, {:.1} images/s",
            loss(record, "scores"),
            loss(record, "boxes"),
            loss(record, "masks"),
            record.samples_per_second
        )
    });
    let ending = if a.export {
        Ending::Finished(recipe.export(&material, &a.out)?)
    } else {
        recipe.train(material, &a.out, interrupted(), &mut |news| shown.hear(news))?
    };
    shown.finish();
    match ending {
        Ending::Finished(trained) => Ok(Summary::new(trained, objects, photographs)),
        Ending::Interrupted { step } => Err(interrupted_after(step)),
    }
}
