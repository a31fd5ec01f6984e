//! A trained detector: the network and the ids of its objects in one file; or weights of torchvision.

use crate::anchored::{AnchoredDetection, AnchoredKind, AnchoredNetwork, Thresholds};
use crate::card::{anchored_kind, classes_of, read_anchored};
use crate::detect::{DetectOptions, Detected, NetworkImage, Numbers, decode};
use crate::network::{Detector, DetectorConfig, EncoderKind};
use crate::torchvision::{self, Torchvision};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_geometry::{Rect, RgbImage};
use sixfold_nn::device;
use sixfold_nn::pretrained::PretrainedError;
use sixfold_nn::weights::{
    ModelCard, WeightsError, load_weights, load_weights_from_bytes, read_card, save_weights,
    write_card_markdown,
};
use std::f32::consts::SQRT_2;
use std::path::{Path, PathBuf};

/// The weights of the detector of any object; their card is next to them.
const PROPOSALS: &[u8] = include_bytes!("../weights/proposals.safetensors");

/// Name of the compact detector in weight files.
pub const COMPACT: &str = "detect-compact";
/// Name of the detector on ResNet-50 in weight files.
pub(crate) const RETINANET: &str = "detect-retinanet";

/// One class of a detector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClassEntry {
    /// The object's id in its dataset.
    pub id: u32,
}

/// Default options of a detector; part of its file.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DetectorUse {
    /// Larger images are reduced to this along their longer side, pixels.
    pub longest_side: usize,
    /// Detections with a lower score are left out.
    pub threshold: f32,
}

impl Default for DetectorUse {
    fn default() -> Self {
        DetectorUse { longest_side: 640, threshold: DetectOptions::default().threshold }
    }
}

/// Why a detector could not be read or used.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The weight file.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The card does not describe a detector.
    #[error("{}: the card's `{field}`: expected {expected}, found {found}; the file is not a detector of this version", file.display())]
    Card {
        /// The file.
        file: PathBuf,
        /// Field of the card.
        field: &'static str,
        /// What it should hold.
        expected: &'static str,
        /// What it holds.
        found: String,
    },
    /// The detector was not trained on this object.
    #[error(
        "the detector was trained on objects {known}, not on object {id}; train it (`sixfold train \
         detector`), give other weights or a file of detections"
    )]
    UnknownObject {
        /// The requested object.
        id: u32,
        /// The objects of the detector.
        known: String,
    },
    /// An option is out of range.
    #[error("{0}")]
    Option(String),
    /// The file is neither a detector of Sixfold nor a network of torchvision.
    #[error(
        "{}: expected a detector that `sixfold train detector` wrote, or torchvision's weights of fasterrcnn_resnet50_fpn, \
         maskrcnn_resnet50_fpn or retinanet_resnet50_fpn, found no tensor of their last layers; give another file", file.display()
    )]
    Foreign {
        /// The file.
        file: PathBuf,
    },
    /// Weights of torchvision that do not fit its network.
    #[error(transparent)]
    Torchvision(PretrainedError),
    /// Error in the file next to weights of torchvision.
    #[error(
        "{}: expected the objects of the labels of the weights beside it, such as {{\"objects\": {{\"1\": \
         5, \"2\": 8}}}} with an object's id for each label, found {found}; correct or remove it", file.display()
    )]
    Objects {
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        found: String,
    },
    /// The image is empty.
    #[error("the image is empty (0x0 pixels); give one with at least one pixel")]
    EmptyImage,
}

/// A network and its card.
#[derive(Debug, Clone)]
pub struct DetectorModel {
    network: Network,
    classes: Vec<ClassEntry>,
    usage: DetectorUse,
    card: ModelCard,
}

/// The kinds of networks.
#[derive(Debug, Clone)]
#[allow(clippy::large_enum_variant)]
enum Network {
    /// Networks that Sixfold trains.
    Anchorless(AnchorlessNetwork),
    /// Networks of torchvision, with the label of every class.
    Anchored(AnchoredNetwork, Vec<usize>),
}

