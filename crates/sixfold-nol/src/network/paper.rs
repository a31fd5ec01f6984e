//! The dissertation's network: DenseNet-121, ConvLSTM 32-32-16, weight block 32-16-8-1, WDSR-B with 32 filters and six blocks.
//!
//! The maps are those after the first convolution and the first three dense blocks, each normalised and rectified before and
//! after the convolution that reduces it, as in the author's public code (which takes them half a step later, after the
//! transition's convolution).

use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use sixfold_geometry::random::stream;
use sixfold_nn::batch_norm::{BatchNorm, BatchNormConfig};
use sixfold_nn::conv_norm::{BareConv, BareConvConfig};
use sixfold_nn::densenet::{DenseNet121, DenseNet121Config};
use sixfold_nn::pretrained::PretrainedError;

use super::decoder::DecoderConfig;
use super::integrator::IntegratorConfig;
use super::weighting::WeightingConfig;
use super::{Head, HeadConfig, Parts, REDUCED};

/// Channels of DenseNet's maps.
const MAPS: [usize; 4] = [64, 256, 512, 1024];
/// ImageNet's mean and standard deviation of red, green and blue in 0..1.
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];

/// Options of the dissertation's network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PaperConfig {
    /// Parts left out for comparisons.
    pub parts: Parts,
}

impl PaperConfig {
    /// The network with random weights.
    pub fn init(&self, seed: u64, device: &Device) -> Paper {
        self.init_with(DenseNet121Config::features(3).init(seed, device), seed, device)
    }

    /// The network with ImageNet weights of DenseNet-121 from torchvision's file; the other weights are random.
    ///
    /// # Errors
    /// [`PretrainedError`].
    pub fn from_imagenet(&self, file: &Path, seed: u64, device: &Device) -> Result<Paper, PretrainedError> {
        Ok(self.init_with(DenseNet121Config::features(3).from_pytorch(file, device)?, seed, device))
    }

    fn init_with(&self, encoder: DenseNet121, seed: u64, device: &Device) -> Paper {
        let mut rng = stream(seed, 1);
        let rng = &mut rng;
        let reduce = MAPS
            .iter()
            .zip(REDUCED)
            .map(|(&inputs, outputs)| BareConvConfig::new([inputs, outputs], 3).init(rng, device));
        let reduce = reduce.collect();
        let before = MAPS.iter().map(|&c| BatchNormConfig::new(c).init(device)).collect();
        let after = REDUCED.iter().map(|&c| BatchNormConfig::new(c).init(device)).collect();
        let head = HeadConfig {
            integrator: IntegratorConfig { kind: self.parts.integrator, hidden: &[32, 32] },
            weighting: WeightingConfig { channels: [32, 16, 8] },
            decoder: self.parts.decoder.then_some(DecoderConfig {
                filters: 32,
                blocks: 6,
                expansion: 4,
                linear_ratio: 0.8,
                half: false,
            }),
        };
        Paper { encoder, before, reduce, after, head: head.init(rng, device) }
    }
}

/// The dissertation's network, created by [`PaperConfig`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Paper {
    encoder: DenseNet121,
    before: Vec<BatchNorm>,
    reduce: Vec<BareConv>,
    after: Vec<BatchNorm>,
    pub(super) head: Head,
}

sixfold_nn::displayed_by_name!(Paper);

impl Paper {
    /// See [`super::Network::encode`].
    pub fn encode(&self, images: Tensor<4>) -> Vec<Tensor<4>> {
        let maps = self.encoder.features(imagenet(images));
        let layers = self.before.iter().zip(&self.reduce).zip(&self.after);
        layers
            .zip(maps)
            .map(|(((before, conv), after), map)| {
                conv.forward_norm(before.forward_rectified(map, None, 0.0), after, None, 0.0)
            })
            .collect()
    }

    /// DenseNet with its current weights, frozen, for the perceptual loss.
    pub(crate) fn frozen_encoder(&self) -> DenseNet121 {
        self.encoder.clone().no_grad()
    }
}

/// Converts colours from -1 to 1 to the input of torchvision's networks.
pub(crate) fn imagenet(images: Tensor<4>) -> Tensor<4> {
    let device = images.device();
    let row = |v: [f32; 3]| Tensor::<1>::from_floats(v, &device).reshape([1, 3, 1, 1]);
    let (mean, deviation) = (row(MEAN), row(DEVIATION));
    (images * 0.5 + 0.5 - mean) / deviation
}
