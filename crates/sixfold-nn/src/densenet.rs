//! DenseNet-121 (Huang et al. 2017, table 1) in torchvision's layout.

use std::path::Path;

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::module::{avg_pool2d, max_pool2d};
use burn::tensor::ops::{AvgPoolOptions, MaxPoolOptions};
use burn::tensor::{Device, Tensor};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::batch_norm::{BatchNorm, BatchNormConfig};
use crate::conv_norm::{BareConv, BareConvConfig};
use crate::dense::dense;
use crate::pretrained::{Naming, PretrainedError, PretrainedFile, fill};

/// Layers of the four dense blocks.
const BLOCKS: [usize; 4] = [6, 12, 24, 16];
/// Channels after the first convolution.
const FIRST: usize = 64;
/// Channels that every dense layer adds.
const GROWTH: usize = 32;
/// Channels between a dense layer's two convolutions.
const INNER: usize = 4 * GROWTH;

/// Which part of DenseNet-121 to build.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DenseNet121Config {
    /// Dense blocks after the first convolution, 0 to 4.
    pub blocks: usize,
    /// Classes of the classifier after the fourth block, if there is one.
    pub classes: Option<usize>,
}

impl DenseNet121Config {
    /// The complete network with its classifier of 1000 ImageNet classes (8.0 million parameters).
    pub fn imagenet() -> Self {
        DenseNet121Config { blocks: 4, classes: Some(1000) }
    }

    /// The first convolution and the first `blocks` of four dense blocks, for their feature maps.
    pub fn features(blocks: usize) -> Self {
        DenseNet121Config { blocks: blocks.min(BLOCKS.len()), classes: None }
    }

    /// The network with random weights (He et al. 2015).
    pub fn init(&self, seed: u64, device: &Device) -> DenseNet121 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let conv0 = BareConvConfig::new([3, FIRST], 7).with_stride(2).init(&mut rng, device);
        let norm0 = BatchNormConfig::new(FIRST).init(device);
        let built = self.blocks.min(BLOCKS.len());
        let (mut denseblock, mut transition) = (Vec::new(), Vec::new());
        let mut channels = FIRST;
        for (i, layers) in BLOCKS.into_iter().take(built).enumerate() {
            if i > 0 {
                let norm = BatchNormConfig::new(channels).init(device);
                let conv = BareConvConfig::new([channels, channels / 2], 1).init(&mut rng, device);
                transition.push(Transition { norm, conv });
                channels /= 2;
            }
            let denselayer = (0..layers)
                .map(|layer| DenseLayer::init(channels + layer * GROWTH, &mut rng, device))
                .collect();
            denseblock.push(DenseBlock { denselayer });
            channels += layers * GROWTH;
        }
        let whole = built == BLOCKS.len();
        let norm5 = whole.then(|| BatchNormConfig::new(channels).init(device));
        let classifier =
            self.classes.filter(|_| whole).map(|classes| dense([channels, classes], &mut rng, device));
        let features = Features { conv0, norm0, denseblock, transition, norm5 };
        DenseNet121 { features, classifier }
    }

    /// The network with torchvision's weights from a `.pth` or `.safetensors` file; the older names in the published files
    /// (`norm.1` for `norm1`) are supported. Tensors of parts that are not built are ignored.
    ///
    /// # Errors
    /// [`PretrainedError`].
    pub fn from_pytorch(&self, path: &Path, device: &Device) -> Result<DenseNet121, PretrainedError> {
        let network = self.init(0, device);
        let blocks = self.blocks;
        let classifier = network.classifier.is_some();
        let naming = Naming {
            network: "DenseNet-121 in torchvision's layout",
            names: &names,
            unused: &|name| {
                let starts =
                    |what: &str, number: usize| name.starts_with(&format!("features.{what}{number}."));
                let later = (blocks + 1..=BLOCKS.len())
                    .any(|b| starts("denseblock", b) || (b > 1 && starts("transition", b - 1)));
                let end = blocks < BLOCKS.len() && name.starts_with("features.norm5.");
                later || end || (!classifier && name.starts_with("classifier."))
            },
        };
        fill(network, &PretrainedFile::open(path)?, &naming)
    }
}

/// torchvision's name of a tensor, which counts from 1 and has no dots (`denseblock1.denselayer2` for `denseblock.0.denselayer.1`),
/// and the older one.
fn names(field: &str) -> Vec<String> {
    let mut name = String::new();
    let mut counts = false;
    for part in field.split('.') {
        match part.parse::<usize>() {
            Ok(index) if counts => name += &(index + 1).to_string(),
            _ => {
                if !name.is_empty() {
                    name.push('.');
                }
                name += part;
            }
        }
        counts = ["denseblock", "denselayer", "transition"].contains(&part);
    }
    let mut old = name.clone();
    if name.contains("denselayer") {
        for (new, dotted) in
            [("norm1", "norm.1"), ("norm2", "norm.2"), ("conv1", "conv.1"), ("conv2", "conv.2")]
        {
            old = old.replace(&format!(".{new}."), &format!(".{dotted}."));
        }
    }
    if old == name { vec![name] } else { vec![name, old] }
}

