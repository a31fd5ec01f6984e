//! An encoder with a feature pyramid (Lin et al. 2017, "Feature pyramid networks", section 3): every level a sum of its own map and
//! the coarser level, twice as large.

use burn::module::Module;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor, activation};
use sixfold_geometry::random::Random;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig, Padding};
use sixfold_nn::lite0::{Lite0, Lite0Config};
use sixfold_nn::ops::upsample;
use sixfold_nn::resnet::ResNet50;

use super::config::{AnchoredConfig, AnchoredKind};
use crate::network::{EncoderKind, LITE0_CHANNELS, lite0_maps};

/// Channels of the map at 1/32 on EfficientNet-Lite0, as many as its own sixth stage has.
const COARSEST_CHANNELS: usize = 192;

/// A 3x3 convolution with a border of zeros and a rectifier.
pub(super) fn rectified(channels: usize, random: &mut Random, device: &Device) -> Conv {
    ConvConfig::new([channels, channels], 3, Activation::Relu).init(2.0, random, device)
}

/// The encoder and the pyramid on it: torchvision's `backbone`. One of the encoders is there.
#[derive(Module, Debug)]
#[module(custom_display)]
pub(super) struct Backbone {
    pub body: Option<ResNet50>,
    pub lite0: Option<Lite0>,
    /// With stride 2 from EfficientNet-Lite0's map at 1/16, where its five pretrained stages end, to one at 1/32.
    coarsest: Option<Conv>,
    fpn: Pyramid,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct Pyramid {
    /// Of every map of the encoder, 1x1.
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
        let [finest, fine, coarse] = LITE0_CHANNELS;
        let channels = match config.encoder {
            EncoderKind::ResNet50 => resnet.channels(),
            EncoderKind::Lite0 => [finest, fine, coarse, COARSEST_CHANNELS],
        };
        let channels = &channels[usize::from(one_stage)..];
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
        let fpn = Pyramid { inner_blocks, layer_blocks, extra_blocks };
        match config.encoder {
            EncoderKind::ResNet50 => {
                Backbone { body: Some(resnet.init(seed, device)), lite0: None, coarsest: None, fpn }
            }
            EncoderKind::Lite0 => {
                let conv = ConvConfig::new([coarse, COARSEST_CHANNELS], 3, Activation::Relu);
                let conv = ConvConfig { stride: 2, padding: Padding::Zeros(1), ..conv };
                let coarsest = Some(conv.init(2.0, random, device));
                let lite0 = Some(Lite0Config::default().init(seed, device));
                Backbone { body: None, lite0, coarsest, fpn }
            }
        }
    }

    /// The encoder's maps, the last ones at 1/4, 1/8, 1/16 and 1/32 of the resolution.
    fn maps(&self, x: Tensor<4>) -> Vec<Tensor<4>> {
        let mut maps = match (&self.body, &self.lite0) {
            (Some(resnet), _) => resnet.features(x),
            (None, Some(lite0)) => lite0_maps(lite0, x),
            (None, None) => unreachable!("a backbone has an encoder"),
        };
        if let Some(conv) = &self.coarsest {
            maps.push(conv.forward(maps[maps.len() - 1].clone()));
        }
        maps
    }

    /// The first stages of the encoder, and the normalisations of a ResNet, stay as they are in a training.
    pub(super) fn freeze_stages(self, stages: usize) -> Backbone {
        let Backbone { body, lite0, coarsest, fpn } = self;
        Backbone {
            body: body.map(|resnet| resnet.freeze_stages(stages)),
            lite0: lite0.map(|lite0| lite0.freeze(stages)),
            coarsest,
            fpn,
        }
    }

    /// What is pretrained.
    pub(super) fn encoder(&self) -> (Option<ResNet50>, Option<Lite0>) {
        (self.body.clone(), self.lite0.clone())
    }

    /// `1 x 3 x rows x columns`, both multiples of 32, to five levels of `1 x pyramid x ..`, finest first: at 1/4 to 1/64 of the
    /// resolution for the R-CNNs, at 1/8 to 1/128 for RetinaNet.
    pub(super) fn forward(&self, x: Tensor<4>) -> Vec<Tensor<4>> {
        let Pyramid { inner_blocks, layer_blocks, extra_blocks } = &self.fpn;
        let maps = self.maps(x);
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

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::random::stream;

    #[test]
    fn levels_on_lite0_have_the_strides_of_those_on_the_resnet() {
        let device = Device::flex();
        let shapes = |config: &AnchoredConfig| -> Vec<[usize; 4]> {
            let backbone = Backbone::init(config, 0, &mut stream(0, 1), &device);
            backbone.forward(Tensor::zeros([1, 3, 96, 160], &device)).iter().map(|l| l.dims()).collect()
        };
        for kind in [AnchoredKind::FasterRcnn, AnchoredKind::MaskRcnn, AnchoredKind::RetinaNet] {
            let lite0 = shapes(&AnchoredConfig::compact(kind, 3));
            let first = if kind == AnchoredKind::RetinaNet { [1, 64, 12, 20] } else { [1, 64, 24, 40] };
            assert_eq!(lite0[0], first);
            let resnet = AnchoredConfig { blocks: [1; 4], width: 4, ..AnchoredConfig::new(kind, 3) };
            assert_eq!(lite0, shapes(&AnchoredConfig { pyramid: 64, ..resnet }));
        }
    }
}
