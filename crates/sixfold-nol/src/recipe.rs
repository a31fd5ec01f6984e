//! A whole training: nothing but a seed in (better: photographs for textures too), a network that renders new views out.
//! Interrupted at any time, it goes on.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use burn::tensor::Device;
use sixfold_nn::pretrained::PretrainedError;
use sixfold_nn::recipe::{Listener, News, NotReady, Trained};
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::{ModelCard, WeightsError};
use sixfold_synth::augment::{AugmentError, Backgrounds, PhotographOptions};
use thiserror::Error;

use crate::loss::Perceptual;
use crate::model::{ModelError, NolModel};
use crate::network::{CompactConfig, Network, PaperConfig, Parts};
use crate::quality::{Quality, QualityOptions, quality};
use crate::training::{Ending, TrainingError, TrainingOptions, TrainingPace, last_checkpoint, train};

/// Share of procedural textures between the photographs.
const PROCEDURAL_SHARE: f32 = 0.2;

/// Which network learns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum NolKind {
    /// On a frozen EfficientNet-Lite0; trains on two cores.
    #[default]
    Compact,
    /// The dissertation's, on DenseNet-121.
    Paper,
}

impl NolKind {
    /// All kinds.
    pub const ALL: [NolKind; 2] = [NolKind::Compact, NolKind::Paper];

    /// As it is typed.
    pub fn name(self) -> &'static str {
        match self {
            NolKind::Compact => "compact",
            NolKind::Paper => "paper",
        }
    }
}

/// How the network is trained.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Recipe {
    /// Which network learns.
    pub network: NolKind,
    /// ImageNet weights of DenseNet-121 in torchvision's layout for [`NolKind::Paper`]; random ones without.
    pub encoder: Option<PathBuf>,
    /// How sources are integrated, and whether there is a decoder.
    pub parts: Parts,
    /// Folder of photographs for textures, backgrounds and clutter; procedural textures only without.
    pub backgrounds: Option<PathBuf>,
    /// Steps in all; `None`: 5000, the dissertation's network 350000.
    pub steps: Option<u64>,
    /// Highest learning rate; `None`: 0.002, the dissertation's network 0.001.
    pub learning_rate: Option<f64>,
    /// Seed of weights and samples.
    pub seed: u64,
    /// What was asked for, for the model's card.
    pub command: String,
}

/// Why no network could be trained. What was trained until then is kept.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecipeError {
    /// An option out of its range, or nothing to export.
    #[error(transparent)]
    NotReady(#[from] NotReady),
    /// Backgrounds.
    #[error("backgrounds: {0}")]
    Backgrounds(#[from] AugmentError),
    /// Weights that come along.
    #[error(transparent)]
    Weights(#[from] WeightsError),
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
    options: TrainingOptions,
    textures: Backgrounds,
    card: ModelCard,
    device: Device,
    folder: PathBuf,
    path: PathBuf,
}

impl Recipe {
    /// Trains, or goes on with the training in `out`, and writes the model there with how like the truth it renders made-up
    /// objects that it was not trained on. `stop` ends it after the current step.
    ///
    /// # Errors
    /// [`RecipeError`].
    pub fn train(
        &self,
        out: &Path,
        stop: &AtomicBool,
        hear: &mut Listener<'_>,
    ) -> Result<Ending<(Trained, Quality)>, RecipeError> {
        let Prepared { network, options, textures, card, device, folder, path } = self.prepare(out)?;
        let perceptual = Perceptual::of(&network, &device)?;
        let mut last = TrainingRecord::default();
        let shown = |record: &TrainingRecord| {
            hear(News::Steps(record, options.steps));
            last = record.clone();
        };
        let (parts, pace) = (self.parts, TrainingPace::default());
        let ending =
            train(&textures, network, parts, &perceptual, &device, &folder, &options, &pace, stop, shown)?;
        let network = match ending {
            Ending::Finished(network) => network,
            Ending::Interrupted { step } => return Ok(Ending::Interrupted { step }),
        };
        let steps = options.steps;
        let quality = self.finish(network, &options, &textures, ModelCard { steps, ..card }, &path, hear)?;
        let trained = Trained { model: path, steps, seconds: Some(last.seconds), losses: last.losses };
        Ok(Ending::Finished((trained, quality)))
    }

    /// Writes the model of the last checkpoint in `out`.
    ///
    /// # Errors
    /// [`RecipeError`].
    pub fn export(&self, out: &Path, hear: &mut Listener<'_>) -> Result<(Trained, Quality), RecipeError> {
        let p = self.prepare(out)?;
        let Some((network, steps)) = last_checkpoint(&p.folder, p.network)? else {
            return Err(NotReady::NoCheckpoint { folder: p.folder }.into());
        };
        let card = ModelCard { steps, ..p.card };
        let quality = self.finish(network, &p.options, &p.textures, card, &p.path, hear)?;
        Ok((Trained { model: p.path, steps, seconds: None, losses: BTreeMap::new() }, quality))
    }

    fn finish(
        &self,
        network: Network,
        options: &TrainingOptions,
        textures: &Backgrounds,
        card: ModelCard,
        path: &Path,
        hear: &mut Listener<'_>,
    ) -> Result<Quality, RecipeError> {
        let mut model = NolModel::new(network, self.parts, card);
        // First without scores: nothing that was trained may be lost.
        model.save(path)?;
        hear(News::Note("measuring the model on made-up objects"));
        let quality = quality(&model, textures, &options.samples, &QualityOptions::default())?;
        model.card_mut().scores = quality.scores();
        model.save(path)?;
        Ok(quality)
    }

    fn prepare(&self, out: &Path) -> Result<Prepared, RecipeError> {
        if self.encoder.is_some() && self.network == NolKind::Compact {
            let expected = "network paper; the compact network brings its encoder along";
            return Err(NotReady::option("encoder", "one for the compact network", expected).into());
        }
        let device = Device::flex().autodiff();
        let parts = self.parts;
        let (network, default) = match self.network {
            NolKind::Compact => {
                let network = CompactConfig { parts }.init(self.seed, &device)?;
                (Network::Compact(network), TrainingOptions::default())
            }
            NolKind::Paper => {
                let config = PaperConfig { parts };
                let network = match &self.encoder {
                    Some(file) => config.from_imagenet(file, self.seed, &device)?,
                    None => config.init(self.seed, &device),
                };
                (Network::Paper(network), TrainingOptions::paper())
            }
        };
        let options = TrainingOptions {
            steps: self.steps.unwrap_or(default.steps),
            learning_rate: self.learning_rate.unwrap_or(default.learning_rate),
            seed: self.seed,
            ..default
        };
        let textures = match &self.backgrounds {
            Some(folder) => Backgrounds::from_folder(folder, &PhotographOptions::default())?
                .with_procedural_share(PROCEDURAL_SHARE),
            None => Backgrounds::procedural(),
        };
        let mut card = ModelCard::new("", "Neural Object Learning, new views from few photographs");
        card.data = format!(
            "made-up household shapes (procedural families, alone and grown together) with textures from {}; no scanned object",
            match textures.images() {
                0 => "noise".to_owned(),
                n => format!("{n} photographs and noise"),
            }
        );
        card.seed = self.seed;
        card.command.clone_from(&self.command);
        card.extra = serde_json::json!({ "training": options });
        let (folder, path) = (out.join("training"), out.join("model.safetensors"));
        Ok(Prepared { network, options, textures, card, device, folder, path })
    }
}
