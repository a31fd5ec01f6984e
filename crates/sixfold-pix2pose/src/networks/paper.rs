//! The dissertation's generator (section 3.2.1): an auto-encoder with skip connections from a colour image of 128 x 128 pixels
//! to object coordinates and expected error of every pixel, 25.7 million parameters.
//!
//! The authors' code has two parallel convolutions in each stage of the encoder and concatenates them; here they are a single one
//! with the sum of the channels, which is the same function. A convolution before batch normalisation has no bias, because it would
//! have no effect.

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::activation::{sigmoid, tanh};
use burn::tensor::{Device, Tensor};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sixfold_nn::batch_norm::{BatchNorm, BatchNormConfig};
use sixfold_nn::conv_norm::{BareConv, BareConvConfig};
use sixfold_nn::conv_transpose::{ConvTranspose, ConvTransposeConfig};
use sixfold_nn::dense::dense;
use sixfold_nn::kernels::ConvSpec;

/// Side of the generator's input and output in pixels.
pub const SIDE: usize = 128;

const KERNEL: usize = 5;
/// Slope of the leaky rectifiers below zero.
const SLOPE: f32 = 0.3;
/// Length of the code (bottleneck).
const CODE: usize = 256;
/// Channels and side of the map on either side of the code.
const BEFORE_CODE: usize = 512;
const AFTER_CODE: usize = 256;
const CODE_SIDE: usize = SIDE / 16;

/// Output of a generator for every pixel.
#[derive(Debug, Clone)]
pub struct GeneratorOutput {
    /// `batch x 3 x 128 x 128`: coordinates in the object's bounding box, in -1..1.
    pub coordinates: Tensor<4>,
    /// `batch x 1 x 128 x 128`: expected error of the coordinates, in 0..1.
    pub error: Tensor<4>,
}

/// The dissertation's generator. Its only option is the seed.
#[derive(Debug, Clone, Copy, Default)]
pub struct PaperGeneratorConfig {
    /// Seed of the random weights.
    pub seed: u64,
}

impl PaperGeneratorConfig {
    /// The network with random weights (He et al. 2015).
    pub fn init(&self, device: &Device) -> PaperGenerator {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        let mut stage = |channels| ConvStage::init(channels, 2, &mut rng, device);
        let encoder = [stage([3, 128]), stage([128, 256]), stage([256, 256]), stage([256, BEFORE_CODE])];
        let [e1, e2, e3, e4] = encoder;
        let decoder = Decoder::init([64, 128, 128], &mut rng, device);
        PaperGenerator { e1, e2, e3, e4, decoder }
    }
}

/// The dissertation's generator, created by [`PaperGeneratorConfig`]. Input: RGB as `(value - 128) / 128` of 8-bit values.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct PaperGenerator {
    e1: ConvStage,
    e2: ConvStage,
    e3: ConvStage,
    e4: ConvStage,
    decoder: Decoder,
}

impl PaperGenerator {
    /// From images, `batch x 3 x 128 x 128`, to coordinates and error.
    pub fn forward(&self, x: Tensor<4>) -> GeneratorOutput {
        let e1 = self.e1.forward(x);
        let e2 = self.e2.forward(e1.clone());
        let e3 = self.e3.forward(e2.clone());
        let e4 = self.e4.forward(e3.clone());
        // The second of the two parallel branches is the skip connection.
        let half = |map: Tensor<4>| {
            let channels = map.dims()[1] / 2;
            map.narrow(1, channels, channels)
        };
        self.decoder.forward(e4, [half(e1), half(e2), half(e3)])
    }
}

/// 5x5 convolution, batch normalisation, leaky rectifier.
#[derive(Module, Debug)]
#[module(custom_display)]
pub(super) struct ConvStage {
    conv: BareConv,
    norm: BatchNorm,
}

impl ConvStage {
    pub(super) fn init(channels: [usize; 2], stride: usize, rng: &mut ChaCha8Rng, device: &Device) -> Self {
        let padding = ConvSpec::same(stride, KERNEL, stride);
        let conv = BareConvConfig::new(channels, KERNEL).with_stride(stride).with_padding(padding);
        ConvStage { conv: conv.init(rng, device), norm: BatchNormConfig::new(channels[1]).init(device) }
    }

    pub(super) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        self.conv.forward_norm(x, &self.norm, None, SLOPE)
    }
}

