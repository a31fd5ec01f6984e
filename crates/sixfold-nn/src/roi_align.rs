//! RoIAlign as an operation of Burn with its gradient ([`crate::kernels::Regions`]).

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
use crate::kernels::{Regions, roi_align_backward, roi_align_forward};
use crate::portable;

/// RoIAlign for a backend.
#[backend_extension(Flex, Autodiff)]
pub trait RoiAlignOps: Backend {
    /// From a map (`1 x channels x height x width`) to `boxes x channels x side x side`.
    fn sixfold_roi_align(map: FloatTensor<Self>, regions: Arc<Regions>) -> FloatTensor<Self>;

    /// Gradient with respect to a map of this size.
    fn sixfold_roi_align_backward(
        dout: FloatTensor<Self>,
        regions: Arc<Regions>,
        size: [usize; 2],
    ) -> FloatTensor<Self>;
}

fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.as_slice::<f32>().is_some() { tensor } else { tensor.to_contiguous() }
}

fn values(tensor: &FlexTensor) -> &[f32] {
    tensor
        .as_slice::<f32>()
        .unwrap_or_else(|| panic!("RoIAlign needs f32 tensors, found {:?}", tensor.dtype()))
}

fn tensor(values: Vec<f32>, shape: impl Into<Shape>) -> FlexTensor {
    FlexTensor::new(burn::tensor::Bytes::from_elems(values), Layout::contiguous(shape.into()), DType::F32)
}

impl RoiAlignOps for Flex {
    fn sixfold_roi_align(map: FloatTensor<Self>, regions: Arc<Regions>) -> FloatTensor<Self> {
        let map = contiguous(map);
        let s = map.shape();
        let out = roi_align_forward(values(&map), s[1], [s[2], s[3]], &regions);
        tensor(out, [regions.boxes.len(), s[1], regions.side, regions.side])
    }

    fn sixfold_roi_align_backward(
        dout: FloatTensor<Self>,
        regions: Arc<Regions>,
        size: [usize; 2],
    ) -> FloatTensor<Self> {
        let dout = contiguous(dout);
        let channels = dout.shape()[1];
        let dmap = roi_align_backward(values(&dout), channels, size, &regions);
        tensor(dmap, [1, channels, size[0], size[1]])
    }
}

#[derive(Debug)]
struct RoiAlignBackward;

impl<B: RoiAlignOps> Backward<B, 1> for RoiAlignBackward {
    type State = (Arc<Regions>, [usize; 2]);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let [node] = ops.parents;
        let dout = grads.consume::<B>(&ops.node);
        let (regions, size) = ops.state;
        if let Some(node) = node {
            grads.register::<B>(node.id, B::sixfold_roi_align_backward(dout, regions, size));
        }
    }
}

impl<B: RoiAlignOps, C: CheckpointStrategy> RoiAlignOps for Autodiff<B, C> {
    fn sixfold_roi_align(map: FloatTensor<Self>, regions: Arc<Regions>) -> FloatTensor<Self> {
        let nodes = [map.node()];
        let map = map.primitive().clone();
        match RoiAlignBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let s = map.shape();
                let size = [s[2], s[3]];
                let out = B::sixfold_roi_align(map, regions.clone());
                prep.finish((regions, size), out)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::sixfold_roi_align(map, regions)),
        }
    }

    fn sixfold_roi_align_backward(_: FloatTensor<Self>, _: Arc<Regions>, _: [usize; 2]) -> FloatTensor<Self> {
        unreachable!("second derivatives of RoIAlign are not needed and not implemented")
    }
}

/// Samples the boxes of one image's map (`1 x channels x height x width`) to a common size: `boxes x channels x side x side`.
///
/// # Panics
/// For a batch of several images, and without boxes, bins or samples.
pub fn roi_align(map: Tensor<4>, regions: Regions) -> Tensor<4> {
    assert_eq!(map.dims()[0], 1, "RoIAlign takes the map of one image");
    assert!(
        !regions.boxes.is_empty() && regions.side > 0 && regions.samples != Some(0),
        "RoIAlign of {} boxes in {} bins of {:?} samples a side",
        regions.boxes.len(),
        regions.side,
        regions.samples
    );
    if !has_kernels(&map.device()) {
        return portable::roi_align(map, &regions);
    }
    Tensor::from_dispatch(Dispatch::sixfold_roi_align(map.into_dispatch(), Arc::new(regions)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};

    #[test]
    fn the_gradient_reaches_the_map_through_the_operation() {
        let device = Device::flex().autodiff();
        let numbers: Vec<f32> = (0..2 * 48).map(|i| (i as f32 * 0.7).sin()).collect();
        let map = Tensor::<4>::from_data(TensorData::new(numbers, [1, 2, 6, 8]), &device).require_grad();
        let boxes = vec![[2.0, 2.0, 20.0, 16.0], [8.0, 4.0, 30.0, 22.0]];
        let regions = Regions { boxes, scale: 0.25, side: 2, samples: Some(2) };
        let out = roi_align(map.clone(), regions.clone());
        assert_eq!(out.dims(), [2, 2, 2, 2]);
        let weights: Vec<f32> = (0..16).map(|i| (i as f32 * 1.3).cos()).collect();
        let factor = Tensor::<4>::from_data(TensorData::new(weights.clone(), [2, 2, 2, 2]), &device);
        let gradients = (out * factor).sum().backward();
        let found: Vec<f32> = map.grad(&gradients).unwrap().try_into_vec_as().unwrap();
        assert_eq!(found, roi_align_backward(&weights, 2, [6, 8], &regions));
    }
}
