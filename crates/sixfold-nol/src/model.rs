//! A trained network as one file, which encodes photographs and renders new views.

use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use sixfold_nn::device;
use sixfold_nn::weights::{
    ModelCard, WeightsError, load_weights, load_weights_from_bytes, read_card, save_weights,
    write_card_markdown,
};

use crate::features::{Map, SourceFeatures};
use crate::network::{CHANNELS, COLOURS, FEATURES, Network, Parts};
use crate::projection::TargetSurface;
use crate::samples::{Lookup, look_up, order};
use crate::source::SourceView;

/// Border around the visible pixels that is processed too, so that they are surrounded by zeros as in the training.
const BORDER: usize = 8;

/// Compact weights for all objects; see the card next to the file.
static SHIPPED: &[u8] = include_bytes!("../weights/nol-compact.safetensors");

/// Why a model could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The weight file.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The card does not describe a network of NOL.
    #[error("{}: the card's `{field}`: expected {expected}, found {found}; the file is not a NOL network of this version", file.display())]
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
}

/// A view, rendered from photographs. All lists are in the order of [`TargetSurface::pixels`].
#[derive(Debug, Clone, PartialEq)]
pub struct Rendering {
    /// X^D: red, green and blue, 0 to 1; mid-grey where no source shows the point.
    pub colours: Vec<[f32; 3]>,
    /// X^S: colours (-1 to 1), 13 features and the cosine; zeros where no source shows the point.
    pub channels: Vec<[f32; CHANNELS]>,
    /// Whether any source shows the point.
    pub seen: Vec<bool>,
    /// Weights of the sources at each point: those of point `i` begin at `i` times the number of sources, in the sources' order.
    pub weights: Vec<f32>,
}

/// A network that renders.
#[derive(Debug, Clone)]
pub struct NolModel {
    network: Network,
    card: ModelCard,
    device: Device,
}

impl NolModel {
    /// A model of a trained network. Its architecture and parts are written into `card`.
    pub fn new(network: Network, parts: Parts, card: ModelCard) -> Self {
        let mut extra = card.extra.clone();
        if !extra.is_object() {
            extra = serde_json::json!({});
        }
        extra["parts"] = serde_json::to_value(parts).unwrap_or_default();
        let card = ModelCard { architecture: network.architecture().to_owned(), extra, ..card };
        NolModel { network: network.valid(), card, device: device::chosen() }
    }

