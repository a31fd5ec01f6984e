//! A trained model: the network and the entries of its objects in one file.

use crate::loss::OutputKind;
use crate::networks::{Compact, CompactConfig};
use crate::networks::{GeneratorOutput, PaperGenerator, PaperGeneratorConfig};
use crate::networks::{ResNet50Generator, ResNet50GeneratorConfig};
use crate::object::{Correction, ObjectEntry};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_nn::device;
use sixfold_nn::weights::{
    ModelCard, WeightsError, load_weights, read_card, save_weights, write_card_markdown,
};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Name of the compact network in weight files.
pub const COMPACT: &str = "pix2pose-compact";
/// Name of the dissertation's generator in weight files.
pub const PAPER: &str = "pix2pose-paper";
/// Name of the generator with a ResNet-50 encoder in weight files.
pub(crate) const RESNET50: &str = "pix2pose-resnet50";

/// A network of one of the three kinds. Those of the dissertation are for one object.
#[derive(Debug, Clone)]
pub enum Network {
    /// Shared encoder, one decoder per object.
    Compact(Box<Compact>),
    /// The dissertation's generator.
    Paper(Box<PaperGenerator>),
    /// The dissertation's generator with a ResNet-50 encoder.
    ResNet50(Box<ResNet50Generator>),
}

impl Network {
    /// Name in weight files.
    pub fn architecture(&self) -> &'static str {
        match self {
            Network::Compact(_) => COMPACT,
            Network::Paper(_) => PAPER,
            Network::ResNet50(_) => RESNET50,
        }
    }

    fn for_inference(self) -> Self {
        match self {
            Network::Compact(n) => Network::Compact(Box::new(n.valid())),
            Network::Paper(n) => Network::Paper(Box::new(n.valid())),
            Network::ResNet50(n) => Network::ResNet50(Box::new(n.valid())),
        }
    }
}

/// Why a model could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The weight file.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The card does not describe its objects.
    #[error("{}: the card's `{field}`: expected {expected}, found {found}; the file is not a Pix2Pose model of this version", file.display())]
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
    /// The model was not trained on this object.
    #[error(
        "the model was trained on objects {known}, not on object {id}; train it (`sixfold train pix2pose`) \
         or give other weights"
    )]
    UnknownObject {
        /// The requested object.
        id: u32,
        /// The objects of the model.
        known: String,
    },
}

/// Maximum number of objects of a compact network.
const MAX_OBJECTS: usize = 1000;
/// Minimum size of a decoder in a file, bytes: 291,000 numbers of two bytes or more. A file cannot name more objects than it has
/// decoders.
const DECODER_BYTES: u64 = 500_000;

/// Sizes of a network's images, part of the card.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ImageSizes {
    /// Side of the input in pixels.
    pub input: usize,
    /// Side of the output in pixels.
    pub output: usize,
}

impl Default for ImageSizes {
    fn default() -> Self {
        Self { input: 128, output: 64 }
    }
}

/// A network and the objects it was trained on.
#[derive(Debug, Clone)]
pub struct Pix2PoseModel {
    network: Network,
    objects: Vec<ObjectEntry>,
    sizes: ImageSizes,
    card: ModelCard,
    device: Device,
}

/// Prediction of the network for one crop, `side x side` pixels each.
#[derive(Debug, Clone, PartialEq)]
pub struct Prediction {
    /// Pixels along a side.
    pub side: usize,
    /// Normalised coordinates, pixel by pixel.
    pub coordinates: Vec<[f32; 3]>,
    /// Expected error of the coordinates, 0 to 1 in normalised units.
    pub error: Vec<f32>,
    /// Probability that the object is visible at the pixel.
    pub visible: Vec<f32>,
}

impl Pix2PoseModel {
    /// A model of a trained network. Its architecture, objects and sizes are written into `card`.
    pub fn new(network: Network, objects: Vec<ObjectEntry>, sizes: ImageSizes, card: ModelCard) -> Self {
        let objects_json = objects.iter().map(|o| serde_json::to_value(o).unwrap_or_default()).collect();
        let mut extra = card.extra.clone();
        if !extra.is_object() {
            extra = serde_json::json!({});
        }
        extra["image_sizes"] = serde_json::to_value(sizes).unwrap_or_default();
        let card = ModelCard {
            architecture: network.architecture().to_string(),
            objects: objects_json,
            extra,
            ..card
        };
        Self { network: network.for_inference(), objects, sizes, card, device: device::chosen() }
    }

    /// The same with another card; its objects and sizes must be those of this model.
    pub(crate) fn with_card(self, card: ModelCard) -> Self {
        Self { card, ..self }
    }