/// A network without anchors, trained by Sixfold.
#[derive(Debug, Clone)]
pub struct AnchorlessNetwork {
    network: Detector,
    config: DetectorConfig,
    device: Device,
}

fn architecture(config: &DetectorConfig) -> &'static str {
    match config.encoder {
        EncoderKind::Lite0 => COMPACT,
        EncoderKind::ResNet50 => RETINANET,
    }
}

impl DetectorModel {
    /// A model of a trained network. Its architecture, classes and sizes are written into `card`.
    ///
    /// # Panics
    /// If there is not one entry per class.
    pub fn new(
        network: Detector,
        config: DetectorConfig,
        classes: Vec<ClassEntry>,
        usage: DetectorUse,
        card: ModelCard,
    ) -> Self {
        assert_eq!(config.classes, classes.len());
        let mut extra = card.extra.clone();
        if !extra.is_object() {
            extra = serde_json::json!({});
        }
        extra["network"] = serde_json::to_value(&config).unwrap_or_default();
        extra["use"] = serde_json::to_value(usage).unwrap_or_default();
        let objects = classes.iter().map(|c| serde_json::to_value(c).unwrap_or_default()).collect();
        let card = ModelCard { architecture: architecture(&config).to_string(), objects, extra, ..card };
        DetectorModel { network: anchorless(network, config, device::chosen()), classes, usage, card }
    }

