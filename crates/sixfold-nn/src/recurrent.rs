//! Two operations of networks that sample an object in several images: the cell of a convolutional LSTM, and feature maps sampled
//! at given positions. Backend extensions with gradients, like [`crate::ops`].

use std::sync::Arc;

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::tensor::{DType, Shape, Tensor};
use burn_flex::{FlexTensor, Layout};

use crate::device::has_kernels;
use crate::kernels::{Places, gather_backward, gather_forward, lstm_backward, lstm_forward};
use crate::portable;

/// Operations that this file adds to a backend.
#[backend_extension(Flex, Autodiff)]
pub trait RecurrentOps: Backend {
    /// From gates and previous state to hidden state and new state, concatenated along the batch.
    fn sixfold_lstm(gates: FloatTensor<Self>, before: FloatTensor<Self>) -> FloatTensor<Self>;

    /// Gradients with respect to gates and previous state.
    fn sixfold_lstm_backward(
        gates: FloatTensor<Self>,
        before: FloatTensor<Self>,
        out: FloatTensor<Self>,
        dout: FloatTensor<Self>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);

    /// From maps to images of their values at the positions.
    fn sixfold_gather(maps: FloatTensor<Self>, places: Arc<Places>) -> FloatTensor<Self>;

    /// Gradient with respect to maps of this size.
    fn sixfold_gather_backward(
        dout: FloatTensor<Self>,
        places: Arc<Places>,
        size: [usize; 2],
    ) -> FloatTensor<Self>;
}

fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.as_slice::<f32>().is_some() { tensor } else { tensor.to_contiguous() }
}

fn values(tensor: &FlexTensor) -> &[f32] {
    tensor.as_slice::<f32>().unwrap_or_else(|| panic!("expected f32 tensors, found {:?}", tensor.dtype()))
}

fn tensor(values: Vec<f32>, shape: impl Into<Shape>) -> FlexTensor {
    FlexTensor::new(burn::tensor::Bytes::from_elems(values), Layout::contiguous(shape.into()), DType::F32)
}

impl RecurrentOps for Flex {
    fn sixfold_lstm(gates: FloatTensor<Self>, before: FloatTensor<Self>) -> FloatTensor<Self> {
        let (gates, before) = (contiguous(gates), contiguous(before));
        let s = before.shape();
        let out = lstm_forward(values(&gates), values(&before), s[2] * s[3]);
        tensor(out, [2 * s[0], s[1], s[2], s[3]])
    }

    fn sixfold_lstm_backward(
        gates: FloatTensor<Self>,
        before: FloatTensor<Self>,
        out: FloatTensor<Self>,
        dout: FloatTensor<Self>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>) {
        let (gates, before) = (contiguous(gates), contiguous(before));
        let (out, dout) = (contiguous(out), contiguous(dout));
        let s = before.shape();
        let (dgates, dbefore) =
            lstm_backward(values(&gates), values(&before), values(&out), values(&dout), s[2] * s[3]);
        (tensor(dgates, gates.shape()), tensor(dbefore, s))
    }

    fn sixfold_gather(maps: FloatTensor<Self>, places: Arc<Places>) -> FloatTensor<Self> {
        let maps = contiguous(maps);
        let s = maps.shape();
        let out = gather_forward(values(&maps), s[1], [s[2], s[3]], &places);
        tensor(out, [s[0], s[1], places.size[0], places.size[1]])
    }

    fn sixfold_gather_backward(
        dout: FloatTensor<Self>,
        places: Arc<Places>,
        size: [usize; 2],
    ) -> FloatTensor<Self> {
        let dout = contiguous(dout);
        let s = dout.shape();
        tensor(gather_backward(values(&dout), s[1], size, &places), [s[0], s[1], size[0], size[1]])
    }
}

#[derive(Debug)]
struct LstmBackward;

