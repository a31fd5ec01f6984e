//! A whole training: nothing but a seed in, a network for template matching out. Made-up objects fall on a table, depth cameras
//! look at them, and the network learns to match regions with templates. Interrupted at any time, it goes on.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use burn::tensor::Device;
use rand::RngExt;
use rayon::prelude::*;
use sixfold_geometry::random::stream;
use sixfold_io::{ImageFileError, write_rgb};
use sixfold_mesh::{Mesh, MeshError};
use sixfold_nn::checkpoint::Checkpoint;
use sixfold_nn::pretrained::PretrainedError;
use sixfold_nn::recipe::{Listener, News, NotReady, Trained};
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::ModelCard;
use sixfold_simulation::{ConvexParts, PileOptions, SimulationError, drop_objects};
use sixfold_synth::shapes::{Family, member, toy};
use thiserror::Error;

use crate::model::{ModelError, MttmModel};
use crate::network::{CompactConfig, Network, PaperConfig};
use crate::quality::{Quality, quality};
use crate::samples::{Arrangement, Batch, Pool, PoolOptions, preview};
use crate::training::{Ending, TrainingError, TrainingOptions, TrainingPace, last_checkpoint, train};

/// Objects of a scene, fewest and most.
const OBJECTS: (usize, usize) = (5, 12);
/// Scenes with objects of their own, for the card: one for so many of the training's, at least so many.
const TEST_SCENES: (usize, usize) = (12, 4);
/// Objects of theirs: one for so many of the training's, at least so many.
const TEST_OBJECTS: (usize, usize) = (4, 16);
/// Scenes that are made between two looks at `stop`.
const AT_A_TIME: usize = 16;

/// Which network learns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum MttmKind {
    /// Plain convolutions on regions of 28x28 pixels; trains on two cores.
    #[default]
    Compact,
    /// The dissertation's sizes: ResNet-50.
    Paper,
}

impl MttmKind {
    /// All kinds.
    pub const ALL: [MttmKind; 2] = [MttmKind::Compact, MttmKind::Paper];

    /// As it is typed.
    pub fn name(self) -> &'static str {
        match self {
            MttmKind::Compact => "compact",
            MttmKind::Paper => "paper",
        }
    }
}

/// How the network is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// Which network learns.
    pub network: MttmKind,
    /// ImageNet weights of ResNet-50 in torchvision's layout for [`MttmKind::Paper`]; random ones without.
    pub encoder: Option<PathBuf>,
    /// Steps in all; `None`: 8000, the dissertation's network 100000.
    pub steps: Option<u64>,
    /// Regions with an object in a step; `None`: 40, the dissertation's network 16.
    pub anchors: Option<usize>,
    /// Highest learning rate; `None`: 0.001, the dissertation's network 0.0001.
    pub learning_rate: Option<f64>,
    /// Made-up objects: half of them household shapes, half of them toys.
    pub objects: usize,
    /// Scenes in which they fall on a table, made at the start; each is seen by five cameras.
    pub scenes: usize,
    /// Seed of weights, objects, scenes and samples.
    pub seed: u64,
    /// What was asked for, for the model's card.
    pub command: String,
}

impl Default for Recipe {
    fn default() -> Self {
        Recipe {
            network: MttmKind::Compact,
            encoder: None,
            steps: None,
            anchors: None,
            learning_rate: None,
            objects: 300,
            scenes: 500,
            seed: 0,
            command: String::new(),
        }
    }
}

