//! A complete training of the template matching network from a seed alone. Synthetic objects are dropped on a table and rendered as
//! depth cameras see them, and the network learns to match regions with templates. It can be interrupted at any time and resumed.

use std::path::PathBuf;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use sixfold_geometry::Progress;
use sixfold_io::write_rgb;
use sixfold_mesh::Mesh;
use sixfold_nn::choice::Choice;
use sixfold_nn::device;
use sixfold_nn::fingerprint::Fingerprint;
use sixfold_nn::options::OptionError;
use sixfold_nn::recipe::{Prepared, Recipe, Session, TrainingEvent};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::weights::ModelCard;
use sixfold_simulation::{ConvexParts, PileOptions, drop_objects};
use sixfold_synth::shapes::{Family, member, toy};

use crate::model::MttmModel;
use crate::network::{CompactConfig, Network, PaperConfig};
use crate::quality::{Quality, quality};
use crate::samples::{Arrangement, Batch, DepthPoolOptions, PairBatchOptions, Pool, preview};
use crate::training::{MttmTraining, MttmTrainingOptions};

/// Fewest and most objects in a scene.
const OBJECTS: (usize, usize) = (5, 12);
/// Test scenes, with objects of their own, for the model's card: the training's number divided by the first, at least the second.
const TEST_SCENES: (usize, usize) = (12, 4);
/// Objects of the test scenes: the training's number divided by the first, at least the second.
const TEST_OBJECTS: (usize, usize) = (4, 16);
/// Scenes simulated between two checks of `stop`.
const AT_A_TIME: usize = 16;

/// Which network is trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum MttmKind {
    /// Plain convolutions on regions of 28x28 pixels; trains on two cores.
    #[default]
    Compact,
    /// The dissertation's sizes: ResNet-50.
    Paper,
}

impl Choice for MttmKind {
    const ALL: &'static [MttmKind] = &[MttmKind::Compact, MttmKind::Paper];

    fn name(self) -> &'static str {
        match self {
            MttmKind::Compact => "compact",
            MttmKind::Paper => "paper",
        }
    }

    fn help(self) -> &'static str {
        match self {
            MttmKind::Compact => "Plain convolutions on regions of 28x28 pixels; trains on two cores",
            MttmKind::Paper => "The dissertation's sizes: ResNet-50; needs days on two cores",
        }
    }
}

impl MttmKind {
    /// Its default training options.
    pub fn options(self) -> MttmTrainingOptions {
        match self {
            MttmKind::Compact => MttmTrainingOptions::default(),
            MttmKind::Paper => MttmTrainingOptions::published(),
        }
    }
}

/// How the network is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct MttmRecipe {
    /// Which network is trained.
    pub network: MttmKind,
    /// ImageNet weights of ResNet-50 in torchvision's layout for [`MttmKind::Paper`]; random ones if `None`.
    pub encoder: Option<PathBuf>,
    /// Number of steps; `None`: the value of [`MttmKind::options`], as for the next two fields.
    pub steps: Option<u64>,
    /// Regions with an object in a step.
    pub anchors: Option<usize>,
    /// Maximum learning rate.
    pub learning_rate: Option<f64>,
    /// Synthetic objects: half of them household shapes, half of them toys.
    pub objects: usize,
    /// Scenes in which they are dropped on a table, simulated at the start; each is seen by five cameras.
    pub scenes: usize,
    /// Seed of weights, objects, scenes and samples.
    pub seed: u64,
    /// The command, for the model's card.
    pub command: String,
}