    /// Reads a weight file.
    ///
    /// # Errors
    /// [`ModelError`] for a file that cannot be read or contains another network.
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        let card = read_card(path)?;
        let network = Self::described(path, &card)?;
        let (network, card) = load_weights(network, path, &card.architecture)?;
        Ok(NolModel { network: network.valid(), card, device: device::chosen() })
    }

    /// Reads a compact model with all its parts from the bytes of a weight file; `name` is used in messages.
    ///
    /// # Errors
    /// [`ModelError`].
    pub fn from_bytes(name: &Path, bytes: &[u8]) -> Result<Self, ModelError> {
        let (device, compact) = (device::chosen(), "nol-compact");
        let network = Network::of_architecture(compact, Parts::default(), &device)?
            .unwrap_or_else(|| unreachable!("the compact network is known"));
        let (network, card) = load_weights_from_bytes(network, name, bytes, compact)?;
        Ok(NolModel { network: network.valid(), card, device })
    }

    /// The shipped network.
    ///
    /// # Errors
    /// [`ModelError`] if the shipped weights have another version than the program.
    pub fn shipped() -> Result<Self, ModelError> {
        Self::from_bytes(Path::new("nol-compact.safetensors"), SHIPPED)
    }

    fn described(path: &Path, card: &ModelCard) -> Result<Network, ModelError> {
        let wrong =
            |field, expected, found| ModelError::Card { file: path.to_path_buf(), field, expected, found };
        let parts: Parts = serde_json::from_value(card.extra["parts"].clone())
            .map_err(|e| wrong("extra.parts", "the network's parts", e.to_string()))?;
        Network::of_architecture(&card.architecture, parts, &device::chosen())?
            .ok_or_else(|| wrong("architecture", "nol-compact or nol-paper", card.architecture.clone()))
    }

    /// Writes the weight file and, next to it, the card as text.
    ///
    /// # Errors
    /// [`ModelError::Weights`].
    pub fn save(&self, path: &Path) -> Result<(), ModelError> {
        save_weights(&self.network, &self.card, path)?;
        Ok(write_card_markdown(&self.card, &path.with_extension("md"))?)
    }

    /// The card.
    pub fn card(&self) -> &ModelCard {
        &self.card
    }

    /// The card, to be completed.
    pub fn card_mut(&mut self) -> &mut ModelCard {
        &mut self.card
    }

    /// Encoded sources, kept for many target views and for refinement. The features do not depend on the sources' poses.
    ///
    /// # Panics
    /// If a crop's side is not a multiple of 16.
    pub fn encode(&self, sources: &[SourceView]) -> Vec<SourceFeatures> {
        sources
            .iter()
            .map(|source| {
                let side = source.side();
                assert!(side.is_multiple_of(16), "crops of {side} pixels, expected a multiple of 16");
                let colours: Vec<f32> = source.patch.data.iter().map(|v| 2.0 * v - 1.0).collect();
                let image = TensorData::new(colours.clone(), [1, COLOURS, side, side]);
                let mut maps = vec![Map { channels: COLOURS, size: [side, side], values: colours }];
                for map in self.network.encode(Tensor::from_data(image, &self.device)) {
                    let [_, channels, height, width] = map.dims();
                    maps.push(Map { channels, size: [height, width], values: numbers(map) });
                }
                SourceFeatures { side, maps }
            })
            .collect()
    }

    /// Renders a view from sources, at their current poses, and their [`Self::encode`]d features. The order of the sources does not
    /// matter.
    ///
    /// # Panics
    /// If there are no features for some source.
    pub fn render(
        &self,
        target: &TargetSurface,
        sources: &[SourceView],
        features: &[SourceFeatures],
    ) -> Rendering {
        assert_eq!(sources.len(), features.len(), "features for every source");
        let points = target.points.len();
        let mut rendering = Rendering {
            colours: vec![[0.5; 3]; points],
            channels: vec![[0.0; CHANNELS]; points],
            seen: vec![false; points],
            weights: vec![0.0; points * sources.len()],
        };
        let lookup: Vec<Lookup> = sources.par_iter().map(|source| look_up(source, target)).collect();
        for point in lookup.iter().flat_map(|l| &l.points) {
            rendering.seen[*point as usize] = true;
        }
        let Some(area) = Area::around(target, &rendering.seen) else { return rendering };
        let order = order(&lookup);
        let pixels = area.width * area.height;
        let mut values = vec![0.0; order.len() * CHANNELS * pixels];
        let mut valid = vec![0.0; order.len() * pixels];
        values.par_chunks_mut(CHANNELS * pixels).zip(valid.par_chunks_mut(pixels)).zip(&order).for_each(
            |((values, valid), &source)| {
                let (lookup, features) = (&lookup[source], &features[source]);
                let mut at_place = [0.0; CHANNELS];
                for ((point, pixel), cosine) in lookup.points.iter().zip(&lookup.pixels).zip(&lookup.cosines)
                {
                    let at = area.index(target, *point as usize);
                    features.sample(pixel[0], pixel[1], &mut at_place);
                    at_place[COLOURS + FEATURES] = *cosine;
                    for (plane, value) in values.chunks_exact_mut(pixels).zip(&at_place) {
                        plane[at] = *value;
                    }
                    valid[at] = 1.0;
                }
            },
        );
        let tensor = |values: Vec<f32>, channels: usize| {
            let shape = [order.len(), channels, area.height, area.width];
            Tensor::<4>::from_data(TensorData::new(values, shape), &self.device)
        };
        let blend = self.network.blend(tensor(values, CHANNELS), tensor(valid, 1), order.len());
        let (weights, sum) = (numbers(blend.weights), numbers(blend.sum));
        for point in (0..points).filter(|p| rendering.seen[*p]) {
            let at = area.index(target, point);
            let channels: [f32; CHANNELS] = std::array::from_fn(|c| sum[c * pixels + at]);
            rendering.channels[point] = channels;
            rendering.colours[point] = std::array::from_fn(|c| (0.5 * channels[c] + 0.5).clamp(0.0, 1.0));
            for (k, source) in order.iter().enumerate() {
                rendering.weights[point * sources.len() + source] = weights[k * pixels + at];
            }
        }
        rendering
    }
}

/// The part of the image that is processed.
struct Area {
    left: usize,
    top: usize,
    width: usize,
    height: usize,
}

impl Area {
    /// The bounding box of the visible pixels with a border; `None` if there are none.
    fn around(target: &TargetSurface, seen: &[bool]) -> Option<Area> {
        let columns = target.camera.width;
        let (mut low, mut high) = ([usize::MAX; 2], [0; 2]);
        for (pixel, _) in target.pixels.iter().zip(seen).filter(|(_, seen)| **seen) {
            let at = [*pixel as usize % columns, *pixel as usize / columns];
            for k in 0..2 {
                low[k] = low[k].min(at[k]);
                high[k] = high[k].max(at[k] + 1);
            }
        }
        if low[0] == usize::MAX {
            return None;
        }
        let ends = [columns, target.camera.height];
        let low = low.map(|v| v.saturating_sub(BORDER));
        let high: [usize; 2] = std::array::from_fn(|k| (high[k] + BORDER).min(ends[k]));
        Some(Area { left: low[0], top: low[1], width: high[0] - low[0], height: high[1] - low[1] })
    }

    fn index(&self, target: &TargetSurface, point: usize) -> usize {
        let (pixel, columns) = (target.pixels[point] as usize, target.camera.width);
        (pixel / columns - self.top) * self.width + pixel % columns - self.left
    }
}

fn numbers<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec().unwrap_or_else(|error| unreachable!("f32 output: {error:?}"))
}

#[cfg(test)]
#[path = "model_tests.rs"]
mod tests;
