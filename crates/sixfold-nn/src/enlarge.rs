//! Bilinear enlargement by whole factors, as PyTorch's `interpolate` without aligned corners.

use burn::tensor::{Tensor, TensorData};

pub(crate) use crate::ops::doubled;

/// Enlargement by any whole factor, as two matrix products.
pub(crate) fn enlarged(x: Tensor<4>, factor: usize) -> Tensor<4> {
    if factor == 1 {
        return x;
    }
    let [batch, channels, height, width] = x.dims();
    let device = x.device();
    let rows = Tensor::<2>::from_data(weights(height, factor), &device).unsqueeze::<3>();
    let columns = Tensor::<2>::from_data(weights(width, factor), &device).transpose().unsqueeze::<3>();
    let flat = x.reshape([batch * channels, height, width]);
    let count = batch * channels;
    let flat = rows.repeat_dim(0, count).matmul(flat).matmul(columns.repeat_dim(0, count));
    flat.reshape([batch, channels, factor * height, factor * width])
}

/// Weight of each of `side` values in each of `factor * side` values.
fn weights(side: usize, factor: usize) -> TensorData {
    let mut weights = vec![0.0f32; factor * side * side];
    for (i, row) in weights.chunks_exact_mut(side).enumerate() {
        let at = ((i as f32 + 0.5) / factor as f32 - 0.5).max(0.0);
        let first = (at as usize).min(side - 1);
        let part = at - first as f32;
        row[first] += 1.0 - part;
        row[(first + 1).min(side - 1)] += part;
    }
    TensorData::new(weights, [factor * side, side])
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, Distribution};

    #[test]
    fn enlarging_keeps_a_ramp_and_a_constant() {
        let device = Device::default();
        let x = Tensor::<4>::from_data(TensorData::new(vec![1.0f32, 3.0, 1.0, 3.0], [1, 1, 2, 2]), &device);
        for enlarge in [|x| enlarged(x, 2), doubled] {
            let y: Vec<f32> = enlarge(x.clone()).try_into_vec_as().unwrap();
            assert_eq!(y, [1.0, 1.5, 2.5, 3.0].repeat(4));
        }
    }

    /// Values and gradients of the kernel and of the matrix products, including sides of one pixel.
    #[test]
    fn doubling_is_enlarging_by_two() {
        let device = Device::default().autodiff();
        for (height, width) in [(1, 1), (1, 4), (3, 1), (5, 7), (16, 24)] {
            let random = |shape| Tensor::<4>::random(shape, Distribution::Normal(0.0, 1.0), &device);
            let (x, factor) = (random([2, 3, height, width]), random([2, 3, 2 * height, 2 * width]));
            let run = |enlarge: fn(Tensor<4>) -> Tensor<4>| {
                let x = x.clone().detach().require_grad();
                let y = enlarge(x.clone());
                let gradients = (y.clone() * factor.clone()).sum().backward();
                (y.inner(), x.grad(&gradients).unwrap())
            };
            let (ours, theirs) = (run(doubled), run(|x| enlarged(x, 2)));
            for (a, b) in [(ours.0, theirs.0), (ours.1, theirs.1)] {
                let difference: f32 = (a - b).abs().max().into_scalar();
                assert!(difference < 1e-5, "{height}x{width}: {difference}");
            }
        }
    }
}
