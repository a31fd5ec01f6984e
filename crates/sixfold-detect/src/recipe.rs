//! A whole training: photographs with their ground truth, and models, in; a detector's file out. Interrupted at any time, it
//! goes on.

use std::collections::BTreeMap;
use std::f32::consts::PI;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use burn::tensor::Device;
use sixfold_synth::augment::AugmentError;
use sixfold_data::{PosedImage, TrainingSet, plain_backgrounds};
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::pretrained::PretrainedError;
use sixfold_nn::recipe::{Listener, News, NotReady, Trained, continued_from};
use sixfold_nn::resnet::ResNet50Config;
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::{ModelCard, WeightsError, training_frames};
use sixfold_pix2pose::material::{Material, plain_backgrounds};
use sixfold_pix2pose::samples::{SampleError, read_real_crops};
use sixfold_synth::augment::AugmentError;
use thiserror::Error;

use crate::model::{ClassEntry, DetectorModel, DetectorUse, ModelError};
use crate::network::{Detector, DetectorConfig, Encoder};
use crate::samples::{SceneError, SceneOptions, SceneSource};
use crate::training::{Ending, TrainingError, TrainingOptions, TrainingPace, last_checkpoint, train};

/// Which network learns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DetectorKind {
    /// EfficientNet-Lite0 with a pyramid of three levels; trains on two cores.
    #[default]
    Compact,
    /// ResNet-50 with RetinaNet's pyramid and heads, as in the dissertation.
    Retinanet,
}

impl DetectorKind {
    /// All kinds.
    pub const ALL: [DetectorKind; 2] = [DetectorKind::Compact, DetectorKind::Retinanet];

    /// As it is typed.
    pub fn name(self) -> &'static str {
        match self {
            DetectorKind::Compact => "compact",
            DetectorKind::Retinanet => "retinanet",
        }
    }
}

/// How a detector is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// Which network learns.
    pub network: DetectorKind,
    /// Steps in all.
    pub steps: u64,
    /// Images in a step.
    pub batch: usize,
    /// Highest learning rate.
    pub learning_rate: f64,
    /// The pretrained encoder's share of the learning rate, 0 to 1.
    pub encoder_share: f64,
    /// Stages of the ImageNet encoder that stay as they are, of five.
    pub frozen_stages: usize,
    /// torchvision's ResNet-50 weights for [`DetectorKind::Retinanet`]; random ones without.
    pub encoder: Option<PathBuf>,
    /// Side of the training images in pixels, a multiple of 32 (RetinaNet: 128).
    pub size: usize,
    /// Share of training images that are parts of photographs, 0 to 1.
    pub photograph_share: f32,
    /// Share of renders among pasted objects that have photographs, 0 to 1.
    pub render_share: f32,
    /// Largest turn in the image plane, radians.
    pub rotation: f32,
    /// Draw the meshes in their own colours; otherwise in random ones.
    pub mesh_colors: bool,
    /// Larger images will be reduced to so many pixels along their longer side before detection.
    pub longest_side: usize,
    /// Score below which detections will be left out unless something else is asked for, 0 to 1.
    pub threshold: f32,
    /// Go on from the weights of another training of the same objects instead of ImageNet's.
    pub init: Option<PathBuf>,
    /// Folder of photographs for backgrounds; made-up textures without.
    pub backgrounds: Option<PathBuf>,
    /// Seed of weights and samples.
    pub seed: u64,
    /// What was asked for, for the model's card.
    pub command: String,
}

impl Default for Recipe {
    fn default() -> Self {
        Recipe {
            network: DetectorKind::Compact,
            steps: 8000,
            batch: 4,
            learning_rate: 0.002,
            encoder_share: 0.3,
            frozen_stages: 2,
            encoder: None,
            size: 320,
            photograph_share: 0.45,
            render_share: 0.4,
            rotation: 15f32.to_radians(),
            mesh_colors: true,
            longest_side: 640,
            threshold: 0.4,
            init: None,
            backgrounds: None,
            seed: 0,
            command: String::new(),
        }
    }
}

