//! GPD's network (Ten Pas et al. 2017, section 5): LeNet, two convolutions with pooling and two dense layers. It has 32x32 pixels
//! instead of 60x60, and 96 hidden units instead of 500: a quarter of the computation, 0.6 MB.

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::activation::relu;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sixfold_grasp::learned::{CHANNELS, SIDE};
use sixfold_nn::dense::dense;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig};

/// Name of the architecture in weight files.
pub(crate) const ARCHITECTURE: &str = "gpd-compact";
/// Maps of both convolutions, as in the paper.
const MAPS: [usize; 2] = [20, 50];
/// Units of the hidden dense layer.
const HIDDEN: usize = 96;

/// Sizes of the network.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GpdConfig;

impl GpdConfig {
    /// The network with random weights.
    pub(crate) fn init(&self, seed: u64, device: &Device) -> Gpd {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let mut conv = |channels| ConvConfig::new(channels, 5, Activation::Relu).init(2.0, rng, device);
        let (first, second) = (conv([CHANNELS, MAPS[0]]), conv(MAPS));
        let smallest = (SIDE / 4).pow(2);
        Gpd {
            first,
            second,
            hidden: dense([MAPS[1] * smallest, HIDDEN], rng, device),
            out: dense([HIDDEN, 1], rng, device),
        }
    }
}

/// The network, created by `GpdConfig`.
#[derive(Module, Debug)]
#[module(custom_display)]
pub(crate) struct Gpd {
    first: Conv,
    second: Conv,
    hidden: Linear,
    out: Linear,
}

sixfold_nn::displayed_by_name!(Gpd);

impl Gpd {
    /// From images, `batch x 15 x 32 x 32`, 0 to 1, to logits of the success probability, `batch`.
    pub(crate) fn forward(&self, images: Tensor<4>) -> Tensor<1> {
        let pool = |x: Tensor<4>| max_pool2d(x, MaxPoolOptions::new([2, 2]));
        let x = pool(self.second.forward(pool(self.first.forward(images))));
        let [batch, channels, height, width] = x.dims();
        let x = relu(self.hidden.forward(x.reshape([batch, channels * height * width])));
        self.out.forward(x).reshape([batch])
    }
}
