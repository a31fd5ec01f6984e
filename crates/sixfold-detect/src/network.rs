//! The networks: an encoder, a feature pyramid (Lin et al. 2017, "Feature pyramid networks"), heads that all levels
//! share (Lin et al. 2017, "Focal loss"; without anchors as Tian et al. 2019, "FCOS"), and prototypes of masks (Bolya
//! et al. 2019, "YOLACT").
//!
//! Every pixel of a level, a *location*, predicts for each class how well its box would fit an object of that class, the four sides
//! of that box, and the coefficients with which the object's mask is combined from the image's prototypes.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};
use sixfold_geometry::random::stream;
use sixfold_nn::choice::Choice;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig, Padding};
use sixfold_nn::lite0::{Lite0, Lite0Config};
use sixfold_nn::ops::upsample;
use sixfold_nn::resnet::{ResNet50, ResNet50Config};

/// Distance of the locations of the finest level, pixels.
pub(crate) const FINEST_STRIDE: usize = 8;
/// Pixels per pixel of the mask prototypes along a side.
pub(crate) const MASK_STRIDE: usize = 4;
/// Initial score of every class at every location (Lin et al. 2017, section 3.3).
const PRIOR: f32 = 0.01;

/// Which encoder a detector uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EncoderKind {
    /// EfficientNet-Lite0 to a sixteenth of the resolution.
    Lite0,
    /// ResNet-50.
    ResNet50,
}

impl Choice for EncoderKind {
    const ALL: &'static [EncoderKind] = &[EncoderKind::Lite0, EncoderKind::ResNet50];

    fn name(self) -> &'static str {
        match self {
            EncoderKind::Lite0 => "lite0",
            EncoderKind::ResNet50 => "resnet50",
        }
    }

    fn help(self) -> &'static str {
        match self {
            EncoderKind::Lite0 => "EfficientNet-Lite0, whose ImageNet weights are part of the program",
            EncoderKind::ResNet50 => "ResNet-50, with torchvision's weights from --encoder",
        }
    }
}

/// Channels of [`lite0_maps`].
pub(crate) const LITE0_CHANNELS: [usize; 3] = [24, 40, 112];

/// EfficientNet-Lite0's maps at 1/4, 1/8 and 1/16 of the resolution.
pub(crate) fn lite0_maps(network: &Lite0, x: Tensor<4>) -> Vec<Tensor<4>> {
    let maps = network.forward(x);
    vec![maps[1].clone(), maps[2].clone(), maps[4].clone()]
}

/// Sizes of a detector; part of its weight file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DetectorConfig {
    /// Number of classes, one per object.
    pub classes: usize,
    /// The encoder.
    pub encoder: EncoderKind,
    /// Channels of pyramid and heads.
    pub width: usize,
    /// Number of levels of the pyramid, the finest at 1/8 of the resolution.
    pub levels: usize,
    /// 3x3 convolutions shared by scores and boxes.
    pub shared: usize,
    /// 3x3 convolutions separate for scores and for boxes with masks.
    pub own: usize,
    /// Whether each level of the pyramid has a final 3x3 convolution.
    pub smooth: bool,
    /// Number of mask prototypes.
    pub prototypes: usize,
}

impl DetectorConfig {
    /// The default: EfficientNet-Lite0, three levels, about one million parameters.
    pub fn compact(classes: usize) -> Self {
        DetectorConfig {
            classes,
            encoder: EncoderKind::Lite0,
            width: 64,
            levels: 3,
            shared: 1,
            own: 1,
            smooth: false,
            prototypes: 16,
        }
    }

    /// The detector of any object: one class, and deeper heads, because its encoder is frozen.
    pub fn proposals() -> Self {
        DetectorConfig { shared: 2, own: 2, ..DetectorConfig::compact(1) }
    }

    /// RetinaNet's pyramid and heads on ResNet-50 (Lin et al. 2017): five levels of 256 channels, four convolutions each for scores
    /// and boxes. In contrast to RetinaNet, locations have no anchors, and there are masks.
    pub fn retinanet(classes: usize) -> Self {
        DetectorConfig {
            classes,
            encoder: EncoderKind::ResNet50,
            width: 256,
            levels: 5,
            shared: 0,
            own: 4,
            smooth: true,
            prototypes: 32,
        }
    }

    /// Channels in addition to the scores: four sides, the mask's coefficients, and its bias.
    pub(crate) fn regression_channels(&self) -> usize {
        4 + self.prototypes + 1
    }

    /// Rows and columns of images must be multiples of this.
    pub fn alignment(&self) -> usize {
        FINEST_STRIDE << (self.levels - 1)
    }

    /// Distance of the locations of a level, pixels.
    pub fn stride(&self, level: usize) -> usize {
        FINEST_STRIDE << level
    }

