//! The dissertation's sizes (section 5.2.2): ResNet-50 up to an eighth of the resolution, maps of 256 channels, dense layers of
//! 256, 256 and 128 (256, 256 and the number of outputs for pairs).
//!
//! The dissertation runs ResNet-50 once over the image and cuts regions out of its map. Here every region is first resampled from
//! the image to 112x112 pixels, which gives the same map of 14x14 in the region's own scale but costs more where many regions
//! overlap. Only the three planes of the normals are used.

use std::path::Path;

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::activation::elu;
use burn::tensor::{Device, Tensor};
use sixfold_geometry::random::stream;
use sixfold_nn::dense::dense;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig};
use sixfold_nn::pretrained::PretrainedError;
use sixfold_nn::resnet::{ResNet50, ResNet50Config};

use super::{DESCRIPTOR, MAP, flat};

/// Channels of maps and of dense layers.
const CHANNELS: usize = 256;
/// Channels of ResNet-50 at an eighth of the resolution.
const BACKBONE: usize = 512;

/// Sizes of the dissertation's network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PaperConfig;

impl PaperConfig {
    /// Side of the input in pixels.
    pub const SIDE: usize = 8 * MAP;

    /// The network with random weights.
    pub fn init(&self, seed: u64, device: &Device) -> Paper {
        self.init_with(ResNet50Config::features(2).init(seed, device), seed, device)
    }

    /// The network with ImageNet weights of ResNet-50 from torchvision's file; the other weights are random.
    ///
    /// # Errors
    /// [`PretrainedError`].
    pub fn from_imagenet(&self, file: &Path, seed: u64, device: &Device) -> Result<Paper, PretrainedError> {
        Ok(self.init_with(ResNet50Config::features(2).from_pytorch(file, device)?, seed, device))
    }

    fn init_with(&self, backbone: ResNet50, seed: u64, device: &Device) -> Paper {
        let mut rng = stream(seed, 1);
        let rng = &mut rng;
        let mut conv = |channels: [usize; 2], kernel: usize, activation: Activation, gain: f32| {
            ConvConfig::new(channels, kernel, activation).init(gain, rng, device)
        };
        let reduce = conv([BACKBONE, CHANNELS], 3, Activation::Relu, 2.0);
        let region = conv([CHANNELS; 2], 3, Activation::Relu, 2.0);
        let template = conv([CHANNELS; 2], 3, Activation::Relu, 2.0);
        let mask = conv([2 * CHANNELS, CHANNELS], 3, Activation::Relu, 2.0);
        let mask_out = conv([CHANNELS, 1], 1, Activation::Linear, 0.1);
        let mut head = |inputs: usize, outputs: usize| {
            [[inputs, CHANNELS], [CHANNELS; 2], [CHANNELS, outputs]].map(|c| dense(c, rng, device)).to_vec()
        };
        Paper {
            backbone,
            reduce,
            descriptor: head(CHANNELS * MAP * MAP, DESCRIPTOR),
            region,
            template,
            mask,
            mask_out,
            numbers: head(2 * CHANNELS * MAP * MAP, 8),
        }
    }
}

/// The dissertation's network, created by [`PaperConfig`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Paper {
    backbone: ResNet50,
    reduce: Conv,
    descriptor: Vec<Linear>,
    region: Conv,
    template: Conv,
    mask: Conv,
    mask_out: Conv,
    numbers: Vec<Linear>,
}

sixfold_nn::displayed_by_name!(Paper);

fn dense_layers(layers: &[Linear], x: Tensor<2>) -> Tensor<2> {
    let last = layers.len().saturating_sub(1);
    layers.iter().enumerate().fold(x, |x, (k, layer)| {
        let x = layer.forward(x);
        if k < last { elu(x, 1.0) } else { x }
    })
}

impl Paper {
    /// See [`super::Network::maps`].
    pub fn maps(&self, patches: Tensor<4>) -> Tensor<4> {
        let maps = self.backbone.features(patches.narrow(1, 0, 3));
        self.reduce.forward(maps[maps.len() - 1].clone())
    }

    /// See [`super::Network::descriptor`].
    pub(crate) fn descriptor(&self, maps: Tensor<4>) -> Tensor<2> {
        dense_layers(&self.descriptor, flat(maps))
    }

    /// Mask logits and the eight numbers of [`super::Network::compare`].
    pub fn compare(&self, regions: Tensor<4>, templates: Tensor<4>) -> (Tensor<4>, Tensor<2>) {
        let pair = Tensor::cat(vec![self.region.forward(regions), self.template.forward(templates)], 1);
        let mask = self.mask_out.forward(self.mask.forward(pair.clone()));
        (mask, dense_layers(&self.numbers, flat(pair)))
    }
}