/// Why no detector could be trained. What was trained until then is kept.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RecipeError {
    /// An option out of its range, or nothing to export.
    #[error(transparent)]
    NotReady(#[from] NotReady),
    /// Backgrounds.
    #[error(transparent)]
    Backgrounds(#[from] AugmentError),
    /// Training images.
    #[error(transparent)]
    Scenes(#[from] SceneError),
    /// Weights to begin with.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// Weights in torchvision's layout.
    #[error(transparent)]
    Pretrained(#[from] PretrainedError),
    /// A model file.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The training itself.
    #[error(transparent)]
    Training(#[from] TrainingError),
}

/// Less complete instances are not cut out to be pasted elsewhere.
const CUT_VISIBLE: f64 = 0.6;
/// Instances in photographs count however little of them is visible.
pub const LEAST_VISIBLE: f64 = 0.0;

/// Everything that stands before the first step.
struct Prepared {
    network: Detector,
    config: DetectorConfig,
    options: TrainingOptions,
    card: ModelCard,
    classes: Vec<ClassEntry>,
    usage: DetectorUse,
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
        material: TrainingSet,
        out: &Path,
        stop: &AtomicBool,
        hear: &mut Listener<'_>,
    ) -> Result<Ending<Trained>, RecipeError> {
        let Prepared { network, config, options, mut card, classes, usage, device, folder, path } =
            self.prepare(&material, out)?;
        let ids: Vec<u32> = classes.iter().map(|c| c.id).collect();
        let scene_options = SceneOptions {
            size: self.size,
            photograph_share: self.photograph_share,
            render_share: self.render_share,
            rotation: self.rotation,
            random_color_chance: if self.mesh_colors { 0.0 } else { 1.0 },
            ..SceneOptions::default()
        };
        let photographs = material.images.len();
        hear(News::Note(&format!(
            "making {} objects and {photographs} photographed instances ready",
            ids.len()
        )));
        let complete = |image: &&PosedImage| image.visible_fraction().is_some_and(|f| f >= CUT_VISIBLE);
        let cut: Vec<PosedImage> = material.images.iter().filter(complete).cloned().collect();
        let (backgrounds, share) = plain_backgrounds(self.backgrounds.as_deref())?;
        let backgrounds = backgrounds.with_procedural_share(share);
        let source = SceneSource::new(material.objects, &material.images, &cut, backgrounds, scene_options)?;
        let mut last = TrainingRecord::default();
        let shown = |record: &TrainingRecord| {
            hear(News::Steps(record, self.steps));
            last = record.clone();
        };
        let pace = TrainingPace::default();
        let ending = train(&source, network, &config, &device, &folder, &options, &pace, stop, shown)?;
        let network = match ending {
            Ending::Finished(network) => network,
            Ending::Interrupted { step } => return Ok(Ending::Interrupted { step }),
        };
        card.steps = self.steps;
        DetectorModel::new(network, config, classes, usage, card).save(&path)?;
        let (seconds, losses) = (Some(last.seconds), last.losses);
        Ok(Ending::Finished(Trained { model: path, steps: self.steps, seconds, losses }))
    }

    /// Writes the model of the last checkpoint in `out`.
    ///
    /// # Errors
    /// [`RecipeError`].
    pub fn export(&self, material: &TrainingSet, out: &Path) -> Result<Trained, RecipeError> {
        let p = self.prepare(material, out)?;
        let Some((network, step)) = last_checkpoint(&p.folder, p.network)? else {
            return Err(NotReady::NoCheckpoint { folder: p.folder }.into());
        };
        let card = ModelCard { steps: step, ..p.card };
        DetectorModel::new(network, p.config, p.classes, p.usage, card).save(&p.path)?;
        Ok(Trained { model: p.path, steps: step, seconds: None, losses: BTreeMap::new() })
    }

    fn check(&self) -> Result<(), RecipeError> {
        let wrong = |field, found: String, expected| Err(NotReady::option(field, found, expected).into());
        if !(0.0..=1.0).contains(&self.threshold) {
            return wrong("threshold", self.threshold.to_string(), "0 to 1");
        }
        if !(32..=16_384).contains(&self.longest_side) {
            return wrong("longest_side", self.longest_side.to_string(), "32 to 16384 pixels");
        }
        if !(0.0..=PI).contains(&self.rotation) {
            return wrong("rotation", self.rotation.to_string(), "radians from 0 to half a turn");
        }
        if self.encoder.is_some() && self.network == DetectorKind::Compact {
            let expected = "network retinanet; the compact network brings its ImageNet encoder along";
            return wrong("encoder", "one for the compact network".to_owned(), expected);
        }
        Ok(())
    }

    fn prepare(&self, material: &TrainingSet, out: &Path) -> Result<Prepared, RecipeError> {
        self.check()?;
        let ids: Vec<u32> = material.objects.iter().map(|o| o.id).collect();
        let device = Device::flex().autodiff();
        let (network, config) = match (&self.init, self.network) {
            (Some(file), _) => DetectorModel::network_for_training(file, &ids, &device)?,
            (None, DetectorKind::Compact) => {
                let config = DetectorConfig::compact(ids.len());
                let encoder = Encoder::Lite0(imagenet_encoder(&device)?);
                (config.init_with(encoder, self.seed, &device), config)
            }
            (None, DetectorKind::Retinanet) => {
                let config = DetectorConfig::retinanet(ids.len());
                let encoder = match &self.encoder {
                    Some(file) => ResNet50Config::features(4).from_pytorch(file, &device)?,
                    None => ResNet50Config::features(4).init(self.seed, &device),
                };
                (config.init_with(Encoder::ResNet50(encoder), self.seed, &device), config)
            }
        };
        let options = TrainingOptions {
            steps: self.steps,
            batch: self.batch,
            learning_rate: self.learning_rate,
            encoder_share: self.encoder_share,
            frozen_stages: self.frozen_stages,
            seed: self.seed,
            ..TrainingOptions::default()
        };
        let mut card = ModelCard::new("", &format!("Detector, {} network", self.network.name()));
        card.data.clone_from(&material.description);
        card.training_frames = training_frames(self.init.as_deref(), &material.frames)?;
        card.seed = self.seed;
        card.command.clone_from(&self.command);
        card.extra = serde_json::json!({
            "training": options, "continued_from": continued_from(self.init.as_deref())?
        });
        let usage = DetectorUse { longest_side: self.longest_side, threshold: self.threshold };
        let classes = ids.iter().map(|id| ClassEntry { id: *id }).collect();
        let (folder, path) = (out.join("training"), out.join("model.safetensors"));
        Ok(Prepared { network, config, options, card, classes, usage, device, folder, path })
    }
}
