//! Networks trained for a comparison: symmetric objects with and without the transformer loss, and two others with their
//! convex hulls in place of the meshes, from photographs alone.
//!
//! Not here yet: L1 with limited views, training against a discriminator.

use std::path::Path;

use anyhow::{Result, bail};
use clap::Parser;
use sixfold_bop::{Models, Target};
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
    /// Of the objects with discrete symmetries; otherwise of the first two others.
    symmetric: bool,
    more: &'static [&'static str],
}

const TRAININGS: [Training; 4] = [
    Training { key: "trained-transformer-loss", title: "transformer loss", symmetric: true, more: &[] },
    Training {
        key: "trained-plain-l1",
        title: "plain L1",
        symmetric: true,
        more: &["--no-transformer-loss"],
    },
    Training {
        key: "trained-mesh",
        title: "meshes, photographs only",
        symmetric: false,
        more: &["--render-share", "0"],
    },
    Training {
        key: "trained-convex-hull",
        title: "convex hulls, photographs only",
        symmetric: false,
        more: &["--render-share", "0", "--convex-hull"],
    },
];

/// Trains, or goes on with the trainings, and measures what they came to.
pub(super) fn rows(a: &ReproducePix2PoseArguments, bench: &Bench) -> Result<Vec<Row>> {
    let infos = bench.dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let symmetric = |id: &u32| infos.0.get(id).is_some_and(|i| !i.symmetries_discrete.is_empty());
    let (turning, others): (Vec<u32>, Vec<u32>) = bench.meshes.keys().copied().partition(symmetric);
    let others: Vec<u32> = others.into_iter().take(2).collect();
    let mut rows = vec![];
    for training in TRAININGS {
        let ids = if training.symmetric { &turning } else { &others };
        let key = format!("{}-{}", training.key, a.steps);
        if ids.is_empty() {
            eprintln!("note: {key}: the model has no such object, nothing to train for the comparison");
            continue;
        }
        let names: Vec<String> = ids.iter().map(u32::to_string).collect();
        let folder = a.out.join("trainings").join(&key);
        rows.push(row::kept_or_made(&a.out, &key, || {
            let model = train_pix2pose(&arguments(a, &names, &folder, training.more)?)?.model;
            let options = EstimateOptions { seed: a.seed, ..EstimateOptions::default() };
            let trained = Pix2Pose::load(Path::new(&model))?.varied(options.clone(), false);
            let setting = Setting {
                key: key.clone(),
                title: format!(
                    "objects {}, {} steps, two stages, PnP: {}",
                    names.join(" and "),
                    a.steps,
                    training.title
                ),
                options,
                refine: false,
                noise: None,
                detections: false,
            };
            bench.of_objects(ids).measure(&trained, &setting, &a.out)
        })?);
    }
    Ok(rows)
}

impl Bench {
    /// The same for a few objects.
    fn of_objects(&self, ids: &[u32]) -> Bench {
        let mine = |regions: &Regions| {
            regions.iter().filter(|(key, _)| ids.contains(&key.2)).map(|(k, v)| (*k, v.clone())).collect()
        };
        let of_them = |t: &&Target| t.object.is_some_and(|o| ids.contains(&o.obj_id));
        Bench {
            dataset: self.dataset.clone(),
            targets: self.targets.iter().filter(of_them).copied().collect(),
            meshes: self
                .meshes
                .iter()
                .filter(|(id, _)| ids.contains(id))
                .map(|(id, m)| (*id, m.clone()))
                .collect(),
            truth: mine(&self.truth),
            detections: None,
            seed: self.seed,
        }
    }
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
            TrainCommand::Detector(_) => bail!("the arguments of a training are not those of Pix2Pose"),
        },
        _ => bail!("the arguments of a training are not those of `sixfold train`"),
    }
}
