//! Networks trained for a comparison: symmetric objects with the transformer loss, with L1 and view limits, and with
//! plain L1 (table 3.1), and two others with their convex hulls in place of the meshes, from photographs alone, and with a
//! discriminator and without (figure 3.12), on whole boxes and on boxes of which half is black.

use std::path::Path;

use anyhow::{Result, bail};
use clap::Parser;
use sixfold_bop::{Models, Target};

use super::row::{self, Row, Setting};
use super::{Bench, Regions, fourfold};
use crate::arguments::{
    Arguments, Command, ReproducePix2PoseArguments, TrainCommand, TrainPix2PoseArguments,
};
use crate::commands::pix2pose::Pix2Pose;
use crate::commands::train::train_pix2pose;

/// What a training of the comparison learns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Of {
    /// The dataset's objects with discrete symmetries.
    Symmetric,
    /// The first two without.
    Others,
    /// A made-up object with four equal sides, from renders.
    Fourfold,
}

/// One training of the comparison.
struct Training {
    key: &'static str,
    title: &'static str,
    of: Of,
    more: &'static [&'static str],
}

const fn training(key: &'static str, title: &'static str, of: Of, more: &'static [&'static str]) -> Training {
    Training { key, title, of, more }
}

const TRAININGS: [Training; 9] = [
    training("trained-transformer-loss", "transformer loss", Of::Symmetric, &[]),
    training("trained-view-limits", "L1 with view limits", Of::Symmetric, &["--view-limits"]),
    training("trained-plain-l1", "L1", Of::Symmetric, &["--no-transformer-loss"]),
    training("fourfold-transformer-loss", "transformer loss", Of::Fourfold, &[]),
    training("fourfold-view-limits", "L1 with view limits", Of::Fourfold, &["--view-limits"]),
    training("fourfold-plain-l1", "L1", Of::Fourfold, &["--no-transformer-loss"]),
    training("trained-mesh", "meshes, photographs only", Of::Others, &["--render-share", "0"]),
    training(
        "trained-discriminator",
        "meshes, photographs only, with discriminators",
        Of::Others,
        &["--render-share", "0", "--adversarial"],
    ),
    training(
        "trained-convex-hull",
        "convex hulls, photographs only",
        Of::Others,
        &["--render-share", "0", "--convex-hull"],
    ),
];

/// Trains, or goes on with the trainings, and measures what they came to.
pub(super) fn rows(a: &ReproducePix2PoseArguments, bench: &Bench) -> Result<Vec<Row>> {
    let infos = bench.dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let symmetric = |id: &u32| infos.0.get(id).is_some_and(|i| !i.symmetries_discrete.is_empty());
    let (turning, others): (Vec<u32>, Vec<u32>) = bench.meshes.keys().copied().partition(symmetric);
    let others: Vec<u32> = others.into_iter().take(2).collect();
    let fourfold_folder = a.out.join("fourfold");
    let mut fourfold_bench = None;
    let mut rows = vec![];
    for training in TRAININGS {
        let ids = match training.of {
            Of::Symmetric => turning.clone(),
            Of::Others => others.clone(),
            Of::Fourfold => vec![fourfold::OBJECT],
        };
        let key = format!("{}-{}", training.key, a.steps);
        if ids.is_empty() {
            eprintln!("note: {key}: the model has no such object, nothing to train for the comparison");
            continue;
        }
        let names: Vec<String> = ids.iter().map(u32::to_string).collect();
        let folder = a.out.join("trainings").join(&key);
        let made = training.of == Of::Fourfold;
        if made && fourfold_bench.is_none() {
            fourfold::write(&fourfold_folder, a.seed)?;
            fourfold_bench = Some(Bench::of_dataset(&fourfold_folder, a.seed)?);
        }
        let what = if made {
            "object with four equal sides".into()
        } else {
            format!("objects {}", names.join(" and "))
        };
        let title = format!("{what}, {} steps, two stages, PnP: {}", a.steps, training.title);
        let mut settings = vec![Setting::plain(&key, &title)];
        if training.of == Of::Others {
            let plain =
                Setting::plain(&format!("{key}-half-black"), &format!("{title}; half of every box black"));
            settings.push(Setting { half_black: true, ..plain });
        }
        for setting in settings {
            rows.push(row::kept_or_made(&a.out, &setting.key, || {
                let dataset = if made { &fourfold_folder } else { &a.dataset };
                let words = arguments(a, dataset, made, &names, &folder, training.more)?;
                let model = train_pix2pose(&words)?.model;
                let trained = setting.of(&Pix2Pose::load(Path::new(&model))?, a.seed);
                match &fourfold_bench {
                    Some(bench) if made => bench.measure(&trained, &setting, &a.out),
                    _ => bench.of_objects(&ids).measure(&trained, &setting, &a.out),
                }
            })?);
        }
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
            detections: vec![],
            seed: self.seed,
        }
    }
}

/// The training's arguments with the defaults of the command line.
fn arguments(
    a: &ReproducePix2PoseArguments,
    dataset: &Path,
    renders_only: bool,
    ids: &[String],
    folder: &Path,
    more: &[&str],
) -> Result<TrainPix2PoseArguments> {
    let text = |path: &Path| path.as_os_str().to_owned();
    let mut words: Vec<std::ffi::OsString> =
        ["sixfold", "train", "pix2pose", "--dataset"].map(Into::into).to_vec();
    words.push(text(dataset));
    if renders_only {
        words.push("--renders-only".into());
    } else {
        words.extend(["--frames".into(), text(&a.frames)]);
    }
    words.extend(["--out".into(), text(folder)]);
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
            _ => bail!("the arguments of a training are not those of Pix2Pose"),
        },
        _ => bail!("the arguments of a training are not those of `sixfold train`"),
    }
}
