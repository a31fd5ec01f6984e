//! Transposed convolution, the learned upsampling of generators, as an operation of Burn with its gradient.
//!
//! It is the input gradient of a convolution, and its own input gradient is that convolution: both are the kernels of
//! [`crate::kernels`] with input and output exchanged.

// Burn's extensions take every tensor as a separate argument.
#![allow(clippy::too_many_arguments)]

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::module::{Module, Param};
use burn::tensor::{DType, Device, Shape, Tensor, TensorData};
use burn_flex::{FlexTensor, Layout};
use rand::Rng;

use crate::device::has_kernels;
use crate::kernels::{Activation, ConvShape, ConvSpec, conv_backward, conv_forward};
use crate::layers::normal;
use crate::portable;

/// Alignment of output and input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TransposedSpec {
    /// Output pixels per input pixel in both directions.
    pub stride: usize,
    /// Rows and columns cut off before and after, as the padding of the convolution in the opposite direction.
    pub padding: [usize; 2],
}

impl TransposedSpec {
    /// TensorFlow's `SAME`: the output's side is the input's times the stride.
    pub fn same(kernel: usize, stride: usize) -> Self {
        TransposedSpec { stride, padding: ConvSpec::same(stride, kernel, stride) }
    }

    fn conv(&self) -> ConvSpec {
        ConvSpec { stride: self.stride, padding: self.padding, groups: 1, activation: Activation::Linear }
    }

    fn side(&self, input: usize, kernel: usize) -> usize {
        (input - 1) * self.stride + kernel - self.padding[0] - self.padding[1]
    }
}

/// Transposed convolution for a backend.
#[backend_extension(Flex, Autodiff)]
pub trait TransposedConvOps: Backend {
    /// `x` is `batch x inputs x height x width`, `weight` `inputs x outputs x kernel x kernel`.
    fn sixfold_conv_transpose(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        spec: TransposedSpec,
    ) -> FloatTensor<Self>;

    /// Gradients with respect to input and weight; those not requested are tensors of length 0.
    fn sixfold_conv_transpose_backward(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        dy: FloatTensor<Self>,
        spec: TransposedSpec,
        wanted: [bool; 2],
    ) -> (FloatTensor<Self>, FloatTensor<Self>);
}

fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.as_slice::<f32>().is_some() { tensor } else { tensor.to_contiguous() }
}

fn values(tensor: &FlexTensor) -> &[f32] {
    tensor
        .as_slice::<f32>()
        .unwrap_or_else(|| panic!("transposed convolution needs f32 tensors, found {:?}", tensor.dtype()))
}

fn tensor(values: Vec<f32>, shape: impl Into<Shape>) -> FlexTensor {
    FlexTensor::new(burn::tensor::Bytes::from_elems(values), Layout::contiguous(shape.into()), DType::F32)
}

/// The convolution from the output of the transposed one to its input.
fn conv_shape(x: &FlexTensor, weight: &FlexTensor, spec: &TransposedSpec) -> ConvShape {
    let (x, w) = (x.shape(), weight.shape());
    let size = [spec.side(x[2], w[2]), spec.side(x[3], w[2])];
    ConvShape { batch: x[0], inputs: w[1], outputs: w[0], size, kernel: w[2] }
}

impl TransposedConvOps for Flex {
    fn sixfold_conv_transpose(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        spec: TransposedSpec,
    ) -> FloatTensor<Self> {
        let (x, weight) = (contiguous(x), contiguous(weight));
        let shape = conv_shape(&x, &weight, &spec);
        let size = [shape.batch, shape.inputs, shape.size[0], shape.size[1]];
        // Only its length matters; the kernel does not read it for the input's gradient.
        let unread = vec![0.0; size.iter().product()];
        let (x, wanted) = (values(&x), [true, false]);
        let y = conv_backward(&unread, values(&weight), x, x, &shape, &spec.conv(), wanted).x;
        tensor(y, size)
    }

