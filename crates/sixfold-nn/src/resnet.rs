//! ResNet-50 (He et al. 2016, table 1) in torchvision's layout: names of the tensors, and the stride in the 3x3 convolution of a
//! bottleneck. [`Bottlenecks`] configures networks of the same kind with other sizes.

use std::path::Path;

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::batch_norm::{BatchNorm, BatchNormConfig};
use crate::conv_norm::{BareConv, BareConvConfig};
use crate::dense::dense;
use crate::pretrained::{Naming, PretrainedError, PretrainedFile, fill};

/// Layers after the first convolution.
const LAYERS: usize = 4;
/// Ratio of a layer's output channels to its inner channels.
const EXPANSION: usize = 4;

/// Sizes of a network of bottlenecks (He et al. 2016, table 1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bottlenecks {
    /// Number of bottlenecks in each of the four layers.
    pub blocks: [usize; 4],
    /// Channels of the first convolution, and inner channels of the first layer; each further layer has twice as many.
    pub width: usize,
    /// Added to the variances of the normalisations.
    pub epsilon: f64,
}

impl Default for Bottlenecks {
    /// ResNet-50, with PyTorch's epsilon of a batch normalisation.
    fn default() -> Self {
        Bottlenecks { blocks: [3, 4, 6, 3], width: 64, epsilon: 1e-5 }
    }
}

impl Bottlenecks {
    /// Channels of the four layers' outputs: 256, 512, 1024 and 2048 of ResNet-50.
    pub fn channels(&self) -> [usize; 4] {
        [0, 1, 2, 3].map(|layer| EXPANSION * (self.width << layer))
    }

    /// The network with all four layers, without a classifier and with random weights (He et al. 2015).
    pub fn init(&self, seed: u64, device: &Device) -> ResNet50 {
        self.build(LAYERS, None, seed, device)
    }

    fn build(&self, layers: usize, classes: Option<usize>, seed: u64, device: &Device) -> ResNet50 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let conv1 = BareConvConfig::new([3, self.width], 7).with_stride(2).init(&mut rng, device);
        let bn1 = self.norm(self.width, device);
        let mut inputs = self.width;
        let [layer1, layer2, layer3, layer4] = [0, 1, 2, 3].map(|layer| {
            let inner = self.width << layer;
            let blocks = if layer < layers { self.blocks[layer] } else { 0 };
            (0..blocks)
                .map(|block| {
                    let stride = if block == 0 && layer > 0 { 2 } else { 1 };
                    let channels = std::mem::replace(&mut inputs, EXPANSION * inner);
                    self.bottleneck([channels, inner], stride, &mut rng, device)
                })
                .collect()
        });
        let fc =
            classes.filter(|_| layers == LAYERS).map(|classes| dense([inputs, classes], &mut rng, device));
        ResNet50 { conv1, bn1, layer1, layer2, layer3, layer4, fc }
    }

    fn norm(&self, channels: usize, device: &Device) -> BatchNorm {
        BatchNormConfig { epsilon: self.epsilon, ..BatchNormConfig::new(channels) }.init(device)
    }

    fn bottleneck(
        &self,
        [inputs, inner]: [usize; 2],
        stride: usize,
        rng: &mut ChaCha8Rng,
        device: &Device,
    ) -> Bottleneck {
        let outputs = EXPANSION * inner;
        let mut conv = |channels: [usize; 2], kernel: usize, stride: usize| {
            let conv = BareConvConfig::new(channels, kernel).with_stride(stride).init(rng, device);
            (conv, self.norm(channels[1], device))
        };
        let (conv1, bn1) = conv([inputs, inner], 1, 1);
        let (conv2, bn2) = conv([inner, inner], 3, stride);
        let (conv3, bn3) = conv([inner, outputs], 1, 1);
        let downsample = (stride != 1 || inputs != outputs).then(|| conv([inputs, outputs], 1, stride));
        Bottleneck { conv1, bn1, conv2, bn2, conv3, bn3, downsample }
    }
}

/// Which part of ResNet-50 to build.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ResNet50Config {
    /// Layers after the first convolution, 0 to 4.
    pub layers: usize,
    /// Classes of the classifier after the fourth layer, if there is one.
    pub classes: Option<usize>,
}

