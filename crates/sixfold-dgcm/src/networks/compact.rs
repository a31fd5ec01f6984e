//! The compact network: the dissertation's structure with plain convolutions, for input of 96x96 pixels.
//!
//! It differs so that two processor cores can train it in half an hour. Instead of ResNet-50 it has nine convolutions with random
//! initial weights (normals differ from photographs, and with a sixth of the computation of ResNet-50 it sees six times the
//! samples). It has ReLU instead of LeakyReLU in convolutions, and bilinear upsampling with convolutions instead of deconvolutions;
//! the last step, from a quarter of the resolution, is a pixel shuffle.
//!
//! It sees the view's own VD-NOC next to its normals. Between two views of one object the VD-NOC of a point are related by an affine
//! transformation (a rotation between the views, and two scales along the axes), so the network predicts that transformation, and a
//! difference from it for every pixel. It compares the maps of both views for it: features are trained to be alike for views whose
//! geometry is similar, so they say little about the rotation between them.

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

use super::{Alignment, Encoded, FEATURE, VIEW, half, moved, shown};

/// Slope of LeakyReLU in the dense layers.
const SLOPE: f64 = 0.1;
/// Channels of the geometry encoder's maps, from 1/2 of the resolution to 1/32.
const GEOMETRY: [usize; 5] = [24, 48, 96, 160, 192];
/// Channels of the VD-NOC encoder's maps.
const CODE: [usize; 5] = [16, 32, 64, 128, 128];
/// Channels of the decoder at 1/32 of the resolution, and after each doubling.
const DECODER: [usize; 4] = [64, 128, 96, 64];

/// Channels of the comparison of both views.
const PAIR: usize = 128;

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
        let steps = |mut inputs: usize, channels: [usize; 5]| {
            channels.map(|outputs| [std::mem::replace(&mut inputs, outputs), outputs])
        };
        let geometry: Vec<Conv> = steps(VIEW, GEOMETRY).into_iter().map(|c| down(c, rng)).collect();
        let refine: Vec<Conv> = GEOMETRY[1..4].iter().map(|&c| same([c, c], rng)).collect();
        let code: Vec<Conv> = steps(3, CODE).into_iter().map(|c| down(c, rng)).collect();
        let smallest = (Self::SIDE / 32).pow(2);
        let pair = [[GEOMETRY[2] + CODE[2], PAIR], [PAIR, PAIR]];
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
            start: dense([4 * FEATURE, DECODER[0] * smallest], rng, device),
            decoder,
            head: ConvConfig::new([DECODER[3], 48], 3, Activation::Linear).init(0.1, rng, device),
            pair: pair.map(|c| down(c, rng)).to_vec(),
            pair_out: dense([PAIR * smallest, FEATURE], rng, device),
            affine: dense([FEATURE, 12], rng, device),
            alignment: Alignment::init(rng, device),
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
    pair: Vec<Conv>,
    pair_out: Linear,
    affine: Linear,
    /// Moves the decoder's coordinates by comparing both views.
    pub(crate) alignment: Alignment,
}

sixfold_nn::displayed_by_name!(Compact);

/// `batch x channels x height x width` to `batch x numbers`.
fn flat(x: Tensor<4>) -> Tensor<2> {
    let [batch, channels, height, width] = x.dims();
    x.reshape([batch, channels * height * width])
}

impl Compact {
    /// See [`super::Network::geometry`].
    pub fn geometry(&self, views: Tensor<4>) -> Encoded {
        let mut x = views.clone();
        let mut maps = vec![];
        for (k, conv) in self.geometry.iter().enumerate() {
            x = conv.forward(x);
            if (1..4).contains(&k) {
                x = self.refine[k - 1].forward(x);
            }
            maps.push(x.clone());
        }
        let feature = leaky_relu(self.feature.forward(flat(x)), SLOPE);
        Encoded { input: views, feature: self.feature_out.forward(feature).tanh(), maps }
    }

    /// See [`super::Network::vd_noc`].
    pub fn vd_noc(&self, vd_noc: Tensor<4>) -> Encoded {
        let mut x = vd_noc.clone();
        let mut maps = vec![];
        for conv in &self.code {
            x = conv.forward(x);
            maps.push(x.clone());
        }
        Encoded { input: vd_noc, feature: self.code_out.forward(flat(x)).tanh(), maps }
    }

    /// See [`super::Network::decode`].
    pub fn decode(&self, input: &Encoded, experience: Tensor<2>, code: &Encoded) -> Tensor<4> {
        let pair = Tensor::cat(vec![input.maps[2].clone(), code.maps[2].clone()], 1);
        let pair = self.pair.iter().fold(pair, |x, conv| conv.forward(x));
        let pair = leaky_relu(self.pair_out.forward(flat(pair)), SLOPE);
        let affine = self.affine.forward(pair.clone());
        let features = Tensor::cat(vec![input.feature.clone(), experience, code.feature.clone(), pair], 1);
        let batch = features.dims()[0];
        let side = CompactConfig::SIDE / 32;
        let mut x = leaky_relu(self.start.forward(features), SLOPE).reshape([batch, DECODER[0], side, side]);
        for (k, conv) in self.decoder.iter().enumerate() {
            let skips = vec![upsample(x), half(&input.maps[3 - k]), half(&code.maps[3 - k])];
            x = conv.forward(Tensor::cat(skips, 1));
        }
        let view = input.input.clone();
        let own = view.clone().narrow(1, 3, 3);
        let object = shown(view);
        (moved(own, affine) + pixel_shuffle(self.head.forward(x), 4)) * object
    }
}
