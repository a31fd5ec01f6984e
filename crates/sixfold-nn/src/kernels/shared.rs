//! Code shared by all convolution kernels: their options, the activation, and writing to disjoint
//! parts of one output from several threads.

use std::marker::PhantomData;
use std::mem::{ManuallyDrop, MaybeUninit};

/// Non-linearity applied to the output of a convolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// None.
    Linear,
    /// `max(0, x)`.
    Relu,
    /// `min(max(0, x), 6)`.
    Relu6,
}

/// Options of a square convolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConvSpec {
    /// Step in both directions, in pixels.
    pub stride: usize,
    /// Zeros before and after each row and column. They differ for TensorFlow's `SAME` rule with a stride of two.
    pub padding: [usize; 2],
    /// 1, or the number of channels for a depthwise convolution.
    pub groups: usize,
    /// Applied to the result.
    pub activation: Activation,
}

impl ConvSpec {
    /// TensorFlow's `SAME` padding for an input side, kernel and stride.
    pub fn same(side: usize, kernel: usize, stride: usize) -> [usize; 2] {
        let total = ((side.div_ceil(stride) - 1) * stride + kernel).saturating_sub(side);
        [total / 2, total - total / 2]
    }
}

pub(super) use crate::vectorised;

vectorised! {
    /// Applies an activation in place.
    pub(super) fn activate(values: &mut [f32], activation: Activation) {
        match activation {
            Activation::Linear => {}
            Activation::Relu => values.iter_mut().for_each(|v| *v = v.max(0.0)),
            Activation::Relu6 => values.iter_mut().for_each(|v| *v = v.clamp(0.0, 6.0)),
        }
    }
}

vectorised! {
    /// Gradient before the activation: `dy` where the output `y` is inside the activation's linear part, otherwise 0.
    pub(super) fn before_activation(out: &mut [f32], y: &[f32], dy: &[f32], activation: Activation) {
        match activation {
            Activation::Linear => out.copy_from_slice(dy),
            Activation::Relu => {
                for ((o, y), d) in out.iter_mut().zip(y).zip(dy) {
                    *o = if *y > 0.0 { *d } else { 0.0 };
                }
            }
            Activation::Relu6 => {
                for ((o, y), d) in out.iter_mut().zip(y).zip(dy) {
                    *o = if *y > 0.0 && *y < 6.0 { *d } else { 0.0 };
                }
            }
        }
    }
}

vectorised! {
    /// Sum of a slice, computed in sixteen lanes.
    pub(super) fn sum(values: &[f32]) -> f32 {
        let mut lanes = [0.0f32; 16];
        let chunks = values.chunks_exact(16);
        let rest: f32 = chunks.remainder().iter().sum();
        for chunk in chunks {
            for (lane, v) in lanes.iter_mut().zip(chunk) {
                *lane += v;
            }
        }
        lanes.iter().sum::<f32>() + rest
    }
}

/// A mutable buffer to which several threads write, each to its own part.
#[derive(Clone, Copy)]
pub(super) struct Shared<'a> {
    start: *mut MaybeUninit<f32>,
    length: usize,
    buffer: PhantomData<&'a mut [MaybeUninit<f32>]>,
}

// SAFETY: the pointer is only used through `slice` and `multiply`, whose callers keep to disjoint parts.
#[allow(unsafe_code)]
unsafe impl Send for Shared<'_> {}
// SAFETY: as above.
#[allow(unsafe_code)]
unsafe impl Sync for Shared<'_> {}

impl<'a> Shared<'a> {
    pub(super) fn new(buffer: &'a mut [MaybeUninit<f32>]) -> Self {
        Self { start: buffer.as_mut_ptr(), length: buffer.len(), buffer: PhantomData }
    }

    /// A buffer of numbers; [`Shared::slice`]'s callers leave numbers in it.
    pub(super) fn of_numbers(buffer: &'a mut [f32]) -> Self {
        Self { start: buffer.as_mut_ptr().cast(), length: buffer.len(), buffer: PhantomData }
    }

    /// Part of the buffer.
    ///
    /// # Safety
    /// Nothing else may use this range while the slice lives, and what was a number there stays one.
    #[allow(unsafe_code)]
    pub(super) unsafe fn slice(self, start: usize, length: usize) -> &'a mut [MaybeUninit<f32>] {
        assert!(start + length <= self.length);
        // SAFETY: within the buffer by the assertion; disjoint by the caller's promise.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(start), length) }
    }
}

/// A buffer in which every number is written before it is read: zeroing large outputs first would take as long as a layer.
pub(super) fn unwritten(length: usize) -> Vec<MaybeUninit<f32>> {
    let mut buffer = Vec::with_capacity(length);
    // SAFETY: the capacity is there, and a `MaybeUninit` needs no value.
    #[allow(unsafe_code)]
    unsafe {
        buffer.set_len(length)
    };
    buffer
}

/// The same, filled with zeros.
pub(super) fn zeroed(length: usize) -> Vec<MaybeUninit<f32>> {
    // Allocated as zeroed numbers: the system provides zeroed pages without cost.
    let mut buffer = ManuallyDrop::new(vec![0.0f32; length]);
    // SAFETY: the parts of a vector that nobody drops; `MaybeUninit<f32>` has the layout of `f32`.
    #[allow(unsafe_code)]
    unsafe {
        Vec::from_raw_parts(buffer.as_mut_ptr().cast(), buffer.len(), buffer.capacity())
    }
}

/// The numbers of a buffer.
///
/// # Safety
/// All of them were written.
#[allow(unsafe_code)]
pub(super) unsafe fn written(buffer: Vec<MaybeUninit<f32>>) -> Vec<f32> {
    let mut buffer = ManuallyDrop::new(buffer);
    // SAFETY: the parts of a vector that nobody drops, in the layout of `f32`; written, as the caller promises.
    unsafe { Vec::from_raw_parts(buffer.as_mut_ptr().cast(), buffer.len(), buffer.capacity()) }
}

/// A matrix in a slice: start, row stride and column stride.
#[derive(Clone, Copy)]
pub(super) struct View<'a> {
    pub(super) data: &'a [f32],
    pub(super) strides: [usize; 2],
}

/// `out = add * out + left * right` on one thread. `out` is `m x n` with unit column stride and row stride
/// `out_stride`, beginning at `start` of the shared buffer; `left` is `m x k`, `right` is `k x n`.
///
/// # Safety
/// Nothing else may use these `n` columns of `out` meanwhile; with `add` they are written already.
#[allow(unsafe_code)]
pub(super) unsafe fn multiply(
    [m, n, k]: [usize; 3],
    (out, start, out_stride): (Shared<'_>, usize, usize),
    add: bool,
    left: View<'_>,
    right: View<'_>,
) {
    let last = |rows: usize, columns: usize, strides: [usize; 2]| {
        (rows - 1) * strides[0] + (columns - 1) * strides[1]
    };
    assert!(m > 0 && n > 0 && k > 0);
    assert!(start + last(m, n, [out_stride, 1]) < out.length);
    assert!(last(m, k, left.strides) < left.data.len());
    assert!(last(k, n, right.strides) < right.data.len());
    // SAFETY: the assertions keep every element inside its buffer; nobody else uses the output, as the caller promises.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out.start.add(start).cast::<f32>(),
            1,
            out_stride as isize,
            add,
            left.data.as_ptr(),
            left.strides[1] as isize,
            left.strides[0] as isize,
            right.data.as_ptr(),
            right.strides[1] as isize,
            right.strides[0] as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}