    /// Reads a weight file.
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        let device = device::chosen();
        let card = read_card(path)?;
        let (objects, sizes) = described(path, &card)?;
        let (network, card) = match card.architecture.as_str() {
            PAPER => {
                let (network, card) =
                    load_weights(PaperGeneratorConfig::default().init(&device), path, PAPER)?;
                (Network::Paper(Box::new(network)), card)
            }
            RESNET50 => {
                let network = ResNet50GeneratorConfig::default().init(&device);
                let (network, card) = load_weights(network, path, RESNET50)?;
                (Network::ResNet50(Box::new(network)), card)
            }
            _ => {
                let network = CompactConfig { objects: objects.len() }.init_random(0, &device);
                let (network, card) = load_weights(network, path, COMPACT)?;
                (Network::Compact(Box::new(network)), card)
            }
        };
        Ok(Self { network, objects, sizes, card, device })
    }

    /// The network of a weight file, for further training on `device` with the objects `ids` in this order.
    pub fn network_for_training(path: &Path, ids: &[u32], device: &Device) -> Result<Compact, ModelError> {
        let model = Self::load(path)?;
        let places = ids.iter().map(|id| Ok(model.object(*id)?.0)).collect::<Result<Vec<_>, ModelError>>()?;
        let network = CompactConfig { objects: model.objects.len() }.init_random(0, device);
        let (network, _) = load_weights(network, path, COMPACT)?;
        let decoders = places.iter().map(|place| network.decoders[*place].clone()).collect();
        Ok(Compact { decoders, ..network })
    }

    /// Writes the weight file and, next to it, the card as text.
    pub fn save(&self, path: &Path) -> Result<(), ModelError> {
        match &self.network {
            Network::Compact(network) => save_weights(network.as_ref(), &self.card, path)?,
            Network::Paper(network) => save_weights(network.as_ref(), &self.card, path)?,
            Network::ResNet50(network) => save_weights(network.as_ref(), &self.card, path)?,
        }
        Ok(write_card_markdown(&self.card, &path.with_extension("md"))?)
    }

    /// The objects, in the order of the network's decoders.
    pub fn objects(&self) -> &[ObjectEntry] {
        &self.objects
    }

    /// Index and entry of an object.
    pub fn object(&self, id: u32) -> Result<(usize, &ObjectEntry), ModelError> {
        self.objects.iter().enumerate().find(|(_, o)| o.id == id).ok_or_else(|| ModelError::UnknownObject {
            id,
            known: self.objects.iter().map(|o| o.id.to_string()).collect::<Vec<_>>().join(", "),
        })
    }

    /// Sets the systematic errors of aligned poses of its objects; other objects are unchanged.
    pub(crate) fn set_corrections(&mut self, corrections: &BTreeMap<u32, Correction>) {
        for object in &mut self.objects {
            if let Some(correction) = corrections.get(&object.id) {
                object.correction = *correction;
            }
        }
        self.describe_objects();
    }

    /// Sets the outlier thresholds of all its objects.
    pub(crate) fn set_thresholds(&mut self, thresholds: &[f32]) {
        self.objects.iter_mut().for_each(|object| object.thresholds = thresholds.to_vec());
        self.describe_objects();
    }

    fn describe_objects(&mut self) {
        self.card.objects =
            self.objects.iter().map(|o| serde_json::to_value(o).unwrap_or_default()).collect();
    }

    /// Sizes of input and output.
    pub fn sizes(&self) -> ImageSizes {
        self.sizes
    }

    /// The card.
    pub fn card(&self) -> &ModelCard {
        &self.card
    }

    /// The card, to add scores to.
    pub fn card_mut(&mut self) -> &mut ModelCard {
        &mut self.card
    }

    /// Runs the network on crops of one object: `count` images of `3 x side x side` values in 0..1, one after another.
    ///
    /// # Panics
    /// If the length is wrong or there is no such object.
    pub fn predict(&self, object_index: usize, crops: &[f32]) -> Vec<Prediction> {
        let side = self.sizes.input;
        let count = crops.len() / (3 * side * side);
        assert!(count > 0 && crops.len() == count * 3 * side * side);
        let input = |values: Vec<f32>| {
            Tensor::<4>::from_data(TensorData::new(values, [count, 3, side, side]), &self.device)
        };
        let generated = match &self.network {
            Network::Compact(network) => {
                let output = network.forward(input(network_input(crops)), &[(object_index, count)]).remove(0);
                return self.compact_predictions(output);
            }
            Network::Paper(network) => network.forward(input(paper_input(crops))),
            Network::ResNet50(network) => network.forward(input(resnet_input(crops))),
        };
        self.paper_predictions(generated)
    }

    fn compact_predictions(&self, output: Tensor<4>) -> Vec<Prediction> {
        let side = self.sizes.output;
        let pixels = side * side;
        let sigmoid = |v: &f32| 1.0 / (1.0 + (-v).exp());
        numbers(output)
            .chunks_exact(OutputKind::Compact.channels() * pixels)
            .map(|raw| Prediction {
                side,
                coordinates: (0..pixels)
                    .map(|p| [0, 1, 2].map(|c| raw[c * pixels + p].clamp(-1.2, 1.2)))
                    .collect(),
                error: raw[3 * pixels..4 * pixels].iter().map(sigmoid).collect(),
                visible: raw[4 * pixels..5 * pixels].iter().map(sigmoid).collect(),
            })
            .collect()
    }

    /// The dissertation's networks have no channel of visibility: a pixel belongs to the object if the norm of its coordinates
    /// exceeds 0.3, and its probability is higher for a smaller expected error.
    fn paper_predictions(&self, output: GeneratorOutput) -> Vec<Prediction> {
        let side = self.sizes.output;
        let pixels = side * side;
        let (coordinates, errors) = (numbers(output.coordinates), numbers(output.error));
        coordinates
            .chunks_exact(3 * pixels)
            .zip(errors.chunks_exact(pixels))
            .map(|(raw, error)| {
                let coordinates: Vec<[f32; 3]> =
                    (0..pixels).map(|p| [0, 1, 2].map(|c| raw[c * pixels + p])).collect();
                let visible = coordinates
                    .iter()
                    .zip(error)
                    .map(|(n, e)| if n.iter().map(|v| v * v).sum::<f32>() > 0.09 { 1.0 - e } else { 0.0 })
                    .collect();
                Prediction { side, coordinates, error: error.to_vec(), visible }
            })
            .collect()
    }
}

