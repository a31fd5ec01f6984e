//! `sixfold train`: posed photographs and meshes in, a model file out; interrupted at any time, it goes on.

use anyhow::{Result, bail};
use sixfold_nn::training::Ending;
use sixfold_pix2pose::recipe::{LEAST_VISIBLE, Recipe};

use super::material::{Shown, Summary, command_line, interrupted_after, loss, material};
use super::train_detector::train_detector;
use crate::arguments::{Preset, TrainArguments, TrainCommand, TrainPix2PoseArguments};
use sixfold_shell::Outcome;
use sixfold_shell::output::report;
use sixfold_shell::progress::interrupted;

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
    if !a.size.is_multiple_of(32) || !(32..=512).contains(&a.size) {
        bail!("--size: found {}, expected a multiple of 32 from 32 to 512", a.size);
    }
    if !(0.0..=180.0).contains(&a.rotation) {
        bail!("--rotation: found {}, expected degrees from 0 to 180", a.rotation);
    }
    let recipe = Recipe {
        network: a.network.kind(),
        steps: a.steps,
        per_object: a.per_object,
        learning_rate: a.learning_rate,
        adversarial: a.adversarial.then_some(true).or(a.no_adversarial.then_some(false)),
        encoder: a.encoder.clone(),
        frozen_stages: a.frozen_stages,
        render_share: a.render_share,
        near_photographs: a.near_photographs,
        rotation: a.rotation.to_radians(),
        size: a.size,
        init: a.init.clone(),
        mesh_colors: !a.no_mesh_colors,
        convex_hull: a.convex_hull,
        transformer_loss: !a.no_transformer_loss,
        view_limits: a.view_limits,
        preset: a.preset.map(Preset::preset),
        backgrounds: a.material.backgrounds.clone(),
        seed: a.seed,
        command: command_line(),
    };
    let material = material(&a.material, LEAST_VISIBLE)?;
    let objects = material.objects.iter().map(|o| o.id).collect();
    let photographs = material.real.len();
    let mut shown = Shown::new(|record| {
        format!("L1 {:.4}, {:.0} images/s", loss(record, "coordinates"), record.samples_per_second)
    });
    let ending = if a.export {
        Ending::Finished(recipe.export(material, &a.out, &mut |news| shown.hear(news))?)
    } else {
        recipe.train(material, &a.out, interrupted(), &mut |news| shown.hear(news))?
    };
    shown.finish();
    match ending {
        Ending::Finished(trained) => Ok(Summary::new(trained, objects, photographs)),
        Ending::Interrupted { step } => Err(interrupted_after(step)),
    }
}
