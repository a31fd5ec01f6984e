//! The compact network: six convolutions on patches of 28x28 pixels in place of ResNet-50 on the whole image. A patch spans a fixed
//! metric size, so the network need not learn distances. Normals differ from photographs, so training starts from random weights.

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::activation::{elu, relu};
use burn::tensor::{Device, Tensor};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sixfold_nn::dense::dense;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig};

use super::{DESCRIPTOR, flat};
use crate::patch::PLANES;

/// Channels of the feature maps.
const CHANNELS: usize = 48;
/// Channels of the comparison head.
const PAIR: usize = 64;

/// Sizes of the compact network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CompactConfig;

impl CompactConfig {
    /// Side of the input in pixels.
    pub const SIDE: usize = 28;

    /// The network with random weights.
    pub fn init(&self, seed: u64, device: &Device) -> Compact {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let rng = &mut rng;
        let mut conv = |channels: [usize; 2], stride: usize, activation: Activation, gain: f32| {
            ConvConfig::new(channels, 3, activation).with_stride(stride).init(gain, rng, device)
        };
        let stem = conv([PLANES, 32], 2, Activation::Relu, 2.0);
        let widen = conv([32, CHANNELS], 1, Activation::Relu, 2.0);
        // Residual blocks: the second convolution starts small.
        let blocks = (0..2)
            .flat_map(|_| [(Activation::Relu, 2.0), (Activation::Linear, 0.2)])
            .map(|(activation, gain)| conv([CHANNELS; 2], 1, activation, gain))
            .collect();
        let down =
            vec![conv([CHANNELS, 64], 2, Activation::Relu, 2.0), conv([64, 96], 2, Activation::Relu, 2.0)];
        let region = conv([CHANNELS; 2], 1, Activation::Relu, 2.0);
        let template = conv([CHANNELS; 2], 1, Activation::Relu, 2.0);
        let merge = conv([2 * CHANNELS, PAIR], 1, Activation::Relu, 2.0);
        let mask = conv([PAIR, PAIR / 2], 1, Activation::Relu, 2.0);
        let mask_out = conv([PAIR / 2, 1], 1, Activation::Linear, 0.1);
        let pose =
            vec![conv([PAIR, PAIR], 2, Activation::Relu, 2.0), conv([PAIR, PAIR], 2, Activation::Relu, 2.0)];
        Compact {
            stem,
            widen,
            blocks,
            down,
            descriptor: dense([96 * 16, 256], rng, device),
            descriptor_out: dense([256, DESCRIPTOR], rng, device),
            region,
            template,
            merge,
            mask,
            mask_out,
            pose,
            numbers: dense([PAIR * 16, 256], rng, device),
            numbers_out: dense([256, 8], rng, device),
        }
    }
}

/// The compact network, created by [`CompactConfig`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Compact {
    stem: Conv,
    widen: Conv,
    blocks: Vec<Conv>,
    down: Vec<Conv>,
    descriptor: Linear,
    descriptor_out: Linear,
    region: Conv,
    template: Conv,
    merge: Conv,
    mask: Conv,
    mask_out: Conv,
    pose: Vec<Conv>,
    numbers: Linear,
    numbers_out: Linear,
}

sixfold_nn::displayed_by_name!(Compact);

impl Compact {
    /// See [`super::Network::maps`].
    pub fn maps(&self, patches: Tensor<4>) -> Tensor<4> {
        let mut x = self.widen.forward(self.stem.forward(patches));
        for pair in self.blocks.chunks_exact(2) {
            x = relu(x.clone() + pair[1].forward(pair[0].forward(x)));
        }
        x
    }

    /// See [`super::Network::descriptor`].
    pub(crate) fn descriptor(&self, maps: Tensor<4>) -> Tensor<2> {
        let x = self.down.iter().fold(maps, |x, conv| conv.forward(x));
        self.descriptor_out.forward(elu(self.descriptor.forward(flat(x)), 1.0))
    }

    /// Mask logits and the eight numbers of [`super::Network::compare`].
    pub fn compare(&self, regions: Tensor<4>, templates: Tensor<4>) -> (Tensor<4>, Tensor<2>) {
        let pair = Tensor::cat(vec![self.region.forward(regions), self.template.forward(templates)], 1);
        let pair = self.merge.forward(pair);
        let mask = self.mask_out.forward(self.mask.forward(pair.clone()));
        let x = self.pose.iter().fold(pair, |x, conv| conv.forward(x));
        (mask, self.numbers_out.forward(elu(self.numbers.forward(flat(x)), 1.0)))
    }
}
