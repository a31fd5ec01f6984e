//! A whole training: nothing but a seed in, a network for grasps from experience out. Interrupted at any time, it goes on.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::AtomicBool;

use burn::tensor::Device;
use sixfold_experience::CropOptions;
use sixfold_nn::pretrained::PretrainedError;
use sixfold_nn::recipe::{Listener, News, NotReady, Trained};
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::ModelCard;
use thiserror::Error;

use crate::model::{DgcmModel, ModelError};
use crate::networks::{CompactConfig, Network, PaperConfig};
use crate::samples::{Pool, PoolOptions};
use crate::training::{Ending, TrainingError, TrainingOptions, TrainingPace, last_checkpoint, train};

/// Which network learns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DgcmKind {
    /// Plain convolutions on 96x96 pixels; trains on two cores.
    #[default]
    Compact,
    /// The dissertation's: ResNet-50, 128x128 pixels.
    Paper,
}

impl DgcmKind {
    /// All kinds.
    pub const ALL: [DgcmKind; 2] = [DgcmKind::Compact, DgcmKind::Paper];

    /// As it is typed.
    pub fn name(self) -> &'static str {
        match self {
            DgcmKind::Compact => "compact",
            DgcmKind::Paper => "paper",
        }
    }
}

/// How the network is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// Which network learns.
    pub network: DgcmKind,
    /// ImageNet weights of ResNet-50 in torchvision's layout for [`DgcmKind::Paper`]; random ones without.
    pub encoder: Option<PathBuf>,
    /// Steps in all; `None`: 4000, the dissertation's network 116000.
    pub steps: Option<u64>,
    /// Positive pairs in a step; `None`: 10, with 3 negative ones, the dissertation's network 25 of both.
    pub pairs: Option<usize>,
    /// Highest learning rate; `None`: 0.0005, the dissertation's network 0.0001.
    pub learning_rate: Option<f64>,
    /// Weight of the coordinates' loss beside the features'; `None`: 300, the dissertation's network 1.
    pub lambda: Option<f64>,
    /// Simulated views to learn from, made at the start (about 35 kB of memory each).
    pub views: usize,
    /// Seed of weights, objects, views and pairs.
    pub seed: u64,
    /// What was asked for, for the model's card.
    pub command: String,
}

impl Default for Recipe {
    fn default() -> Self {
        Recipe {
            network: DgcmKind::Compact,
            encoder: None,
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
    crop: CropOptions,
    options: TrainingOptions,
    pool: PoolOptions,
    card: ModelCard,
    device: Device,
    folder: PathBuf,
    path: PathBuf,
}

impl Recipe {
    /// Trains, or goes on with the training in `out`, and writes the model there. `stop` ends it after the current step.
    ///
    /// # Errors
    /// [`RecipeError`].
    pub fn train(
        &self,
        out: &Path,
        stop: &AtomicBool,
        hear: &mut Listener<'_>,
    ) -> Result<Ending<Trained>, RecipeError> {
        let Prepared { network, crop, options, pool, mut card, device, folder, path } = self.prepare(out)?;
        hear(News::Note(&format!("making {} views", self.views)));
        let pool = {
            let hear = Mutex::new(&mut *hear);
            Pool::new(&pool, |done| {
                if let Ok(mut hear) = hear.lock() {
                    hear(News::Preparing(done, self.views));
                }
            })
        };
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
        card.steps = options.steps;
        DgcmModel::new(network, crop, card).save(&path)?;
        let (seconds, losses) = (Some(last.seconds), last.losses);
        Ok(Ending::Finished(Trained { model: path, steps: options.steps, seconds, losses }))
    }

    /// Writes the model of the last checkpoint in `out`.
    ///
    /// # Errors
    /// [`RecipeError`].
    pub fn export(&self, out: &Path) -> Result<Trained, RecipeError> {
        let p = self.prepare(out)?;
        let Some((network, step)) = last_checkpoint(&p.folder, p.network)? else {
            return Err(NotReady::NoCheckpoint { folder: p.folder }.into());
        };
        DgcmModel::new(network, p.crop, ModelCard { steps: step, ..p.card }).save(&p.path)?;
        Ok(Trained { model: p.path, steps: step, seconds: None, losses: BTreeMap::new() })
    }

    fn prepare(&self, out: &Path) -> Result<Prepared, RecipeError> {
        let wrong = |field, found: String, expected| Err(NotReady::option(field, found, expected).into());
        if !(64..=1_000_000).contains(&self.views) {
            return wrong("views", self.views.to_string(), "64 to 1000000");
        }
        if self.encoder.is_some() && self.network == DgcmKind::Compact {
            let expected = "network paper; the compact network starts from random weights";
            return wrong("encoder", "one for the compact network".to_owned(), expected);
        }
        let device = Device::flex().autodiff();
        let (network, crop, default) = match self.network {
            DgcmKind::Compact => {
                let network = Network::Compact(CompactConfig.init(self.seed, &device));
                (network, CropOptions::compact(), TrainingOptions::default())
            }
            DgcmKind::Paper => {
                let network = match &self.encoder {
                    Some(file) => PaperConfig.from_imagenet(file, self.seed, &device)?,
                    None => PaperConfig.init(self.seed, &device),
                };
                (Network::Paper(network), CropOptions::paper(), TrainingOptions::paper())
            }
        };
        let options = TrainingOptions {
            steps: self.steps.unwrap_or(default.steps),
            pairs: self.pairs.unwrap_or(default.pairs),
            lambda: self.lambda.unwrap_or(default.lambda),
            learning_rate: self.learning_rate.unwrap_or(default.learning_rate),
            seed: self.seed,
            ..default
        };
        let pool = PoolOptions { views: self.views, crop, seed: self.seed, ..PoolOptions::default() };
        let mut card = ModelCard::new("", "DGCM-Net, grasps from experience");
        card.data = format!(
            "{} simulated depth views of procedural families (can, mug, cup, bottle, bowl, box, clamp, drill) with random axis scales; no scanned object and no photograph",
            self.views
        );
        card.seed = self.seed;
        card.command.clone_from(&self.command);
        card.extra = serde_json::json!({ "training": options, "pool": pool });
        let (folder, path) = (out.join("training"), out.join("model.safetensors"));
        Ok(Prepared { network, crop, options, pool, card, device, folder, path })
    }
}
