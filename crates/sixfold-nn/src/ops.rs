//! The kernels as operations of Burn: a backend extension with gradients, so that training and inference use the same network
//! definition.
//!
//! Burn's `flex` backend derives the gradients of a convolution from further convolutions, which is slow; these use matrix products
//! over patches instead, and a single pass for bias and activation.

use crate::device::has_kernels;
use crate::kernels::{
    ConvShape, ConvSpec, Upsampling, conv_backward, conv_forward, upsample_2x, upsample_2x_backward,
};
use crate::portable;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::tensor::{DType, Shape, Tensor};
use burn_flex::{FlexTensor, Layout};

/// Operations that this crate adds to a backend.
#[backend_extension(Flex, Autodiff)]
pub trait SixfoldOps: Backend {
    /// `activation(conv(x, weight) + bias)`.
    fn sixfold_conv(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        spec: ConvSpec,
    ) -> FloatTensor<Self>;

    /// Gradients with respect to input, weight and bias; those not requested are tensors of length 0.
    fn sixfold_conv_backward(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        y: FloatTensor<Self>,
        dy: FloatTensor<Self>,
        spec: ConvSpec,
        wanted: [bool; 2],
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);

    /// Every pixel becomes 2x2 pixels.
    fn sixfold_upsample(x: FloatTensor<Self>, kind: Upsampling) -> FloatTensor<Self>;

    /// The gradient with respect to the small image.
    fn sixfold_upsample_backward(dy: FloatTensor<Self>, kind: Upsampling) -> FloatTensor<Self>;
}

fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.as_slice::<f32>().is_some() { tensor } else { tensor.to_contiguous() }
}

fn values(tensor: &FlexTensor) -> &[f32] {
    tensor
        .as_slice::<f32>()
        .unwrap_or_else(|| panic!("convolution needs f32 tensors, found {:?}", tensor.dtype()))
}

fn tensor(values: Vec<f32>, shape: impl Into<Shape>) -> FlexTensor {
    FlexTensor::new(burn::tensor::Bytes::from_elems(values), Layout::contiguous(shape.into()), DType::F32)
}

fn conv_shape(x: &FlexTensor, weight: &FlexTensor) -> ConvShape {
    let (x, w) = (x.shape(), weight.shape());
    ConvShape { batch: x[0], inputs: x[1], outputs: w[0], size: [x[2], x[3]], kernel: w[2] }
}

impl SixfoldOps for Flex {
    fn sixfold_conv(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        spec: ConvSpec,
    ) -> FloatTensor<Self> {
        let (x, weight, bias) = (contiguous(x), contiguous(weight), contiguous(bias));
        let shape = conv_shape(&x, &weight);
        let [height, width] = shape.output_size(&spec);
        let y = conv_forward(values(&x), values(&weight), values(&bias), &shape, &spec);
        tensor(y, [shape.batch, shape.outputs, height, width])
    }

    fn sixfold_conv_backward(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        y: FloatTensor<Self>,
        dy: FloatTensor<Self>,
        spec: ConvSpec,
        wanted: [bool; 2],
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>) {
        let (x, weight, y, dy) = (contiguous(x), contiguous(weight), contiguous(y), contiguous(dy));
        let shape = conv_shape(&x, &weight);
        let gradients =
            conv_backward(values(&x), values(&weight), values(&y), values(&dy), &shape, &spec, wanted);
        let or_empty = |values: Vec<f32>, shape: Shape| {
            if values.is_empty() { tensor(values, [0]) } else { tensor(values, shape) }
        };
        (
            or_empty(gradients.x, x.shape()),
            or_empty(gradients.weight, weight.shape()),
            or_empty(gradients.bias, Shape::from([shape.outputs])),
        )
    }

    fn sixfold_upsample(x: FloatTensor<Self>, kind: Upsampling) -> FloatTensor<Self> {
        let x = contiguous(x);
        let s = x.shape();
        tensor(upsample_2x(values(&x), [s[2], s[3]], kind), [s[0], s[1], 2 * s[2], 2 * s[3]])
    }

    fn sixfold_upsample_backward(dy: FloatTensor<Self>, kind: Upsampling) -> FloatTensor<Self> {
        let dy = contiguous(dy);
        let s = dy.shape();
        let small = [s[2] / 2, s[3] / 2];
        tensor(upsample_2x_backward(values(&dy), small, kind), [s[0], s[1], small[0], small[1]])
    }
}

#[derive(Debug)]
struct ConvBackward;

