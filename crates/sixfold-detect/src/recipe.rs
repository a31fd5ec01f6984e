//! A complete training: from photographs with ground truth and models to a detector's file. It can be interrupted at any time and
//! resumed.

use std::f32::consts::PI;
use std::path::PathBuf;

use burn::tensor::Device;
use serde_json::json;
use sixfold_data::{PosedImage, TrainingSet, background_files, plain_backgrounds};
use sixfold_nn::choice::Choice;
use sixfold_nn::device;
use sixfold_nn::fingerprint::Fingerprint;
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::options::OptionError;
use sixfold_nn::recipe::{Prepared, Recipe, Session, continued_from};
use sixfold_nn::resnet::ResNet50Config;
use sixfold_nn::train_error::TrainError;
use sixfold_nn::weights::{ModelCard, training_frames};

use crate::anchored::{AnchoredConfig, AnchoredKind, AnchoredNetwork, AnchoredTraining};
use crate::model::{ClassEntry, DetectorModel, DetectorUse};
use crate::network::{Detector, DetectorConfig, Encoder, EncoderKind};
use crate::samples::{TrainingImageError, TrainingImageOptions, TrainingImageSource};
use crate::training::{AnyTraining, DetectorTraining, DetectorTrainingOptions};

/// Which network is trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DetectorKind {
    /// EfficientNet-Lite0 with a pyramid of three levels; trains on two cores.
    #[default]
    Compact,
    /// ResNet-50 with RetinaNet's pyramid and towers. There are no anchors, unlike in the dissertation.
    Retinanet,
    /// The dissertation's detectors, from pretrained weights of torchvision or on EfficientNet-Lite0.
    Anchored(AnchoredKind),
}

impl Choice for DetectorKind {
    const ALL: &'static [DetectorKind] = &[
        DetectorKind::Compact,
        DetectorKind::Retinanet,
        DetectorKind::Anchored(AnchoredKind::FasterRcnn),
        DetectorKind::Anchored(AnchoredKind::MaskRcnn),
        DetectorKind::Anchored(AnchoredKind::RetinaNet),
    ];

    fn name(self) -> &'static str {
        match self {
            DetectorKind::Compact => "compact",
            DetectorKind::Retinanet => "retinanet",
            DetectorKind::Anchored(kind) => kind.name(),
        }
    }

    fn help(self) -> &'static str {
        match self {
            DetectorKind::Compact => "EfficientNet-Lite0 with a pyramid of three levels; trains on two cores",
            DetectorKind::Retinanet => {
                "ResNet-50 with RetinaNet's pyramid and towers (boxes without anchors); needs days on two cores"
            }
            DetectorKind::Anchored(kind) => kind.help(),
        }
    }
}

/// Options of the training of a detector.
#[derive(Debug, Clone, PartialEq)]
pub struct DetectorRecipe {
    /// Which network is trained.
    pub network: DetectorKind,
    /// The encoder under the pyramid of [`DetectorKind::Anchored`]; without, ResNet-50, or that of `init`. The other networks have one each.
    pub backbone: Option<EncoderKind>,
    /// Steps in all.
    pub steps: u64,
    /// Images in a step.
    pub batch: usize,
    /// Maximum learning rate.
    pub learning_rate: f64,
    /// Learning rate of the pretrained encoder as a fraction of the learning rate, 0 to 1.
    pub encoder_rate: f64,
    /// Number of frozen stages of the ImageNet encoder, of five.
    pub frozen_stages: usize,
    /// torchvision's ResNet-50 weights for [`DetectorKind::Retinanet`]; random ones without. For [`DetectorKind::Anchored`] on ResNet-50,
    /// which needs it, these or torchvision's weights of the same network.
    pub encoder: Option<PathBuf>,
    /// Side of the training images in pixels, a multiple of 32 (RetinaNet: 128).
    pub size: usize,
    /// Fraction of training images that are parts of photographs, 0 to 1.
    pub photograph_fraction: f32,
    /// Fraction of renders among pasted objects that have photographs, 0 to 1.
    pub render_fraction: f32,
    /// Largest rotation in the image plane, radians.
    pub rotation: f32,
    /// Render the meshes in their own colours; otherwise in random ones.
    pub mesh_colors: bool,
    /// Larger images are reduced to this many pixels along their longer side before detection.
    pub longest_side: usize,
    /// Default score below which detections are left out, 0 to 1.
    pub threshold: f32,
    /// Continue from the weights of another training of the same objects instead of ImageNet's.
    pub init: Option<PathBuf>,
    /// Folder of photographs for backgrounds; procedural textures if `None`.
    pub backgrounds: Option<PathBuf>,
    /// Seed of weights and samples.
    pub seed: u64,
    /// The command, for the model's card.
    pub command: String,
}

