//! The layers of U2-Net-p: a U-shaped network in which every stage is a small U-shaped network.

use burn::module::Module;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor, activation};

use crate::enlarge::{doubled, enlarged};
use crate::kernels::Activation;
use crate::layers::{Conv, ConvConfig, Padding};

/// Sides of images must be multiples of this many pixels.
pub const MULTIPLE: usize = 32;

/// Channels between the stages.
const OUTER: usize = 64;
/// Channels within a stage.
const INNER: usize = 16;
/// Levels of the stages from fine to coarse: the first four halve the map between their levels, the others dilate the kernels.
const LEVELS: [usize; 6] = [7, 6, 5, 4, 4, 4];
/// Number of stages that halve the map between their levels.
const HALVING: usize = 4;

/// One stage: down through its levels, up again, and added to its input ("residual U-block").
#[derive(Module, Debug)]
#[module(custom_display)]
struct Stage {
    input: Conv,
    down: Vec<Conv>,
    /// The layers of the upward path, the deepest first.
    up: Vec<Conv>,
    halves: bool,
}

impl Stage {
    fn empty(inputs: usize, level: usize, device: &Device) -> Stage {
        let levels = LEVELS[level];
        let layer = |inputs, outputs| empty([inputs, outputs], 3, Activation::Relu, device);
        let down = (0..levels).map(|i| layer(if i == 0 { OUTER } else { INNER }, INNER)).collect();
        let up = (1..levels).rev().map(|i| layer(2 * INNER, if i == 1 { OUTER } else { INNER })).collect();
        Stage { input: layer(inputs, OUTER), down, up, halves: level < HALVING }
    }

    /// Distance of the nine pixels of a convolution at a level.
    fn dilation(&self, level: usize) -> usize {
        match (self.halves, level + 1 == self.down.len()) {
            (true, false) => 1,
            (true, true) => 2,
            (false, _) => 1 << level,
        }
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let start = self.input.forward(x);
        let mut maps: Vec<Tensor<4>> = Vec::new();
        let last = self.down.len() - 1;
        let mut x = start.clone();
        for (i, layer) in self.down.iter().enumerate() {
            if self.halves && i > 0 && i < last {
                x = halved(x);
            }
            x = dilated(layer, x, self.dilation(i));
            if i < last {
                maps.push(x.clone());
            }
        }
        for layer in &self.up {
            let Some(map) = maps.pop() else { break };
            let level = maps.len();
            let dilation = if self.halves { 1 } else { self.dilation(level) };
            x = dilated(layer, Tensor::cat(vec![x, map], 1), dilation);
            if self.halves && level > 0 {
                x = doubled(x);
            }
        }
        x + start
    }
}

/// The layers, created by `Layers::empty` and filled from a weight file.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Layers {
    encoder: Vec<Stage>,
    /// The stages of the decoder, the coarsest first.
    decoder: Vec<Stage>,
    /// One map from every stage of the decoder, the finest first, and from the last stage of the encoder.
    sides: Vec<Conv>,
    fusion: Conv,
}

crate::displayed_by_name!(Stage, Layers);

impl Layers {
    /// The layers with zeros as weights.
    pub(super) fn empty(device: &Device) -> Layers {
        let coarsest = LEVELS.len() - 1;
        Layers {
            encoder: (0..=coarsest)
                .map(|i| Stage::empty(if i == 0 { 3 } else { OUTER }, i, device))
                .collect(),
            decoder: (0..coarsest).rev().map(|i| Stage::empty(2 * OUTER, i, device)).collect(),
            sides: LEVELS.map(|_| empty([OUTER, 1], 3, Activation::Linear, device)).into(),
            fusion: empty([LEVELS.len(), 1], 1, Activation::Linear, device),
        }
    }

