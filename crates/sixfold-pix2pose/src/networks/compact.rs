//! The compact network: an EfficientNet-Lite0 encoder shared by all objects, and one small decoder per object.
//!
//! It differs from the dissertation's generator so that two processor cores can train it: the encoder starts from ImageNet weights
//! and ends at a sixteenth of the resolution, its first stages are frozen, the targets have half the resolution of the input, and a
//! fifth channel predicts the object's visibility. Encoder and one decoder together have 1.0 million parameters.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rand_chacha::ChaCha8Rng;
use sixfold_geometry::random::stream;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig, Padding};
use sixfold_nn::lite0::{Lite0, Lite0Config};
use sixfold_nn::ops::{pixel_shuffle, upsample};

/// Channels of the output: three coordinates, the error's logit, the visibility's logit.
pub(crate) const CHANNELS: usize = 5;

/// Channels of the encoder's maps at 1/2, 1/4, 1/8 and 1/16 of the resolution.
const SKIPS: [usize; 4] = [16, 24, 40, 112];

/// Sizes of the compact network.
#[derive(Debug, Clone, Copy)]
pub struct CompactConfig {
    /// Number of decoders, one per object.
    pub objects: usize,
}

/// Shared encoder, one decoder per object.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Compact {
    /// EfficientNet-Lite0 to 1/16 of the resolution.
    pub encoder: Lite0,
    /// In the order of the objects.
    pub decoders: Vec<Decoder>,
}

/// Decodes the encoder's maps to one object's coordinates.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Decoder {
    code: Conv,
    context: Conv,
    eighth: Conv,
    narrow: Conv,
    detail: Conv,
    quarter: Conv,
    refine: Conv,
    head: Conv,
}

sixfold_nn::displayed_by_name!(Compact, Decoder);

impl CompactConfig {
    /// The network with random decoders and the given encoder.
    pub fn init(&self, encoder: Lite0, seed: u64, device: &Device) -> Compact {
        let decoders = (0..self.objects)
            .map(|object| {
                let mut rng = stream(seed, object as u64 + 1);
                Decoder::init(&mut rng, device)
            })
            .collect();
        Compact { encoder, decoders }
    }

    /// The network with random weights throughout, for weights loaded from a file.
    pub fn init_random(&self, seed: u64, device: &Device) -> Compact {
        self.init(Lite0Config::default().init(seed, device), seed, device)
    }
}

impl Decoder {
    fn init(rng: &mut ChaCha8Rng, device: &Device) -> Self {
        let mut conv = |channels: [usize; 2], kernel: usize| {
            ConvConfig::new(channels, kernel, Activation::Relu).init(2.0, rng, device)
        };
        let code = conv([SKIPS[3], 128], 1);
        let context = conv([128, 128], 1);
        let eighth = conv([128 + SKIPS[2], 96], 3);
        let narrow = conv([96, 64], 1);
        let quarter = conv([64 + SKIPS[1] + 32, 64], 3);
        let refine = conv([64, 64], 3);
        let detail = ConvConfig {
            stride: 2,
            padding: Padding::Zeros(0),
            ..ConvConfig::new([SKIPS[0], 32], 2, Activation::Relu)
        }
        .init(2.0, rng, device);
        let head = ConvConfig::new([64, 4 * CHANNELS], 1, Activation::Linear).init(0.1, rng, device);
        Self { code, context, eighth, narrow, detail, quarter, refine, head }
    }

    /// From the encoder's maps to `batch x 5 x half x half`.
    fn forward(&self, maps: &[Tensor<4>]) -> Tensor<4> {
        let code = self.code.forward(maps[4].clone());
        let context = self.context.forward(code.clone().mean_dim(2).mean_dim(3));
        let x = upsample(code + context);
        let x = self.eighth.forward(Tensor::cat(vec![x, maps[2].clone()], 1));
        let x = upsample(self.narrow.forward(x));
        let detail = self.detail.forward(maps[0].clone());
        let x = self.quarter.forward(Tensor::cat(vec![x, maps[1].clone(), detail], 1));
        let x = self.refine.forward(x);
        pixel_shuffle(self.head.forward(x), 2)
    }
}

impl Compact {
    /// Raw outputs (`count x 5 x side / 2 x side / 2` each) for a batch (`x`: sum of the counts `x 3 x side x side`) whose
    /// images belong to several objects, `(decoder, count)` in the order of the batch.
    pub fn forward(&self, x: Tensor<4>, objects: &[(usize, usize)]) -> Vec<Tensor<4>> {
        let maps = self.encoder.forward(x);
        let mut start = 0;
        let mut outputs = Vec::with_capacity(objects.len());
        for (object, count) in objects {
            let part: Vec<Tensor<4>> = maps.iter().map(|map| map.clone().narrow(0, start, *count)).collect();
            outputs.push(self.decoders[*object].forward(&part));
            start += count;
        }
        outputs
    }

    /// The same with the costly first stages of the encoder frozen, for training.
    pub fn freeze(mut self, stages: usize) -> Self {
        self.encoder = self.encoder.freeze(stages);
        self
    }
}
