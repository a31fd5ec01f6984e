//! This crate's operations composed of Burn's own: for processors without our kernels, such as a GPU, and the reference of the
//! kernels' tests. Results and gradients are the kernels' up to rounding.

use burn::tensor::activation::{relu, sigmoid};
use burn::tensor::module::{conv_transpose2d, conv2d};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};
use burn::tensor::{Device, Int, Tensor, TensorData};

use crate::batch_norm::NormOptions;
use crate::conv_transpose::TransposedSpec;
use crate::enlarge::enlarged;
use crate::kernels::{Activation, ConvSpec, Places, Regions, Upsampling, neighbours};

/// As [`crate::ops::conv`].
pub fn conv(x: Tensor<4>, weight: Tensor<4>, bias: Tensor<1>, spec: ConvSpec) -> Tensor<4> {
    let [before, after] = spec.padding;
    // Burn pads both sides alike.
    let (x, padding) =
        if before == after { (x, before) } else { (x.pad((before, after, before, after), 0.0), 0) };
    let options = ConvOptions::new([spec.stride; 2], [padding; 2], [1, 1], spec.groups);
    let y = conv2d(x, weight, Some(bias), options);
    match spec.activation {
        Activation::Linear => y,
        Activation::Relu => relu(y),
        Activation::Relu6 => relu(y).clamp_max(6.0),
    }
}

/// As [`crate::conv_transpose::conv_transpose`].
pub fn conv_transpose(x: Tensor<4>, weight: Tensor<4>, spec: TransposedSpec) -> Tensor<4> {
    let [before, after] = spec.padding;
    let options = ConvTransposeOptions::new([spec.stride; 2], [0, 0], [0, 0], [1, 1], 1);
    let y = conv_transpose2d(x, weight, None, options);
    let [_, _, height, width] = y.dims();
    y.narrow(2, before, height - before - after).narrow(3, before, width - before - after)
}

/// As [`crate::ops::upsample`] and [`crate::ops::doubled`].
pub fn upsample(x: Tensor<4>, kind: Upsampling) -> Tensor<4> {
    let [batch, channels, height, width] = x.dims();
    match kind {
        Upsampling::Repeated => x
            .reshape([batch, channels, height, 1, width, 1])
            .expand([batch, channels, height, 2, width, 2])
            .reshape([batch, channels, 2 * height, 2 * width]),
        Upsampling::Bilinear => enlarged(x, 2),
    }
}

/// As [`crate::recurrent::lstm_cell`].
pub fn lstm_cell(gates: Tensor<4>, before: Tensor<4>) -> (Tensor<4>, Tensor<4>) {
    let [batch, channels, height, width] = before.dims();
    let gates = gates.reshape([batch, channels, 4, height, width]);
    let gate = |number| gates.clone().narrow(2, number, 1).squeeze_dim::<4>(2);
    let state = sigmoid(gate(1)) * before + sigmoid(gate(0)) * gate(3).tanh();
    (sigmoid(gate(2)) * state.clone().tanh(), state)
}

/// Weighted sums of rows of a table (`rows x channels`): `terms` has the row and the weight of every output, term by term.
fn weighted_rows(table: Tensor<2>, terms: impl Iterator<Item = (Vec<i32>, Vec<f32>)>) -> Tensor<2> {
    let (device, channels): (Device, usize) = (table.device(), table.dims()[1]);
    let mut sum: Option<Tensor<2>> = None;
    for (rows, weights) in terms {
        let count = rows.len();
        let rows = Tensor::<1, Int>::from_data(TensorData::new(rows, [count]), &device);
        let weights = Tensor::<2>::from_data(TensorData::new(weights, [count, 1]), &device);
        let term = table.clone().select(0, rows) * weights;
        sum = Some(match sum {
            Some(sum) => sum + term,
            None => term,
        });
    }
    sum.unwrap_or_else(|| Tensor::zeros([0, channels], &device))
}

/// The pixels of a batch of maps as rows: `images x channels x height x width` to `(images * height * width) x channels`.
fn pixels_as_rows(maps: Tensor<4>) -> Tensor<2> {
    let [images, channels, height, width] = maps.dims();
    maps.permute([0, 2, 3, 1]).reshape([images * height * width, channels])
}

