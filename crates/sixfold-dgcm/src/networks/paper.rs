//! The dissertation's network (section 6.2.2) for input of 128x128 pixels.
//!
//! Choices that the dissertation leaves open: LeakyReLU's slope is 0.2, deconvolutions and the convolutions after them have 3x3
//! kernels with 256, 256, 128, 64 and 32 channels, skip connections are joined after the deconvolution of their resolution, the
//! last layer is linear, and ResNet-50 keeps its batch normalisation.

use std::path::Path;

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::activation::leaky_relu;
use burn::tensor::{Device, Tensor};
use sixfold_geometry::random::stream;
use sixfold_nn::conv_transpose::{ConvTranspose, ConvTransposeConfig};
use sixfold_nn::dense::dense;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig};
use sixfold_nn::pretrained::PretrainedError;
use sixfold_nn::resnet::{ResNet50, ResNet50Config};

use super::{Encoded, FEATURE, half};

const SLOPE: f64 = 0.2;
/// Channels of the convolutions after ResNet-50's third stage, and their kernels.
const GEOMETRY: [(usize, usize); 3] = [(256, 3), (256, 3), (128, 2)];
/// Channels and kernels of the VD-NOC encoder.
const CODE: [(usize, usize); 5] = [(128, 5), (256, 3), (256, 3), (256, 3), (256, 3)];
/// Channels at 4x4 pixels: a dense layer with 2048 outputs.
const START: usize = 128;
/// Channels of the decoder's blocks, at 8, 16, 32, 64 and 128 pixels.
const DECODER: [usize; 5] = [256, 256, 128, 64, 32];
/// ResNet-50's maps at 64, 32, 16 and 8 pixels.
const BACKBONE: [usize; 4] = [64, 256, 512, 1024];

/// Sizes of the dissertation's network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PaperConfig;

impl PaperConfig {
    /// Side of the input in pixels.
    pub(crate) const SIDE: usize = 128;

    /// The network with random weights.
    pub(crate) fn init(&self, seed: u64, device: &Device) -> Paper {
        self.init_with(ResNet50Config::features(3).init(seed, device), seed, device)
    }

    /// The network with ImageNet weights of ResNet-50 from torchvision's file; the other weights are random.
    ///
    /// # Errors
    /// [`PretrainedError`].
    pub(crate) fn init_from_imagenet(
        &self,
        file: &Path,
        seed: u64,
        device: &Device,
    ) -> Result<Paper, PretrainedError> {
        Ok(self.init_with(ResNet50Config::features(3).from_pytorch(file, device)?, seed, device))
    }

    fn init_with(&self, backbone: ResNet50, seed: u64, device: &Device) -> Paper {
        let mut rng = stream(seed, 1);
        let rng = &mut rng;
        let mut down = |layers: &[(usize, usize)], mut inputs: usize| -> Vec<Conv> {
            layers
                .iter()
                .map(|&(outputs, kernel)| {
                    let channels = [std::mem::replace(&mut inputs, outputs), outputs];
                    ConvConfig::new(channels, kernel, Activation::Linear)
                        .with_stride(2)
                        .init(2.0, rng, device)
                })
                .collect()
        };
        let geometry = down(&GEOMETRY, BACKBONE[3]);
        let code = down(&CODE, 3);
        let mut up = vec![];
        let mut mix = vec![];
        let mut inputs = START;
        for (k, outputs) in DECODER.into_iter().enumerate() {
            let config =
                ConvTransposeConfig { channels: [inputs, outputs], kernel: 3, stride: 2, bias: true };
            up.push(config.init(2.0, rng, device));
            // At full resolution there is no skip connection.
            let skips = if k < 4 { (BACKBONE[3 - k] + CODE[3 - k].0) / 2 } else { 0 };
            mix.push(
                ConvConfig::new([outputs + skips, outputs], 3, Activation::Linear).init(2.0, rng, device),
            );
            inputs = outputs;
        }
        Paper {
            backbone,
            geometry,
            feature: dense([GEOMETRY[2].0, FEATURE], rng, device),
            feature_out: dense([FEATURE, FEATURE], rng, device),
            code,
            code_out: dense([CODE[4].0 * 16, FEATURE], rng, device),
            start: dense([3 * FEATURE, START * 16], rng, device),
            up,
            mix,
            head: ConvConfig::new([DECODER[4], 3], 3, Activation::Linear).init(0.1, rng, device),
        }
    }
}

/// The dissertation's network, created by `PaperConfig`.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Paper {
    backbone: ResNet50,
    geometry: Vec<Conv>,
    feature: Linear,
    feature_out: Linear,
    code: Vec<Conv>,
    code_out: Linear,
    start: Linear,
    up: Vec<ConvTranspose>,
    mix: Vec<Conv>,
    head: Conv,
}

sixfold_nn::displayed_by_name!(Paper);

fn flat(x: Tensor<4>) -> Tensor<2> {
    let [batch, channels, height, width] = x.dims();
    x.reshape([batch, channels * height * width])
}

impl Paper {
    /// See [`super::Network::geometry`].
    pub fn geometry(&self, normals: Tensor<4>) -> Encoded {
        let maps = self.backbone.features(normals.clone());
        let mut x = maps[3].clone();
        for conv in &self.geometry {
            x = leaky_relu(conv.forward(x), SLOPE);
        }
        let feature = leaky_relu(self.feature.forward(flat(x)), SLOPE);
        Encoded { input: normals, feature: self.feature_out.forward(feature).tanh(), maps }
    }

    /// See [`super::Network::vd_noc`].
    pub fn vd_noc(&self, vd_noc: Tensor<4>) -> Encoded {
        let mut x = vd_noc.clone();
        let mut maps = vec![];
        for conv in &self.code {
            x = leaky_relu(conv.forward(x), SLOPE);
            maps.push(x.clone());
        }
        Encoded { input: vd_noc, feature: self.code_out.forward(flat(x)).tanh(), maps }
    }

    /// See [`super::Network::decode`].
    pub fn decode(&self, input: &Encoded, experience: Tensor<2>, code: &Encoded) -> Tensor<4> {
        let features = Tensor::cat(vec![input.feature.clone(), experience, code.feature.clone()], 1);
        let batch = features.dims()[0];
        let mut x = leaky_relu(self.start.forward(features), SLOPE).reshape([batch, START, 4, 4]);
        for (k, (up, mix)) in self.up.iter().zip(&self.mix).enumerate() {
            x = leaky_relu(up.forward(x), SLOPE);
            if k < 4 {
                x = Tensor::cat(vec![x, half(&input.maps[3 - k]), half(&code.maps[3 - k])], 1);
            }
            x = leaky_relu(mix.forward(x), SLOPE);
        }
        self.head.forward(x)
    }
}
