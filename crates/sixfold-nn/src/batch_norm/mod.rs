//! Batch normalisation (Ioffe and Szegedy 2015) with its rectifier and a residual in one operation.
//!
//! Burn composes it from elementwise operations with one pass over memory each; here a channel is read once while it is in the
//! cache. Tensor names and the unbiased running variance are as in PyTorch.

mod kernel;
mod operation;

pub use operation::{BatchNormOps, NormKind};

use burn::module::{Flag, Module, Param, RunningState};
use burn::tensor::{Device, Tensor};

/// Parameters of one normalisation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NormOptions {
    /// Added to the variance.
    pub epsilon: f64,
    /// Factor for values below zero: 1 for no rectifier, 0 for ReLU, in between for a leaky one.
    pub slope: f32,
}

/// Configuration of [`BatchNorm`].
#[derive(Debug, Clone, Copy)]
pub struct BatchNormConfig {
    /// Number of channels.
    pub channels: usize,
    /// Added to the variance.
    pub epsilon: f64,
    /// Weight of a new batch in the running statistics.
    pub momentum: f64,
}

impl BatchNormConfig {
    /// PyTorch's values: epsilon 1e-5, momentum 0.1.
    pub fn new(channels: usize) -> Self {
        BatchNormConfig { channels, epsilon: 1e-5, momentum: 0.1 }
    }

    /// A layer with weight 1, bias 0, mean 0 and variance 1.
    pub fn init(&self, device: &Device) -> BatchNorm {
        let shape = [self.channels];
        BatchNorm {
            weight: Param::from_tensor(Tensor::ones(shape, device)),
            bias: Param::from_tensor(Tensor::zeros(shape, device)),
            running_mean: RunningState::new(Tensor::zeros(shape, device)),
            running_var: RunningState::new(Tensor::ones(shape, device)),
            training: Param::from_bool(true),
            momentum: self.momentum,
            epsilon: self.epsilon,
        }
    }
}

/// `weight * (x - mean) / sqrt(variance + epsilon) + bias` for every channel, created by [`BatchNormConfig`].
///
/// On a device with gradients, mean and variance are the batch's, unless the layer is frozen; otherwise they are the running ones.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct BatchNorm {
    /// Factor of every channel.
    pub weight: Param<Tensor<1>>,
    /// Offset of every channel.
    pub bias: Param<Tensor<1>>,
    /// Running mean of every channel.
    pub running_mean: RunningState<Tensor<1>>,
    /// Running, unbiased variance of every channel.
    pub running_var: RunningState<Tensor<1>>,
    /// Whether the layer takes part in training.
    pub training: Param<Flag>,
    momentum: f64,
    epsilon: f64,
}

crate::displayed_by_name!(BatchNorm);