impl Default for MttmRecipe {
    fn default() -> Self {
        MttmRecipe {
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

impl MttmRecipe {
    /// The dissertation's training (sections 5.2.3 and 5.3.1): its network, its losses, 20,000 views of scenes.
    pub fn published() -> Self {
        MttmRecipe { network: MttmKind::Paper, scenes: 4000, ..MttmRecipe::default() }
    }

    /// How the network is trained.
    pub fn options(&self) -> MttmTrainingOptions {
        let default = self.network.options();
        MttmTrainingOptions {
            common: default.common.with(self.steps, self.learning_rate, self.seed),
            batch: PairBatchOptions {
                anchors: self.anchors.unwrap_or(default.batch.anchors),
                ..default.batch
            },
            ..default
        }
    }
}

impl Recipe for MttmRecipe {
    type Data = ();
    type Samples = Pool;
    type Training = MttmTraining;
    type Context = DepthPoolOptions;
    type Report = Quality;

    fn steps(&self) -> u64 {
        self.options().common.steps
    }

    fn seed(&self) -> u64 {
        self.seed
    }

    fn command(&self) -> &str {
        &self.command
    }

    fn check(&self) -> Result<(), OptionError> {
        let objects = (16..=100_000).contains(&self.objects);
        OptionError::unless(objects, "objects", self.objects, "16 to 100000")?;
        let scenes = (4..=1_000_000).contains(&self.scenes);
        OptionError::unless(scenes, "scenes", self.scenes, "4 to 1000000")?;
        let wrong = self.encoder.is_some() && self.network == MttmKind::Compact;
        let expected = "network paper; the compact network starts from random weights";
        OptionError::unless(!wrong, "encoder", "one for the compact network", expected)?;
        self.options().check()
    }

    fn inputs(&self, (): &()) -> Result<Fingerprint, TrainError> {
        // Every field by name, so that the compiler reports a new one; fields left out are in the options or have no effect.
        #[rustfmt::skip]
        let MttmRecipe { network, encoder, objects, scenes, steps: _, anchors: _, learning_rate: _, seed: _, command: _ } = self;
        Fingerprint::of(&self.options())?
            .with("network", network.name())
            .with("objects", *objects)
            .with("scenes", *scenes)
            .with_file("encoder", encoder.as_deref())
    }

    fn prepare(
        &self,
        _: (),
        _: &mut Session<'_>,
    ) -> Result<Prepared<MttmTraining, DepthPoolOptions>, TrainError> {
        let device = device::chosen().autodiff();
        let network = match (self.network, &self.encoder) {
            (MttmKind::Compact, _) => Network::Compact(CompactConfig.init(self.seed, &device)),
            (MttmKind::Paper, None) => Network::Paper(PaperConfig.init(self.seed, &device)),
            (MttmKind::Paper, Some(file)) => {
                let network = PaperConfig.from_imagenet(file, self.seed, &device);
                Network::Paper(network.map_err(TrainError::about("encoder"))?)
            }
        };
        let default = DepthPoolOptions::for_side(network.side());
        // As published, objects of which less than half is visible are not used in the training, and every view has noise.
        let pool = match self.network {
            MttmKind::Compact => DepthPoolOptions { seed: self.seed, ..default },
            MttmKind::Paper => {
                DepthPoolOptions { visible: 0.5, some_without_noise: false, seed: self.seed, ..default }
            }
        };
        let mut card =
            ModelCard::new("", "Multi-task template matching, objects never trained on in depth images");
        card.data = format!(
            "{} scenes of {} synthetic objects (household shapes by a procedure, and toys grown of simple solids) that fell on a table, each \
             seen by {} simulated depth cameras; no scanned object and no photograph",
            self.scenes, self.objects, pool.views
        );
        let options = self.options();
        card.extra = serde_json::json!({ "training": options, "pool": pool });
        Ok(Prepared { training: MttmTraining::new(network, options, device), card, context: pool })
    }

    fn samples(
        &self,
        options: &mut DepthPoolOptions,
        session: &mut Session<'_>,
    ) -> Result<Option<Pool>, TrainError> {
        let pool = {
            let progress = session.progress(TrainingEvent::Preparing);
            make_pool(self.objects, self.scenes, options, &progress)?
        };
        let Some(pool) = pool else { return Ok(None) };
        session.note(&format!("scenes: {} regions with an object", pool.with_object().len()));
        let first = Batch::of_step(&pool, &self.options().batch, self.seed, 0);
        write_rgb(&session.out.join("samples.png"), &preview(&first, options.anchors.side, 10))
            .map_err(TrainError::method)?;
        Ok(Some(pool))
    }

    /// Measures how well the model matches objects and scenes that were not used in the training.
    fn finish(
        &self,
        Prepared { training, mut card, context: pool }: Prepared<MttmTraining, DepthPoolOptions>,
        session: &mut Session<'_>,
    ) -> Result<Option<Quality>, TrainError> {
        let network = training.into_network();
        let path = session.model();
        MttmModel::new(network.clone(), card.clone()).save(&path).map_err(TrainError::method)?;
        let test = DepthPoolOptions { seed: self.seed ^ 0x7e57, ..pool };
        let objects = (self.objects / TEST_OBJECTS.0).max(TEST_OBJECTS.1);
        let scenes = (self.scenes / TEST_SCENES.0).max(TEST_SCENES.1);
        let test = make_pool(objects, scenes, &test, &session.progress(TrainingEvent::Measuring))?;
        let Some(test) = test else { return Ok(None) };
        session.note(&format!("test scenes: {} regions with an object", test.with_object().len()));
        let quality = quality(&network, &test);
        card.extra["quality"] = serde_json::to_value(quality).map_err(TrainError::method)?;
        MttmModel::new(network, card).save(&path).map_err(TrainError::method)?;
        Ok(Some(quality))
    }
}

/// Generates objects, drops them and renders them; `None` when stopped meanwhile.
fn make_pool(
    objects: usize,
    scenes: usize,
    options: &DepthPoolOptions,
    progress: &dyn Progress,
) -> Result<Option<Pool>, TrainError> {
    let objects: Vec<(Mesh, ConvexParts)> = (0..objects)
        .into_par_iter()
        .map(|number| -> Result<_, TrainError> {
            let mut random = ChaCha8Rng::seed_from_u64(options.seed);
            random.set_stream(number as u64);
            let mesh = match number % 2 {
                0 => member(Family::ALL[number / 2 % Family::ALL.len()], &mut random).map(|m| m.mesh),
                _ => toy(&mut random),
            };
            let mesh = mesh.map_err(TrainError::about("a synthetic object"))?;
            let hull = ConvexParts::of_convex(&mesh).map_err(TrainError::about("a synthetic object"))?;
            Ok((mesh, hull))
        })
        .collect::<Result<_, _>>()?;
    let (meshes, hulls): (Vec<Mesh>, Vec<ConvexParts>) = objects.into_iter().unzip();
    let pile = PileOptions::default();
    // In batches, so that progress is reported and an interruption noticed.
    let mut arrangements: Vec<Arrangement> = vec![];
    for start in (0..scenes).step_by(AT_A_TIME) {
        let part: Vec<Arrangement> = (start..(start + AT_A_TIME).min(scenes))
            .into_par_iter()
            .map(|scene| arrange(&hulls, &pile, options.seed, scene as u64))
            .collect();
        arrangements.extend(part);
        if !progress.report(arrangements.len(), 2 * scenes) {
            return Ok(None);
        }
    }
    Ok(Pool::new(&meshes, &arrangements, options, &|done, _| progress.report(scenes + done, 2 * scenes)))
}

/// Some of the objects, dropped on the table.
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