/// Upsampling by two with a transposed convolution, concatenation with the encoder's map, and a convolution over both.
#[derive(Module, Debug)]
#[module(custom_display)]
struct UpStage {
    up: ConvTranspose,
    norm: BatchNorm,
    conv: ConvStage,
}

impl UpStage {
    fn init([inputs, up, skip, outputs]: [usize; 4], rng: &mut ChaCha8Rng, device: &Device) -> Self {
        let config = ConvTransposeConfig { channels: [inputs, up], kernel: KERNEL, stride: 2, bias: false };
        UpStage {
            up: config.init(2.0, rng, device),
            norm: BatchNormConfig::new(up).init(device),
            conv: ConvStage::init([up + skip, outputs], 1, rng, device),
        }
    }

    fn forward(&self, x: Tensor<4>, skip: Tensor<4>) -> Tensor<4> {
        let x = self.norm.forward_rectified(self.up.forward(x), None, SLOPE);
        self.conv.forward(Tensor::cat(vec![x, skip], 1))
    }
}

/// The part from the map of 8 x 8 pixels through the code to the output; shared by the generators.
#[derive(Module, Debug)]
#[module(custom_display)]
pub(super) struct Decoder {
    code: Linear,
    uncode: Linear,
    d1: UpStage,
    d2: UpStage,
    d3: UpStage,
    coordinates: ConvTranspose,
    error: ConvTranspose,
}

sixfold_nn::displayed_by_name!(PaperGenerator, ConvStage, UpStage, Decoder);

impl Decoder {
    /// `skips`: channels of the encoder's maps at 64, 32 and 16 pixels.
    pub(super) fn init(skips: [usize; 3], rng: &mut ChaCha8Rng, device: &Device) -> Self {
        let pixels = CODE_SIDE * CODE_SIDE;
        let head =
            |outputs| ConvTransposeConfig { channels: [128, outputs], kernel: KERNEL, stride: 2, bias: true };
        Decoder {
            code: dense([BEFORE_CODE * pixels, CODE], rng, device),
            uncode: dense([CODE, AFTER_CODE * pixels], rng, device),
            d1: UpStage::init([AFTER_CODE, 256, skips[2], 256], rng, device),
            d2: UpStage::init([256, 128, skips[1], 256], rng, device),
            d3: UpStage::init([256, 64, skips[0], 128], rng, device),
            coordinates: head(3).init(1.0, rng, device),
            error: head(1).init(1.0, rng, device),
        }
    }

    /// `x` is `batch x 512 x 8 x 8`; the skips have 64, 32 and 16 pixels.
    pub(super) fn forward(&self, x: Tensor<4>, [s1, s2, s3]: [Tensor<4>; 3]) -> GeneratorOutput {
        let batch = x.dims()[0];
        let code = self.code.forward(x.reshape([batch, BEFORE_CODE * CODE_SIDE * CODE_SIDE]));
        let x = self.uncode.forward(code).reshape([batch, AFTER_CODE, CODE_SIDE, CODE_SIDE]);
        let x = self.d3.forward(self.d2.forward(self.d1.forward(x, s3), s2), s1);
        let error = sigmoid(self.error.forward(x.clone()));
        GeneratorOutput { coordinates: tanh(self.coordinates.forward(x)), error }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::optim::GradientsParams;
    use burn::tensor::TensorData;

    #[test]
    fn it_gives_coordinates_and_error_and_all_of_it_learns() {
        let device = Device::default().autodiff();
        let network = PaperGeneratorConfig { seed: 1 }.init(&device);
        assert_eq!(network.num_params() / 100_000, 257);
        let values: Vec<f32> = (0..2 * 3 * SIDE * SIDE).map(|i| ((i * i) as f32 * 1e-3).sin()).collect();
        let x = Tensor::<4>::from_data(TensorData::new(values, [2, 3, SIDE, SIDE]), &device);
        let output = network.forward(x);
        assert_eq!(
            (output.coordinates.dims(), output.error.dims()),
            ([2, 3, SIDE, SIDE], [2, 1, SIDE, SIDE])
        );
        let error: Vec<f32> = output.error.clone().try_into_vec_as().unwrap();
        assert!(error.iter().all(|v| (0.0..=1.0).contains(v)));
        let loss = output.coordinates.square().mean() + output.error.mean();
        let gradients = GradientsParams::from_grads(loss.backward(), &network);
        // Seven convolutions and three transposed ones with weight, scale and offset; two dense layers and two heads with
        // weight and bias.
        assert_eq!(gradients.len(), 10 * 3 + 4 * 2);
    }
}
