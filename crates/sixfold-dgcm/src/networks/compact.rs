//! The compact network: the dissertation's structure with plain convolutions, for input of 96x96 pixels.
//!
//! It differs so that two processor cores can train it in half an hour. Instead of ResNet-50 it has nine convolutions with random
//! initial weights (normals differ from photographs, and with a sixth of the computation of ResNet-50 it sees six times the
//! samples). It has ReLU instead of LeakyReLU in convolutions, and bilinear upsampling with convolutions instead of deconvolutions;
//! the last step, from a quarter of the resolution, is a pixel shuffle.

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::activation::leaky_relu;
use burn::tensor::{Device, Tensor};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sixfold_nn::dense::dense;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig};
use sixfold_nn::ops::{pixel_shuffle, upsample};

use super::{Encoded, FEATURE, half};

/// Slope of LeakyReLU in the dense layers.
const SLOPE: f64 = 0.1;
/// Channels of the geometry encoder's maps, from 1/2 of the resolution to 1/32.
const GEOMETRY: [usize; 5] = [24, 48, 96, 160, 192];
/// Channels of the VD-NOC encoder's maps.
const CODE: [usize; 5] = [16, 32, 64, 128, 128];
/// Channels of the decoder at 1/32 of the resolution, and after each doubling.
const DECODER: [usize; 4] = [64, 128, 96, 64];

/// Sizes of the compact network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct CompactConfig;

impl CompactConfig {
    /// Side of the input in pixels.
    pub(crate) const SIDE: usize = 96;

    /// The network with random weights.
    pub(crate) fn init(&self, seed: u64, device: &Device) -> Compact {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let rng = &mut rng;
        let down = |channels: [usize; 2], rng: &mut ChaCha8Rng| {
            ConvConfig::new(channels, 3, Activation::Relu).with_stride(2).init(2.0, rng, device)
        };
        let same = |channels: [usize; 2], rng: &mut ChaCha8Rng| {
            ConvConfig::new(channels, 3, Activation::Relu).init(2.0, rng, device)
        };
        let steps = |channels: [usize; 5]| {
            let mut inputs = 3;
            channels.map(|outputs| [std::mem::replace(&mut inputs, outputs), outputs])
        };
        let geometry: Vec<Conv> = steps(GEOMETRY).into_iter().map(|c| down(c, rng)).collect();
        let refine: Vec<Conv> = GEOMETRY[1..4].iter().map(|&c| same([c, c], rng)).collect();
        let code: Vec<Conv> = steps(CODE).into_iter().map(|c| down(c, rng)).collect();
        let smallest = (Self::SIDE / 32).pow(2);
        let decoder: Vec<Conv> = (0..3)
            .map(|k| {
                let skips = (GEOMETRY[3 - k] + CODE[3 - k]) / 2;
                same([DECODER[k] + skips, DECODER[k + 1]], rng)
            })
            .collect();
        Compact {
            geometry,
            refine,
            feature: dense([GEOMETRY[4] * smallest, FEATURE], rng, device),
            feature_out: dense([FEATURE, FEATURE], rng, device),
            code,
            code_out: dense([CODE[4] * smallest, FEATURE], rng, device),
            start: dense([3 * FEATURE, DECODER[0] * smallest], rng, device),
            decoder,
            head: ConvConfig::new([DECODER[3], 48], 3, Activation::Linear).init(0.1, rng, device),
        }
    }
}

/// The compact network, created by `CompactConfig`.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Compact {
    geometry: Vec<Conv>,
    refine: Vec<Conv>,
    feature: Linear,
    feature_out: Linear,
    code: Vec<Conv>,
    code_out: Linear,
    start: Linear,
    decoder: Vec<Conv>,
    head: Conv,
}

sixfold_nn::displayed_by_name!(Compact);

/// `batch x channels x height x width` to `batch x numbers`.
fn flat(x: Tensor<4>) -> Tensor<2> {
    let [batch, channels, height, width] = x.dims();
    x.reshape([batch, channels * height * width])
}

impl Compact {
    /// See [`super::Network::geometry`].
    pub fn geometry(&self, normals: Tensor<4>) -> Encoded {
        let mut x = normals;
        let mut maps = vec![];
        for (k, conv) in self.geometry.iter().enumerate() {
            x = conv.forward(x);
            if (1..4).contains(&k) {
                x = self.refine[k - 1].forward(x);
            }
            maps.push(x.clone());
        }
        let feature = leaky_relu(self.feature.forward(flat(x)), SLOPE);
        Encoded { feature: self.feature_out.forward(feature).tanh(), maps }
    }

    /// See [`super::Network::vd_noc`].
    pub fn vd_noc(&self, vd_noc: Tensor<4>) -> Encoded {
        let mut x = vd_noc;
        let mut maps = vec![];
        for conv in &self.code {
            x = conv.forward(x);
            maps.push(x.clone());
        }
        Encoded { feature: self.code_out.forward(flat(x)).tanh(), maps }
    }

    /// See [`super::Network::decode`].
    pub fn decode(&self, input: &Encoded, experience: Tensor<2>, code: &Encoded) -> Tensor<4> {
        let features = Tensor::cat(vec![input.feature.clone(), experience, code.feature.clone()], 1);
        let batch = features.dims()[0];
        let side = CompactConfig::SIDE / 32;
        let mut x = leaky_relu(self.start.forward(features), SLOPE).reshape([batch, DECODER[0], side, side]);
        for (k, conv) in self.decoder.iter().enumerate() {
            let skips = vec![upsample(x), half(&input.maps[3 - k]), half(&code.maps[3 - k])];
            x = conv.forward(Tensor::cat(skips, 1));
        }
        pixel_shuffle(self.head.forward(x), 4)
    }
}
