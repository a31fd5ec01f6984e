//! The network (dissertation, section 4.2.1, figures 4.2 to 4.4): photographs are encoded, sampled at the surface points of a new
//! view, integrated over the sources, weighted and summed; for the training a decoder turns the sum into an image.
//!
//! Training and inference use the same definition. `N` below counts sources; those of a batch of `B` views with `K` sources each
//! are ordered source by source (all first ones, then all second ones, ...), so `N = K B`.

mod compact;
mod decoder;
mod integrator;
mod paper;
mod weighting;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};
use sixfold_nn::choice::Choice;
use sixfold_nn::weights::WeightsError;

pub use compact::{Compact, CompactConfig};
pub(crate) use paper::imagenet;
pub use paper::{Paper, PaperConfig};

use decoder::{Decoder, DecoderConfig};
use integrator::{Integrator, IntegratorConfig};
use weighting::{Weighting, WeightingConfig};

/// Channels of colour, from -1 to 1.
pub(crate) const COLOURS: usize = 3;
/// Channels that the encoder's maps are reduced to, finest first.
pub(crate) const REDUCED: [usize; 4] = [4, 3, 3, 3];
/// Channels of features.
pub const FEATURES: usize = 13;
/// Channels of a projected source: colour, features, and the cosine between normal and line of sight.
pub const CHANNELS: usize = COLOURS + FEATURES + 1;
/// Channels of the integrated features.
const INTEGRATED: usize = 16;

/// How the sources are integrated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum IntegratorKind {
    /// Convolutional LSTM over the sources.
    #[default]
    Lstm,
    /// The mean over the sources that show a pixel: the dissertation's ablation without LSTM.
    Average,
}

impl Choice for IntegratorKind {
    const ALL: &'static [IntegratorKind] = &[IntegratorKind::Lstm, IntegratorKind::Average];

    fn name(self) -> &'static str {
        match self {
            IntegratorKind::Lstm => "lstm",
            IntegratorKind::Average => "average",
        }
    }

    fn help(self) -> &'static str {
        match self {
            IntegratorKind::Lstm => "Convolutional LSTM over the sources",
            IntegratorKind::Average => "Their mean, for comparison",
        }
    }
}

/// Parts of the network that can be left out for comparisons.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Parts {
    /// How the sources are integrated.
    pub integrator: IntegratorKind,
    /// Whether the training's loss is computed on a decoded image; otherwise on the weighted colours themselves.
    pub decoder: bool,
}

impl Default for Parts {
    fn default() -> Self {
        Parts { integrator: IntegratorKind::Lstm, decoder: true }
    }
}

/// Integrator, weight prediction and decoder.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Head {
    integrator: Integrator,
    weighting: Weighting,
    decoder: Option<Decoder>,
}

struct HeadConfig {
    integrator: IntegratorConfig,
    weighting: WeightingConfig,
    decoder: Option<DecoderConfig>,
}

impl HeadConfig {
    fn init(&self, rng: &mut rand_chacha::ChaCha8Rng, device: &Device) -> Head {
        Head {
            integrator: self.integrator.init(rng, device),
            weighting: self.weighting.init(rng, device),
            decoder: self.decoder.map(|d| d.init(rng, device)),
        }
    }
}

/// The weighted sum of the sources in a view.
#[derive(Debug, Clone)]
pub struct Blend {
    /// Weights of the sources, `K x B x 1 x height x width`: they sum to 1 where any source is valid, and are 0 elsewhere.
    pub weights: Tensor<5>,
    /// X^S, `B x 17 x height x width`: the first three channels are the rendering X^D, -1 to 1.
    pub sum: Tensor<4>,
}

/// One of the networks.
#[derive(Module, Debug)]
#[module(custom_display)]
#[allow(clippy::large_enum_variant)]
pub enum Network {
    /// Small enough to train on two processor cores.
    Compact(Compact),
    /// The dissertation's network.
    Paper(Paper),
}

sixfold_nn::displayed_by_name!(Head, Network);

