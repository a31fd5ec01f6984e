//! A convolution without bias followed by batch normalisation, a residual and a rectifier: the building block of ResNets
//! and DenseNets.
//!
//! In training the normalisation uses the batch's statistics; in inference, and if the layer is frozen, it is folded into the
//! convolution.

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData, activation};
use rand::Rng;

use crate::batch_norm::BatchNorm;
use crate::kernels::{Activation, ConvSpec};
use crate::layers::normal;
use crate::ops::conv;

/// Sizes of a [`BareConv`].
#[derive(Debug, Clone, Copy)]
pub struct BareConvConfig {
    /// Channels in and out.
    pub channels: [usize; 2],
    /// Side of the kernel in pixels.
    pub kernel: usize,
    /// Step in pixels.
    pub stride: usize,
    /// Zeros before and after each row and column.
    pub padding: [usize; 2],
}

impl BareConvConfig {
    /// An odd kernel with a border of zeros that keeps the size, stride 1.
    pub fn new(channels: [usize; 2], kernel: usize) -> Self {
        BareConvConfig { channels, kernel, stride: 1, padding: [kernel / 2; 2] }
    }

    /// The same with another stride.
    pub fn with_stride(self, stride: usize) -> Self {
        BareConvConfig { stride, ..self }
    }

    /// The same with another border.
    pub fn with_padding(self, padding: [usize; 2]) -> Self {
        BareConvConfig { padding, ..self }
    }

    /// A layer with random weights of variance 2 / (outputs x kernel x kernel) (He et al. 2015, as PyTorch's ResNet).
    pub fn init(&self, rng: &mut impl Rng, device: &Device) -> BareConv {
        let [inputs, outputs] = self.channels;
        let shape = [outputs, inputs, self.kernel, self.kernel];
        let deviation = (2.0 / (outputs * self.kernel * self.kernel) as f32).sqrt();
        let weight: Vec<f32> = (0..shape.iter().product()).map(|_| deviation * normal(rng)).collect();
        BareConv {
            weight: Param::from_tensor(Tensor::from_data(TensorData::new(weight, shape), device)),
            stride: self.stride,
            padding: self.padding,
        }
    }
}

/// A convolution without bias, created by [`BareConvConfig`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct BareConv {
    /// `outputs x inputs x kernel x kernel`.
    pub weight: Param<Tensor<4>>,
    stride: usize,
    padding: [usize; 2],
}

crate::displayed_by_name!(BareConv);

impl BareConv {
    fn apply(&self, x: Tensor<4>, weight: Tensor<4>, bias: Tensor<1>, activation: Activation) -> Tensor<4> {
        let spec = ConvSpec { stride: self.stride, padding: self.padding, groups: 1, activation };
        conv(x, weight, bias, spec)
    }

    /// From `batch x inputs x height x width` to `batch x outputs x height / stride x width / stride`.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let weight = self.weight.val();
        let bias = Tensor::zeros([weight.dims()[0]], &x.device());
        self.apply(x, weight, bias, Activation::Linear)
    }

    /// `rectify(norm(conv(x)) + residual)`, where values below zero are multiplied by `slope` (0 for ReLU, 1 for none).
    pub fn forward_norm(
        &self,
        x: Tensor<4>,
        norm: &BatchNorm,
        residual: Option<Tensor<4>>,
        slope: f32,
    ) -> Tensor<4> {
        if norm.is_training(&x) {
            return norm.forward_rectified(self.forward(x), residual, slope);
        }
        let (weight, bias) = norm.fold(self.weight.val());
        if residual.is_none() && slope == 0.0 {
            return self.apply(x, weight, bias, Activation::Relu);
        }
        let y = self.apply(x, weight, bias, Activation::Linear);
        let y = match residual {
            Some(residual) => y + residual,
            None => y,
        };
        match slope {
            1.0 => y,
            0.0 => activation::relu(y),
            slope => activation::leaky_relu(y, f64::from(slope)),
        }
    }
}
