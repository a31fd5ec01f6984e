//! Burn's dense layer with weights from a given seed; Burn itself uses the device's random numbers.

use burn::module::Param;
use burn::nn::{Linear, LinearConfig};
use burn::tensor::{Device, Tensor, TensorData};
use rand::{Rng, RngExt};

/// From `batch x inputs` to `batch x outputs`, with weights and bias uniform within `1 / sqrt(inputs)` of 0, as in PyTorch.
pub fn dense([inputs, outputs]: [usize; 2], rng: &mut impl Rng, device: &Device) -> Linear {
    let bound = 1.0 / (inputs as f32).sqrt();
    let mut numbers = |count: usize| -> Vec<f32> {
        (0..count).map(|_| bound * (2.0 * rng.random::<f32>() - 1.0)).collect()
    };
    let (weight, bias) = (numbers(inputs * outputs), numbers(outputs));
    let mut layer = LinearConfig::new(inputs, outputs).init(device);
    layer.weight = Param::from_tensor(Tensor::from_data(TensorData::new(weight, [inputs, outputs]), device));
    layer.bias = Some(Param::from_tensor(Tensor::from_data(TensorData::new(bias, [outputs]), device)));
    layer
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn the_seed_decides() {
        let device = Device::default();
        let weights = |seed: u64| -> Vec<f32> {
            let layer = dense([64, 9], &mut ChaCha8Rng::seed_from_u64(seed), &device);
            assert_eq!(layer.forward(Tensor::<2>::ones([2, 64], &device)).dims(), [2, 9]);
            layer.weight.val().try_into_vec_as().unwrap()
        };
        assert_eq!(weights(1), weights(1));
        assert_ne!(weights(1), weights(2));
        assert!(weights(1).iter().all(|w| w.abs() <= 0.125));
    }
}