    /// Reads a weight file: one written by a training, or torchvision's weights of Faster R-CNN, Mask R-CNN or RetinaNet (`.pth`,
    /// `.pt` or `.safetensors`; [`crate::torchvision::objects_file`] next to it maps its labels to objects).
    ///
    /// # Errors
    /// [`ModelError`] for a file that cannot be read or is not a detector.
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        let pickled =
            path.extension().is_some_and(|e| e.eq_ignore_ascii_case("pth") || e.eq_ignore_ascii_case("pt"));
        if pickled || matches!(read_card(path), Err(WeightsError::Card { .. })) {
            return Self::of_torchvision(path);
        }
        if anchored_kind(&read_card(path)?).is_some() {
            let (network, labels, classes, usage, card) = read_anchored(path, &device::chosen())?;
            let network = network.with_labels(&labels);
            return Ok(DetectorModel { network: Network::Anchored(network, labels), classes, usage, card });
        }
        let device = device::chosen();
        let (network, config, classes, usage, card) = read(path, &device)?;
        Ok(DetectorModel { network: anchorless(network, config, device), classes, usage, card })
    }

    /// A model of a trained network with anchors, whose labels are the classes in their order. Its architecture, classes and sizes
    /// are written into `card`.
    pub fn of_anchored(
        network: AnchoredNetwork,
        classes: Vec<ClassEntry>,
        usage: DetectorUse,
        card: ModelCard,
    ) -> Self {
        let first = network.config().first_label();
        let labels = (first..first + classes.len()).collect();
        DetectorModel { network: Network::Anchored(network, labels), classes, usage, card }
    }

    fn of_torchvision(path: &Path) -> Result<Self, ModelError> {
        let Torchvision { network, labels, classes, beside, card } = torchvision::read(path)?;
        let default = DetectorUse::default();
        let usage = DetectorUse {
            longest_side: network.config().max_side,
            threshold: beside.threshold.unwrap_or(default.threshold),
        };
        Ok(DetectorModel { network: Network::Anchored(network, labels), classes, usage, card })
    }

    /// The shipped detector of any object, with one class, [`crate::proposals::ANY_OBJECT`].
    ///
    /// # Errors
    /// [`ModelError`] if the shipped weights have another version than the program.
    pub fn proposals() -> Result<Self, ModelError> {
        let device = device::chosen();
        let config = DetectorConfig::proposals();
        let name = Path::new("proposals.safetensors");
        let (network, card) =
            load_weights_from_bytes(config.init(0, &device), name, PROPOSALS, architecture(&config))?;
        let classes = vec![ClassEntry { id: crate::proposals::ANY_OBJECT }];
        let usage = serde_json::from_value(card.extra["use"].clone()).unwrap_or_default();
        Ok(DetectorModel { network: anchorless(network, config, device), classes, usage, card })
    }

    /// The encoder of a network without anchors.
    #[cfg(test)]
    pub(crate) fn encoder(&self) -> Option<&crate::network::Encoder> {
        match &self.network {
            Network::Anchorless(network) => Some(&network.network.encoder),
            Network::Anchored(..) => None,
        }
    }

    /// The network of a weight file, for further training on `device` with the objects `ids` in this order.
    ///
    /// # Errors
    /// As [`DetectorModel::load`]; [`ModelError::Card`] also for a detector of other objects or in another order.
    pub fn network_for_training(
        path: &Path,
        ids: &[u32],
        device: &Device,
    ) -> Result<(Detector, DetectorConfig), ModelError> {
        let (network, config, classes, ..) = read(path, device)?;
        let found: Vec<u32> = classes.iter().map(|c| c.id).collect();
        if found != ids {
            return Err(other_objects(path, &found, ids));
        }
        Ok((network, config))
    }

    /// Writes the weight file and, next to it, the card as text.
    ///
    /// # Errors
    /// [`ModelError::Weights`].
    pub fn save(&self, path: &Path) -> Result<(), ModelError> {
        let (network, labels) = match &self.network {
            Network::Anchorless(network) => {
                save_weights(&network.network, &self.card, path)?;
                return Ok(write_card_markdown(&self.card, &path.with_extension("md"))?);
            }
            Network::Anchored(network, labels) => (network, labels),
        };
        let mut card = self.card.clone();
        if !card.extra.is_object() {
            card.extra = serde_json::json!({});
        }
        card.extra["network"] = serde_json::to_value(network.config()).unwrap_or_default();
        card.extra["use"] = serde_json::to_value(self.usage).unwrap_or_default();
        card.extra["labels"] = serde_json::to_value(labels).unwrap_or_default();
        card.objects = self.classes.iter().map(|c| serde_json::to_value(c).unwrap_or_default()).collect();
        card.architecture = network.config().kind.architecture().to_owned();
        network.save(&card, path)?;
        Ok(write_card_markdown(&card, &path.with_extension("md"))?)
    }

    /// As [`DetectorModel::network_for_training`], of a network with anchors.
    pub(crate) fn anchored_for_training(
        path: &Path,
        kind: AnchoredKind,
        ids: &[u32],
        device: &Device,
    ) -> Result<AnchoredNetwork, ModelError> {
        let card = read_card(path)?;
        if anchored_kind(&card) != Some(kind) {
            return Err(ModelError::Card {
                file: path.to_path_buf(),
                field: "architecture",
                expected: "the network that is to be trained",
                found: card.architecture,
            });
        }
        let (network, _, classes, ..) = read_anchored(path, device)?;
        let found: Vec<u32> = classes.iter().map(|c| c.id).collect();
        let config = network.config();
        if found != ids || config.labels != ids.len() + config.first_label() {
            return Err(other_objects(path, &found, ids));
        }
        Ok(network)
    }

    /// The classes, in the order of the network's outputs.
    pub fn classes(&self) -> &[ClassEntry] {
        &self.classes
    }

    /// The object's id of a class of this network.
    pub fn id_of(&self, class: usize) -> u32 {
        self.classes.get(class).map_or(0, |c| c.id)
    }

    /// Returns an error if the detector was not trained on the object.
    ///
    /// # Errors
    /// [`ModelError::UnknownObject`].
    pub fn check_object(&self, id: u32) -> Result<(), ModelError> {
        if self.classes.iter().any(|c| c.id == id) {
            return Ok(());
        }
        let known = self.classes.iter().map(|c| c.id.to_string()).collect::<Vec<_>>().join(", ");
        Err(ModelError::UnknownObject { id, known })
    }

    /// Its default options.
    pub fn usage(&self) -> DetectorUse {
        self.usage
    }

    /// The network, if it is one without anchors.
    pub fn anchorless(&self) -> Option<&AnchorlessNetwork> {
        match &self.network {
            Network::Anchorless(network) => Some(network),
            Network::Anchored(..) => None,
        }
    }

    /// The card.
    pub fn card(&self) -> &ModelCard {
        &self.card
    }

    /// The default options with the model's own threshold.
    pub fn options(&self) -> DetectOptions {
        DetectOptions { threshold: self.usage.threshold, ..DetectOptions::default() }
    }

    /// Whether it processes images at several sizes ([`DetectOptions::scales`]).
    pub(crate) fn has_scales(&self) -> bool {
        matches!(self.network, Network::Anchorless(_))
    }

    /// Detects the model's objects in an image of any size, best first.
    ///
    /// # Errors
    /// [`ModelError::Option`] and [`ModelError::EmptyImage`].
    pub fn detect(&self, image: &RgbImage, options: &DetectOptions) -> Result<Vec<Detected>, ModelError> {
        options.check().map_err(ModelError::Option)?;
        match &self.network {
            Network::Anchorless(network) => {
                let (width, height) = image.size();
                let longest = self.usage.longest_side.min(width.max(height)) as f32;
                let mut found = Vec::new();
                for scale in 0..options.scales {
                    let side = (longest * SQRT_2.powi(-(scale as i32))).round() as usize;
                    let input =
                        NetworkImage::new(image, &network.config, side).ok_or(ModelError::EmptyImage)?;
                    let numbers = network.run(&input);
                    found.push((input, numbers));
                }
                Ok(decode(&found, image.size(), &network.config, options))
            }
            Network::Anchored(..) if image.size().0 == 0 || image.size().1 == 0 => {
                Err(ModelError::EmptyImage)
            }
            Network::Anchored(..) if options.scales != 1 => Err(ModelError::Option(format!(
                "detection option scales: found {}, expected 1: the network has anchors of all sizes",
                options.scales
            ))),
            Network::Anchored(network, labels) => Ok(anchored(network, labels, image, options)),
        }
    }
}

