//! Networks trained for a comparison: symmetric objects with the transformer loss, with L1 and view limits, and with plain
//! L1 (table 3.1); and two other objects with convex hulls instead of meshes, from photographs alone, and with and without
//! a discriminator (figure 3.12), on whole boxes and on half-black boxes.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use sixfold_bop::{Models, Target};
use sixfold_pix2pose::recipe::{MIN_VISIBILITY, Pix2PoseRecipe};

use super::super::kept::kept_or_made;
use super::model::Pix2Pose;
use super::row::{Row, Setting};
use super::{Bench, Regions, ReproducePix2PoseArguments, fourfold};
use sixfold_shell::training::{MaterialArguments, Shown, command_line, loss, train_in, training_set};

/// The objects of a training.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Of {
    /// The dataset's objects with discrete symmetries.
    Symmetric,
    /// The first two objects without discrete symmetries.
    Others,
    /// A synthetic object with four equal sides, from renders.
    Fourfold,
}

/// One training of the comparison.
struct Training {
    key: &'static str,
    title: &'static str,
    of: Of,
    /// The changes to the default recipe.
    vary: fn(&mut Pix2PoseRecipe),
}

const fn training(key: &'static str, title: &'static str, of: Of, vary: fn(&mut Pix2PoseRecipe)) -> Training {
    Training { key, title, of, vary }
}

const TRAININGS: [Training; 9] = [
    training("trained-transformer-loss", "transformer loss", Of::Symmetric, |_| ()),
    training("trained-view-limits", "L1 with view limits", Of::Symmetric, |r| r.view_limits = true),
    training("trained-plain-l1", "L1", Of::Symmetric, |r| r.transformer_loss = false),
    training("fourfold-transformer-loss", "transformer loss", Of::Fourfold, |_| ()),
    training("fourfold-view-limits", "L1 with view limits", Of::Fourfold, |r| r.view_limits = true),
    training("fourfold-plain-l1", "L1", Of::Fourfold, |r| r.transformer_loss = false),
    training("trained-mesh", "meshes, photographs only", Of::Others, |r| r.render_fraction = 0.0),
    training("trained-discriminator", "meshes, photographs only, with discriminators", Of::Others, |r| {
        (r.render_fraction, r.adversarial) = (0.0, Some(true))
    }),
    training("trained-convex-hull", "convex hulls, photographs only", Of::Others, |r| {
        (r.render_fraction, r.convex_hull) = (0.0, true)
    }),
];

/// Trains the networks, or resumes the trainings, and measures their results.
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
            rows.push(kept_or_made(&a.out, &setting.key, || {
                let dataset = if made { &fourfold_folder } else { &a.dataset };
                let model = training.train(a, dataset, &ids, &folder)?;
                let trained = setting.of(&Pix2Pose::load(&model)?, a.seed);
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
    /// The same benchmark with only a few objects.
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

impl Training {
    /// Trains or resumes a training; returns the path of the model.
    fn train(
        &self,
        a: &ReproducePix2PoseArguments,
        dataset: &Path,
        ids: &[u32],
        folder: &Path,
    ) -> Result<PathBuf> {
        if !a.size.is_multiple_of(32) || !(32..=512).contains(&a.size) {
            bail!("--size: found {}, expected a multiple of 32 from 32 to 512", a.size);
        }
        let renders_only = self.of == Of::Fourfold;
        let material = training_set(
            &MaterialArguments {
                models: a.models.clone().filter(|_| *dataset == *a.dataset),
                dataset: Some(dataset.to_owned()),
                split: a.split.clone(),
                frames: (!renders_only).then(|| a.frames.clone()),
                renders_only,
                ids: ids.to_vec(),
                objects: vec![],
                unit: None,
                backgrounds: a.backgrounds.clone(),
                store: PathBuf::new(),
            },
            MIN_VISIBILITY,
        )?;
        let mut recipe = Pix2PoseRecipe {
            steps: Some(a.steps),
            size: a.size,
            backgrounds: a.backgrounds.clone(),
            seed: a.seed,
            command: command_line(),
            ..Pix2PoseRecipe::default()
        };
        (self.vary)(&mut recipe);
        let shown = Shown {
            preparing: "samples",
            measuring: "alignment measured on the photographs",
            message: |record| {
                format!("L1 {:.4}, {:.0} images/s", loss(record, "coordinates"), record.samples_per_second)
            },
        };
        let by_flag = |error: &sixfold_nn::options::OptionError| anyhow::anyhow!("{error}");
        Ok(train_in(&recipe, material, folder, false, shown, by_flag)?.model)
    }
}
