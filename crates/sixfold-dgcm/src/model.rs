//! A trained DGCM-Net as one file, and its queries: features, and coordinates of an object in an experience.

use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use sixfold_experience::{Crop, CropOptions, FeatureExtractor};
use sixfold_io::fnv1a;
use sixfold_nn::device;
use sixfold_nn::weights::{
    ModelCard, WeightsError, load_weights, load_weights_from_bytes, read_card, save_weights,
    write_card_markdown,
};

use crate::networks::{Encoded, FEATURE, Network, numbers};

/// Why a model could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The weight file.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The card does not describe a DGCM-Net.
    #[error("{}: the card's `{field}`: expected {expected}, found {found}; the file is not a DGCM-Net of this version", file.display())]
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

/// A network and the options of its crops.
#[derive(Debug, Clone)]
pub struct DgcmModel {
    network: Network,
    crop: CropOptions,
    card: ModelCard,
    device: Device,
}

/// The network's encoding of an input, reused for several experiences.
#[derive(Debug, Clone)]
pub struct InputCode {
    encoded: Encoded,
    /// The feature, 256 numbers.
    pub feature: Vec<f32>,
}

impl DgcmModel {
    /// A model of a trained network. Its architecture and crop are written into `card`.
    pub fn new(network: Network, crop: CropOptions, card: ModelCard) -> Self {
        let mut extra = card.extra.clone();
        if !extra.is_object() {
            extra = serde_json::json!({});
        }
        extra["crop"] = serde_json::to_value(crop).unwrap_or_default();
        let card = ModelCard { architecture: network.architecture().to_owned(), extra, ..card };
        DgcmModel { network: network.valid(), crop, card, device: device::chosen() }
    }

    /// Reads a weight file.
    ///
    /// # Errors
    /// [`ModelError`] for a file that cannot be read or is not a DGCM-Net.
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        let card = read_card(path)?;
        let device = device::chosen();
        let (network, crop) = Self::described(path, &card, &device)?;
        let (network, card) = load_weights(network, path, &card.architecture)?;
        Ok(DgcmModel { network: network.valid(), crop, card, device })
    }

    /// Reads a model from the bytes of a weight file; `name` is used in messages.
    ///
    /// # Errors
    /// [`ModelError`].
    pub fn from_bytes(name: &Path, bytes: &[u8]) -> Result<Self, ModelError> {
        let device = device::chosen();
        let compact = "dgcm-compact";
        let network = Network::of_architecture(compact, &device)
            .unwrap_or_else(|| unreachable!("the compact network is known"));
        let (network, card) = load_weights_from_bytes(network, name, bytes, compact)?;
        let (_, crop) = Self::described(name, &card, &device)?;
        Ok(DgcmModel { network: network.valid(), crop, card, device })
    }

    fn described(
        path: &Path,
        card: &ModelCard,
        device: &Device,
    ) -> Result<(Network, CropOptions), ModelError> {
        let wrong =
            |field, expected, found| ModelError::Card { file: path.to_path_buf(), field, expected, found };
        let network = Network::of_architecture(&card.architecture, device)
            .ok_or_else(|| wrong("architecture", "dgcm-compact or dgcm-paper", card.architecture.clone()))?;
        let crop: CropOptions = serde_json::from_value(card.extra["crop"].clone())
            .map_err(|e| wrong("extra.crop", "how objects are cut out", e.to_string()))?;
        check_crop(&crop).map_err(|(field, expected, found)| wrong(field, expected, found))?;
        if crop.side != network.side() {
            return Err(wrong(
                "extra.crop.side",
                "the side of the network's input, pixels",
                crop.side.to_string(),
            ));
        }
        Ok((network, crop))
    }

    /// Writes the weight file and, next to it, the card as text.
    ///
    /// # Errors
    /// [`ModelError::Weights`].
    pub fn save(&self, path: &Path) -> Result<(), ModelError> {
        save_weights(&self.network, &self.card, path)?;
        Ok(write_card_markdown(&self.card, &path.with_extension("md"))?)
    }

    /// Options of the network's crops.
    pub fn crop_options(&self) -> &CropOptions {
        &self.crop
    }

    /// The card.
    pub fn card(&self) -> &ModelCard {
        &self.card
    }

    /// A name that distinguishes this network's features from those of another: its architecture and a hash of its card.
    pub fn fingerprint(&self) -> String {
        let hash = fnv1a(serde_json::to_string(&self.card).unwrap_or_default().as_bytes());
        format!("{}-{hash:016x}", self.card.architecture)
    }

    /// Encodes an object's normals and its own VD-NOC.
    ///
    /// # Panics
    /// If the crop's side differs from the network's.
    pub fn encode(&self, crop: &Crop) -> InputCode {
        assert_eq!(crop.side, self.crop.side, "a crop of another size than the network's");
        let planes = [crop.normal_planes(), crop.vd_noc_planes()].concat();
        let encoded = self.network.geometry(self.tensor(planes, 1));
        let feature = numbers(&encoded.feature);
        InputCode { encoded, feature }
    }

    /// For every experience (its feature, and its VD-NOC as three planes) the VD-NOC of the input's pixels in the
    /// experience's frame, pixel by pixel.
    ///
    /// # Panics
    /// If features or VD-NOC do not have the network's size.
    pub fn coordinates(&self, input: &InputCode, experiences: &[(&[f32], &[f32])]) -> Vec<Vec<[f32; 3]>> {
        let (count, pixels) = (experiences.len(), self.crop.side * self.crop.side);
        if count == 0 {
            return vec![];
        }
        let features: Vec<f32> = experiences.iter().flat_map(|(f, _)| f.iter().copied()).collect();
        let vd_noc: Vec<f32> = experiences.iter().flat_map(|(_, v)| v.iter().copied()).collect();
        assert_eq!((features.len(), vd_noc.len()), (count * FEATURE, count * 3 * pixels));
        let features = Tensor::<2>::from_data(TensorData::new(features, [count, FEATURE]), &self.device);
        let code = self.network.vd_noc(self.tensor(vd_noc, count));
        let input = input.encoded.repeat(count);
        let decoded = self.network.decode(&input, features, &code);
        let out = self.network.aligned(&decoded, &input, &code);
        out.chunks_exact(3 * pixels)
            .map(|image| (0..pixels).map(|i| [0, 1, 2].map(|k| image[k * pixels + i])).collect())
            .collect()
    }

    fn tensor(&self, values: Vec<f32>, count: usize) -> Tensor<4> {
        let side = self.crop.side;
        let channels = values.len() / (count * side * side);
        Tensor::from_data(TensorData::new(values, [count, channels, side, side]), &self.device)
    }
}

