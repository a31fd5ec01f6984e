//! The weight prediction block (dissertation, figure 4.4): the weight of each source per pixel, and the weighted sum.

use burn::module::Module;
use burn::tensor::{Device, Tensor, activation::softmax};
use rand_chacha::ChaCha8Rng;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig};

use super::{Blend, CHANNELS, INTEGRATED};

/// Subtracted from the score of a source that does not show a pixel: larger than any difference of two scores.
const NOT_SEEN: f64 = 1e4;

/// Channels of the block's convolutions; the last has one.
#[derive(Debug, Clone, Copy)]
pub(super) struct WeightingConfig {
    pub channels: [usize; 3],
}

impl WeightingConfig {
    pub(crate) fn init(&self, rng: &mut ChaCha8Rng, device: &Device) -> Weighting {
        let mut inputs = CHANNELS + INTEGRATED;
        let mut layers: Vec<Conv> = self
            .channels
            .iter()
            .map(|&outputs| {
                let channels = [std::mem::replace(&mut inputs, outputs), outputs];
                ConvConfig::new(channels, 3, Activation::Relu).init(2.0, rng, device)
            })
            .collect();
        layers.push(ConvConfig::new([inputs, 1], 3, Activation::Linear).init(0.5, rng, device));
        Weighting { layers }
    }
}

/// Predicts weights; created by [`WeightingConfig`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub(super) struct Weighting {
    layers: Vec<Conv>,
}

sixfold_nn::displayed_by_name!(Weighting);

impl Weighting {
    /// `K B x 17`, `K B x 1` and `B x 16` channels of `height x width`.
    pub(crate) fn forward(
        &self,
        looked_up: Tensor<4>,
        valid: Tensor<4>,
        integrated: Tensor<4>,
        sources: usize,
    ) -> Blend {
        let [all, channels, height, width] = looked_up.dims();
        let batch = all / sources;
        let mut x = Tensor::cat(vec![looked_up.clone(), integrated.repeat_dim(0, sources)], 1);
        for layer in &self.layers {
            x = layer.forward(x);
        }
        let scores = x + (valid.clone() - 1.0) * NOT_SEEN;
        let weights = softmax(scores.reshape([sources, batch * height * width]), 0);
        // Where no source is valid the softmax is uniform; these weights are set to zero too.
        let weights = weights.reshape([all, 1, height, width]) * valid;
        let sum = (looked_up * weights.clone())
            .reshape([sources, batch * channels, height, width])
            .sum_dim(0)
            .reshape([batch, channels, height, width]);
        Blend { weights: weights.reshape([sources, batch, 1, height, width]), sum }
    }
}
