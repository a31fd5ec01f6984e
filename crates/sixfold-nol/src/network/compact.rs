//! The compact network: the dissertation's structure sized for training on two processor cores.
//!
//! It differs in the encoder, EfficientNet-Lite0 with frozen ImageNet weights (its maps of 16, 24, 40 and 112 channels at 1/2 to
//! 1/16 of the resolution), in two LSTM layers of 16 channels instead of three of 32, 32 and 16, in a narrower weight block, and in
//! a decoder of four blocks at half the resolution.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sixfold_nn::batch_norm::{BatchNorm, BatchNormConfig};
use sixfold_nn::conv_norm::{BareConv, BareConvConfig};
use sixfold_nn::lite0::{Lite0, imagenet_encoder};
use sixfold_nn::weights::WeightsError;

use super::decoder::DecoderConfig;
use super::integrator::IntegratorConfig;
use super::weighting::WeightingConfig;
use super::{Head, HeadConfig, Parts, REDUCED};

/// The encoder's maps that are used, and their channels.
const MAPS: [(usize, usize); 4] = [(0, 16), (1, 24), (2, 40), (4, 112)];

/// The compact network's options.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CompactConfig {
    /// Parts left out for comparisons.
    pub parts: Parts,
}

impl CompactConfig {
    /// The network with the shipped ImageNet encoder; the other weights are random.
    ///
    /// # Errors
    /// [`WeightsError`] if the shipped encoder has another version than the program.
    pub fn init(&self, seed: u64, device: &Device) -> Result<Compact, WeightsError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let rng = &mut rng;
        let reduce = MAPS
            .iter()
            .zip(REDUCED)
            .map(|(&(_, inputs), outputs)| BareConvConfig::new([inputs, outputs], 3).init(rng, device));
        let reduce = reduce.collect();
        let norm = REDUCED.iter().map(|&c| unit_norm(c, device)).collect();
        let head = HeadConfig {
            integrator: IntegratorConfig { kind: self.parts.integrator, hidden: &[16] },
            weighting: WeightingConfig { channels: [16, 16, 8] },
            decoder: self.parts.decoder.then_some(DecoderConfig {
                filters: 24,
                blocks: 4,
                expansion: 4,
                linear_ratio: 0.8,
                half: true,
            }),
        };
        Ok(Compact {
            encoder: imagenet_encoder(&device.clone().inner())?,
            reduce,
            norm,
            head: head.init(rng, device),
        })
    }
}

/// A normalisation with factor and offset fixed at 1 and 0: otherwise the smoothness loss of equation 4.2 would shrink the
/// features, which is smooth but carries no information.
fn unit_norm(channels: usize, device: &Device) -> BatchNorm {
    let mut norm = BatchNormConfig::new(channels).init(device);
    norm.weight = norm.weight.set_require_grad(false);
    norm.bias = norm.bias.set_require_grad(false);
    norm
}

/// The compact network, created by [`CompactConfig`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Compact {
    /// Frozen, on a device without gradients, and not stored in weight files: it is shipped with the program.
    #[module(skip)]
    encoder: Lite0,
    reduce: Vec<BareConv>,
    norm: Vec<BatchNorm>,
    pub(super) head: Head,
}

sixfold_nn::displayed_by_name!(Compact);

impl Compact {
    /// See [`super::Network::encode`].
    pub fn encode(&self, images: Tensor<4>) -> Vec<Tensor<4>> {
        let training = images.device().is_autodiff();
        let maps = self.encoder.forward_stages(if training { images.inner() } else { images }, 5);
        let layers = self.reduce.iter().zip(&self.norm);
        layers
            .zip(MAPS)
            .map(|((conv, norm), (map, _))| {
                let map = maps[map].clone();
                let map = if training { Tensor::from_inner(map) } else { map };
                conv.forward_norm(map, norm, None, 0.0)
            })
            .collect()
    }
}