impl Default for DetectorRecipe {
    fn default() -> Self {
        let DetectorTrainingOptions { common, batch, encoder_rate, frozen_stages } = Default::default();
        let DetectorUse { longest_side, threshold } = DetectorUse::default();
        let samples = TrainingImageOptions::default();
        DetectorRecipe {
            network: DetectorKind::Compact,
            backbone: None,
            steps: common.steps,
            batch,
            learning_rate: common.learning_rate,
            encoder_rate,
            frozen_stages,
            encoder: None,
            size: samples.size,
            photograph_fraction: samples.photograph_fraction,
            render_fraction: samples.render_fraction,
            rotation: samples.rotation,
            mesh_colors: true,
            longest_side,
            threshold,
            init: None,
            backgrounds: None,
            seed: common.seed,
            command: String::new(),
        }
    }
}

/// Instances with a smaller visible fraction are not cut out for pasting.
const CUT_VISIBLE: f64 = 0.6;
/// Instances in photographs count even if little of them is visible.
pub const MIN_VISIBILITY: f64 = 0.0;

/// Data prepared before the first step, in addition to the network.
pub struct Context {
    material: TrainingSet,
    classes: Vec<ClassEntry>,
}

impl DetectorRecipe {
    /// The dissertation's training (section 3.4.1) as far as it is implemented here: the ResNet-50 network on objects cut out of
    /// photographs and pasted on other backgrounds.
    pub fn published() -> Self {
        DetectorRecipe {
            network: DetectorKind::Retinanet,
            photograph_fraction: 0.0,
            render_fraction: 0.0,
            ..DetectorRecipe::default()
        }
    }

    /// How the network is trained.
    pub fn options(&self) -> DetectorTrainingOptions {
        let default = DetectorTrainingOptions::default().common;
        DetectorTrainingOptions {
            common: default.with(Some(self.steps), Some(self.learning_rate), self.seed),
            batch: self.batch,
            encoder_rate: self.encoder_rate,
            frozen_stages: self.frozen_stages,
        }
    }

    fn scenes(&self) -> TrainingImageOptions {
        TrainingImageOptions {
            size: self.size,
            photograph_fraction: self.photograph_fraction,
            render_fraction: self.render_fraction,
            rotation: self.rotation,
            random_color_probability: if self.mesh_colors { 0.0 } else { 1.0 },
            ..TrainingImageOptions::default()
        }
    }

    fn network(&self, ids: &[u32], device: &Device) -> Result<(Detector, DetectorConfig), TrainError> {
        if let Some(file) = &self.init {
            return DetectorModel::network_for_training(file, ids, device).map_err(TrainError::method);
        }
        let (config, encoder) = match self.network {
            DetectorKind::Compact | DetectorKind::Anchored(_) => {
                (DetectorConfig::compact(ids.len()), Encoder::Lite0(imagenet_encoder(device)?))
            }
            DetectorKind::Retinanet => {
                let encoder = match &self.encoder {
                    Some(file) => {
                        ResNet50Config::features(4).from_pytorch(file, device).map_err(TrainError::method)?
                    }
                    None => ResNet50Config::features(4).init(self.seed, device),
                };
                (DetectorConfig::retinanet(ids.len()), Encoder::ResNet50(encoder))
            }
        };
        Ok((config.init_with(encoder, self.seed, device), config))
    }
}

