//! The fused convolution against Burn's own, values and gradients, for every kind of layer that the networks use.

use burn::tensor::{Device, Tensor, TensorData};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sixfold_nn::kernels::{Activation, ConvSpec};
use sixfold_nn::layers::normal;
use sixfold_nn::ops::{conv, upsample};
use sixfold_nn::portable;

fn random<const D: usize>(shape: [usize; D], rng: &mut ChaCha8Rng, device: &Device) -> Tensor<D> {
    let values: Vec<f32> = (0..shape.iter().product::<usize>()).map(|_| normal(rng)).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

fn largest_difference<const D: usize>(a: Tensor<D>, b: Tensor<D>) -> f32 {
    assert_eq!(a.dims(), b.dims());
    (a - b).abs().max().into_scalar::<f32>()
}

#[test]
fn values_and_gradients_equal_burns_own() {
    let device = Device::flex().autodiff();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    // batch, inputs, outputs, height, width, kernel, stride, depthwise, activation
    let cases = [
        (3, 5, 7, 12, 9, 1, 1, false, Activation::Linear),
        (9, 6, 4, 16, 16, 3, 1, false, Activation::Relu),
        (2, 3, 8, 32, 32, 3, 2, false, Activation::Relu6),
        (1, 4, 4, 64, 48, 5, 1, false, Activation::Linear),
        (2, 3, 6, 31, 31, 5, 2, false, Activation::Relu6),
        (2, 4, 6, 16, 16, 1, 2, false, Activation::Linear),
        (2, 40, 40, 16, 16, 3, 1, true, Activation::Relu6),
        (3, 9, 9, 33, 33, 5, 2, true, Activation::Relu6),
        (2, 8, 8, 8, 8, 5, 1, true, Activation::Linear),
        (2, 8, 8, 64, 64, 3, 2, true, Activation::Relu6),
        // Larger than one band of patches.
        (2, 64, 16, 40, 40, 3, 1, false, Activation::Relu),
    ];
    for case in cases {
        let (batch, inputs, outputs, height, width, kernel, stride, depthwise, activation) = case;
        let spec = ConvSpec {
            stride,
            padding: ConvSpec::same(height, kernel, stride),
            groups: if depthwise { inputs } else { 1 },
            activation,
        };
        let x = random([batch, inputs, height, width], &mut rng, &device).require_grad();
        let weight =
            random([outputs, inputs / spec.groups, kernel, kernel], &mut rng, &device).require_grad();
        let bias = random([outputs], &mut rng, &device).require_grad();

        let ours = conv(x.clone(), weight.clone(), bias.clone(), spec);
        let theirs = portable::conv(x.clone(), weight.clone(), bias.clone(), spec);
        let scale = theirs.clone().abs().max().into_scalar::<f32>();
        let error = largest_difference(ours.clone().inner(), theirs.clone().inner());
        assert!(error < 1e-5 * scale, "{case:?}: values differ by {error}");

        let weighting = random(ours.dims(), &mut rng, &device);
        let ours = (ours * weighting.clone()).sum().backward();
        let theirs = (theirs * weighting).sum().backward();
        let scale = |t: &Tensor<4>| t.clone().abs().max().into_scalar::<f32>().max(1.0);
        let (a, b) = (x.grad(&ours).unwrap(), x.grad(&theirs).unwrap());
        let error = largest_difference(a, b.clone());
        assert!(error < 1e-5 * scale(&b), "{case:?}: input gradients differ by {error}");
        let (a, b) = (weight.grad(&ours).unwrap(), weight.grad(&theirs).unwrap());
        let error = largest_difference(a, b.clone());
        assert!(error < 2e-5 * scale(&b), "{case:?}: weight gradients differ by {error}");
        let (a, b) = (bias.grad(&ours).unwrap(), bias.grad(&theirs).unwrap());
        let largest = b.clone().abs().max().into_scalar::<f32>().max(1.0);
        let error = largest_difference(a, b);
        assert!(error < 1e-4 * largest, "{case:?}: bias gradients differ by {error}");
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bytes() {
    let device = Device::flex().autodiff();
    let run = |threads: usize| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
            let mut rng = ChaCha8Rng::seed_from_u64(5);
            let x = random([6, 8, 20, 20], &mut rng, &device).require_grad();
            let dense = random([16, 8, 3, 3], &mut rng, &device).require_grad();
            let depthwise = random([16, 1, 5, 5], &mut rng, &device).require_grad();
            let bias = random([16], &mut rng, &device).require_grad();
            let spec = |groups, kernel| ConvSpec {
                stride: 1,
                padding: ConvSpec::same(20, kernel, 1),
                groups,
                activation: Activation::Relu6,
            };
            let y = conv(x.clone(), dense.clone(), bias.clone(), spec(1, 3));
            let y = conv(y, depthwise.clone(), bias.clone(), spec(16, 5));
            let loss = (y.clone() * y).sum();
            let gradients = loss.backward();
            let mut bytes = Vec::new();
            for data in [
                x.grad(&gradients).unwrap().into_data(),
                dense.grad(&gradients).unwrap().into_data(),
                depthwise.grad(&gradients).unwrap().into_data(),
            ] {
                bytes.extend_from_slice(data.as_bytes());
            }
            bytes
        })
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn upsampling_repeats_pixels_and_sums_gradients() {
    let device = Device::flex().autodiff();
    let x = Tensor::<4>::from_data([[[[1.0, 2.0], [3.0, 4.0]]]], &device).require_grad();
    let y = upsample(x.clone());
    let expected =
        [[[[1.0, 1.0, 2.0, 2.0], [1.0, 1.0, 2.0, 2.0], [3.0, 3.0, 4.0, 4.0], [3.0, 3.0, 4.0, 4.0]]]];
    y.clone().into_data().assert_eq(&TensorData::from(expected), false);
    let weights: Vec<f32> = (0..16).map(|i| i as f32).collect();
    let weights = Tensor::<4>::from_data(TensorData::new(weights, [1, 1, 4, 4]), &device);
    let gradients = (y * weights).sum().backward();
    let expected = [[[[10.0, 18.0], [42.0, 50.0]]]];
    x.grad(&gradients).unwrap().into_data().assert_eq(&TensorData::from(expected), false);
}