    /// The network with random weights.
    pub fn init(&self, seed: u64, device: &Device) -> Detector {
        let encoder = match self.encoder {
            EncoderKind::Lite0 => Encoder::Lite0(Lite0Config::default().init(seed, device)),
            EncoderKind::ResNet50 => Encoder::ResNet50(ResNet50Config::features(4).init(seed, device)),
        };
        self.init_with(encoder, seed, device)
    }

    /// The network with a given encoder; the other weights are random.
    ///
    /// # Panics
    /// If the encoder is not of the configured kind.
    pub fn init_with(&self, encoder: Encoder, seed: u64, device: &Device) -> Detector {
        let channels: &[usize] = match encoder {
            Encoder::Lite0(_) => &LITE0_CHANNELS,
            Encoder::ResNet50(_) => &[256, 512, 1024, 2048],
        };
        assert_eq!(matches!(encoder, Encoder::Lite0(_)), self.encoder == EncoderKind::Lite0);
        let mut rng = stream(seed, 1);
        let mut conv = |inputs: usize, outputs: usize, kernel: usize, activation: Activation, gain: f32| {
            ConvConfig::new([inputs, outputs], kernel, activation).init(gain, &mut rng, device)
        };
        let w = self.width;
        let of_encoder = (channels.len() - 1).min(self.levels);
        let lateral: Vec<Conv> =
            channels[1..][..of_encoder].iter().map(|c| conv(*c, w, 1, Activation::Linear, 1.0)).collect();
        let smooth = (0..if self.smooth { of_encoder } else { 0 })
            .map(|_| conv(w, w, 3, Activation::Linear, 1.0))
            .collect();
        let tower = |count: usize, conv: &mut dyn FnMut() -> Conv| (0..count).map(|_| conv()).collect();
        let mut layer = || conv(w, w, 3, Activation::Relu, 2.0);
        let shared = tower(self.shared, &mut layer);
        let score_tower = tower(self.own, &mut layer);
        let box_tower = tower(self.own, &mut layer);
        // Small, because the encoder's outputs are large: initial scores are equal to their prior everywhere.
        let mut scores = conv(w, self.classes, 1, Activation::Linear, 0.003);
        scores.bias = burn::module::Param::from_tensor(Tensor::full(
            [self.classes],
            -((1.0 - PRIOR) / PRIOR).ln(),
            device,
        ));
        let mut boxes = conv(w, self.regression_channels(), 1, Activation::Linear, 0.003);
        // Sides are initially e (2.7) strides away.
        let bias: Vec<f32> = (0..self.regression_channels()).map(|i| f32::from(i < 4)).collect();
        boxes.bias = burn::module::Param::from_tensor(Tensor::from_data(
            burn::tensor::TensorData::new(bias, [self.regression_channels()]),
            device,
        ));
        let half = w / 2;
        let masks = Prototypes {
            coarse: conv(w, half, 1, Activation::Linear, 1.0),
            fine: conv(channels[0], half, 1, Activation::Linear, 1.0),
            mix: conv(half, half, 3, Activation::Relu, 2.0),
            out: conv(half, self.prototypes, 1, Activation::Relu, 0.1),
        };
        let extra = (of_encoder..self.levels)
            .map(|_| {
                ConvConfig {
                    stride: 2,
                    padding: Padding::Zeros(1),
                    ..ConvConfig::new([w, w], 3, Activation::Relu)
                }
                .init(2.0, &mut rng, device)
            })
            .collect();
        Detector { encoder, lateral, extra, smooth, shared, score_tower, box_tower, scores, boxes, masks }
    }
}

/// The pretrained part.
#[derive(Module, Debug)]
#[module(custom_display)]
#[allow(clippy::large_enum_variant)]
pub enum Encoder {
    /// EfficientNet-Lite0, five stages.
    Lite0(Lite0),
    /// ResNet-50, four layers.
    ResNet50(ResNet50),
}

impl Encoder {
    /// Maps at 1/4, 1/8, 1/16 (and 1/32) of the resolution.
    pub fn maps(&self, x: Tensor<4>) -> Vec<Tensor<4>> {
        match self {
            Encoder::Lite0(network) => lite0_maps(network, x),
            Encoder::ResNet50(network) => network.features(x).split_off(1),
        }
    }
}

/// Computes prototypes of masks from the finest level and the encoder's map at 1/4.
#[derive(Module, Debug)]
#[module(custom_display)]
struct Prototypes {
    coarse: Conv,
    fine: Conv,
    mix: Conv,
    out: Conv,
}

/// A detector, created by [`DetectorConfig`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Detector {
    /// The pretrained part.
    pub encoder: Encoder,
    lateral: Vec<Conv>,
    extra: Vec<Conv>,
    smooth: Vec<Conv>,
    shared: Vec<Conv>,
    score_tower: Vec<Conv>,
    box_tower: Vec<Conv>,
    scores: Conv,
    boxes: Conv,
    masks: Prototypes,
}

