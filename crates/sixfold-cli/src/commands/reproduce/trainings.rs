//! Networks trained for a comparison: symmetric objects with and without the transformer loss.
//!
//! Not here yet: L1 with limited views, training against a discriminator, convex hulls in place of meshes.

use std::path::Path;

use anyhow::{Result, bail};
use clap::Parser;
use sixfold_bop::Models;
use sixfold_pix2pose::estimate::EstimateOptions;

use super::row::{self, Row, Setting};
use super::{Bench, Regions};
use crate::arguments::{
    Arguments, Command, ReproducePix2PoseArguments, TrainCommand, TrainPix2PoseArguments,
};
use crate::commands::pix2pose::Pix2Pose;
use crate::commands::train::train_pix2pose;

/// One training of the comparison.
struct Training {
    key: &'static str,
    title: &'static str,
    more: &'static [&'static str],
}

const TRAININGS: [Training; 2] = [
    Training { key: "trained-transformer-loss", title: "symmetric objects, transformer loss", more: &[] },
    Training {
        key: "trained-plain-l1",
        title: "symmetric objects, plain L1",
        more: &["--no-transformer-loss"],
    },
];

/// Trains, or goes on with the trainings, and measures what they came to.
pub(super) fn rows(a: &ReproducePix2PoseArguments, bench: &Bench) -> Result<Vec<Row>> {
    let infos = bench.dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let ids: Vec<u32> = bench
        .meshes
        .keys()
        .copied()
        .filter(|id| infos.0.get(id).is_some_and(|i| !i.symmetries_discrete.is_empty()))
        .collect();
    if ids.is_empty() {
        eprintln!(
            "note: no object of the model has a discrete symmetry: nothing to train for the comparison"
        );
        return Ok(vec![]);
    }
    let mine = |regions: &Regions| {
        regions.iter().filter(|(key, _)| ids.contains(&key.2)).map(|(k, v)| (*k, v.clone())).collect()
    };
    let few = Bench {
        dataset: bench.dataset.clone(),
        targets: bench
            .targets
            .iter()
            .filter(|t| t.object.is_some_and(|o| ids.contains(&o.obj_id)))
            .copied()
            .collect(),
        meshes: bench
            .meshes
            .iter()
            .filter(|(id, _)| ids.contains(id))
            .map(|(id, mesh)| (*id, mesh.clone()))
            .collect(),
        truth: mine(&bench.truth),
        detections: None,
        seed: bench.seed,
    };
    let names: Vec<String> = ids.iter().map(u32::to_string).collect();
    let mut rows = vec![];
    for training in TRAININGS {
        let folder = a.out.join("trainings").join(format!("{}-{}", training.key, a.steps));
        let key = format!("{}-{}", training.key, a.steps);
        rows.push(row::kept_or_made(&a.out, &key, || {
            let model = train_pix2pose(&arguments(a, &names, &folder, training.more)?)?.model;
            let options = EstimateOptions { seed: a.seed, ..EstimateOptions::default() };
            let trained = Pix2Pose::load(Path::new(&model))?.varied(options.clone(), false);
            let setting = Setting {
                key: training.key,
                title: format!("objects {}, {} steps: {}", names.join(" and "), a.steps, training.title),
                options,
                refine: false,
                noise: None,
                detections: false,
            };
            few.measure(&trained, &setting, &a.out)
        })?);
    }
    Ok(rows)
}

/// The training's arguments with the defaults of the command line.
fn arguments(
    a: &ReproducePix2PoseArguments,
    ids: &[String],
    folder: &Path,
    more: &[&str],
) -> Result<TrainPix2PoseArguments> {
    let text = |path: &Path| path.as_os_str().to_owned();
    let mut words: Vec<std::ffi::OsString> =
        ["sixfold", "train", "pix2pose", "--dataset"].map(Into::into).to_vec();
    words.push(text(&a.dataset));
    words.extend(["--frames".into(), text(&a.frames), "--out".into(), text(folder)]);
    let options = [
        ("--split", a.split.clone()),
        ("--ids", ids.join(",")),
        ("--steps", a.steps.to_string()),
        ("--size", a.size.to_string()),
        ("--seed", a.seed.to_string()),
    ];
    words.extend(options.into_iter().flat_map(|(name, value)| [name.into(), value.into()]));
    if let Some(folder) = &a.backgrounds {
        words.extend(["--backgrounds".into(), text(folder)]);
    }
    words.extend(more.iter().map(Into::into));
    match Arguments::try_parse_from(words)?.command {
        Command::Train(train) => match train.command {
            TrainCommand::Pix2pose(arguments) => Ok(*arguments),
        },
        _ => bail!("the arguments of a training are not those of `sixfold train`"),
    }
}
