//! The network: for every cell of a render, the position of the same point of the object in the crop, with its confidence.

use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use sixfold_geometry::random::stream;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig, Padding};
use sixfold_nn::weights::{ModelCard, WeightsError, load_weights, load_weights_from_bytes};
use sixfold_nn::xfeat::CHANNELS;

use crate::network::INPUTS;

/// Name of the network in weight files.
pub const ARCHITECTURE: &str = "views-refiner";

/// Distance within which features of the crop are compared with that of a cell, cells.
pub const REACH: usize = 3;
/// Number of products with the features around a cell.
pub(crate) const PRODUCTS: usize = (2 * REACH + 1) * (2 * REACH + 1);
/// Inputs per cell: its features in the render and in the crop, products, whether it shows the object.
pub(crate) const CELL_INPUTS: usize = 2 * CHANNELS + PRODUCTS + 1;
/// Planes of the image input: the render, the crop, and the mask of the render.
pub(crate) const PICTURE_INPUTS: usize = 2 * INPUTS + 1;
/// Outputs per cell: displacement (x, y), logarithm of its spread, and the logits that the crop shows the cell's point nearby, and
/// at the same position.
pub(crate) const OUTPUTS: usize = 5;

/// The shipped weights; their card is next to them.
const WEIGHTS: &[u8] = include_bytes!("../../weights/refiner.safetensors");

/// Channels of the layers after both inputs are joined.
const WIDTH: usize = 80;
/// Channels of the layers on the cells' features, and of those on the images.
const FROM_CELLS: usize = 64;
const DETAIL: [usize; 3] = [24, 32, 48];
/// Number of residual layers.
const DEPTH: usize = 5;

/// Compares a render with a crop.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct RefinerNetwork {
    detail: Vec<Conv>,
    cells: Conv,
    join: Conv,
    everywhere: Conv,
    trunk: Vec<Conv>,
    head: Conv,
}

sixfold_nn::displayed_by_name!(RefinerNetwork);

impl RefinerNetwork {
    /// With random weights.
    pub fn random(seed: u64, device: &Device) -> RefinerNetwork {
        let mut random = stream(seed, 0x5EF1_7E12);
        let relu = Activation::Relu;
        let mut conv = |config: ConvConfig, gain: f32| config.init(gain, &mut random, device);
        let [a, b, c] = DETAIL;
        RefinerNetwork {
            detail: vec![
                conv(
                    ConvConfig {
                        padding: Padding::Zeros(0),
                        ..ConvConfig::new([PICTURE_INPUTS, a], 4, relu).with_stride(4)
                    },
                    2.0,
                ),
                conv(ConvConfig::new([a, b], 3, relu), 2.0),
                conv(
                    ConvConfig {
                        padding: Padding::Zeros(1),
                        ..ConvConfig::new([b, c], 3, relu).with_stride(2)
                    },
                    2.0,
                ),
            ],
            cells: conv(ConvConfig::new([CELL_INPUTS, FROM_CELLS], 1, relu), 2.0),
            join: conv(ConvConfig::new([FROM_CELLS + c, WIDTH], 3, relu), 2.0),
            everywhere: conv(ConvConfig::new([WIDTH, WIDTH], 1, Activation::Linear), 1.0),
            trunk: (0..DEPTH).map(|_| conv(ConvConfig::new([WIDTH, WIDTH], 3, relu), 0.5)).collect(),
            head: conv(ConvConfig::new([WIDTH, OUTPUTS], 1, Activation::Linear), 0.1),
        }
    }

    /// The shipped network.
    ///
    /// # Errors
    /// [`WeightsError`] if the shipped weights have another version than the program.
    pub fn shipped(device: &Device) -> Result<RefinerNetwork, WeightsError> {
        let name = Path::new("refiner.safetensors");
        Ok(load_weights_from_bytes(RefinerNetwork::random(0, device), name, WEIGHTS, ARCHITECTURE)?.0)
    }

    /// A network written by `sixfold train refiner`, with its card.
    ///
    /// # Errors
    /// [`WeightsError`].
    pub fn load(path: &Path, device: &Device) -> Result<(RefinerNetwork, ModelCard), WeightsError> {
        load_weights(RefinerNetwork::random(0, device), path, ARCHITECTURE)
    }

    /// `pairs x OUTPUTS x side / 8 x side / 8` from images, `pairs x PICTURE_INPUTS x side x side`, and cells, `pairs x CELL_INPUTS
    /// x side / 8 x side / 8`.
    pub fn forward(&self, pictures: Tensor<4>, cells: Tensor<4>) -> Tensor<4> {
        let detail = self.detail.iter().fold(pictures, |x, layer| layer.forward(x));
        let mut x = self.join.forward(Tensor::cat(vec![self.cells.forward(cells), detail], 1));
        let mean = x.clone().mean_dim(2).mean_dim(3);
        x = x + self.everywhere.forward(mean);
        for layer in &self.trunk {
            x = x.clone() + layer.forward(x);
        }
        self.head.forward(x)
    }
}