impl<B: SixfoldOps> Backward<B, 3> for ConvBackward {
    type State = (FloatTensor<B>, FloatTensor<B>, FloatTensor<B>, ConvSpec);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let [node_x, node_weight, node_bias] = ops.parents;
        let dy = grads.consume::<B>(&ops.node);
        let (x, weight, y, spec) = ops.state;
        let wanted = [node_x.is_some(), node_weight.is_some() || node_bias.is_some()];
        let (dx, dweight, dbias) = B::sixfold_conv_backward(x, weight, y, dy, spec, wanted);
        for (node, gradient) in [(node_x, dx), (node_weight, dweight), (node_bias, dbias)] {
            if let Some(node) = node {
                grads.register::<B>(node.id, gradient);
            }
        }
    }
}

#[derive(Debug)]
struct UpsampleBackward;

impl<B: SixfoldOps> Backward<B, 1> for UpsampleBackward {
    type State = Upsampling;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let [node] = ops.parents;
        let dy = grads.consume::<B>(&ops.node);
        if let Some(node) = node {
            grads.register::<B>(node.id, B::sixfold_upsample_backward(dy, ops.state));
        }
    }
}

impl<B: SixfoldOps, C: CheckpointStrategy> SixfoldOps for Autodiff<B, C> {
    fn sixfold_conv(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        spec: ConvSpec,
    ) -> FloatTensor<Self> {
        let nodes = [x.node(), weight.node(), bias.node()];
        let (x, weight, bias) = (x.primitive().clone(), weight.primitive().clone(), bias.primitive().clone());
        match ConvBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let y = B::sixfold_conv(x.clone(), weight.clone(), bias, spec);
                prep.finish((x, weight, y.clone(), spec), y)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::sixfold_conv(x, weight, bias, spec)),
        }
    }

    fn sixfold_conv_backward(
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: ConvSpec,
        _: [bool; 2],
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>) {
        unreachable!("second derivatives of convolutions are not needed and not implemented")
    }

    fn sixfold_upsample(x: FloatTensor<Self>, kind: Upsampling) -> FloatTensor<Self> {
        let nodes = [x.node()];
        match UpsampleBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish(kind, B::sixfold_upsample(x.primitive().clone(), kind)),
            OpsKind::UnTracked(prep) => prep.finish(B::sixfold_upsample(x.primitive().clone(), kind)),
        }
    }

    fn sixfold_upsample_backward(_: FloatTensor<Self>, _: Upsampling) -> FloatTensor<Self> {
        unreachable!("second derivatives of upsampling are not needed and not implemented")
    }
}

/// `activation(conv(x, weight) + bias)`: `x` is `batch x inputs x height x width`, `weight`
/// `outputs x inputs / groups x kernel x kernel`, `bias` `outputs`.
///
/// # Panics
/// If the shapes are inconsistent, like Burn's own convolution.
pub fn conv(x: Tensor<4>, weight: Tensor<4>, bias: Tensor<1>, spec: ConvSpec) -> Tensor<4> {
    let ([_, inputs, ..], [outputs, per_group, kernel, second], [biases]) =
        (x.dims(), weight.dims(), bias.dims());
    assert!(
        biases == outputs
            && kernel == second
            && (spec.groups == 1 || (spec.groups == inputs && inputs == outputs))
            && per_group * spec.groups == inputs,
        "convolution: input {:?}, weight {:?}, bias {biases}, groups {} do not fit",
        x.dims(),
        weight.dims(),
        spec.groups
    );
    if !has_kernels(&x.device()) {
        return portable::conv(x, weight, bias, spec);
    }
    Tensor::from_dispatch(Dispatch::sixfold_conv(
        x.into_dispatch(),
        weight.into_dispatch(),
        bias.into_dispatch(),
        spec,
    ))
}

/// Upsamples an image by two, repeating pixels: `batch x channels x height x width` to twice the rows and columns.
pub fn upsample(x: Tensor<4>) -> Tensor<4> {
    upsampled(x, Upsampling::Repeated)
}

/// Upsamples an image by two bilinearly, as PyTorch's `interpolate` without aligned corners: `batch x channels x height x width` to
/// twice the rows and columns.
pub fn doubled(x: Tensor<4>) -> Tensor<4> {
    upsampled(x, Upsampling::Bilinear)
}

fn upsampled(x: Tensor<4>, kind: Upsampling) -> Tensor<4> {
    if !has_kernels(&x.device()) {
        return portable::upsample(x, kind);
    }
    Tensor::from_dispatch(Dispatch::sixfold_upsample(x.into_dispatch(), kind))
}

/// Rearranges channels to pixels: `batch x (factor * factor * c) x h x w` to `batch x c x (factor * h) x (factor * w)` (Shi et al.
/// 2016).
///
/// # Panics
/// If the number of channels is not a multiple of `factor * factor`.
pub fn pixel_shuffle(x: Tensor<4>, factor: usize) -> Tensor<4> {
    let [batch, channels, height, width] = x.dims();
    let c = channels / (factor * factor);
    x.reshape([batch, c, factor, factor, height, width]).permute([0, 1, 4, 2, 5, 3]).reshape([
        batch,
        c,
        factor * height,
        factor * width,
    ])
}
