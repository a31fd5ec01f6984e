//! The network: XFeat's backbone, extended to colour input and trained further so that the same point of an object has the same
//! feature in renders and photographs.

use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig, Padding};
use sixfold_nn::weights::{ModelCard, WeightsError, load_weights, load_weights_from_bytes};
use sixfold_nn::xfeat::{Backbone, STEM_CHANNELS, XFeat};

/// Name of the network in weight files.
pub(crate) const ARCHITECTURE: &str = "views-xfeat-colour";

/// Channels of the input: grey, and two of colour.
pub(crate) const INPUTS: usize = 3;
/// Side of the stem's cells, pixels.
const STEM_CELL: usize = 4;

/// The shipped weights; their card is next to them.
const WEIGHTS: &[u8] = include_bytes!("../weights/views.safetensors");

/// The hash of the shipped weights.
pub(crate) fn shipped_hash() -> u64 {
    sixfold_io::fnv1a(WEIGHTS)
}

/// Features of crops, 64 numbers for every 8x8 pixels.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct ViewNetwork {
    backbone: Backbone,
    colour: Conv,
}

sixfold_nn::displayed_by_name!(ViewNetwork);

impl ViewNetwork {
    /// XFeat with its authors' weights; the colour channels have no influence yet.
    ///
    /// # Errors
    /// [`WeightsError`] if the shipped weights have another version than the program.
    pub fn untrained(device: &Device) -> Result<ViewNetwork, WeightsError> {
        let config = ConvConfig {
            padding: Padding::Zeros(0),
            ..ConvConfig::new([INPUTS - 1, STEM_CHANNELS], STEM_CELL, Activation::Linear)
                .with_stride(STEM_CELL)
        };
        let zeros = vec![0.0; config.weight_shape().iter().product()];
        let colour = config.with_values(zeros, vec![0.0; STEM_CHANNELS], device);
        Ok(ViewNetwork { backbone: XFeat::shipped(device)?.into_backbone(), colour })
    }

    /// The shipped network.
    ///
    /// # Errors
    /// [`WeightsError`] if the shipped weights have another version than the program.
    pub fn shipped(device: &Device) -> Result<ViewNetwork, WeightsError> {
        let name = Path::new("views.safetensors");
        Ok(load_weights_from_bytes(ViewNetwork::untrained(device)?, name, WEIGHTS, ARCHITECTURE)?.0)
    }

    /// A network written by `sixfold train views`, with its card.
    ///
    /// # Errors
    /// [`WeightsError`].
    pub fn load(path: &Path, device: &Device) -> Result<(ViewNetwork, ModelCard), WeightsError> {
        load_weights(ViewNetwork::untrained(device)?, path, ARCHITECTURE)
    }

    /// Features before normalisation to length 1, `batch x 64 x side / 8 x side / 8`, of inputs from `input`, `batch x 3 x side x
    /// side`; sides are multiples of 32 pixels.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let grey = x.clone().narrow(1, 0, 1);
        let colour = x.narrow(1, 1, INPUTS - 1);
        self.backbone.features(self.backbone.stem(grey) + self.colour.forward(colour))
    }
}

/// The network's input for a planar colour crop (0 to 1): grey values with mean 0 and variance 1, and the differences of red from
/// green and of blue from both, on the same scale; all of these are invariant to exposure.
pub(crate) fn input(planes: &[f32]) -> Vec<f32> {
    let area = planes.len() / 3;
    let (red, rest) = planes.split_at(area);
    let (green, blue) = rest.split_at(area);
    let mut out = Vec::with_capacity(3 * area);
    out.extend((0..area).map(|i| (red[i] + green[i] + blue[i]) / 3.0));
    let mean = out.iter().map(|v| f64::from(*v)).sum::<f64>() / area.max(1) as f64;
    let square = out.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / area.max(1) as f64;
    let (mean, scale) = (mean as f32, 1.0 / (square as f32 + 1e-5).sqrt());
    out.iter_mut().for_each(|v| *v = (*v - mean) * scale);
    out.extend((0..area).map(|i| (red[i] - green[i]) * scale));
    out.extend((0..area).map(|i| (blue[i] - 0.5 * (red[i] + green[i])) * scale));
    out
}