/// As [`crate::recurrent::gather`].
pub fn gather(maps: Tensor<4>, places: &Places) -> Tensor<4> {
    let [images, channels, height, width] = maps.dims();
    let ([rows, columns], plane) = (places.size, height * width);
    let count = images * rows * columns;
    // Pixels without a position: row 0 with weight 0.
    let mut terms: [(Vec<i32>, Vec<f32>); 4] = std::array::from_fn(|_| (vec![0; count], vec![0.0; count]));
    for (image, sampled) in places.images.iter().enumerate() {
        for place in sampled {
            let (at, weights) = neighbours(place.x, place.y, [height, width]);
            let pixel = image * rows * columns + place.pixel as usize;
            for ((term, at), weight) in terms.iter_mut().zip(at).zip(weights) {
                (term.0[pixel], term.1[pixel]) = ((image * plane + at) as i32, weight);
            }
        }
    }
    weighted_rows(pixels_as_rows(maps), terms.into_iter())
        .reshape([images, rows, columns, channels])
        .permute([0, 3, 1, 2])
}

/// As [`crate::roi_align::roi_align`].
pub fn roi_align(map: Tensor<4>, regions: &Regions) -> Tensor<4> {
    let [_, channels, height, width] = map.dims();
    let (boxes, side) = (regions.boxes.len(), regions.side);
    weighted_rows(pixels_as_rows(map), regions.terms([height, width]).into_iter())
        .reshape([boxes, side, side, channels])
        .permute([0, 3, 1, 2])
}

