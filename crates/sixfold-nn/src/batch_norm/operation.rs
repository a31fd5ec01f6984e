//! Batch normalisation as an operation of Burn, with its gradient: a backend extension like [`crate::ops`].

// Burn's extensions take every tensor as a separate argument.
#![allow(clippy::too_many_arguments)]

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, AutodiffBackend, Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::tensor::{DType, Shape, Tensor};
use burn_flex::{FlexTensor, Layout};

use crate::device::has_kernels;
use crate::portable;

use super::NormOptions;
use super::kernel::{Forward, Planes, Statistics, backward, forward};

/// Batch normalisation for a backend.
#[backend_extension(Flex, Autodiff)]
pub trait BatchNormOps: Backend {
    /// Output, mean and variance. `residual` has length 0 for none; `mean` and `variance` have length 0 if the batch's own are to
    /// be used.
    fn sixfold_batch_norm(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        residual: FloatTensor<Self>,
        mean: FloatTensor<Self>,
        variance: FloatTensor<Self>,
        options: NormOptions,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);

    /// Gradients with respect to input, weight, bias and residual (length 0 for none).
    fn sixfold_batch_norm_backward(
        x: FloatTensor<Self>,
        y: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        mean: FloatTensor<Self>,
        variance: FloatTensor<Self>,
        dy: FloatTensor<Self>,
        options: NormOptions,
        kind: NormKind,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
}

/// Which inputs the forward pass had.
#[derive(Debug, Clone, Copy)]
pub struct NormKind {
    /// Whether a residual was added.
    pub residual: bool,
    /// Whether mean and variance were given.
    pub given: bool,
}

fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.as_slice::<f32>().is_some() { tensor } else { tensor.to_contiguous() }
}

fn values(tensor: &FlexTensor) -> &[f32] {
    tensor
        .as_slice::<f32>()
        .unwrap_or_else(|| panic!("batch normalisation needs f32 tensors, found {:?}", tensor.dtype()))
}

fn tensor(values: Vec<f32>, shape: impl Into<Shape>) -> FlexTensor {
    FlexTensor::new(burn::tensor::Bytes::from_elems(values), Layout::contiguous(shape.into()), DType::F32)
}

fn planes(x: &FlexTensor) -> Planes {
    let s = x.shape();
    Planes { images: s[0], channels: s[1], pixels: s[2] * s[3] }
}

fn per_channel(values: Vec<f32>) -> FlexTensor {
    let length = values.len();
    tensor(values, [length])
}

impl BatchNormOps for Flex {
    fn sixfold_batch_norm(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        residual: FloatTensor<Self>,
        mean: FloatTensor<Self>,
        variance: FloatTensor<Self>,
        options: NormOptions,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>) {
        let [x, weight, bias, residual, mean, variance] =
            [x, weight, bias, residual, mean, variance].map(contiguous);
        let given = (!values(&mean).is_empty())
            .then(|| Statistics { mean: values(&mean).to_vec(), variance: values(&variance).to_vec() });
        let mut y = vec![0.0; values(&x).len()];
        let parameters = [values(&weight), values(&bias)];
        let statistics =
            forward(values(&x), planes(&x), parameters, values(&residual), given, options, &mut y);
        (tensor(y, x.shape()), per_channel(statistics.mean), per_channel(statistics.variance))
    }

    fn sixfold_batch_norm_backward(
        x: FloatTensor<Self>,
        y: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        mean: FloatTensor<Self>,
        variance: FloatTensor<Self>,
        dy: FloatTensor<Self>,
        options: NormOptions,
        kind: NormKind,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>) {
        let [x, y, weight, bias, mean, variance, mut dy] =
            [x, y, weight, bias, mean, variance, dy].map(contiguous);
        let statistics = Statistics { mean: values(&mean).to_vec(), variance: values(&variance).to_vec() };
        let used = Forward {
            x: values(&x),
            y: values(&y),
            weight: values(&weight),
            bias: values(&bias),
            statistics: &statistics,
            given: kind.given,
        };
        let length = values(&x).len();
        let mut dx = vec![0.0; if kind.residual { length } else { 0 }];
        // In place if the gradient is not shared, otherwise in a copy.
        let gradient = &mut dy.storage_mut::<f32>()[..length];
        let gradients = backward(&used, planes(&x), options, gradient, &mut dx);
        let (weight, bias) = (per_channel(gradients.weight), per_channel(gradients.bias));
        if kind.residual {
            (tensor(dx, x.shape()), weight, bias, dy)
        } else {
            (dy, weight, bias, per_channel(Vec::new()))
        }
    }
}

