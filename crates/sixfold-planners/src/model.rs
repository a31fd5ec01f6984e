//! A trained GPD network as one file, and its success probabilities.

use std::path::Path;

use burn::module::Module;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor, TensorData};
use sixfold_grasp::learned::{CHANNELS, ClosingRegion, SIDE};
use sixfold_nn::device;
use sixfold_nn::weights::{
    ModelCard, WeightsError, load_weights, load_weights_from_bytes, save_weights, write_card_markdown,
};

use crate::network::{ARCHITECTURE, Gpd, GpdConfig};

/// The shipped weights; see the card next to the file.
static SHIPPED: &[u8] = include_bytes!("../weights/gpd-compact.safetensors");

/// Candidates per forward pass.
const AT_A_TIME: usize = 64;

/// A network and its card.
#[derive(Debug, Clone)]
pub struct GpdModel {
    network: Gpd,
    card: ModelCard,
}

impl GpdModel {
    #[cfg(feature = "recipe")]
    pub(crate) fn new(network: Gpd, card: ModelCard) -> Self {
        let card = ModelCard { architecture: ARCHITECTURE.to_owned(), ..card };
        GpdModel { network: network.valid(), card }
    }

    /// The shipped model.
    ///
    /// # Panics
    /// Never: a test reads it.
    pub fn shipped() -> Self {
        let network = GpdConfig.init(0, &device::chosen());
        let name = Path::new("gpd-compact.safetensors");
        let (network, card) = load_weights_from_bytes(network, name, SHIPPED, ARCHITECTURE)
            .unwrap_or_else(|error| unreachable!("the shipped planner: {error}"));
        GpdModel { network: network.valid(), card }
    }

    /// Reads a weight file written by `sixfold train planner --planner gpd`.
    ///
    /// # Errors
    /// [`WeightsError`].
    pub fn load(path: &Path) -> Result<Self, WeightsError> {
        let (network, card) = load_weights(GpdConfig.init(0, &device::chosen()), path, ARCHITECTURE)?;
        Ok(GpdModel { network: network.valid(), card })
    }

    /// Writes the weight file and, next to it, the card as text.
    ///
    /// # Errors
    /// [`WeightsError`].
    pub fn save(&self, path: &Path) -> Result<(), WeightsError> {
        save_weights(&self.network, &self.card, path)?;
        write_card_markdown(&self.card, &path.with_extension("md"))
    }

    /// The card.
    pub fn card(&self) -> &ModelCard {
        &self.card
    }

    /// Success probabilities of candidates, 0 to 1.
    pub fn scores(&self, regions: &[ClosingRegion]) -> Vec<f64> {
        let device = device::chosen();
        let of_batch = |batch: &[ClosingRegion]| {
            let logits = self.network.forward(tensor(batch.iter(), batch.len(), &device));
            let scores: Vec<f32> = sigmoid(logits)
                .into_data()
                .try_to_vec()
                .unwrap_or_else(|error| unreachable!("f32 output: {error:?}"));
            scores.into_iter().map(f64::from)
        };
        regions.chunks(AT_A_TIME).flat_map(of_batch).collect()
    }
}

/// Images as the network's input: `count x 15 x 32 x 32`, 0 to 1.
pub(crate) fn tensor<'a>(
    regions: impl Iterator<Item = &'a ClosingRegion>,
    count: usize,
    device: &Device,
) -> Tensor<4> {
    let values: Vec<f32> = regions.flat_map(|r| r.pixels().iter().map(|&v| f32::from(v) / 255.0)).collect();
    Tensor::from_data(TensorData::new(values, [count, CHANNELS, SIDE, SIDE]), device)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shipped_planner_is_read_and_other_files_are_refused() {
        let model = GpdModel::shipped();
        assert_eq!(model.card().architecture, ARCHITECTURE);
        assert!(model.scores(&[]).is_empty());
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("gpd.safetensors");
        model.save(&file).unwrap();
        assert_eq!(GpdModel::load(&file).unwrap().card(), model.card());
        std::fs::write(&file, b"none").unwrap();
        let error = GpdModel::load(&file).unwrap_err().to_string();
        assert!(error.contains("gpd.safetensors"), "{error}");
    }
}
