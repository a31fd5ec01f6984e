//! A complete training of the network for grasps from experience, from a seed alone. It can be interrupted at any time and resumed.

use std::path::PathBuf;

use sixfold_io::write_rgb;
use sixfold_nn::choice::Choice;
use sixfold_nn::device;
use sixfold_nn::fingerprint::Fingerprint;
use sixfold_nn::options::OptionError;
use sixfold_nn::recipe::{Prepared, Recipe, Session, TrainingEvent, continued_from};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::weights::{ModelCard, load_weights_but};

use crate::model::DgcmModel;
use crate::networks::{CompactConfig, Network, PaperConfig};
use crate::quality::{Quality, quality};
use crate::samples::{GraspPoolOptions, Pool};
use crate::training::{DgcmTraining, DgcmTrainingOptions};
use sixfold_experience::CropOptions;

/// Views of other objects for the model's card: the training's number divided by the first, at least the second, at most the third.
const TEST_VIEWS: (usize, usize, usize) = (4, 64, 1600);
/// The same for pairs of these views.
const TEST_PAIRS: (usize, usize, usize) = (12, 8, 600);

/// Which network is trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DgcmKind {
    /// Plain convolutions on 96x96 pixels; trains on two cores.
    #[default]
    Compact,
    /// The dissertation's network: ResNet-50, 128x128 pixels.
    Paper,
}

impl Choice for DgcmKind {
    const ALL: &'static [DgcmKind] = &[DgcmKind::Compact, DgcmKind::Paper];

    fn name(self) -> &'static str {
        match self {
            DgcmKind::Compact => "compact",
            DgcmKind::Paper => "paper",
        }
    }

    fn help(self) -> &'static str {
        match self {
            DgcmKind::Compact => "Plain convolutions on 96x96 pixels; trains on two cores",
            DgcmKind::Paper => "The dissertation's: ResNet-50, 128x128 pixels; needs days on two cores",
        }
    }
}

impl DgcmKind {
    /// Its default training options.
    pub fn options(self) -> DgcmTrainingOptions {
        match self {
            DgcmKind::Compact => DgcmTrainingOptions::default(),
            DgcmKind::Paper => DgcmTrainingOptions::published(),
        }
    }

    /// Crops, and the cameras' distances (table 6.1).
    fn pool(self) -> GraspPoolOptions {
        let default = GraspPoolOptions::default();
        match self {
            DgcmKind::Compact => default,
            DgcmKind::Paper => {
                GraspPoolOptions { crop: CropOptions::paper(), distance: (1.0, 1.7), ..default }
            }
        }
    }
}

/// How the network is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct DgcmRecipe {
    /// Which network is trained.
    pub network: DgcmKind,
    /// ImageNet weights of ResNet-50 in torchvision's layout for [`DgcmKind::Paper`]; random ones if `None`.
    pub encoder: Option<PathBuf>,
    /// Weights of a trained network of this kind to start from; random ones if `None`.
    pub init: Option<PathBuf>,
    /// Whether only the alignment of both views is trained, and everything else stays as in `init`.
    pub alignment_only: bool,
    /// Number of steps; `None`: the value of [`DgcmKind::options`], as for the next three fields.
    pub steps: Option<u64>,
    /// Positive pairs in a step; the dissertation's network uses the same number of negative ones.
    pub pairs: Option<usize>,
    /// Maximum learning rate.
    pub learning_rate: Option<f64>,
    /// Weight of the loss of coordinates relative to that of features.
    pub lambda: Option<f64>,
    /// Simulated views for the training, generated at the start (about 35 kB of memory each).
    pub views: usize,
    /// Seed of weights, objects, views and pairs.
    pub seed: u64,
    /// The command, for the model's card.
    pub command: String,
}

impl Default for DgcmRecipe {
    fn default() -> Self {
        DgcmRecipe {
            network: DgcmKind::Compact,
            encoder: None,
            init: None,
            alignment_only: false,
            steps: None,
            pairs: None,
            learning_rate: None,
            lambda: None,
            views: 6000,
            seed: 0,
            command: String::new(),
        }
    }
}

impl DgcmRecipe {
    /// The dissertation's training (section 6.2.2): its network and options on 166,000 views.
    pub fn published() -> Self {
        DgcmRecipe { network: DgcmKind::Paper, views: 166_000, ..DgcmRecipe::default() }
    }

    /// How the network is trained.
    pub fn options(&self) -> DgcmTrainingOptions {
        let default = self.network.options();
        DgcmTrainingOptions {
            common: default.common.with(self.steps, self.learning_rate, self.seed),
            pairs: self.pairs.unwrap_or(default.pairs),
            negatives: self.pairs.filter(|_| self.network == DgcmKind::Paper).unwrap_or(default.negatives),
            lambda: self.lambda.unwrap_or(default.lambda),
            alignment_only: self.alignment_only,
            ..default
        }
    }
}