impl<B: RecurrentOps> Backward<B, 2> for LstmBackward {
    type State = (FloatTensor<B>, FloatTensor<B>, FloatTensor<B>);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let [node_gates, node_before] = ops.parents;
        let dout = grads.consume::<B>(&ops.node);
        let (gates, before, out) = ops.state;
        let (dgates, dbefore) = B::sixfold_lstm_backward(gates, before, out, dout);
        for (node, gradient) in [(node_gates, dgates), (node_before, dbefore)] {
            if let Some(node) = node {
                grads.register::<B>(node.id, gradient);
            }
        }
    }
}

#[derive(Debug)]
struct GatherBackward;

impl<B: RecurrentOps> Backward<B, 1> for GatherBackward {
    type State = (Arc<Places>, [usize; 2]);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let [node] = ops.parents;
        let dout = grads.consume::<B>(&ops.node);
        let (places, size) = ops.state;
        if let Some(node) = node {
            grads.register::<B>(node.id, B::sixfold_gather_backward(dout, places, size));
        }
    }
}

impl<B: RecurrentOps, C: CheckpointStrategy> RecurrentOps for Autodiff<B, C> {
    fn sixfold_lstm(gates: FloatTensor<Self>, before: FloatTensor<Self>) -> FloatTensor<Self> {
        let nodes = [gates.node(), before.node()];
        let (gates, before) = (gates.primitive().clone(), before.primitive().clone());
        match LstmBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let out = B::sixfold_lstm(gates.clone(), before.clone());
                prep.finish((gates, before, out.clone()), out)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::sixfold_lstm(gates, before)),
        }
    }

    fn sixfold_lstm_backward(
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
        _: FloatTensor<Self>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>) {
        unreachable!("second derivatives of LSTM cells are not needed and not implemented")
    }

    fn sixfold_gather(maps: FloatTensor<Self>, places: Arc<Places>) -> FloatTensor<Self> {
        let nodes = [maps.node()];
        let maps = maps.primitive().clone();
        match GatherBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let s = maps.shape();
                let size = [s[2], s[3]];
                let out = B::sixfold_gather(maps, places.clone());
                prep.finish((places, size), out)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::sixfold_gather(maps, places)),
        }
    }

    fn sixfold_gather_backward(_: FloatTensor<Self>, _: Arc<Places>, _: [usize; 2]) -> FloatTensor<Self> {
        unreachable!("second derivatives of look-ups are not needed and not implemented")
    }
}

/// The cell of a convolutional LSTM (Shi et al. 2015, equation 3, without peepholes): hidden state and new state, each `batch x
/// channels x height x width`, from the gates (`batch x 4 channels x height x width`; of every channel input, forget and output
/// gate and the candidate, before their activations) and the previous state.
///
/// # Panics
/// If the shapes are inconsistent.
pub fn lstm_cell(gates: Tensor<4>, before: Tensor<4>) -> (Tensor<4>, Tensor<4>) {
    let ([batch, all, height, width], shape) = (gates.dims(), before.dims());
    assert_eq!([batch, all, height, width], [shape[0], 4 * shape[1], shape[2], shape[3]], "gates of an LSTM");
    if !has_kernels(&gates.device()) {
        return portable::lstm_cell(gates, before);
    }
    let out =
        Tensor::<4>::from_dispatch(Dispatch::sixfold_lstm(gates.into_dispatch(), before.into_dispatch()));
    (out.clone().narrow(0, 0, batch), out.narrow(0, batch, batch))
}

/// Samples maps (`images x channels x any size`) at the positions: `images x channels x places.size`, 0 where there is no position.
///
/// # Panics
/// If positions are missing for some image, or a position's pixel is outside.
pub fn gather(maps: Tensor<4>, places: Arc<Places>) -> Tensor<4> {
    assert_eq!(maps.dims()[0], places.images.len(), "places for every map");
    if !has_kernels(&maps.device()) {
        return portable::gather(maps, &places);
    }
    Tensor::from_dispatch(Dispatch::sixfold_gather(maps.into_dispatch(), places))
}
