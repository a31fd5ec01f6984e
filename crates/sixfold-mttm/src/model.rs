//! A trained network as one file, and its queries: descriptors of regions and templates, and predictions for pairs of them.

use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use sixfold_geometry::nalgebra::{Quaternion, UnitQuaternion};
use sixfold_io::fnv1a;
use sixfold_nn::device;
use sixfold_nn::weights::{
    ModelCard, WeightsError, load_weights, load_weights_from_bytes, read_card, save_weights,
    write_card_markdown,
};

use crate::network::{DESCRIPTOR, MAP, Network, masked};
use crate::patch::{PLANES, Patch};

/// Patches per forward pass.
const AT_A_TIME: usize = 64;

/// Compact weights for all objects; see the card next to the file.
static SHIPPED: &[u8] = include_bytes!("../weights/mttm-compact.safetensors");

/// Why a model could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The weight file.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The card does not describe a network of template matching.
    #[error("{}: the card's `{field}`: expected {expected}, found {found}; the file is not a template-matching network of this version", file.display())]
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

/// A descriptor: regions and templates of the same object in about the same pose have close descriptors (Euclidean distance).
pub type Descriptor = [f32; DESCRIPTOR];

/// Predictions of the network for a region and a template.
#[derive(Debug, Clone, PartialEq)]
pub struct PairOutput {
    /// Probability that each of 14 x 14 cells of the region belongs to the object, row by row.
    pub mask: Vec<f32>,
    /// Region from template.
    pub rotation: UnitQuaternion<f64>,
    /// Position of the template's reference point relative to the region's centre, as a fraction of the patch's size; `None` if the
    /// training had no loss for it, as in the dissertation.
    pub offset: Option<[f64; 3]>,
    /// Probability that both show the same object in about the same pose; 1 if the training had no loss for it.
    pub matching: f32,
}

/// Maps of patches, `count x channels x 14 x 14`.
#[derive(Debug, Clone)]
pub struct Encoded {
    maps: Tensor<4>,
}

impl Encoded {
    /// The maps of some of the patches, in the order of `numbers`.
    pub fn select(&self, numbers: &[usize]) -> Encoded {
        let rows = numbers.iter().map(|&i| self.maps.clone().narrow(0, i, 1)).collect();
        Encoded { maps: Tensor::cat(rows, 0) }
    }

    /// Concatenates several.
    ///
    /// # Panics
    /// If `parts` is empty.
    pub fn joined(parts: &[Encoded]) -> Encoded {
        Encoded { maps: Tensor::cat(parts.iter().map(|p| p.maps.clone()).collect(), 0) }
    }
}

/// A network and its card.
#[derive(Debug, Clone)]
pub struct MttmModel {
    network: Network,
    card: ModelCard,
    device: Device,
}

impl MttmModel {
    /// A model of a trained network; its architecture is written into `card`.
    pub fn new(network: Network, card: ModelCard) -> Self {
        let card = ModelCard { architecture: network.architecture().to_owned(), ..card };
        MttmModel { network: network.valid(), card, device: device::chosen() }
    }

    /// Reads a weight file.
    ///
    /// # Errors
    /// [`ModelError`] for a file that cannot be read or contains another network.
    pub fn load(path: &Path) -> Result<Self, ModelError> {
        let card = read_card(path)?;
        let device = device::chosen();
        let network =
            Network::of_architecture(&card.architecture, &device).ok_or_else(|| ModelError::Card {
                file: path.to_path_buf(),
                field: "architecture",
                expected: "mttm-compact or mttm-paper",
                found: card.architecture.clone(),
            })?;
        let (network, card) = load_weights(network, path, &card.architecture)?;
        Ok(MttmModel { network: network.valid(), card, device })
    }

    /// Reads a compact model from the bytes of a weight file; `name` is used in messages.
    ///
    /// # Errors
    /// [`ModelError`].
    pub fn from_bytes(name: &Path, bytes: &[u8]) -> Result<Self, ModelError> {
        let (device, compact) = (device::chosen(), "mttm-compact");
        let network = Network::of_architecture(compact, &device)
            .unwrap_or_else(|| unreachable!("the compact network is known"));
        let (network, card) = load_weights_from_bytes(network, name, bytes, compact)?;
        Ok(MttmModel { network: network.valid(), card, device })
    }