impl ResNet50Config {
    /// The complete network with its classifier of 1000 ImageNet classes (25.6 million parameters).
    pub fn imagenet() -> Self {
        ResNet50Config { layers: 4, classes: Some(1000) }
    }

    /// The first convolution and the first `layers` of four layers, for their feature maps.
    pub fn features(layers: usize) -> Self {
        ResNet50Config { layers: layers.min(LAYERS), classes: None }
    }

    /// The network with random weights (He et al. 2015).
    pub fn init(&self, seed: u64, device: &Device) -> ResNet50 {
        Bottlenecks::default().build(self.layers, self.classes, seed, device)
    }

    /// The network with torchvision's weights from a `.pth` or `.safetensors` file. Tensors of parts that are not built are
    /// ignored.
    ///
    /// # Errors
    /// [`PretrainedError`].
    pub fn from_pytorch(&self, path: &Path, device: &Device) -> Result<ResNet50, PretrainedError> {
        let network = self.init(0, device);
        let layers = self.layers;
        let classifier = network.fc.is_some();
        let naming = Naming {
            network: "ResNet-50 in torchvision's layout",
            names: &|name| vec![name.to_owned()],
            unused: &|name| {
                let later = (layers + 1..=LAYERS).any(|l| name.starts_with(&format!("layer{l}.")));
                later || (!classifier && name.starts_with("fc."))
            },
        };
        fill(network, &PretrainedFile::open(path)?, &naming)
    }
}

/// ResNet-50, created by [`ResNet50Config`], or a network of other sizes, created by [`Bottlenecks`]. Input: RGB, for torchvision's
/// weights in 0..1 minus mean (0.485, 0.456, 0.406) over deviation (0.229, 0.224, 0.225).
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct ResNet50 {
    conv1: BareConv,
    bn1: BatchNorm,
    layer1: Vec<Bottleneck>,
    layer2: Vec<Bottleneck>,
    layer3: Vec<Bottleneck>,
    layer4: Vec<Bottleneck>,
    fc: Option<Linear>,
}

/// A bottleneck: 1x1 to fewer channels, 3x3, 1x1 to more, and the input added.
#[derive(Module, Debug)]
#[module(custom_display)]
struct Bottleneck {
    conv1: BareConv,
    bn1: BatchNorm,
    conv2: BareConv,
    bn2: BatchNorm,
    conv3: BareConv,
    bn3: BatchNorm,
    /// Shortcut if stride or channels change: PyTorch's `downsample.0` and `downsample.1`.
    downsample: Option<(BareConv, BatchNorm)>,
}

crate::displayed_by_name!(ResNet50, Bottleneck);

impl Bottleneck {
    fn freeze_norms(self) -> Bottleneck {
        let Bottleneck { conv1, bn1, conv2, bn2, conv3, bn3, downsample } = self;
        let downsample = downsample.map(|(conv, norm)| (conv, norm.freeze()));
        let [bn1, bn2, bn3] = [bn1, bn2, bn3].map(Module::freeze);
        Bottleneck { conv1, bn1, conv2, bn2, conv3, bn3, downsample }
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let y = self.conv1.forward_norm(x.clone(), &self.bn1, None, 0.0);
        let y = self.conv2.forward_norm(y, &self.bn2, None, 0.0);
        let shortcut = match &self.downsample {
            Some((conv, norm)) => conv.forward_norm(x, norm, None, 1.0),
            None => x,
        };
        self.conv3.forward_norm(y, &self.bn3, Some(shortcut), 0.0)
    }
}

impl ResNet50 {
    /// Freezes all normalisations and, of the five stages (the first convolution, the four layers), the first `stages`.
    pub fn freeze_stages(self, stages: usize) -> ResNet50 {
        let layer = |number: usize, blocks: Vec<Bottleneck>| {
            let frozen = |block: Bottleneck| {
                if number < stages { block.freeze() } else { block.freeze_norms() }
            };
            blocks.into_iter().map(frozen).collect()
        };
        let ResNet50 { conv1, bn1, layer1, layer2, layer3, layer4, fc } = self;
        ResNet50 {
            conv1: if stages > 0 { conv1.freeze() } else { conv1 },
            bn1: bn1.freeze(),
            layer1: layer(1, layer1),
            layer2: layer(2, layer2),
            layer3: layer(3, layer3),
            layer4: layer(4, layer4),
            fc,
        }
    }

