//! Layers over the crate's own operations: a convolution with bias and activation in one pass.

use crate::kernels::{Activation, ConvSpec};
use crate::ops::conv;
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData};
use rand::Rng;

/// Padding of a convolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Padding {
    /// TensorFlow's `SAME`: the output has `ceil(side / stride)` pixels; with a stride of two there may be more zeros after than
    /// before.
    Same,
    /// This many zeros on every side.
    Zeros(usize),
}

/// A square convolution's sizes and options.
#[derive(Debug, Clone, Copy)]
pub struct ConvConfig {
    /// Input channels.
    pub inputs: usize,
    /// Output channels.
    pub outputs: usize,
    /// Side of the kernel in pixels.
    pub kernel: usize,
    /// Step in pixels.
    pub stride: usize,
    /// Whether there is one kernel per channel instead of one over all channels.
    pub depthwise: bool,
    /// Padding at the border.
    pub padding: Padding,
    /// Applied to the result.
    pub activation: Activation,
}

impl ConvConfig {
    /// A dense convolution with stride 1 and `SAME` border.
    pub fn new([inputs, outputs]: [usize; 2], kernel: usize, activation: Activation) -> Self {
        Self { inputs, outputs, kernel, stride: 1, depthwise: false, padding: Padding::Same, activation }
    }

    /// A depthwise convolution with `SAME` border.
    pub fn depthwise(channels: usize, kernel: usize, stride: usize, activation: Activation) -> Self {
        let padding = Padding::Same;
        Self { inputs: channels, outputs: channels, kernel, stride, depthwise: true, padding, activation }
    }

    /// The same with another stride.
    pub fn with_stride(self, stride: usize) -> Self {
        Self { stride, ..self }
    }

    /// Shape of the weights: `outputs x inputs / groups x kernel x kernel`.
    pub fn weight_shape(&self) -> [usize; 4] {
        [self.outputs, if self.depthwise { 1 } else { self.inputs }, self.kernel, self.kernel]
    }

    /// A layer with random weights of variance `gain / fan-in` (He et al. 2015 for a gain of 2) and zero bias.
    pub fn init(&self, gain: f32, rng: &mut impl Rng, device: &Device) -> Conv {
        let shape = self.weight_shape();
        let deviation = (gain / (shape[1] * shape[2] * shape[3]) as f32).sqrt();
        let weight = (0..shape.iter().product()).map(|_| deviation * normal(rng)).collect();
        self.with_values(weight, vec![0.0; self.outputs], device)
    }

    /// A layer with the given weights (in the order of [`ConvConfig::weight_shape`]) and bias.
    ///
    /// # Panics
    /// If a length is wrong.
    pub fn with_values(&self, weight: Vec<f32>, bias: Vec<f32>, device: &Device) -> Conv {
        Conv {
            weight: Param::from_tensor(Tensor::from_data(
                TensorData::new(weight, self.weight_shape()),
                device,
            )),
            bias: Param::from_tensor(Tensor::from_data(TensorData::new(bias, [self.outputs]), device)),
            stride: self.stride,
            depthwise: self.depthwise,
            padding: self.padding,
            activation: self.activation,
        }
    }
}

pub use sixfold_geometry::random::normal;

/// `activation(conv(x) + bias)`, created by [`ConvConfig`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Conv {
    /// `outputs x inputs / groups x kernel x kernel`.
    pub weight: Param<Tensor<4>>,
    /// `outputs`.
    pub bias: Param<Tensor<1>>,
    stride: usize,
    depthwise: bool,
    #[module(skip)]
    padding: Padding,
    #[module(skip)]
    activation: Activation,
}

crate::displayed_by_name!(Conv);

impl Conv {
    /// From `batch x inputs x height x width` to `batch x outputs x height / stride x width / stride`.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let [_, inputs, height, width] = x.dims();
        let weight = self.weight.val();
        let kernel = weight.dims()[2];
        let padding = match self.padding {
            Padding::Zeros(n) => [n, n],
            Padding::Same => {
                let padding = ConvSpec::same(height, kernel, self.stride);
                assert_eq!(
                    padding,
                    ConvSpec::same(width, kernel, self.stride),
                    "a convolution with SAME border and stride {} needs rows and columns of one parity, found \
                     {height}x{width}",
                    self.stride
                );
                padding
            }
        };
        let groups = if self.depthwise { inputs } else { 1 };
        let spec = ConvSpec { stride: self.stride, padding, groups, activation: self.activation };
        conv(x, weight, self.bias.val(), spec)
    }
}