/// Detections of a network of torchvision. Its boxes are not converted: the convention of their coordinates depends on its
/// training.
fn anchored(
    network: &AnchoredNetwork,
    labels: &[usize],
    image: &RgbImage,
    options: &DetectOptions,
) -> Vec<Detected> {
    let DetectOptions { threshold, overlap, per_class, max_detections, masks, scales: _, voting: _ } =
        *options;
    let thresholds = Thresholds {
        score: threshold,
        overlap: f64::from(overlap),
        most: max_detections,
        per_label: per_class,
    };
    let found = network.detect(image, &thresholds, masks);
    let detected = |d: AnchoredDetection| {
        let [left, top, right, bottom] = d.corners.map(f64::from);
        Some(Detected {
            class: labels.iter().position(|label| *label == d.label)?,
            score: d.score,
            bbox: Rect { x: left, y: top, width: right - left, height: bottom - top },
            mask: d.mask.map(|mask| mask.pasted(&d.corners, image.size()).mask(image.size())),
        })
    };
    found.into_iter().filter_map(detected).collect()
}

fn anchorless(network: Detector, config: DetectorConfig, device: Device) -> Network {
    Network::Anchorless(AnchorlessNetwork { network: network.valid(), config, device })
}

impl AnchorlessNetwork {
    /// Sizes of the network.
    pub fn config(&self) -> &DetectorConfig {
        &self.config
    }

    /// The network's output for an image.
    pub fn run(&self, input: &NetworkImage) -> Numbers {
        let data = TensorData::new(input.values.clone(), [1, 3, input.height, input.width]);
        let out = self.network.forward(Tensor::from_data(data, &self.device));
        let numbers = |t: Tensor<4>| -> Vec<f32> {
            t.into_data().try_to_vec().unwrap_or_else(|error| unreachable!("f32 output: {error:?}"))
        };
        Numbers {
            scores: out.scores.into_iter().map(numbers).collect(),
            boxes: out.boxes.into_iter().map(numbers).collect(),
            prototypes: numbers(out.prototypes),
        }
    }
}