    /// The shipped network.
    ///
    /// # Errors
    /// [`ModelError`] if the shipped weights have another version than the program.
    pub fn shipped() -> Result<Self, ModelError> {
        Self::from_bytes(Path::new("mttm-compact.safetensors"), SHIPPED)
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

    /// Side of its input patches, pixels.
    pub fn side(&self) -> usize {
        self.network.side()
    }

    /// A fingerprint that distinguishes this network's descriptors from those of another: FNV-1a over its card.
    pub fn fingerprint(&self) -> u64 {
        fnv1a(serde_json::to_string(&self.card).unwrap_or_default().as_bytes())
    }

    /// Maps of patches, the input of all other queries.
    ///
    /// # Panics
    /// If the patches have another side than the network's input.
    pub fn encode(&self, patches: &[&Patch]) -> Encoded {
        Encoded { maps: self.network.maps(self.tensor(patches)) }
    }

    /// Maps of templates: zeros outside the object.
    ///
    /// # Panics
    /// As [`MttmModel::encode`].
    pub(crate) fn encode_templates(&self, patches: &[Patch]) -> Encoded {
        let masks = patches.iter().flat_map(template_mask).collect();
        self.without_background(&self.encode(&patches.iter().collect::<Vec<_>>()), masks)
    }

    /// Maps with zeros where `masks` (14 x 14 numbers for each patch, 0 to 1) has zeros.
    pub fn without_background(&self, encoded: &Encoded, masks: Vec<f32>) -> Encoded {
        Encoded { maps: masked(encoded.maps.clone(), self.cells(masks)) }
    }

    /// The descriptor of each patch.
    pub fn describe(&self, encoded: &Encoded) -> Vec<Descriptor> {
        let numbers = numbers(self.network.descriptor(encoded.maps.clone()));
        numbers.chunks_exact(DESCRIPTOR).map(|row| std::array::from_fn(|k| row[k])).collect()
    }

    /// Descriptors of many templates, computed in batches: `patch` returns the template with a number.
    ///
    /// # Panics
    /// As [`MttmModel::encode`].
    pub(crate) fn describe_templates(
        &self,
        count: usize,
        patch: impl Fn(usize) -> Patch + Sync,
    ) -> Vec<Descriptor> {
        let parts: Vec<Vec<Descriptor>> = (0..count.div_ceil(AT_A_TIME))
            .into_par_iter()
            .map(|part| {
                let range = part * AT_A_TIME..((part + 1) * AT_A_TIME).min(count);
                let patches: Vec<Patch> = range.map(&patch).collect();
                self.describe(&self.encode_templates(&patches))
            })
            .collect();
        parts.concat()
    }

    /// The network's predictions for pairs of a region and a template, row by row.
    pub fn compare(&self, regions: &Encoded, templates: &Encoded) -> Vec<PairOutput> {
        let compared = self.network.compare(regions.maps.clone(), templates.maps.clone());
        let masks = numbers(sigmoid(compared.mask));
        let rotations = numbers(compared.rotation);
        let offsets = numbers(compared.offset);
        let matching = numbers(sigmoid(compared.matching));
        let (place, match_) = (self.taught("offset"), self.taught("matching"));
        (0..matching.len())
            .map(|i| {
                let q: [f64; 4] = std::array::from_fn(|k| f64::from(rotations[4 * i + k]));
                let quaternion = Quaternion::new(q[0], q[1], q[2], q[3]);
                PairOutput {
                    mask: masks[i * MAP * MAP..(i + 1) * MAP * MAP].to_vec(),
                    rotation: UnitQuaternion::try_new(quaternion, 1e-3)
                        .unwrap_or_else(UnitQuaternion::identity),
                    offset: place.then(|| std::array::from_fn(|k| f64::from(offsets[3 * i + k]))),
                    matching: if match_ { matching[i] } else { 1.0 },
                }
            })
            .collect()
    }

    /// Whether the loss `weight` was used in the training, according to the card; files from before the card had this entry used
    /// it.
    fn taught(&self, weight: &str) -> bool {
        self.card.extra["training"][weight].as_f64().is_none_or(|weight| weight > 0.0)
    }

    fn tensor(&self, patches: &[&Patch]) -> Tensor<4> {
        let side = self.side();
        assert!(patches.iter().all(|p| p.side == side), "patches of another side than the network's");
        let values: Vec<f32> = patches.iter().flat_map(|p| p.values.iter().copied()).collect();
        Tensor::from_data(TensorData::new(values, [patches.len(), PLANES, side, side]), &self.device)
    }

    fn cells(&self, values: Vec<f32>) -> Tensor<4> {
        let count = values.len() / (MAP * MAP);
        Tensor::from_data(TensorData::new(values, [count, 1, MAP, MAP]), &self.device)
    }
}

/// The fraction of each of 14 x 14 cells in which a patch has measurements: for a template, the object.
pub(crate) fn template_mask(patch: &Patch) -> Vec<f32> {
    let (side, step) = (patch.side, patch.side / MAP);
    let known = &patch.values[4 * side * side..];
    (0..MAP * MAP)
        .map(|i| {
            let (x, y) = (i % MAP * step, i / MAP * step);
            let sum: f32 = (0..step * step).map(|k| known[(y + k / step) * side + x + k % step]).sum();
            sum / (step * step) as f32
        })
        .collect()
}

fn numbers<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec().unwrap_or_else(|error| unreachable!("f32 output: {error:?}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::CompactConfig;

    fn model() -> MttmModel {
        let network = Network::Compact(CompactConfig.init(1, &Device::flex()));
        MttmModel::new(network, ModelCard::new("", "test"))
    }

    fn patch(k: usize) -> Patch {
        let values = (0..PLANES * 28 * 28).map(|i| ((i * (k + 3)) as f32 * 0.01).sin().max(0.0)).collect();
        Patch { side: 28, values }
    }

    #[test]
    fn a_batch_gives_the_same_as_single_queries() {
        let model = model();
        let patches: Vec<Patch> = (0..70).map(patch).collect();
        let encoded = model.encode(&patches.iter().collect::<Vec<_>>());
        let last = encoded.select(&[69]);
        let (many, alone) = (model.describe(&encoded), model.describe(&last));
        assert!(many[69].iter().zip(&alone[0]).all(|(a, b)| (a - b).abs() < 1e-5));
        let hidden = model.without_background(&last, vec![0.0; MAP * MAP]);
        assert_ne!(model.describe(&hidden), alone);
        let templates = model.encode_templates(&patches);
        let (all, one) =
            (model.compare(&encoded, &templates), model.compare(&last, &templates.select(&[69])));
        assert_eq!(all.len(), 70);
        assert!((all[69].matching - one[0].matching).abs() < 1e-5);
        assert!(one[0].mask.iter().all(|v| (0.0..=1.0).contains(v)) && one[0].mask.len() == 196);
        let described = model.describe_templates(70, patch);
        assert!(described[3].iter().zip(&model.describe(&templates)[3]).all(|(a, b)| (a - b).abs() < 1e-5));
    }

    #[test]
    fn untrained_outputs_are_not_used() {
        let network = Network::Compact(CompactConfig.init(1, &Device::flex()));
        let output = |training: serde_json::Value| {
            let extra = serde_json::json!({ "training": training });
            let model = MttmModel::new(network.clone(), ModelCard { extra, ..ModelCard::new("", "test") });
            let encoded = model.encode(&[&patch(1)]);
            model.compare(&encoded, &model.encode_templates(&[patch(2)])).remove(0)
        };
        let all = output(serde_json::json!({ "offset": 4.0, "matching": 0.5 }));
        assert!(all.offset.is_some() && all.matching < 1.0);
        let published =
            output(serde_json::to_value(crate::training::MttmTrainingOptions::published()).unwrap());
        assert_eq!((published.offset, published.matching), (None, 1.0));
        assert_eq!((published.mask, published.rotation), (all.mask, all.rotation));
    }

    #[test]
    fn a_model_survives_its_file_and_other_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("mttm.safetensors");
        model().save(&file).unwrap();
        let again = MttmModel::load(&file).unwrap();
        let bytes = std::fs::read(&file).unwrap();
        let third = MttmModel::from_bytes(&file, &bytes).unwrap();
        let described = |m: &MttmModel| m.describe(&m.encode(&[&patch(1)]));
        assert_eq!(described(&again), described(&third));
        assert_eq!(again.fingerprint(), third.fingerprint());
        assert!(folder.path().join("mttm.md").exists());
        let missing = MttmModel::load(&folder.path().join("none.safetensors")).unwrap_err().to_string();
        assert!(missing.contains("none.safetensors"), "{missing}");
        let error = MttmModel::from_bytes(&file, &bytes[..bytes.len() / 2]).unwrap_err().to_string();
        assert!(error.contains("mttm.safetensors"), "{error}");
    }

    #[test]
    fn a_card_of_another_network_is_refused_and_nothing_else_of_it_is_believed() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("mttm.safetensors");
        let whole = model();
        let other = ModelCard { architecture: "mttm".to_owned(), ..whole.card.clone() };
        save_weights(&whole.network, &other, &file).unwrap();
        let error = MttmModel::load(&file).unwrap_err().to_string();
        assert!(error.contains("mttm.safetensors") && error.contains("`architecture`"), "{error}");
        let paper = ModelCard { architecture: "mttm-paper".to_owned(), ..whole.card.clone() };
        save_weights(&whole.network, &paper, &file).unwrap();
        let error = MttmModel::load(&file).unwrap_err().to_string();
        assert!(error.contains("mttm.safetensors") && error.contains("differently configured"), "{error}");
        // The architecture determines the sizes: other numbers in the card have no effect.
        let extra = serde_json::json!({ "pool": { "anchors": { "side": u64::MAX } } });
        save_weights(&whole.network, &ModelCard { extra, ..whole.card.clone() }, &file).unwrap();
        assert_eq!(MttmModel::load(&file).unwrap().side(), whole.side());
    }
}
