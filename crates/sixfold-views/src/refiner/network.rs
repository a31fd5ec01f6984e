//! The network: for every cell of a render, where the crop shows the same point of the object, and how sure that is.

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

/// How far from a cell features of the crop are compared with its own, cells.
pub const REACH: usize = 3;
/// Products with the features about a cell.
pub(crate) const PRODUCTS: usize = (2 * REACH + 1) * (2 * REACH + 1);
/// Numbers for every cell: its features in the render and in the crop, products, whether it shows the object.
pub(crate) const CELL_INPUTS: usize = 2 * CHANNELS + PRODUCTS + 1;
/// Planes of a picture: the render, the crop, and where the render shows the object.
pub(crate) const PICTURE_INPUTS: usize = 2 * INPUTS + 1;
/// Numbers that come out for every cell: displacement (x, y), logarithm of its spread, and the logits that the crop shows the
/// cell's point near, and that it shows it right there.
pub(crate) const OUTPUTS: usize = 5;

/// The weights within the program; their card lies beside them.
const WEIGHTS: &[u8] = include_bytes!("../../weights/refiner.safetensors");

/// Channels of the layers behind both inputs.
const WIDTH: usize = 80;
/// Channels of what is drawn from the cells' features, and from the pictures.
const FROM_CELLS: usize = 64;
const DETAIL: [usize; 3] = [24, 32, 48];
/// Layers that add to what they get.
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

    /// The network within the program.
    ///
    /// # Errors
    /// [`WeightsError`] if the program carries other weights than its own version's.
    pub fn shipped(device: &Device) -> Result<RefinerNetwork, WeightsError> {
        let name = Path::new("refiner.safetensors");
        Ok(load_weights_from_bytes(RefinerNetwork::random(0, device), name, WEIGHTS, ARCHITECTURE)?.0)
    }

    /// A network that `sixfold train refiner` wrote, with its card.
    ///
    /// # Errors
    /// [`WeightsError`].
    pub fn load(path: &Path, device: &Device) -> Result<(RefinerNetwork, ModelCard), WeightsError> {
        load_weights(RefinerNetwork::random(0, device), path, ARCHITECTURE)
    }

    /// `pairs x OUTPUTS x side / 8 x side / 8` from pictures, `pairs x PICTURE_INPUTS x side x side`, and cells, `pairs x CELL_INPUTS x
    /// side / 8 x side / 8`.
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