    fn sixfold_conv_transpose_backward(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        dy: FloatTensor<Self>,
        spec: TransposedSpec,
        [want_x, want_weight]: [bool; 2],
    ) -> (FloatTensor<Self>, FloatTensor<Self>) {
        let (x, weight, dy) = (contiguous(x), contiguous(weight), contiguous(dy));
        let shape = conv_shape(&x, &weight, &spec);
        let empty = || tensor(Vec::new(), [0]);
        let dx = if want_x {
            let bias = vec![0.0; shape.outputs];
            tensor(conv_forward(values(&dy), values(&weight), &bias, &shape, &spec.conv()), x.shape())
        } else {
            empty()
        };
        let dweight = if want_weight {
            let (x, wanted) = (values(&x), [false, true]);
            let gradients = conv_backward(values(&dy), values(&weight), x, x, &shape, &spec.conv(), wanted);
            tensor(gradients.weight, weight.shape())
        } else {
            empty()
        };
        (dx, dweight)
    }
}

#[derive(Debug)]
struct TransposedBackward;

impl<B: TransposedConvOps> Backward<B, 2> for TransposedBackward {
    type State = (FloatTensor<B>, FloatTensor<B>, TransposedSpec);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let nodes = ops.parents;
        let dy = grads.consume::<B>(&ops.node);
        let (x, weight, spec) = ops.state;
        let wanted = [nodes[0].is_some(), nodes[1].is_some()];
        let (dx, dweight) = B::sixfold_conv_transpose_backward(x, weight, dy, spec, wanted);
        for (node, gradient) in nodes.into_iter().zip([dx, dweight]) {
            if let Some(node) = node {
                grads.register::<B>(node.id, gradient);
            }
        }
    }
}

impl<B: TransposedConvOps, C: CheckpointStrategy> TransposedConvOps for Autodiff<B, C> {
    fn sixfold_conv_transpose(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        spec: TransposedSpec,
    ) -> FloatTensor<Self> {
        let nodes = [x.node(), weight.node()];
        let (x, weight) = (x.primitive().clone(), weight.primitive().clone());
        match TransposedBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let y = B::sixfold_conv_transpose(x.clone(), weight.clone(), spec);
                prep.finish((x, weight, spec), y)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::sixfold_conv_transpose(x, weight, spec)),
        }
    }

    fn sixfold_conv_transpose_backward(
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: TransposedSpec,
        _: [bool; 2],
    ) -> (FloatTensor<Self>, FloatTensor<Self>) {
        unreachable!("second derivatives of transposed convolutions are not needed and not implemented")
    }
}

/// `x` is `batch x inputs x height x width`, `weight` `inputs x outputs x kernel x kernel`.
///
/// # Panics
/// If the shapes are inconsistent or the padding is larger than the output.
pub fn conv_transpose(x: Tensor<4>, weight: Tensor<4>, spec: TransposedSpec) -> Tensor<4> {
    let ([_, channels, height, width], [inputs, _, kernel, second]) = (x.dims(), weight.dims());
    assert!(
        channels == inputs
            && kernel == second
            && (height.min(width) - 1) * spec.stride + kernel > spec.padding[0] + spec.padding[1]
            && spec.padding.iter().all(|p| *p < kernel),
        "transposed convolution: input {:?}, weight {:?}, {spec:?} do not fit",
        x.dims(),
        weight.dims()
    );
    if !has_kernels(&x.device()) {
        return portable::conv_transpose(x, weight, spec);
    }
    Tensor::from_dispatch(Dispatch::sixfold_conv_transpose(x.into_dispatch(), weight.into_dispatch(), spec))
}

/// Sizes of a [`ConvTranspose`] with TensorFlow's `SAME` border.
#[derive(Debug, Clone, Copy)]
pub struct ConvTransposeConfig {
    /// Channels in and out.
    pub channels: [usize; 2],
    /// Side of the kernel in pixels.
    pub kernel: usize,
    /// Output pixels per input pixel in both directions.
    pub stride: usize,
    /// Whether a bias is added; it has no effect before batch normalisation.
    pub bias: bool,
}

