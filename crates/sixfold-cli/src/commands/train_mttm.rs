//! `sixfold train mttm`: made-up objects fall on a table, depth cameras look at them, and a network learns to match regions
//! with templates. Nothing but a seed goes in.

use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::{Context, Result, bail};
use burn::tensor::Device;
use clap::{Args, ValueEnum};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::Serialize;
use sixfold_bop::write_rgb;
use sixfold_mesh::Mesh;
use sixfold_mttm::model::MttmModel;
use sixfold_mttm::network::{CompactConfig, Network, PaperConfig};
use sixfold_mttm::quality::{Quality, quality};
use sixfold_mttm::samples::{Arrangement, Batch, Pool, PoolOptions, preview};
use sixfold_mttm::training::{Ending, TrainingOptions, TrainingPace, last_checkpoint, train};
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::ModelCard;
use sixfold_shapes::{Family, member, toy};
use sixfold_simulation::{ConvexParts, PileOptions, drop_objects};

use super::material::command_line;
use crate::progress::{Progress, interrupted};

/// Objects of a scene, fewest and most.
const OBJECTS: (usize, usize) = (5, 12);
/// Scenes with objects of their own, for the card: one for so many of the training's, at least so many.
const TEST_SCENES: (usize, usize) = (12, 4);

/// Which network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum MttmKind {
    /// Plain convolutions on regions of 28x28 pixels; trains on two cores
    Compact,
    /// The dissertation's sizes: ResNet-50; needs days on two cores
    Paper,
}