    /// The salience of each pixel, 0 to 1, `batch x 1 x height x width`: the first of the seven maps that the network is trained
    /// on, which is computed from the other six. `x` is `batch x 3 x height x width`, red, green and blue divided by the largest
    /// value of the image, then normalised by [`MEAN`](super::MEAN) and [`DEVIATION`](super::DEVIATION).
    ///
    /// # Panics
    /// If a side is not a multiple of 32 pixels.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let [_, _, height, width] = x.dims();
        assert!(
            height.is_multiple_of(MULTIPLE) && width.is_multiple_of(MULTIPLE),
            "U2-Net-p takes images whose sides are multiples of {MULTIPLE} pixels, found {height}x{width}"
        );
        let mut maps: Vec<Tensor<4>> = Vec::new();
        let mut x = x;
        for (i, stage) in self.encoder.iter().enumerate() {
            if i > 0 {
                x = halved(x);
            }
            x = stage.forward(x);
            maps.push(x.clone());
        }
        // The decoder starts with the coarsest map.
        maps.pop();
        let side = |level: usize, x: &Tensor<4>| enlarged(self.sides[level].forward(x.clone()), 1 << level);
        let mut sides = vec![side(LEVELS.len() - 1, &x)];
        for stage in &self.decoder {
            let Some(map) = maps.pop() else { break };
            x = stage.forward(Tensor::cat(vec![doubled(x), map], 1));
            sides.push(side(maps.len(), &x));
        }
        sides.reverse();
        activation::sigmoid(self.fusion.forward(Tensor::cat(sides, 1)))
    }
}

fn empty(channels: [usize; 2], kernel: usize, activation: Activation, device: &Device) -> Conv {
    let config =
        ConvConfig { padding: Padding::Zeros(kernel / 2), ..ConvConfig::new(channels, kernel, activation) };
    let count = config.weight_shape().iter().product();
    config.with_values(vec![0.0; count], vec![0.0; channels[1]], device)
}

/// Maximum over blocks of 2x2 pixels.
fn halved(x: Tensor<4>) -> Tensor<4> {
    max_pool2d(x, MaxPoolOptions::new([2, 2]))
}

/// A convolution whose nine pixels are `by` apart: it treats every `by`-th row and column as a separate image.
fn dilated(layer: &Conv, x: Tensor<4>, by: usize) -> Tensor<4> {
    if by == 1 {
        return layer.forward(x);
    }
    let [batch, channels, height, width] = x.dims();
    let (rows, columns) = (height.div_ceil(by), width.div_ceil(by));
    let whole = Tensor::zeros([batch, channels, rows * by, columns * by], &x.device());
    let whole = whole.slice_assign([0..batch, 0..channels, 0..height, 0..width], x);
    let parts = whole
        .reshape([batch, channels, rows, by, columns, by])
        .permute([0, 3, 5, 1, 2, 4])
        .reshape([batch * by * by, channels, rows, columns]);
    let parts = layer.forward(parts);
    let outputs = parts.dims()[1];
    parts
        .reshape([batch, by, by, outputs, rows, columns])
        .permute([0, 3, 4, 1, 5, 2])
        .reshape([batch, outputs, rows * by, columns * by])
        .slice([0..batch, 0..outputs, 0..height, 0..width])
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::module::Param;
    use burn::tensor::Distribution;
    use burn::tensor::module::conv2d;
    use burn::tensor::ops::ConvOptions;

    #[test]
    fn a_dilated_convolution_is_that_of_burn() {
        let device = Device::default();
        for (by, height, width) in [(2, 10, 10), (4, 10, 7), (8, 10, 20)] {
            let mut layer = empty([3, 5], 3, Activation::Linear, &device);
            let weight = Tensor::<4>::random([5, 3, 3, 3], Distribution::Normal(0.0, 1.0), &device);
            let bias = Tensor::<1>::random([5], Distribution::Normal(0.0, 1.0), &device);
            layer.weight = Param::from_tensor(weight.clone());
            layer.bias = Param::from_tensor(bias.clone());
            let x = Tensor::<4>::random([2, 3, height, width], Distribution::Normal(0.0, 1.0), &device);
            let options = ConvOptions::<2>::new([1, 1], [by, by], [by, by], 1);
            let expected = conv2d(x.clone(), weight, Some(bias), options);
            let difference: f32 = (dilated(&layer, x, by) - expected).abs().max().into_scalar();
            assert!(difference < 1e-4, "dilation {by}: {difference}");
        }
    }
}