impl Recipe for DgcmRecipe {
    type Data = ();
    type Samples = Pool;
    type Training = DgcmTraining;
    type Context = GraspPoolOptions;
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
        let views = (64..=1_000_000).contains(&self.views);
        OptionError::unless(views, "views", self.views, "64 to 1000000")?;
        let wrong = self.encoder.is_some() && self.network == DgcmKind::Compact;
        let expected = "network paper; the compact network starts from random weights";
        OptionError::unless(!wrong, "encoder", "one for the compact network", expected)?;
        if self.alignment_only {
            let expected = "network compact, which has an alignment";
            let found = format!("network {}", self.network.name());
            OptionError::unless(self.network == DgcmKind::Compact, "alignment_only", found, expected)?;
            let expected = "init: weights whose other parts stay as they are";
            OptionError::unless(self.init.is_some(), "alignment_only", "no init", expected)?;
        }
        self.options().check()
    }

    fn inputs(&self, (): &()) -> Result<Fingerprint, TrainError> {
        // Every field by name, so that the compiler reports a new one; fields left out are in the options or have no effect.
        #[rustfmt::skip]
        let DgcmRecipe { network, encoder, init, alignment_only: _, views, steps: _, pairs: _, lambda: _, learning_rate: _, seed: _, command: _ } = self;
        Fingerprint::of(&self.options())?
            .with("network", network.name())
            .with("views", *views)
            .with_file("encoder", encoder.as_deref())?
            .with_file("init", init.as_deref())
    }

    fn prepare(
        &self,
        _: (),
        _: &mut Session<'_>,
    ) -> Result<Prepared<DgcmTraining, GraspPoolOptions>, TrainError> {
        let device = device::chosen().autodiff();
        let mut network = match (self.network, &self.encoder) {
            (DgcmKind::Compact, _) => Network::Compact(CompactConfig.init(self.seed, &device)),
            (DgcmKind::Paper, None) => Network::Paper(PaperConfig.init(self.seed, &device)),
            (DgcmKind::Paper, Some(file)) => {
                let network = PaperConfig.init_from_imagenet(file, self.seed, &device);
                Network::Paper(network.map_err(TrainError::about("encoder"))?)
            }
        };
        if let Some(file) = &self.init {
            let architecture = network.architecture();
            // Weights of before there was an alignment have no such part.
            let without = Some("Compact.alignment");
            (network, _) =
                load_weights_but(network, file, architecture, without).map_err(TrainError::about("init"))?;
        }
        let options = self.options();
        let pool = GraspPoolOptions { views: self.views, seed: self.seed, ..self.network.pool() };
        let mut card = ModelCard::new("", "DGCM-Net, grasps from experience");
        card.data = format!(
            "{} simulated depth views of procedural families (can, mug, cup, bottle, bowl, box, clamp, drill) with random axis scales; no scanned object and no photograph",
            self.views
        );
        card.extra = serde_json::json!({
            "training": options, "pool": pool, "continued_from": continued_from(self.init.as_deref())?
        });
        Ok(Prepared { training: DgcmTraining::new(network, options, device), card, context: pool })
    }

    fn samples(
        &self,
        pool: &mut GraspPoolOptions,
        session: &mut Session<'_>,
    ) -> Result<Option<Pool>, TrainError> {
        session.note(&format!("making {} views", self.views));
        let views = Pool::new(pool, &session.progress(TrainingEvent::Preparing));
        if let Some(views) = &views {
            let options = self.options();
            let pairs = views.preview(&options.samples, options.common.seed);
            write_rgb(&session.folder().join("preview.png"), &pairs).map_err(TrainError::method)?;
        }
        Ok(views)
    }

    /// Measures the coordinates of objects that were not used in the training.
    fn finish(
        &self,
        Prepared { training, mut card, context: pool }: Prepared<DgcmTraining, GraspPoolOptions>,
        session: &mut Session<'_>,
    ) -> Result<Option<Quality>, TrainError> {
        let network = training.into_network();
        let path = session.model();
        DgcmModel::new(network.clone(), pool.crop, card.clone()).save(&path).map_err(TrainError::method)?;
        let test = GraspPoolOptions {
            views: (self.views / TEST_VIEWS.0).clamp(TEST_VIEWS.1, TEST_VIEWS.2),
            seed: self.seed ^ 0x7e57,
            ..pool
        };
        let pairs = (self.views / TEST_PAIRS.0).clamp(TEST_PAIRS.1, TEST_PAIRS.2);
        let Some(test) = Pool::new(&test, &session.progress(TrainingEvent::Measuring)) else {
            return Ok(None);
        };
        let quality = quality(&network, &test, pairs);
        card.extra["quality"] = serde_json::to_value(&quality).map_err(TrainError::method)?;
        DgcmModel::new(network, pool.crop, card).save(&path).map_err(TrainError::method)?;
        Ok(Some(quality))
    }
}