#[derive(Debug)]
struct BatchNormBackward;

impl<B: BatchNormOps> Backward<B, 4> for BatchNormBackward {
    /// Input, output, weight, bias, mean, variance.
    type State = ([FloatTensor<B>; 6], NormOptions, NormKind);

    fn backward(self, ops: Ops<Self::State, 4>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let nodes = ops.parents;
        let dy = grads.consume::<B>(&ops.node);
        let ([x, y, weight, bias, mean, variance], options, kind) = ops.state;
        let (dx, dweight, dbias, dresidual) =
            B::sixfold_batch_norm_backward(x, y, weight, bias, mean, variance, dy, options, kind);
        for (node, gradient) in nodes.into_iter().zip([dx, dweight, dbias, dresidual]) {
            if let Some(node) = node {
                grads.register::<B>(node.id, gradient);
            }
        }
    }
}

impl<B: BatchNormOps, C: CheckpointStrategy> BatchNormOps for Autodiff<B, C> {
    fn sixfold_batch_norm(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        residual: FloatTensor<Self>,
        mean: FloatTensor<Self>,
        variance: FloatTensor<Self>,
        options: NormOptions,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>) {
        let nodes = [x.node(), weight.node(), bias.node(), residual.node()];
        let [x, weight, bias, residual, mean, variance] =
            [x, weight, bias, residual, mean, variance].map(|t| t.primitive().clone());
        let kind = NormKind {
            residual: residual.shape().num_elements() > 0,
            given: mean.shape().num_elements() > 0,
        };
        let (state, prep) = match BatchNormBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                (Some((x.clone(), weight.clone(), bias.clone())), OpsKind::Tracked(prep))
            }
            OpsKind::UnTracked(prep) => (None, OpsKind::UnTracked(prep)),
        };
        let (y, mean, variance) = B::sixfold_batch_norm(x, weight, bias, residual, mean, variance, options);
        let (kept_mean, kept_variance) = (mean.clone(), variance.clone());
        let output = match (prep, state) {
            (OpsKind::Tracked(prep), Some((x, weight, bias))) => {
                let kept_y = if kind.residual { y.clone() } else { x.clone() };
                prep.finish(([x, kept_y, weight, bias, kept_mean, kept_variance], options, kind), y)
            }
            (OpsKind::UnTracked(prep), _) => prep.finish(y),
            (OpsKind::Tracked(_), None) => unreachable!("a tracked operation keeps its state"),
        };
        (output, Self::from_inner(mean), Self::from_inner(variance))
    }

    fn sixfold_batch_norm_backward(
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: NormOptions,
        _: NormKind,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>) {
        unreachable!("second derivatives of batch normalisation are not needed and not implemented")
    }
}

/// Output, mean and variance of [`BatchNormOps::sixfold_batch_norm`] for `x` of `batch x channels x height x width`.
pub(super) fn batch_norm(
    x: Tensor<4>,
    [weight, bias]: [Tensor<1>; 2],
    residual: Option<Tensor<4>>,
    given: Option<[Tensor<1>; 2]>,
    options: NormOptions,
) -> (Tensor<4>, Tensor<1>, Tensor<1>) {
    let device = x.device();
    if let Some(residual) = &residual {
        assert_eq!(
            x.dims(),
            residual.dims(),
            "batch normalisation: the residual must have the input's shape"
        );
    }
    if !has_kernels(&device) {
        return portable::batch_norm(x, [weight, bias], residual, given, options);
    }
    let residual = residual.unwrap_or_else(|| Tensor::zeros([0, 1, 1, 1], &device));
    let [mean, variance] =
        given.unwrap_or_else(|| [Tensor::zeros([0], &device), Tensor::zeros([0], &device)]);
    let (y, mean, variance) = Dispatch::sixfold_batch_norm(
        x.into_dispatch(),
        weight.into_dispatch(),
        bias.into_dispatch(),
        residual.into_dispatch(),
        mean.into_dispatch(),
        variance.into_dispatch(),
        options,
    );
    (Tensor::from_dispatch(y), Tensor::from_dispatch(mean), Tensor::from_dispatch(variance))
}