/// Tests that the numbers of a card are valid for a crop; otherwise returns the invalid field, the expected values and the value
/// found.
fn check_crop(crop: &CropOptions) -> Result<(), (&'static str, &'static str, String)> {
    if !(crop.size > 0.01 && crop.size < 5.0) {
        return Err(("extra.crop.size", "0.01 to 5 m", crop.size.to_string()));
    }
    if !(1..=50).contains(&crop.normal_radius) {
        return Err(("extra.crop.normal_radius", "1 to 50 pixels", crop.normal_radius.to_string()));
    }
    if !(0.0..0.5).contains(&crop.trim) {
        return Err(("extra.crop.trim", "0 up to 0.5", crop.trim.to_string()));
    }
    if !(8..=1024).contains(&crop.side) {
        return Err(("extra.crop.side", "8 to 1024 pixels", crop.side.to_string()));
    }
    let pixels = crop.side * crop.side;
    if !(1..=pixels).contains(&crop.min_pixels) {
        return Err(("extra.crop.min_pixels", "1 to the pixels of the crop", crop.min_pixels.to_string()));
    }
    Ok(())
}

impl FeatureExtractor for DgcmModel {
    fn fingerprint(&self) -> String {
        DgcmModel::fingerprint(self)
    }

    fn crop_options(&self) -> &CropOptions {
        DgcmModel::crop_options(self)
    }

    fn feature(&self, crop: &Crop) -> Vec<f32> {
        self.encode(crop).feature
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::networks::CompactConfig;

    #[test]
    fn a_model_survives_its_file_and_other_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("dgcm.safetensors");
        let network = Network::Compact(CompactConfig.init(1, &Device::flex()));
        let model = DgcmModel::new(network, CropOptions::compact(), ModelCard::new("", "test"));
        model.save(&file).unwrap();
        let again = DgcmModel::load(&file).unwrap();
        assert_eq!(again.crop_options(), &CropOptions::compact());
        let bytes = std::fs::read(&file).unwrap();
        assert!(DgcmModel::from_bytes(&file, &bytes).is_ok());
        assert!(folder.path().join("dgcm.md").exists());
        let missing = DgcmModel::load(&folder.path().join("none.safetensors")).unwrap_err().to_string();
        assert!(missing.contains("none.safetensors"), "{missing}");
        let error = DgcmModel::from_bytes(&file, &bytes[..bytes.len() / 2]).unwrap_err().to_string();
        assert!(error.contains("dgcm.safetensors"), "{error}");
    }

    #[test]
    fn cards_with_impossible_numbers_are_refused() {
        use serde_json::{Value, json};
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("dgcm.safetensors");
        let network = Network::Compact(CompactConfig.init(1, &Device::flex()));
        let whole = DgcmModel::new(network.clone(), CropOptions::compact(), ModelCard::new("", "test")).card;
        let crop: [(&str, Value, &str); 9] = [
            ("side", json!(0), "extra.crop.side"),
            ("side", json!(1u64 << 63), "extra.crop.side"),
            ("side", json!(128), "extra.crop.side"),
            ("size", json!(1e300), "extra.crop.size"),
            ("size", json!(-0.3), "extra.crop.size"),
            ("normal_radius", json!(u64::MAX), "extra.crop.normal_radius"),
            ("trim", json!(0.5), "extra.crop.trim"),
            ("min_pixels", json!(0), "extra.crop.min_pixels"),
            ("min_pixels", json!(u64::MAX), "extra.crop.min_pixels"),
        ];
        let refused = |card: &ModelCard, field: &str| {
            save_weights(&network, card, &file).unwrap();
            let bytes = std::fs::read(&file).unwrap();
            for error in
                [DgcmModel::load(&file).unwrap_err(), DgcmModel::from_bytes(&file, &bytes).unwrap_err()]
            {
                let error = error.to_string();
                assert!(error.contains("dgcm.safetensors") && error.contains(field), "{field}: {error}");
            }
        };
        for (name, value, field) in crop {
            let mut card = whole.clone();
            card.extra["crop"][name] = value;
            refused(&card, field);
        }
        refused(&ModelCard { extra: Value::Null, ..whole.clone() }, "extra.crop");
        refused(&ModelCard { architecture: "dgcm".to_owned(), ..whole }, "dgcm-compact");
    }
}