/// Why no network could be trained. What was trained until then is kept.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecipeError {
    /// An option out of its range, or nothing to export.
    #[error(transparent)]
    NotReady(#[from] NotReady),
    /// Weights in torchvision's layout.
    #[error("encoder: {0}")]
    Pretrained(#[from] PretrainedError),
    /// A made-up object.
    #[error("a made-up object: {0}")]
    Shape(#[from] MeshError),
    /// A made-up object that cannot fall.
    #[error("a made-up object: {0}")]
    Simulation(#[from] SimulationError),
    /// The picture of the first samples.
    #[error(transparent)]
    Picture(#[from] ImageFileError),
    /// The model file.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The training itself.
    #[error(transparent)]
    Training(#[from] TrainingError),
}

/// Everything that stands before the first step.
struct Prepared {
    network: Network,
    options: TrainingOptions,
    pool: PoolOptions,
    card: ModelCard,
    device: Device,
    folder: PathBuf,
    path: PathBuf,
}

/// Hears how many of how many things are made.
type Made<'a> = dyn FnMut(usize, usize) + Send + 'a;

impl Recipe {
    /// Trains, or goes on with the training in `out`, and writes the model there with how well it matches made-up objects that
    /// it was not trained on. `stop` ends it after the current step.
    ///
    /// # Errors
    /// [`RecipeError`].
    pub fn train(
        &self,
        out: &Path,
        stop: &AtomicBool,
        hear: &mut Listener<'_>,
    ) -> Result<Ending<(Trained, Quality)>, RecipeError> {
        let Prepared { network, options, pool: pool_options, card, device, folder, path } =
            self.prepare(out)?;
        let made = &mut |done, all| hear(News::Preparing(done, all));
        let Some(pool) = make_pool(self.objects, self.scenes, &pool_options, stop, made)? else {
            let step = Checkpoint::latest(&folder).map_err(TrainingError::from)?.map_or(0, |c| c.step());
            return Ok(Ending::Interrupted { step });
        };
        hear(News::Note(&format!("scenes: {} regions with an object", pool.with_object().len())));
        let first = Batch::of_step(&pool, &options.batch, options.seed, 0);
        write_rgb(&out.join("samples.png"), &preview(&first, pool_options.anchors.side, 10))?;
        let mut last = TrainingRecord::default();
        let shown = |record: &TrainingRecord| {
            hear(News::Steps(record, options.steps));
            last = record.clone();
        };
        let pace = TrainingPace::default();
        let network = match train(&pool, network, &device, &folder, &options, &pace, stop, shown)? {
            Ending::Finished(network) => network,
            Ending::Interrupted { step } => return Ok(Ending::Interrupted { step }),
        };
        drop(pool);
        let steps = options.steps;
        let card = ModelCard { steps, ..card };
        let measured = self.finish(network, &options, &pool_options, card, &path, stop, hear)?;
        let Some(quality) = measured else { return Ok(Ending::Interrupted { step: steps }) };
        let trained = Trained { model: path, steps, seconds: Some(last.seconds), losses: last.losses };
        Ok(Ending::Finished((trained, quality)))
    }

    /// Writes the model of the last checkpoint in `out`, as [`Recipe::train`] does at the end.
    ///
    /// # Errors
    /// [`RecipeError`].
    pub fn export(
        &self,
        out: &Path,
        stop: &AtomicBool,
        hear: &mut Listener<'_>,
    ) -> Result<Ending<(Trained, Quality)>, RecipeError> {
        let p = self.prepare(out)?;
        let Some((network, steps)) = last_checkpoint(&p.folder, p.network)? else {
            return Err(NotReady::NoCheckpoint { folder: p.folder }.into());
        };
        let card = ModelCard { steps, ..p.card };
        let measured = self.finish(network, &p.options, &p.pool, card, &p.path, stop, hear)?;
        let Some(quality) = measured else { return Ok(Ending::Interrupted { step: steps }) };
        let trained = Trained { model: p.path, steps, seconds: None, losses: BTreeMap::new() };
        Ok(Ending::Finished((trained, quality)))
    }

    /// Writes the model and measures it on objects and scenes that the training never saw; `None` when asked to stop meanwhile.
    #[allow(clippy::too_many_arguments)]
    fn finish(
        &self,
        network: Network,
        options: &TrainingOptions,
        pool: &PoolOptions,
        mut card: ModelCard,
        path: &Path,
        stop: &AtomicBool,
        hear: &mut Listener<'_>,
    ) -> Result<Option<Quality>, RecipeError> {
        card.extra = serde_json::json!({ "training": options, "pool": pool });
        // First without scores: nothing that was trained may be lost.
        MttmModel::new(network.clone(), card.clone()).save(path)?;
        let test = PoolOptions { seed: self.seed ^ 0x7e57, ..*pool };
        let objects = (self.objects / TEST_OBJECTS.0).max(TEST_OBJECTS.1);
        let scenes = (self.scenes / TEST_SCENES.0).max(TEST_SCENES.1);
        let made = &mut |done, all| hear(News::Measuring(done, all));
        let Some(test) = make_pool(objects, scenes, &test, stop, made)? else { return Ok(None) };
        hear(News::Note(&format!("test scenes: {} regions with an object", test.with_object().len())));
        let quality = quality(&network, &test);
        card.extra = serde_json::json!({ "training": options, "pool": pool, "quality": quality });
        MttmModel::new(network, card).save(path)?;
        Ok(Some(quality))
    }

    fn prepare(&self, out: &Path) -> Result<Prepared, RecipeError> {
        let wrong = |field, found: String, expected| Err(NotReady::option(field, found, expected).into());
        if !(16..=100_000).contains(&self.objects) {
            return wrong("objects", self.objects.to_string(), "16 to 100000");
        }
        if !(4..=1_000_000).contains(&self.scenes) {
            return wrong("scenes", self.scenes.to_string(), "4 to 1000000");
        }
        if self.encoder.is_some() && self.network == MttmKind::Compact {
            let expected = "network paper; the compact network starts from random weights";
            return wrong("encoder", "one for the compact network".to_owned(), expected);
        }
        let device = Device::flex().autodiff();
        let (network, default) = match self.network {
            MttmKind::Compact => {
                (Network::Compact(CompactConfig.init(self.seed, &device)), TrainingOptions::default())
            }
            MttmKind::Paper => {
                let network = match &self.encoder {
                    Some(file) => PaperConfig.from_imagenet(file, self.seed, &device)?,
                    None => PaperConfig.init(self.seed, &device),
                };
                (Network::Paper(network), TrainingOptions::paper())
            }
        };
        let mut batch = default.batch;
        batch.anchors = self.anchors.unwrap_or(batch.anchors);
        let options = TrainingOptions {
            steps: self.steps.unwrap_or(default.steps),
            learning_rate: self.learning_rate.unwrap_or(default.learning_rate),
            seed: self.seed,
            batch,
            ..default
        };
        let pool = PoolOptions { seed: self.seed, ..PoolOptions::for_side(network.side()) };
        let mut card =
            ModelCard::new("", "Multi-task template matching, objects never trained on in depth images");
        card.data = format!(
            "{} scenes of {} made-up objects (household shapes by a procedure, and toys grown of simple solids) that fell on a table, each \
             seen by {} simulated depth cameras; no scanned object and no photograph",
            self.scenes, self.objects, pool.views
        );
        card.seed = self.seed;
        card.command.clone_from(&self.command);
        let (folder, path) = (out.join("training"), out.join("model.safetensors"));
        Ok(Prepared { network, options, pool, card, device, folder, path })
    }
}

/// Makes objects, lets them fall, and looks at them; `None` when asked to stop meanwhile.
fn make_pool(
    objects: usize,
    scenes: usize,
    options: &PoolOptions,
    stop: &AtomicBool,
    made: &mut Made<'_>,
) -> Result<Option<Pool>, RecipeError> {
    let objects: Vec<(Mesh, ConvexParts)> = (0..objects)
        .into_par_iter()
        .map(|number| -> Result<_, RecipeError> {
            let mut random = stream(options.seed, number as u64);
            let mesh = match number % 2 {
                0 => member(Family::ALL[number / 2 % Family::ALL.len()], &mut random)?.mesh,
                _ => toy(&mut random)?,
            };
            let hull = ConvexParts::of_convex(&mesh)?;
            Ok((mesh, hull))
        })
        .collect::<Result<_, _>>()?;
    let (meshes, hulls): (Vec<Mesh>, Vec<ConvexParts>) = objects.into_iter().unzip();
    let pile = PileOptions::default();
    // In parts, so that progress is seen and an interruption heard.
    let mut arrangements: Vec<Arrangement> = vec![];
    for start in (0..scenes).step_by(AT_A_TIME) {
        if stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
        let part: Vec<Arrangement> = (start..(start + AT_A_TIME).min(scenes))
            .into_par_iter()
            .map(|scene| arrange(&hulls, &pile, options.seed, scene as u64))
            .collect();
        arrangements.extend(part);
        made(arrangements.len(), 2 * scenes);
    }
    let done = AtomicUsize::new(0);
    let made = Mutex::new(made);
    let pool = Pool::new(&meshes, &arrangements, options, stop, || {
        if let Ok(mut made) = made.lock() {
            made(scenes + done.fetch_add(1, Ordering::Relaxed) + 1, 2 * scenes);
        }
    });
    Ok(pool)
}

/// Some of the objects, fallen.
fn arrange(hulls: &[ConvexParts], pile: &PileOptions, seed: u64, scene: u64) -> Arrangement {
    let mut random = stream(seed ^ 0x5ce7e, scene);
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
