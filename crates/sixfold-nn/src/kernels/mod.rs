//! Convolution kernels on plain `f32` slices: forward and backward of dense, pointwise and depthwise convolutions
//! with bias and activation in one pass.
//!
//! All images are `channels x height x width`, row-major, batches one image after another. The order of every sum is independent of
//! the number of threads.

mod dense;
mod depthwise;
#[cfg(target_arch = "x86_64")]
mod direct;
mod gather;
mod lstm;
mod roi_align;
mod shared;
mod upsample;

pub use gather::{Places, SampledPixel, neighbours};
pub(crate) use gather::{gather_backward, gather_forward};
pub(crate) use lstm::{lstm_backward, lstm_forward};
pub(crate) use roi_align::roi_align_backward;
pub use roi_align::{Regions, roi_align_forward};
pub use shared::{Activation, ConvSpec};
pub use upsample::Upsampling;
pub(crate) use upsample::{upsample_2x, upsample_2x_backward};

use dense::{dense_backward, dense_forward};
use depthwise::{depthwise_backward, depthwise_forward};

/// Sizes of one convolution: `x` is `batch x inputs x height x width`, the weights are
/// `outputs x inputs / groups x kernel x kernel`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConvShape {
    /// Number of images.
    pub batch: usize,
    /// Input channels.
    pub inputs: usize,
    /// Output channels.
    pub outputs: usize,
    /// Input rows and columns.
    pub size: [usize; 2],
    /// Side of the kernel in pixels.
    pub kernel: usize,
}

impl ConvShape {
    /// Rows and columns of the output.
    pub(crate) fn output_size(&self, spec: &ConvSpec) -> [usize; 2] {
        let side =
            |i: usize| (self.size[i] + spec.padding[0] + spec.padding[1] - self.kernel) / spec.stride + 1;
        [side(0), side(1)]
    }

    fn pixels(&self) -> usize {
        self.size[0] * self.size[1]
    }
}

/// Gradients of a convolution; those not requested are empty.
#[derive(Debug, Default)]
pub struct ConvGradients {
    /// Gradient with respect to the input, in its shape.
    pub x: Vec<f32>,
    /// Gradient with respect to the weights, in their shape.
    pub weight: Vec<f32>,
    /// Gradient with respect to the bias.
    pub bias: Vec<f32>,
}

/// `activation(conv(x, weight) + bias)`.
pub(crate) fn conv_forward(
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    shape: &ConvShape,
    spec: &ConvSpec,
) -> Vec<f32> {
    if spec.groups == 1 {
        #[cfg(target_arch = "x86_64")]
        if let Some(y) = direct::direct_forward(x, weight, bias, shape, spec) {
            return y;
        }
        dense_forward(x, weight, bias, shape, spec)
    } else {
        depthwise_forward(x, weight, bias, shape, spec)
    }
}

/// Gradients of [`conv_forward`], from its output `y` and the gradient `dy` with respect to it.
///
/// `wanted` selects the gradients that are needed: that of the input, and those of weight and bias.
pub(crate) fn conv_backward(
    x: &[f32],
    weight: &[f32],
    y: &[f32],
    dy: &[f32],
    shape: &ConvShape,
    spec: &ConvSpec,
    wanted: [bool; 2],
) -> ConvGradients {
    if spec.groups == 1 {
        dense_backward(x, weight, y, dy, shape, spec, wanted)
    } else {
        depthwise_backward(x, weight, y, dy, shape, spec, wanted)
    }
}