sixfold_nn::displayed_by_name!(Encoder, Prototypes, Detector);

/// Raw output of a detector for a batch.
#[derive(Debug, Clone)]
pub struct DetectorOutput {
    /// Logits of every level, finest first: `batch x classes x height x width`.
    pub scores: Vec<Tensor<4>>,
    /// For every level: logarithms of the distances in strides from the location to the left, top, right and bottom side, then the
    /// coefficients of the prototypes, then the mask's bias; `batch x channels x height x width`.
    pub boxes: Vec<Tensor<4>>,
    /// `batch x prototypes x height / 4 x width / 4`.
    pub prototypes: Tensor<4>,
}

impl Detector {
    /// `x` is `batch x 3 x height x width`, rows and columns multiples of [`DetectorConfig::alignment`], values scaled for the
    /// encoder ([`DetectorConfig::input`]).
    pub fn forward(&self, x: Tensor<4>) -> DetectorOutput {
        let maps = self.encoder.maps(x);
        let mut levels: Vec<Tensor<4>> =
            self.lateral.iter().zip(&maps[1..]).map(|(conv, map)| conv.forward(map.clone())).collect();
        let of_encoder = levels.len();
        for conv in &self.extra {
            let coarser = conv.forward(levels[levels.len() - 1].clone());
            levels.push(coarser);
        }
        // Coarser levels are added to finer ones; RetinaNet's further levels are not included.
        let top = if self.smooth.is_empty() { levels.len() } else { of_encoder };
        for level in (1..top).rev() {
            levels[level - 1] = levels[level - 1].clone() + upsample(levels[level].clone());
        }
        for (level, conv) in self.smooth.iter().enumerate() {
            levels[level] = conv.forward(levels[level].clone());
        }
        let m = &self.masks;
        let mixed = upsample(m.coarse.forward(levels[0].clone())) + m.fine.forward(maps[0].clone());
        let prototypes = m.out.forward(m.mix.forward(mixed));
        let (mut scores, mut boxes) = (vec![], vec![]);
        for level in levels {
            let through = |convs: &[Conv], x: Tensor<4>| convs.iter().fold(x, |x, conv| conv.forward(x));
            let common = through(&self.shared, level);
            scores.push(self.scores.forward(through(&self.score_tower, common.clone())));
            boxes.push(self.boxes.forward(through(&self.box_tower, common)));
        }
        DetectorOutput { scores, boxes, prototypes }
    }

    /// Freezes the costly first stages of the encoder during training (EfficientNet-Lite0 only).
    pub fn freeze(mut self, stages: usize) -> Self {
        self.encoder = match self.encoder {
            Encoder::Lite0(network) => Encoder::Lite0(network.freeze(stages)),
            other => other,
        };
        self
    }
}

impl DetectorConfig {
    /// Scales an image of three planes with values in 0..1, `pixels` each, for the encoder: `(255 v - 127) / 128` for
    /// EfficientNet-Lite0, torchvision's mean and standard deviation for ResNet-50.
    pub fn input(&self, rgb: &mut [f32], pixels: usize) {
        const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
        const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];
        for (channel, plane) in rgb.chunks_exact_mut(pixels).enumerate() {
            let (factor, offset) = match self.encoder {
                EncoderKind::Lite0 => (255.0 / 128.0, -127.0 / 128.0),
                EncoderKind::ResNet50 => {
                    (1.0 / DEVIATION[channel % 3], -MEAN[channel % 3] / DEVIATION[channel % 3])
                }
            };
            plane.iter_mut().for_each(|v| *v = *v * factor + offset);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_have_their_shapes_and_the_compact_network_is_small() {
        let device = Device::flex();
        let config = DetectorConfig::compact(8);
        let network = config.init(1, &device);
        assert!(network.num_params() < 4_000_000, "{}", network.num_params());
        let out = network.forward(Tensor::zeros([1, 3, 96, 160], &device));
        let shapes: Vec<_> = out.scores.iter().map(|t| t.dims()).collect();
        assert_eq!(shapes, [[1, 8, 12, 20], [1, 8, 6, 10], [1, 8, 3, 5]]);
        assert_eq!(out.boxes[1].dims(), [1, 21, 6, 10]);
        assert_eq!(out.prototypes.dims(), [1, 16, 24, 40]);
    }

    #[test]
    fn retinanet_has_five_levels() {
        let device = Device::flex();
        let config = DetectorConfig::retinanet(3);
        let out = config.init(1, &device).forward(Tensor::zeros([1, 3, 128, 128], &device));
        let sides: Vec<_> = out.scores.iter().map(|t| t.dims()[2]).collect();
        assert_eq!(sides, [16, 8, 4, 2, 1]);
    }
}