impl BatchNorm {
    /// Input and output are `batch x channels x height x width`.
    ///
    /// # Panics
    /// If the number of channels is not the layer's.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        self.forward_rectified(x, None, 1.0)
    }

    /// As [`Self::forward`], then adds the residual and multiplies values below zero by `slope`.
    ///
    /// # Panics
    /// If the number of channels is not the layer's, or the residual's shape is not the input's.
    pub fn forward_rectified(&self, x: Tensor<4>, residual: Option<Tensor<4>>, slope: f32) -> Tensor<4> {
        let ([batch, channels, height, width], [expected]) = (x.dims(), self.weight.dims());
        assert_eq!(channels, expected, "batch normalisation: channels of the input {:?}", x.dims());
        let options = NormOptions { epsilon: self.epsilon, slope };
        let parameters = [self.weight.val(), self.bias.val()];
        if !self.is_training(&x) {
            let given = [self.running_mean.value_sync(), self.running_var.value_sync()];
            return operation::batch_norm(x, parameters, residual, Some(given), options).0;
        }
        let (y, mean, variance) = operation::batch_norm(x, parameters, residual, None, options);
        let count = (batch * height * width) as f64;
        let unbiased = variance.detach().mul_scalar(count / (count - 1.0).max(1.0));
        for (state, new) in [(&self.running_mean, mean.detach()), (&self.running_var, unbiased)] {
            let old = state.value_sync().mul_scalar(1.0 - self.momentum);
            state.update((old + new.mul_scalar(self.momentum)).detach());
        }
        y
    }

    /// Whether the statistics of the batch are used and recorded for this input.
    pub(crate) fn is_training(&self, x: &Tensor<4>) -> bool {
        x.device().is_autodiff() && self.training.is_enabled()
    }

    /// Weights (`channels x inputs x kernel x kernel`) and bias of the single convolution that is equivalent to a convolution with
    /// these weights and no bias, followed by this layer with its running statistics.
    pub fn fold(&self, weight: Tensor<4>) -> (Tensor<4>, Tensor<1>) {
        let deviation = (self.running_var.value_sync() + self.epsilon).sqrt();
        let factor = self.weight.val() / deviation;
        let bias = self.bias.val() - self.running_mean.value_sync() * factor.clone();
        let [channels] = factor.dims();
        (weight * factor.reshape([channels, 1, 1, 1]), bias)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::nn;
    use burn::tensor::TensorData;

    fn numbers(count: usize, seed: f32) -> Vec<f32> {
        (0..count).map(|i| 2.0 * ((i * i) as f32 * 0.013 + seed + i as f32 * 0.7).sin() + 0.3).collect()
    }

    fn tensor<const D: usize>(shape: [usize; D], seed: f32, device: &Device) -> Tensor<D> {
        Tensor::from_data(TensorData::new(numbers(shape.iter().product(), seed), shape), device)
    }

    fn close(a: Vec<f32>, b: Vec<f32>, what: &str) {
        assert_eq!(a.len(), b.len(), "{what}");
        let scale = b.iter().fold(1e-3f32, |m, v| m.max(v.abs()));
        for (i, (a, b)) in a.iter().zip(&b).enumerate() {
            assert!((a - b).abs() <= 1e-5 * scale, "{what}[{i}]: {a} against {b}, scale {scale}");
        }
    }

    fn vec<const D: usize>(t: Tensor<D>) -> Vec<f32> {
        t.try_into_vec_as().unwrap()
    }

    /// Both layers with the same, non-uniform parameters.
    fn layers(channels: usize, device: &Device) -> (BatchNorm, nn::BatchNorm) {
        let mut ours = BatchNormConfig::new(channels).init(device);
        let mut burns = nn::BatchNormConfig::new(channels).init(device);
        let (weight, bias) = (tensor([channels], 0.4, device), tensor([channels], 0.9, device));
        ours.weight = Param::from_tensor(weight.clone());
        ours.bias = Param::from_tensor(bias.clone());
        burns.gamma = Param::from_tensor(weight);
        burns.beta = Param::from_tensor(bias);
        (ours, burns)
    }

    #[test]
    fn output_gradients_and_statistics_are_those_of_burn() {
        let device = Device::default().autodiff();
        for (shape, residual, slope) in [
            ([3, 5, 7, 9], false, 1.0),
            ([2, 18, 4, 4], false, 0.0),
            ([2, 3, 50, 45], false, 0.3),
            ([4, 6, 5, 3], true, 0.0),
            ([2, 4, 3, 3], true, 1.0),
        ] {
            let (ours, burns) = layers(shape[1], &device);
            let x = tensor(shape, 0.0, &device).require_grad();
            let r = tensor(shape, 5.0, &device).require_grad();
            let factor = tensor(shape, 2.0, &device);

            let y = ours.forward_rectified(x.clone(), residual.then(|| r.clone()), slope);
            let expected = burns.forward(x.clone());
            let expected = if residual { expected + r.clone() } else { expected };
            let expected = expected.clone().clamp_min(0.0) + expected.clamp_max(0.0) * slope;
            close(vec(y.clone()), vec(expected.clone()), "output");

            let (a, b) =
                ((y * factor.clone()).sum().backward(), (expected * factor.clone()).sum().backward());
            let grad = |t: &Tensor<4>, g: &burn::tensor::Gradients| vec(t.grad(g).unwrap());
            close(grad(&x, &a), grad(&x, &b), "input's gradient");
            if residual {
                close(grad(&r, &a), grad(&r, &b), "residual's gradient");
            }
            let of = |p: &Param<Tensor<1>>, g: &burn::tensor::Gradients| vec(p.val().grad(g).unwrap());
            close(of(&ours.weight, &a), of(&burns.gamma, &b), "weight's gradient");
            close(of(&ours.bias, &a), of(&burns.beta, &b), "bias' gradient");

            let count = (shape[0] * shape[2] * shape[3]) as f32;
            let biased = |v: Vec<f32>| -> Vec<f32> {
                // Burn keeps the biased variance: remove the factor from the new batch's part.
                v.iter().map(|v| (v - 0.9) * (count - 1.0) / count + 0.9).collect()
            };
            close(vec(ours.running_mean.value_sync()), vec(burns.running_mean.value_sync()), "running mean");
            close(
                biased(vec(ours.running_var.value_sync())),
                vec(burns.running_var.value_sync()),
                "running variance",
            );
        }
    }

    #[test]
    fn running_statistics_are_used_without_gradients_and_when_frozen() {
        let device = Device::default().autodiff();
        let (ours, burns) = layers(4, &device);
        let shape = [2, 4, 5, 5];
        for seed in [1.0, 2.0, 3.0] {
            ours.forward(tensor(shape, seed, &device));
        }
        let mut burns = burns.freeze();
        burns.running_mean = RunningState::new(ours.running_mean.value_sync());
        burns.running_var = RunningState::new(ours.running_var.value_sync());

        let plain = Device::default();
        let x = tensor(shape, 0.0, &plain);
        close(vec(ours.valid().forward(x.clone())), vec(burns.valid().forward(x)), "inference");

        let before = vec(ours.running_mean.value_sync());
        let ours = ours.freeze();
        let (a, b) = (tensor(shape, 0.0, &device).require_grad(), tensor(shape, 0.0, &device).require_grad());
        let factor = tensor(shape, 2.0, &device);
        let ga = (ours.forward(a.clone()) * factor.clone()).sum().backward();
        let gb = (burns.forward(b.clone()) * factor).sum().backward();
        close(vec(a.grad(&ga).unwrap()), vec(b.grad(&gb).unwrap()), "gradient through a frozen layer");
        assert_eq!(before, vec(ours.running_mean.value_sync()));
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let device = Device::default().autodiff();
                let (ours, _) = layers(13, &device);
                let x = tensor([3, 13, 31, 17], 0.0, &device).require_grad();
                let y = ours.forward_rectified(x.clone(), None, 0.0);
                let grads = (y.clone() * tensor([3, 13, 31, 17], 2.0, &device)).sum().backward();
                let bits = |v: Vec<f32>| v.into_iter().map(f32::to_bits).collect::<Vec<_>>();
                let weight = ours.weight.val().grad(&grads).unwrap();
                [bits(vec(y)), bits(vec(x.grad(&grads).unwrap())), bits(vec(weight))]
            })
        };
        assert_eq!(run(1), run(5));
    }

    #[test]
    fn folding_into_a_convolution_changes_nothing() {
        let device = Device::default();
        let (mut norm, _) = layers(6, &device);
        norm.running_mean = RunningState::new(tensor([6], 3.0, &device));
        norm.running_var = RunningState::new(tensor([6], 4.0, &device).abs() + 0.1);
        let (x, weight) = (tensor([2, 3, 8, 8], 0.0, &device), tensor([6, 3, 3, 3], 1.0, &device));
        let spec = crate::kernels::ConvSpec {
            stride: 1,
            padding: [1, 1],
            groups: 1,
            activation: crate::kernels::Activation::Linear,
        };
        let bias = Tensor::zeros([6], &device);
        let apart = norm.forward(crate::ops::conv(x.clone(), weight.clone(), bias, spec));
        let (weight, bias) = norm.fold(weight);
        close(vec(crate::ops::conv(x, weight, bias, spec)), vec(apart), "folded");
    }
}
