//! A ResNet with a feature pyramid (Lin et al. 2017, "Feature pyramid networks", section 3): every level a sum of its own map and
//! the coarser level, twice as large.

use burn::module::Module;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor, activation};
use sixfold_geometry::random::Random;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig, Padding};
use sixfold_nn::ops::upsample;
use sixfold_nn::resnet::ResNet50;

use super::config::{AnchoredConfig, AnchoredKind};

/// A 3x3 convolution with a border of zeros and a rectifier.
pub(super) fn rectified(channels: usize, random: &mut Random, device: &Device) -> Conv {
    ConvConfig::new([channels, channels], 3, Activation::Relu).init(2.0, random, device)
}

/// The ResNet and the pyramid on it: torchvision's `backbone`.
#[derive(Module, Debug)]
#[module(custom_display)]
pub(super) struct Backbone {
    pub body: ResNet50,
    fpn: Pyramid,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct Pyramid {
    /// Of every map of the ResNet, 1x1.
    inner_blocks: Vec<Conv>,
    /// Of every level, 3x3.
    layer_blocks: Vec<Conv>,
    /// RetinaNet's further levels.
    extra_blocks: Option<Further>,
}

/// 3x3 convolutions with stride 2 (Lin et al. 2017, "Focal loss", section 4; from the finest level that they follow, as torchvision's
/// v1 models do).
#[derive(Module, Debug)]
#[module(custom_display)]
struct Further {
    p6: Conv,
    p7: Conv,
}

sixfold_nn::displayed_by_name!(Backbone, Pyramid, Further);

impl Backbone {
    pub(super) fn init(config: &AnchoredConfig, seed: u64, random: &mut Random, device: &Device) -> Backbone {
        let one_stage = config.kind == AnchoredKind::RetinaNet;
        let resnet = config.resnet();
        let channels = &resnet.channels()[usize::from(one_stage)..];
        let width = config.pyramid;
        let conv = |inputs: usize, kernel: usize, random: &mut Random| {
            ConvConfig::new([inputs, width], kernel, Activation::Linear).init(1.0, random, device)
        };
        let inner_blocks = channels.iter().map(|inputs| conv(*inputs, 1, random)).collect();
        let layer_blocks = channels.iter().map(|_| conv(width, 3, random)).collect();
        let further = |random: &mut Random| {
            let config = ConvConfig::new([width, width], 3, Activation::Linear);
            ConvConfig { stride: 2, padding: Padding::Zeros(1), ..config }.init(1.0, random, device)
        };
        let extra_blocks = one_stage.then(|| Further { p6: further(random), p7: further(random) });
        Backbone {
            body: resnet.init(seed, device),
            fpn: Pyramid { inner_blocks, layer_blocks, extra_blocks },
        }
    }

    /// `1 x 3 x rows x columns`, both multiples of 32, to five levels of `1 x pyramid x ..`, finest first: at 1/4 to 1/64 of the
    /// resolution for the R-CNNs, at 1/8 to 1/128 for RetinaNet.
    pub(super) fn forward(&self, x: Tensor<4>) -> Vec<Tensor<4>> {
        let Pyramid { inner_blocks, layer_blocks, extra_blocks } = &self.fpn;
        let maps = self.body.features(x);
        let maps = &maps[maps.len() - inner_blocks.len()..];
        let mut levels: Vec<Tensor<4>> =
            inner_blocks.iter().zip(maps).map(|(conv, map)| conv.forward(map.clone())).collect();
        for level in (1..levels.len()).rev() {
            levels[level - 1] = levels[level - 1].clone() + upsample(levels[level].clone());
        }
        let mut levels: Vec<Tensor<4>> =
            layer_blocks.iter().zip(levels).map(|(conv, level)| conv.forward(level)).collect();
        let coarsest = levels[levels.len() - 1].clone();
        match extra_blocks {
            Some(Further { p6, p7 }) => {
                let sixth = p6.forward(coarsest);
                levels.push(sixth.clone());
                levels.push(p7.forward(activation::relu(sixth)));
            }
            // Every other pixel, for proposals alone.
            None => levels.push(max_pool2d(coarsest, MaxPoolOptions::new([1, 1]).with_stride([2, 2]))),
        }
        levels
    }
}