#[derive(Debug, Args)]
pub(crate) struct TrainMttmArguments {
    /// Network
    #[arg(long, value_enum, default_value = "compact")]
    pub network: MttmKind,
    /// ImageNet weights of ResNet-50 in torchvision's layout (.pth), for --network paper
    #[arg(long, value_name = "FILE")]
    pub encoder: Option<PathBuf>,
    /// Training steps (default: 8000; the dissertation's network: 100000)
    #[arg(long, value_name = "N")]
    pub steps: Option<u64>,
    /// Regions with an object in a step (default: 40; the dissertation's network: 16)
    #[arg(long, value_name = "N")]
    pub anchors: Option<usize>,
    /// Highest learning rate (default: 0.001; the dissertation's network: 0.0001)
    #[arg(long, value_name = "RATE")]
    pub learning_rate: Option<f64>,
    /// Made-up objects: half of them household shapes, half of them toys
    #[arg(long, value_name = "N", default_value = "300")]
    pub objects: usize,
    /// Scenes in which they fall on a table, made at the start; each is seen by five cameras
    #[arg(long, value_name = "N", default_value = "500")]
    pub scenes: usize,
    /// Seed of weights, objects, scenes and samples
    #[arg(long, default_value = "0")]
    pub seed: u64,
    /// Train no further: write the model of the last checkpoint in --out
    #[arg(long)]
    pub export: bool,
    /// Folder for the model and the training's checkpoints, log and curves
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// What a training came to.
#[derive(Serialize)]
pub(super) struct MttmSummary {
    pub model: String,
    pub steps: u64,
    /// Of training; `None` where a model was only exported.
    pub seconds: Option<f64>,
    pub losses: std::collections::BTreeMap<String, f64>,
    /// On made-up objects that were not trained on.
    pub quality: Quality,
}

/// Trains, or goes on with a training, and writes the model.
pub(super) fn train_mttm(a: &TrainMttmArguments) -> Result<MttmSummary> {
    for (field, found, least, most) in
        [("--objects", a.objects, 16, 100_000), ("--scenes", a.scenes, 4, 1_000_000)]
    {
        if !(least..=most).contains(&found) {
            bail!("{field}: found {found}, expected {least} to {most}");
        }
    }
    if a.encoder.is_some() && a.network == MttmKind::Compact {
        bail!("--encoder: the compact network starts from random weights; it belongs to --network paper");
    }
    let device = Device::flex().autodiff();
    let (network, default) = match a.network {
        MttmKind::Compact => {
            (Network::Compact(CompactConfig.init(a.seed, &device)), TrainingOptions::default())
        }
        MttmKind::Paper => {
            let network = match &a.encoder {
                Some(file) => PaperConfig.from_imagenet(file, a.seed, &device).context("--encoder")?,
                None => PaperConfig.init(a.seed, &device),
            };
            (Network::Paper(network), TrainingOptions::paper())
        }
    };
    let mut batch = default.batch;
    batch.anchors = a.anchors.unwrap_or(batch.anchors);
    let options = TrainingOptions {
        steps: a.steps.unwrap_or(default.steps),
        learning_rate: a.learning_rate.unwrap_or(default.learning_rate),
        seed: a.seed,
        batch,
        ..default
    };
    let pool_options = PoolOptions { seed: a.seed, ..PoolOptions::for_side(network.side()) };
    let folder = a.out.join("training");
    let path = a.out.join("model.safetensors");
    let mut card =
        ModelCard::new("", "Multi-task template matching, objects never trained on in depth images");
    card.data = format!(
        "{} scenes of {} made-up objects (household shapes by a procedure, and toys grown of simple solids) that fell on a table, each \
         seen by {} simulated depth cameras; no scanned object and no photograph",
        a.scenes, a.objects, pool_options.views
    );
    card.seed = a.seed;
    card.command = command_line();
    // Objects and scenes that the training never sees.
    let test_scenes = (a.scenes / TEST_SCENES.0).max(TEST_SCENES.1);
    let test_seed = a.seed ^ 0x7e57;
    let test_options = PoolOptions { seed: test_seed, ..pool_options };
    let judged = |network: &Network| -> Result<Quality> {
        let test = make_pool("test scenes", (a.objects / 4).max(16), test_scenes, &test_options)?;
        Ok(quality(network, &test))
    };
    let finished = |mut card: ModelCard, network: Network, steps, seconds, losses| -> Result<MttmSummary> {
        let quality = judged(&network)?;
        card.steps = steps;
        card.extra = serde_json::json!({ "training": options, "pool": pool_options, "quality": quality });
        MttmModel::new(network, card).save(&path)?;
        Ok(MttmSummary { model: path.display().to_string(), steps, seconds, losses, quality })
    };
    if a.export {
        let Some((network, step)) = last_checkpoint(&folder, network)? else {
            bail!("{}: holds no checkpoint; train first", folder.display());
        };
        return finished(card, network, step, None, Default::default());
    }
    let pool = make_pool("scenes", a.objects, a.scenes, &pool_options)?;
    let first = Batch::of_step(&pool, &options.batch, options.seed, 0);
    write_rgb(&a.out.join("samples.png"), &preview(&first, pool_options.anchors.side, 10))?;
    let mut progress = Progress::new("steps", options.steps as usize);
    let mut last = TrainingRecord::default();
    let shown = |record: &TrainingRecord| {
        progress.set(record.step as usize);
        let loss = |name: &str| record.losses.get(name).copied().unwrap_or(f64::NAN);
        progress.message(format!(
            "triplet {:.3}, other objects {:.3}, mask {:.3}, rotation {:.3}, offset {:.3}, matching {:.3}, {:.0} regions/s",
            loss("triplet"),
            loss("other objects"),
            loss("mask"),
            loss("rotation"),
            loss("offset"),
            loss("matching"),
            record.samples_per_second
        ));
        last = record.clone();
    };
    let pace = TrainingPace::default();
    let ending = train(&pool, network, &device, &folder, &options, &pace, interrupted(), shown)?;
    progress.finish();
    drop(pool);
    match ending {
        Ending::Finished(network) => finished(card, network, options.steps, Some(last.seconds), last.losses),
        Ending::Interrupted { step } => {
            bail!("interrupted after step {step}, which is kept; run the same command again to go on")
        }
    }
}

/// Makes objects, lets them fall, and looks at them.
fn make_pool(what: &'static str, objects: usize, scenes: usize, options: &PoolOptions) -> Result<Pool> {
    let made: Vec<(Mesh, ConvexParts)> = (0..objects)
        .into_par_iter()
        .map(|number| -> Result<_> {
            let mut random = ChaCha8Rng::seed_from_u64(options.seed);
            random.set_stream(number as u64);
            let mesh = match number % 2 {
                0 => member(Family::ALL[number / 2 % Family::ALL.len()], &mut random)?.mesh,
                _ => toy(&mut random)?,
            };
            let hull = ConvexParts::of_convex(&mesh)?;
            Ok((mesh, hull))
        })
        .collect::<Result<_>>()?;
    let (meshes, hulls): (Vec<Mesh>, Vec<ConvexParts>) = made.into_iter().unzip();
    let mut progress = Progress::new(what, 2 * scenes);
    let done = AtomicUsize::new(0);
    let pile = PileOptions::default();
    // In parts, so that progress is seen and an interruption heard.
    let mut arrangements: Vec<Arrangement> = vec![];
    for start in (0..scenes).step_by(16) {
        let part: Vec<Arrangement> = (start..(start + 16).min(scenes))
            .into_par_iter()
            .map(|scene| arrange(&hulls, &pile, options.seed, scene as u64))
            .collect();
        arrangements.extend(part);
        crate::progress::check_interrupt("nothing was trained yet; run the same command again")?;
        progress.set(arrangements.len());
    }
    let shared = std::sync::Mutex::new(progress);
    let pool = Pool::new(&meshes, &arrangements, options, || {
        let done = done.fetch_add(1, Ordering::Relaxed) + 1;
        if let Ok(mut progress) = shared.lock() {
            progress.set(scenes + done);
        }
    });
    if let Ok(progress) = shared.into_inner() {
        progress.finish();
    }
    eprintln!("{what}: {} regions with an object", pool.with_object().len());
    Ok(pool)
}

/// Some of the objects, fallen.
fn arrange(hulls: &[ConvexParts], pile: &PileOptions, seed: u64, scene: u64) -> Arrangement {
    let mut random = ChaCha8Rng::seed_from_u64(seed ^ 0x5ce7e);
    random.set_stream(scene);
    let count = random.random_range(OBJECTS.0..=OBJECTS.1);
    let mut chosen: Vec<usize> = vec![];
    while chosen.len() < count {
        let k = random.random_range(0..hulls.len());
        if !chosen.contains(&k) {
            chosen.push(k);
        }
    }
    let parts: Vec<&ConvexParts> = chosen.iter().map(|&k| &hulls[k]).collect();
    let poses = drop_objects(&parts, pile, seed, scene);
    chosen.into_iter().zip(poses).filter_map(|(k, pose)| pose.map(|p| (k, p))).collect()
}