/// Output, mean and variance of batch normalisation, as the layer [`crate::batch_norm::BatchNorm`] uses them.
pub(crate) fn batch_norm(
    x: Tensor<4>,
    [weight, bias]: [Tensor<1>; 2],
    residual: Option<Tensor<4>>,
    given: Option<[Tensor<1>; 2]>,
    options: NormOptions,
) -> (Tensor<4>, Tensor<1>, Tensor<1>) {
    let channels = x.dims()[1];
    let wide = |t: Tensor<1>| t.reshape([1, channels, 1, 1]);
    let over_pixels = |t: Tensor<4>| t.mean_dim(0).mean_dim(2).mean_dim(3);
    let [mean, variance] = given.map_or_else(
        || {
            let mean = over_pixels(x.clone());
            let deviation = x.clone() - mean.clone();
            [mean, over_pixels(deviation.clone() * deviation)]
        },
        |given| given.map(wide),
    );
    let deviation = (variance.clone() + options.epsilon).sqrt();
    let mut z = (x - mean.clone()) / deviation * wide(weight) + wide(bias);
    if let Some(residual) = residual {
        z = z + residual;
    }
    let y = if options.slope == 1.0 {
        z
    } else if options.slope == 0.0 {
        relu(z)
    } else {
        relu(z.clone()) - relu(-z) * options.slope
    };
    (y, mean.reshape([channels]).detach(), variance.reshape([channels]).detach())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::conv_transpose::tests::tensor;
    use crate::{batch_norm, kernels, ops, recurrent, roi_align};

    /// Output and gradient with respect to the input, of a function of an input of this shape.
    fn run(f: impl Fn(Tensor<4>) -> Tensor<4>, shape: [usize; 4]) -> [Vec<f32>; 2] {
        let device = Device::flex().autodiff();
        let x = tensor(shape, 0.3, &device).require_grad();
        let y = f(x.clone());
        let gradients = (y.clone() * tensor(y.dims(), 2.0, &device)).sum().backward();
        [y.inner(), x.grad(&gradients).unwrap()].map(|t| t.try_into_vec_as().unwrap())
    }

    fn equal(
        kernels: impl Fn(Tensor<4>) -> Tensor<4>,
        portable: impl Fn(Tensor<4>) -> Tensor<4>,
        shape: [usize; 4],
    ) {
        let pairs = run(kernels, shape).into_iter().zip(run(portable, shape));
        for ((ours, burns), what) in pairs.zip(["value", "gradient"]) {
            assert_eq!(ours.len(), burns.len(), "{what}");
            let scale = burns.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            assert!(scale > 0.01, "{what}: all are small");
            for (i, (a, b)) in ours.iter().zip(&burns).enumerate() {
                assert!((a - b).abs() <= 2e-5 * scale, "{what} {i}: {a} against {b}, largest {scale}");
            }
        }
    }

    #[test]
    fn repeated_pixels_are_those_of_the_kernel() {
        equal(ops::upsample, |x| upsample(x, Upsampling::Repeated), [2, 3, 4, 5]);
        equal(ops::doubled, |x| upsample(x, Upsampling::Bilinear), [2, 3, 4, 5]);
    }

    #[test]
    fn the_lstm_cell_is_that_of_the_kernel() {
        // Gates and previous state from one input, so that one gradient covers both.
        let split = |x: Tensor<4>| (x.clone().narrow(1, 0, 12) * 2.0, x.narrow(1, 12, 3));
        let both = |(hidden, state)| Tensor::cat(vec![hidden, state], 1);
        let kernel = |x| {
            let (gates, before) = split(x);
            both(recurrent::lstm_cell(gates, before))
        };
        let portable = |x| {
            let (gates, before) = split(x);
            both(lstm_cell(gates, before))
        };
        equal(kernel, portable, [2, 15, 4, 5]);
    }

    #[test]
    fn sampled_maps_are_those_of_the_kernel() {
        let place = |pixel, x, y| kernels::SampledPixel { pixel, x, y };
        let first = vec![place(0, 0.1, 0.2), place(3, 0.5, 0.99), place(7, 1.0, 0.0)];
        let places = Arc::new(Places { size: [2, 4], images: vec![first, vec![place(5, 0.4, 0.7)]] });
        equal(|x| recurrent::gather(x, places.clone()), |x| gather(x, &places), [2, 3, 5, 6]);
    }

    #[test]
    fn boxes_of_a_map_are_those_of_the_kernel() {
        // Boxes with different numbers of samples, one of them partly outside.
        let boxes = vec![[2.0, 2.0, 20.0, 16.0], [8.0, 4.0, 90.0, 60.0], [-9.0, -30.0, 12.0, 5.0]];
        for samples in [Some(2), None] {
            let regions = Regions { boxes: boxes.clone(), scale: 0.25, side: 3, samples };
            let kernel = |x| roi_align::roi_align(x, regions.clone());
            equal(kernel, |x| roi_align(x, &regions), [1, 4, 12, 20]);
        }
    }

    #[test]
    fn batch_normalisation_is_that_of_the_kernel() {
        let device = Device::flex().autodiff();
        for slope in [1.0, 0.0, 0.3] {
            for residual in [false, true] {
                let options = NormOptions { epsilon: 1e-5, slope };
                let parameters = || [tensor([5], 0.4, &device), tensor([5], 0.9, &device)];
                let parts = |x: Tensor<4>| (x.clone() * 0.7, residual.then(|| x.flip([2])));
                let mut layer = batch_norm::BatchNormConfig::new(5).init(&device);
                [layer.weight, layer.bias] = parameters().map(burn::module::Param::from_tensor);
                let kernel = |x| {
                    let (x, residual) = parts(x);
                    layer.forward_rectified(x, residual, slope)
                };
                let portable = |x| {
                    let (x, residual) = parts(x);
                    super::batch_norm(x, parameters(), residual, None, options).0
                };
                equal(kernel, portable, [3, 5, 4, 6]);
            }
        }
    }

    #[test]
    fn statistics_of_a_batch_are_its_mean_and_variance_and_given_ones_are_used() {
        let device = Device::flex();
        let x = Tensor::<4>::from_data([[[[1.0, 3.0]]], [[[5.0, 7.0]]]], &device);
        let one = || [Tensor::ones([1], &device), Tensor::zeros([1], &device)];
        let options = NormOptions { epsilon: 0.0, slope: 1.0 };
        let (_, mean, variance) = super::batch_norm(x.clone(), one(), None, None, options);
        assert_eq!((mean.into_scalar::<f32>(), variance.into_scalar::<f32>()), (4.0, 5.0));
        let given = [Tensor::from_floats([1.0], &device), Tensor::from_floats([4.0], &device)];
        let (y, ..) = super::batch_norm(x, one(), None, Some(given), options);
        assert_eq!(y.try_into_vec_as::<f32>().unwrap(), [0.0, 1.0, 2.0, 3.0]);
    }
}
