//! The decoder of the training (dissertation, section 4.2.1): WDSR-B (Yu et al. 2018), wide activations before narrow linear
//! layers. It corrects colour errors of the sources, so that the loss does not attribute them to the weights.
//!
//! Without the original's weight normalisation; zeros at the border.

use burn::module::Module;
use burn::tensor::module::avg_pool2d;
use burn::tensor::ops::AvgPoolOptions;
use burn::tensor::{Device, Tensor};
use rand_chacha::ChaCha8Rng;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig, Padding};
use sixfold_nn::ops::pixel_shuffle;

use super::{CHANNELS, COLOURS};

/// Sizes of the decoder.
#[derive(Debug, Clone, Copy)]
pub(super) struct DecoderConfig {
    /// Channels between the blocks.
    pub filters: usize,
    /// Residual blocks.
    pub blocks: usize,
    /// Channels at the activation, in units of `filters`.
    pub expansion: usize,
    /// Channels of the narrow layer, in units of `filters`.
    pub linear_ratio: f32,
    /// Whether the blocks run at half the resolution, followed by a pixel shuffle; otherwise, as in the original, at full
    /// resolution, and the shuffled result of twice that is averaged down again.
    pub half: bool,
}

impl DecoderConfig {
    pub(crate) fn init(&self, rng: &mut ChaCha8Rng, device: &Device) -> Decoder {
        let (filters, wide) = (self.filters, self.filters * self.expansion);
        let narrow = (filters as f32 * self.linear_ratio) as usize;
        let head = ConvConfig::new([CHANNELS, filters], 3, Activation::Linear);
        let head =
            if self.half { ConvConfig { padding: Padding::Zeros(1), ..head.with_stride(2) } } else { head };
        let head = head.init(1.0, rng, device);
        let blocks = (0..self.blocks)
            .map(|_| Block {
                wide: ConvConfig::new([filters, wide], 1, Activation::Relu).init(2.0, rng, device),
                narrow: ConvConfig::new([wide, narrow], 1, Activation::Linear).init(1.0, rng, device),
                mix: ConvConfig::new([narrow, filters], 3, Activation::Linear).init(0.1, rng, device),
            })
            .collect();
        let tail = ConvConfig::new([filters, 4 * COLOURS], 3, Activation::Linear).init(0.1, rng, device);
        let shuffled = if self.half { 1 } else { 4 };
        // The skip connection is initialised to pass the colours through, so that the decoder learns only differences.
        let config = ConvConfig::new([CHANNELS, shuffled * COLOURS], 5, Activation::Linear);
        let mut weight = vec![0.0; config.weight_shape().iter().product()];
        for output in 0..shuffled * COLOURS {
            weight[(output * CHANNELS + output / shuffled) * 25 + 12] = 1.0;
        }
        let skip = config.with_values(weight, vec![0.0; shuffled * COLOURS], device);
        Decoder { head, blocks, tail, skip, half: self.half }
    }
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct Block {
    wide: Conv,
    narrow: Conv,
    mix: Conv,
}

/// WDSR-B, created by [`DecoderConfig`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub(super) struct Decoder {
    head: Conv,
    blocks: Vec<Block>,
    tail: Conv,
    skip: Conv,
    half: bool,
}

sixfold_nn::displayed_by_name!(Block, Decoder);

impl Decoder {
    /// X^S (`B x 17 x height x width`, sides even) to X^phi (`B x 3 x height x width`).
    pub(crate) fn forward(&self, sum: Tensor<4>) -> Tensor<4> {
        let mut x = self.head.forward(sum.clone());
        for block in &self.blocks {
            let inner = block.narrow.forward(block.wide.forward(x.clone()));
            x = x + block.mix.forward(inner);
        }
        let (body, skip) = (self.tail.forward(x), self.skip.forward(sum));
        if self.half {
            return pixel_shuffle(body, 2) + skip;
        }
        // Bilinear downsampling by two equals the mean of 2x2 pixels.
        avg_pool2d(pixel_shuffle(body + skip, 2), AvgPoolOptions::new([2, 2]))
    }
}