fn other_objects(path: &Path, found: &[u32], ids: &[u32]) -> ModelError {
    ModelError::Card {
        file: path.to_path_buf(),
        field: "objects",
        expected: "the objects that are to be trained, in this order",
        found: format!("{found:?} instead of {ids:?}"),
    }
}

type Content = (Detector, DetectorConfig, Vec<ClassEntry>, DetectorUse, ModelCard);

fn read(path: &Path, device: &Device) -> Result<Content, ModelError> {
    let card = read_card(path)?;
    let wrong = |field, expected, found: String| ModelError::Card {
        file: path.to_path_buf(),
        field,
        expected,
        found,
    };
    if card.architecture != COMPACT && card.architecture != RETINANET {
        return Err(wrong("architecture", "detect-compact or detect-retinanet", card.architecture));
    }
    let classes = classes_of(&card, path)?;
    let config: DetectorConfig = serde_json::from_value(card.extra["network"].clone())
        .map_err(|e| wrong("extra.network", "the network's sizes", e.to_string()))?;
    let usage: DetectorUse = serde_json::from_value(card.extra["use"].clone())
        .map_err(|e| wrong("extra.use", "longest_side and threshold", e.to_string()))?;
    let bytes = std::fs::metadata(path)
        .map_err(|source| WeightsError::Read { file: path.to_path_buf(), source })?
        .len();
    check_sizes(&config, &usage, classes.len(), bytes)
        .map_err(|(field, expected, found)| wrong(field, expected, found))?;
    if architecture(&config) != card.architecture {
        let expected = "lite0 for detect-compact, res_net50 for detect-retinanet";
        return Err(wrong("extra.network.encoder", expected, card.architecture));
    }
    let (network, card) = load_weights(config.init(0, device), path, architecture(&config))?;
    Ok((network, config, classes, usage, card))
}

/// Tests that the numbers of a card are valid for a detector in a file of `bytes` bytes; otherwise returns the invalid field, the
/// expected values and the value found. Called before anything of these sizes is allocated.
fn check_sizes(
    config: &DetectorConfig,
    usage: &DetectorUse,
    objects: usize,
    bytes: u64,
) -> Result<(), (&'static str, &'static str, String)> {
    let DetectorConfig { classes, width, levels, shared, own, prototypes, .. } = *config;
    if classes != objects {
        return Err((
            "extra.network.classes",
            "as many as there are objects",
            format!("{classes} for {objects} objects"),
        ));
    }
    let ranges = [
        ("extra.network.classes", classes, 1..=10_000, "1 to 10000"),
        ("extra.network.width", width, 2..=1024, "2 to 1024"),
        ("extra.network.levels", levels, 2..=6, "2 to 6"),
        ("extra.network.shared", shared, 0..=16, "0 to 16"),
        ("extra.network.own", own, 0..=16, "0 to 16"),
        ("extra.network.prototypes", prototypes, 1..=1024, "1 to 1024"),
        ("extra.use.longest_side", usage.longest_side, 32..=16_384, "32 to 16384 pixels"),
    ];
    for (field, value, range, expected) in ranges {
        if !range.contains(&value) {
            return Err((field, expected, value.to_string()));
        }
    }
    if !(0.0..=1.0).contains(&usage.threshold) {
        return Err(("extra.use.threshold", "0 to 1", usage.threshold.to_string()));
    }
    // At least two bytes for each weight of the heads' 3x3 convolutions and of the scores.
    let numbers = 9 * width * width * (shared + 2 * own) + width * classes;
    if bytes < 2 * numbers as u64 {
        let found = format!("{bytes} bytes for {numbers} numbers or more");
        return Err(("extra.network", "sizes of a network that the file holds", found));
    }
    Ok(())
}