impl ConvTransposeConfig {
    /// A layer with random weights of variance `gain * stride^2 / (inputs x kernel x kernel)` (He et al. 2015 for a gain of 2: this
    /// is the number of terms in each output) and bias 0.
    pub fn init(&self, gain: f32, rng: &mut impl Rng, device: &Device) -> ConvTranspose {
        let [inputs, outputs] = self.channels;
        let shape = [inputs, outputs, self.kernel, self.kernel];
        let terms = inputs * self.kernel * self.kernel;
        let deviation = (gain * (self.stride * self.stride) as f32 / terms as f32).sqrt();
        let weight: Vec<f32> = (0..shape.iter().product()).map(|_| deviation * normal(rng)).collect();
        ConvTranspose {
            weight: Param::from_tensor(Tensor::from_data(TensorData::new(weight, shape), device)),
            bias: self.bias.then(|| Param::from_tensor(Tensor::zeros([outputs], device))),
            stride: self.stride,
        }
    }
}

/// Transposed convolution with TensorFlow's `SAME` border, created by [`ConvTransposeConfig`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct ConvTranspose {
    /// `inputs x outputs x kernel x kernel`.
    pub weight: Param<Tensor<4>>,
    /// `outputs`.
    pub bias: Option<Param<Tensor<1>>>,
    stride: usize,
}

crate::displayed_by_name!(ConvTranspose);

impl ConvTranspose {
    /// From `batch x inputs x height x width` to `batch x outputs x height * stride x width * stride`.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let weight = self.weight.val();
        let [_, outputs, kernel, _] = weight.dims();
        let y = conv_transpose(x, weight, TransposedSpec::same(kernel, self.stride));
        match &self.bias {
            Some(bias) => y + bias.val().reshape([1, outputs, 1, 1]),
            None => y,
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use burn::tensor::module::conv_transpose2d;
    use burn::tensor::ops::ConvTransposeOptions;
    use rand::SeedableRng;

    /// A tensor of this shape with reproducible numbers between -1 and 1.
    pub(crate) fn tensor<const D: usize>(shape: [usize; D], seed: f32, device: &Device) -> Tensor<D> {
        let numbers: Vec<f32> =
            (0..shape.iter().product()).map(|i| ((i * i) as f32 * 0.013 + seed + i as f32).sin()).collect();
        Tensor::from_data(TensorData::new(numbers, shape), device)
    }

    fn close(a: Tensor<4>, b: Tensor<4>, what: &str) {
        assert_eq!(a.dims(), b.dims(), "{what}");
        let scale = b.clone().abs().max().into_scalar::<f32>();
        let largest = (a - b).abs().max().into_scalar::<f32>();
        assert!(largest <= 1e-5 * scale, "{what}: off by {largest}, largest {scale}");
    }

    #[test]
    fn output_and_gradients_are_those_of_burn() {
        let device = Device::default().autodiff();
        // Kernel, stride, symmetric padding, rows and columns that PyTorch adds at the end.
        for (kernel, stride, padding, more) in [(5, 2, 2, 1), (4, 2, 1, 0), (3, 1, 1, 0), (3, 2, 0, 0)] {
            let x = tensor([3, 4, 5, 6], 0.0, &device).require_grad();
            let weight = tensor([4, 7, kernel, kernel], 1.0, &device).require_grad();
            let spec = TransposedSpec { stride, padding: [padding, padding - more] };
            let ours = conv_transpose(x.clone(), weight.clone(), spec);
            let options =
                ConvTransposeOptions::new([stride, stride], [padding, padding], [more, more], [1, 1], 1);
            let burns = conv_transpose2d(x.clone(), weight.clone(), None, options);
            close(portable::conv_transpose(x.clone(), weight.clone(), spec), burns.clone(), "portable");
            close(ours.clone(), burns.clone(), "output");
            let factor = tensor(burns.dims(), 2.0, &device);
            let (a, b) = ((ours * factor.clone()).sum().backward(), (burns * factor).sum().backward());
            close(x.grad(&a).unwrap(), x.grad(&b).unwrap(), "input's gradient");
            close(weight.grad(&a).unwrap(), weight.grad(&b).unwrap(), "weight's gradient");
        }
    }

    #[test]
    fn a_layer_multiplies_the_sides_by_its_stride() {
        let device = Device::default();
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        for kernel in [3, 4, 5] {
            let config = ConvTransposeConfig { channels: [2, 3], kernel, stride: 2, bias: true };
            let y = config.init(2.0, &mut rng, &device).forward(tensor([1, 2, 5, 8], 0.0, &device));
            assert_eq!(y.dims(), [1, 3, 10, 16], "kernel {kernel}");
        }
    }
}