/// DenseNet-121, created by [`DenseNet121Config`]. Input: RGB, for torchvision's weights in 0..1 minus mean (0.485, 0.456, 0.406)
/// over deviation (0.229, 0.224, 0.225).
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct DenseNet121 {
    features: Features,
    classifier: Option<Linear>,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct Features {
    conv0: BareConv,
    norm0: BatchNorm,
    denseblock: Vec<DenseBlock>,
    /// The transitions between the blocks, one fewer than blocks.
    transition: Vec<Transition>,
    norm5: Option<BatchNorm>,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct DenseBlock {
    denselayer: Vec<DenseLayer>,
}

/// Normalise, rectify, 1x1, normalise, rectify, 3x3: adds 32 channels, computed from all earlier ones.
#[derive(Module, Debug)]
#[module(custom_display)]
struct DenseLayer {
    norm1: BatchNorm,
    conv1: BareConv,
    norm2: BatchNorm,
    conv2: BareConv,
}

/// A transition: half the channels at half the resolution.
#[derive(Module, Debug)]
#[module(custom_display)]
struct Transition {
    norm: BatchNorm,
    conv: BareConv,
}

crate::displayed_by_name!(DenseNet121, Features, DenseBlock, DenseLayer, Transition);

impl DenseLayer {
    fn init(inputs: usize, rng: &mut ChaCha8Rng, device: &Device) -> Self {
        DenseLayer {
            norm1: BatchNormConfig::new(inputs).init(device),
            conv1: BareConvConfig::new([inputs, INNER], 1).init(rng, device),
            norm2: BatchNormConfig::new(INNER).init(device),
            conv2: BareConvConfig::new([INNER, GROWTH], 3).init(rng, device),
        }
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let x = self.norm1.forward_rectified(x, None, 0.0);
        self.conv2.forward(self.conv1.forward_norm(x, &self.norm2, None, 0.0))
    }
}

impl Transition {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let x = self.conv.forward(self.norm.forward_rectified(x, None, 0.0));
        avg_pool2d(x, AvgPoolOptions::new([2, 2]))
    }
}

impl DenseNet121 {
    /// From `batch x 3 x height x width` to the maps after the first convolution and after every dense block that was built: 64,
    /// 256, 512, 1024 and 1024 channels at 1/2, 1/4, 1/8, 1/16 and 1/32 of the resolution. The map of the fourth block is
    /// normalised and rectified (torchvision's `norm5`), the others are the direct outputs of their blocks.
    pub fn features(&self, x: Tensor<4>) -> Vec<Tensor<4>> {
        let f = &self.features;
        let mut maps = vec![f.conv0.forward_norm(x, &f.norm0, None, 0.0)];
        for (i, block) in f.denseblock.iter().enumerate() {
            let x = match i {
                0 => {
                    let pool = MaxPoolOptions::new([3, 3]).with_stride([2, 2]).with_padding([1, 1]);
                    max_pool2d(maps[0].clone(), pool)
                }
                _ => f.transition[i - 1].forward(maps[i].clone()),
            };
            let add = |x: Tensor<4>, layer: &DenseLayer| Tensor::cat(vec![x.clone(), layer.forward(x)], 1);
            maps.push(block.denselayer.iter().fold(x, add));
        }
        if let Some(norm5) = &f.norm5
            && let Some(last) = maps.pop()
        {
            maps.push(norm5.forward_rectified(last, None, 0.0));
        }
        maps
    }

    /// From `batch x 3 x height x width` to `batch x classes` logits; `None` if the network has no classifier.
    pub fn classify(&self, x: Tensor<4>) -> Option<Tensor<2>> {
        self.classify_map(self.features(x).pop()?)
    }

    /// Logits from the last of [`Self::features`].
    pub fn classify_map(&self, map: Tensor<4>) -> Option<Tensor<2>> {
        let classifier = self.classifier.as_ref()?;
        let [batch, channels, ..] = map.dims();
        Some(classifier.forward(map.mean_dim(3).mean_dim(2).reshape([batch, channels])))
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
        let network = DenseNet121Config::imagenet().init(0, &Device::default());
        // torchvision's 7 978 856 parameters and 2 x 41 824 running statistics.
        assert_eq!(network.num_params(), 7_978_856 + 2 * 41_824);
    }

    #[test]
    fn maps_have_their_shapes() {
        let device = Device::default();
        let network = DenseNet121Config { blocks: 4, classes: Some(7) }.init(1, &device);
        let shapes: Vec<_> = network.features(input(&device)).iter().map(|m| m.dims()).collect();
        let expected = [[2, 64, 32, 32], [2, 256, 16, 16], [2, 512, 8, 8], [2, 1024, 4, 4], [2, 1024, 2, 2]];
        assert_eq!(shapes, expected);
        assert_eq!(network.classify(input(&device)).unwrap().dims(), [2, 7]);
        let part = DenseNet121Config::features(2).init(1, &device).features(input(&device));
        assert_eq!(part.len(), 3);
        assert_eq!(DenseNet121Config::features(0).init(1, &device).features(input(&device)).len(), 1);
    }

    #[test]
    fn names_are_those_of_torchvision() {
        let both = names("features.denseblock.0.denselayer.11.norm1.weight");
        let expected = [
            "features.denseblock1.denselayer12.norm1.weight",
            "features.denseblock1.denselayer12.norm.1.weight",
        ];
        assert_eq!(both, expected);
        assert_eq!(names("features.transition.2.conv.weight"), ["features.transition3.conv.weight"]);
        assert_eq!(names("classifier.bias"), ["classifier.bias"]);
    }
}