    /// From `batch x 3 x height x width` to the maps after the first convolution and after every layer that was built: 64, 256,
    /// 512, 1024 and 2048 channels at 1/2, 1/4, 1/8, 1/16 and 1/32 of the resolution.
    pub fn features(&self, x: Tensor<4>) -> Vec<Tensor<4>> {
        let first = self.conv1.forward_norm(x, &self.bn1, None, 0.0);
        let pool = MaxPoolOptions::new([3, 3]).with_stride([2, 2]).with_padding([1, 1]);
        let mut maps = vec![first];
        for (i, layer) in [&self.layer1, &self.layer2, &self.layer3, &self.layer4].into_iter().enumerate() {
            if layer.is_empty() {
                break;
            }
            let x = maps[i].clone();
            let x = if i == 0 { max_pool2d(x, pool.clone()) } else { x };
            maps.push(layer.iter().fold(x, |x, block| block.forward(x)));
        }
        maps
    }

    /// From `batch x 3 x height x width` to `batch x classes` logits; `None` if the network has no classifier.
    pub fn classify(&self, x: Tensor<4>) -> Option<Tensor<2>> {
        self.classify_map(self.features(x).pop()?)
    }

    /// Logits from the last of [`Self::features`].
    pub fn classify_map(&self, map: Tensor<4>) -> Option<Tensor<2>> {
        let fc = self.fc.as_ref()?;
        let [batch, channels, ..] = map.dims();
        Some(fc.forward(map.mean_dim(3).mean_dim(2).reshape([batch, channels])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::TensorData;

    fn input(device: &Device) -> Tensor<4> {
        let values: Vec<f32> = (0..2 * 3 * 64 * 64).map(|i| ((i * i) as f32 * 1e-3).sin()).collect();
        Tensor::from_data(TensorData::new(values, [2, 3, 64, 64]), device)
    }

    #[test]
    fn it_has_the_published_size() {
        let device = Device::default();
        let network = ResNet50Config::imagenet().init(0, &device);
        // torchvision's 25 557 032 parameters and 2 x 26 560 running statistics.
        assert_eq!(network.num_params(), 25_557_032 + 2 * 26_560);
        assert_eq!(ResNet50Config::features(3).init(0, &device).features(input(&device)).len(), 4);
    }

    #[test]
    fn maps_have_their_shapes() {
        let device = Device::default();
        let network = ResNet50Config { layers: 4, classes: Some(7) }.init(1, &device);
        let shapes: Vec<_> = network.features(input(&device)).iter().map(|m| m.dims()).collect();
        let expected = [[2, 64, 32, 32], [2, 256, 16, 16], [2, 512, 8, 8], [2, 1024, 4, 4], [2, 2048, 2, 2]];
        assert_eq!(shapes, expected);
        assert_eq!(network.classify(input(&device)).unwrap().dims(), [2, 7]);
        assert!(ResNet50Config::features(4).init(0, &device).classify(input(&device)).is_none());
    }

    #[test]
    fn every_parameter_gets_a_gradient() {
        let device = Device::default().autodiff();
        let network = ResNet50Config { layers: 4, classes: Some(3) }.init(1, &device);
        let loss = network.classify(input(&device)).unwrap().square().mean();
        let grads = burn::optim::GradientsParams::from_grads(loss.backward(), &network);
        // 53 convolutions, 2 x 53 of their normalisations, weight and bias of the classifier.
        assert_eq!(grads.len(), 53 * 3 + 2);

        // Without the normalisations, and without the first convolution and the first layer (10 convolutions).
        for (stages, expected) in [(0, 53), (2, 53 - 11), (5, 0)] {
            let network =
                ResNet50Config { layers: 4, classes: Some(3) }.init(1, &device).freeze_stages(stages);
            let loss = network.classify(input(&device)).unwrap().square().mean();
            let grads = burn::optim::GradientsParams::from_grads(loss.backward(), &network);
            assert_eq!(grads.len(), expected + 2, "{stages} stages");
        }
    }
}