impl DetectorRecipe {
    fn anchored(
        &self,
        kind: AnchoredKind,
        ids: &[u32],
        device: &Device,
    ) -> Result<AnchoredNetwork, TrainError> {
        if let Some(file) = &self.init {
            let network = DetectorModel::anchored_for_training(file, kind, ids, device);
            let network = network.map_err(TrainError::method)?;
            let (asked, its) = (self.backbone, network.config().encoder);
            if let Some(asked) = asked.filter(|asked| *asked != its) {
                let found = format!("{} for weights on {} in {}", asked.name(), its.name(), file.display());
                let expected = "the backbone of the weights that the training continues from";
                return Err(OptionError { field: "backbone", found, expected }.into());
            }
            return Ok(network);
        }
        // The R-CNNs know a background beside the objects.
        let labels = ids.len() + AnchoredConfig::new(kind, 1).first_label();
        if self.backbone == Some(EncoderKind::Lite0) {
            return Ok(AnchoredNetwork::on_lite0(kind, labels, self.seed, device)?);
        }
        let expected = "torchvision's weights of ResNet-50 or of the same network";
        let wrong = |found: String| OptionError { field: "encoder", found, expected };
        let file = self.encoder.as_deref().ok_or_else(|| wrong("none".to_owned()))?;
        let network = AnchoredNetwork::pretrained(file, kind, labels, self.seed, device);
        let network = network.map_err(TrainError::method)?;
        Ok(network.ok_or_else(|| wrong(format!("weights of another network in {}", file.display())))?)
    }
}

impl Recipe for DetectorRecipe {
    type Data = TrainingSet;
    type Samples = TrainingImageSource;
    type Training = AnyTraining;
    type Context = Context;
    type Report = ();

    fn steps(&self) -> u64 {
        self.steps
    }

    fn seed(&self) -> u64 {
        self.seed
    }

    fn command(&self) -> &str {
        &self.command
    }

    fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_fraction("threshold", self.threshold)?;
        let side = (32..=16_384).contains(&self.longest_side);
        OptionError::unless(side, "longest_side", self.longest_side, "32 to 16384 pixels")?;
        let rotation = (0.0..=PI).contains(&self.rotation);
        OptionError::unless(rotation, "rotation", self.rotation, "radians from 0 to half a turn")?;
        let wrong = self.encoder.is_some() && self.network == DetectorKind::Compact;
        let expected = "network retinanet; the compact network brings its ImageNet encoder along";
        OptionError::unless(!wrong, "encoder", "one for the compact network", expected)?;
        let anchored = matches!(self.network, DetectorKind::Anchored(_));
        let lite0 = self.backbone == Some(EncoderKind::Lite0);
        if let Some(backbone) = self.backbone {
            let found = format!("{} with network {}", backbone.name(), self.network.name());
            let expected =
                "none; the networks compact (lite0) and retinanet (resnet50) have one backbone each";
            OptionError::unless(anchored, "backbone", found, expected)?;
        }
        let wrong = anchored && lite0 && self.encoder.is_some();
        let expected = "none; the backbone lite0 brings its ImageNet weights along";
        OptionError::unless(!wrong, "encoder", "a file with backbone lite0", expected)?;
        let start = !anchored || lite0 || self.encoder.is_some() || self.init.is_some();
        let expected = "torchvision's weights of ResNet-50 or of the same network, weights to continue from, or backbone lite0";
        OptionError::unless(start, "encoder", "none", expected)?;
        if let Err(TrainingImageError::Option { field, found, expected }) = self.scenes().check() {
            return Err(OptionError { field, found, expected });
        }
        self.options().check()
    }

    /// The default options of the detector (`longest_side`, `threshold`) do not count: it may be exported again with others.
    fn inputs(&self, material: &TrainingSet) -> Result<Fingerprint, TrainError> {
        // Every field by name, so that the compiler reports a new one.
        #[rustfmt::skip]
        let DetectorRecipe {
            network, backbone, encoder, init, backgrounds,
            // In the options of training and samples.
            steps: _, batch: _, learning_rate: _, encoder_rate: _, frozen_stages: _, size: _, photograph_fraction: _,
            render_fraction: _, rotation: _, mesh_colors: _, seed: _,
            // These do not affect the training.
            longest_side: _, threshold: _, command: _,
        } = self;
        let backgrounds = background_files(backgrounds.as_deref()).map_err(TrainError::method)?;
        Fingerprint::of(&self.options())?
            .merged(&Fingerprint::of(&json!({ "samples": self.scenes() }))?)
            .with("network", network.name())
            .merged(&Fingerprint::of(&backbone.map(|b| json!({ "backbone": b })).unwrap_or(json!({})))?)
            .with_contents(material.contents())
            .with_file("encoder", encoder.as_deref())?
            .with_file("init", init.as_deref())?
            .with_files("backgrounds", &backgrounds)
    }

    fn prepare(
        &self,
        material: TrainingSet,
        _: &mut Session<'_>,
    ) -> Result<Prepared<AnyTraining, Context>, TrainError> {
        let ids: Vec<u32> = material.objects.iter().map(|o| o.id).collect();
        let device = device::chosen().autodiff();
        let options = self.options();
        let mut card = ModelCard::new("", &format!("Detector, {} network", self.network.name()));
        card.data.clone_from(&material.description);
        card.training_frames =
            training_frames(self.init.as_deref(), &material.frames).map_err(TrainError::method)?;
        card.extra = json!({
            "training": options, "continued_from": continued_from(self.init.as_deref())?
        });
        let training = match self.network {
            DetectorKind::Anchored(kind) => {
                let network = self.anchored(kind, &ids, &device)?;
                AnyTraining::Anchored(Box::new(AnchoredTraining::new(network, self.size, options)))
            }
            _ => {
                let (network, config) = self.network(&ids, &device)?;
                let training = DetectorTraining::new(network, config, self.size, options, device);
                AnyTraining::Anchorless(Box::new(training))
            }
        };
        let classes = ids.iter().map(|id| ClassEntry { id: *id }).collect();
        Ok(Prepared { training, card, context: Context { material, classes } })
    }

    fn samples(
        &self,
        Context { material, classes }: &mut Context,
        session: &mut Session<'_>,
    ) -> Result<Option<TrainingImageSource>, TrainError> {
        let ids: Vec<u32> = classes.iter().map(|c| c.id).collect();
        let photographs = material.images.len();
        session.note(&format!("making {} objects and {photographs} photographed instances ready", ids.len()));
        let complete = |image: &&PosedImage| image.visible_fraction().is_some_and(|f| f >= CUT_VISIBLE);
        let cut: Vec<PosedImage> = material.images.iter().filter(complete).cloned().collect();
        let objects = std::mem::take(&mut material.objects);
        let (backgrounds, fraction) =
            plain_backgrounds(self.backgrounds.as_deref()).map_err(TrainError::method)?;
        let backgrounds = backgrounds.with_procedural_fraction(fraction);
        TrainingImageSource::new(objects, &material.images, &cut, backgrounds, self.scenes())
            .map(Some)
            .map_err(TrainError::method)
    }

    fn finish(
        &self,
        Prepared { training, card, context }: Prepared<AnyTraining, Context>,
        session: &mut Session<'_>,
    ) -> Result<Option<()>, TrainError> {
        let usage = DetectorUse { longest_side: self.longest_side, threshold: self.threshold };
        let model = match training {
            AnyTraining::Anchorless(training) => {
                let (network, config) = training.into_network();
                DetectorModel::new(network, config, context.classes, usage, card)
            }
            AnyTraining::Anchored(training) => {
                let network = training.into_network().with_longest_side(self.longest_side);
                DetectorModel::of_anchored(network, context.classes, usage, card)
            }
        };
        model.save(&session.model()).map_err(TrainError::method)?;
        Ok(Some(()))
    }
}