/// Objects and sizes of a card, checked before a network of that size is created.
fn described(path: &Path, card: &ModelCard) -> Result<(Vec<ObjectEntry>, ImageSizes), ModelError> {
    let file = || path.to_path_buf();
    let wrong = |field, expected, found: String| ModelError::Card { file: file(), field, expected, found };
    let compact = match card.architecture.as_str() {
        COMPACT => true,
        PAPER | RESNET50 => false,
        other => {
            return Err(wrong(
                "architecture",
                "pix2pose-compact, pix2pose-paper or pix2pose-resnet50",
                other.to_owned(),
            ));
        }
    };
    let count = card.objects.len();
    if compact {
        let expected = "1 to 1000 objects, and 500 kB of the file for each";
        let bytes =
            std::fs::metadata(path).map_err(|source| WeightsError::Read { file: file(), source })?.len();
        if !(1..=MAX_OBJECTS).contains(&count) || bytes < count as u64 * DECODER_BYTES {
            return Err(wrong("objects", expected, format!("{count} in a file of {bytes} bytes")));
        }
    } else if count != 1 {
        return Err(wrong("objects", "one object, which is all this network knows", count.to_string()));
    }
    let mut objects: Vec<ObjectEntry> = Vec::with_capacity(count);
    for value in &card.objects {
        let entry: ObjectEntry = serde_json::from_value(value.clone()).map_err(|error| {
            wrong("objects", "id, diameter, centre, half_size, thresholds", error.to_string())
        })?;
        entry.check().map_err(|(field, expected, found)| {
            wrong(field, expected, format!("{found} (object {})", entry.id))
        })?;
        if objects.iter().any(|o| o.id == entry.id) {
            return Err(wrong("objects", "every id once", format!("object {} twice", entry.id)));
        }
        objects.push(entry);
    }
    let sizes: ImageSizes = serde_json::from_value(card.extra["image_sizes"].clone())
        .map_err(|error| wrong("extra.image_sizes", "input and output in pixels", error.to_string()))?;
    let ImageSizes { input, output } = sizes;
    let (fits, expected) = if compact {
        let fits = input.is_multiple_of(32) && (32..=512).contains(&input) && output == input / 2;
        (fits, "an input of 32 to 512 pixels, a multiple of 32, and an output of half of it")
    } else {
        (input == 128 && output == 128, "128 pixels for input and output")
    };
    if !fits {
        return Err(wrong("extra.image_sizes", expected, format!("{input} and {output}")));
    }
    Ok((objects, sizes))
}

fn numbers(output: Tensor<4>) -> Vec<f32> {
    output.into_data().try_to_vec().unwrap_or_else(|error| unreachable!("f32 output: {error:?}"))
}

/// Scales values in 0..1 for the dissertation's generator: `(255 v - 128) / 128`.
pub fn paper_input(rgb: &[f32]) -> Vec<f32> {
    rgb.iter().map(|v| (v * 255.0 - 128.0) / 128.0).collect()
}

/// Scales images of `3 x side x side` values in 0..1 for torchvision's ResNet-50.
pub(crate) fn resnet_input(rgb: &[f32]) -> Vec<f32> {
    const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
    const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];
    let plane = 128 * 128;
    rgb.iter().enumerate().map(|(i, v)| (v - MEAN[i / plane % 3]) / DEVIATION[i / plane % 3]).collect()
}

/// Scales values in 0..1 for EfficientNet-Lite0: `(255 v - 127) / 128`.
pub(crate) fn network_input(rgb: &[f32]) -> Vec<f32> {
    rgb.iter().map(|v| (v * 255.0 - 127.0) / 128.0).collect()
}