impl Network {
    /// Its name in weight files.
    pub fn architecture(&self) -> &'static str {
        match self {
            Network::Compact(_) => "nol-compact",
            Network::Paper(_) => "nol-paper",
        }
    }

    /// A network of this name whose weights are to be loaded from a file; `None` for unknown names.
    ///
    /// # Errors
    /// [`WeightsError`] if the shipped encoder has another version than the program.
    pub fn of_architecture(
        name: &str,
        parts: Parts,
        device: &Device,
    ) -> Result<Option<Network>, WeightsError> {
        Ok(match name {
            "nol-compact" => Some(Network::Compact(CompactConfig { parts }.init(0, device)?)),
            "nol-paper" => Some(Network::Paper(PaperConfig { parts }.init(0, device))),
            _ => None,
        })
    }

    /// Source images (`N x 3 x height x width`, -1 to 1; sides are multiples of 16) to their reduced maps, finest first: 4, 3, 3
    /// and 3 channels.
    pub fn encode(&self, images: Tensor<4>) -> Vec<Tensor<4>> {
        match self {
            Network::Compact(n) => n.encode(images),
            Network::Paper(n) => n.encode(images),
        }
    }

    /// Blends projected sources: `looked_up` is `K B x 17 x height x width` with zeros where a source is not `valid` (`K B x 1 x
    /// height x width`, 0 or 1).
    pub fn blend(&self, looked_up: Tensor<4>, valid: Tensor<4>, sources: usize) -> Blend {
        let head = self.head();
        let integrated = head.integrator.forward(looked_up.clone(), &valid, sources);
        head.weighting.forward(looked_up, valid, integrated, sources)
    }

    /// X^phi (`B x 3 x height x width`, sides even) of X^S; `None` for a network without decoder.
    pub fn decode(&self, sum: Tensor<4>) -> Option<Tensor<4>> {
        self.head().decoder.as_ref().map(|decoder| decoder.forward(sum))
    }

    fn head(&self) -> &Head {
        match self {
            Network::Compact(n) => &n.head,
            Network::Paper(n) => &n.head,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Distribution, TensorData};

    fn check(network: &Network, sources: usize) {
        let device = Device::flex();
        let images = Tensor::<4>::random([2, 3, 64, 64], Distribution::Uniform(-1.0, 1.0), &device);
        let maps = network.encode(images);
        let channels: Vec<usize> = maps.iter().map(|m| m.dims()[1]).collect();
        assert_eq!(channels, REDUCED);
        let (height, width) = (8, 12);
        let valid: Vec<f32> =
            (0..sources * 2 * 96).map(|i| f32::from(u8::from(i % 3 != 0 && i % 96 != 5))).collect();
        let valid = Tensor::<4>::from_data(TensorData::new(valid, [sources * 2, 1, height, width]), &device);
        let shape = [sources * 2, CHANNELS, height, width];
        let looked_up = Tensor::<4>::random(shape, Distribution::Uniform(-1.0, 1.0), &device) * valid.clone();
        let blend = network.blend(looked_up, valid.clone(), sources);
        assert_eq!(blend.sum.dims(), [2, CHANNELS, height, width]);
        let weights: Vec<f32> = blend.weights.into_data().try_to_vec().unwrap();
        let valid: Vec<f32> = valid.into_data().try_to_vec().unwrap();
        let pixels = 2 * height * width;
        for p in 0..pixels {
            let of = |v: &[f32]| (0..sources).map(|k| v[k * pixels + p]).sum::<f32>();
            let expected = if of(&valid) > 0.0 { 1.0 } else { 0.0 };
            assert!((of(&weights) - expected).abs() < 1e-4, "{p}: {}", of(&weights));
            assert!((0..sources).all(|k| valid[k * pixels + p] > 0.0 || weights[k * pixels + p] == 0.0));
        }
        assert_eq!(network.decode(blend.sum).unwrap().dims(), [2, 3, height, width]);
    }

    #[test]
    fn weights_add_up_and_are_zero_where_unseen() {
        let device = Device::flex();
        for integrator in [IntegratorKind::Lstm, IntegratorKind::Average] {
            let parts = Parts { integrator, decoder: true };
            let network = Network::of_architecture("nol-compact", parts, &device).unwrap().unwrap();
            check(&network, 1);
            check(&network, 5);
        }
        let network = Network::of_architecture("nol-paper", Parts::default(), &device).unwrap().unwrap();
        check(&network, 2);
        assert!(Network::of_architecture("other", Parts::default(), &device).unwrap().is_none());
        let bare = Parts { decoder: false, ..Parts::default() };
        let network = Network::of_architecture("nol-compact", bare, &device).unwrap().unwrap();
        assert!(network.decode(Tensor::zeros([1, CHANNELS, 8, 8], &device)).is_none());
    }
}
