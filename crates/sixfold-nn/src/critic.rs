//! A discriminator in training, and the losses of adversarial training (dissertation, equations 3.4 and 3.5).

use burn::tensor::{Device, Tensor};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::discriminator::{Discriminator, DiscriminatorConfig};
use crate::learner::Learner;

/// A discriminator in training: learns to distinguish generated images from true ones.
///
/// Generated and true images are in separate batches, as in the author's code. Batch normalisation, which also follows its last
/// convolution, then brings both kinds to the same mean, so that they can hardly be distinguished. (Smooth gradients against noise,
/// 32 pixels: after 120 steps the mean logits differ by 0.05.)
pub struct Critic {
    /// The network in training.
    pub learner: Learner<Discriminator>,
    seed: u64,
}

impl Critic {
    /// A new discriminator; `name` is its section in checkpoints.
    pub fn new(name: impl Into<String>, seed: u64, device: &Device) -> Self {
        Critic { learner: Learner::adam(name, DiscriminatorConfig { seed }.init(device)), seed }
    }

    /// One step on generated, then on true images (`batch x 3 x side x side`, without gradients through them); returns the mean
    /// loss.
    pub fn step(
        &mut self,
        generated: Tensor<4>,
        truth: Tensor<4>,
        step: u64,
        rate: f64,
        device: &Device,
    ) -> f64 {
        // Soft labels, sometimes swapped for a whole batch, as in the author's code.
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        random.set_stream(step + 1);
        let mut sum = 0.0;
        for (images, true_label) in [(generated, false), (truth, true)] {
            let label = if true_label != (random.random::<f32>() < 0.2) {
                random.random_range(0.9..1.0)
            } else {
                random.random_range(0.0..0.1)
            };
            let images = Tensor::from_data(images.into_data(), device);
            let loss = entropy(self.learner.network().forward(images), label);
            sum += 0.5 * f64::from(loss.clone().inner().into_scalar::<f32>());
            self.learner.descend(rate, loss);
        }
        sum
    }

    /// The generator's adversarial loss: how confidently generated images are recognised as such.
    pub fn generator_loss(&self, generated: Tensor<4>) -> Tensor<1> {
        entropy(self.learner.network().forward(generated), 1.0)
    }
}

/// Mean binary cross entropy of logits against one label.
fn entropy(logits: Tensor<2>, label: f32) -> Tensor<1> {
    let positive = logits.clone().clamp_min(0.0);
    let rest = logits.clone().abs().neg().exp().log1p();
    (positive - logits.mul_scalar(label) + rest).mean()
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::TensorData;

    #[test]
    fn its_gradient_agrees_with_finite_differences() {
        let device = Device::flex().autodiff();
        let critic = Critic::new("critic", 3, &device);
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let pixels: Vec<f32> = (0..4 * 3 * 256).map(|_| random.random_range(-1.0..1.0)).collect();
        let images =
            |values: Vec<f32>| Tensor::<4>::from_data(TensorData::new(values, [4, 3, 16, 16]), &device);
        let loss =
            |values: Vec<f32>| f64::from(critic.generator_loss(images(values)).inner().into_scalar::<f32>());
        let generated = images(pixels.clone()).require_grad();
        let gradients = critic.generator_loss(generated.clone()).backward();
        let gradient: Vec<f32> = generated.grad(&gradients).unwrap().into_data().try_to_vec().unwrap();
        let length = gradient.iter().map(|g| g * g).sum::<f32>().sqrt();
        assert!(length > 1e-4, "{length}");
        let moved = |by: f32| pixels.iter().zip(&gradient).map(|(p, g)| p + by * g / length).collect();
        let step = 0.02;
        let slope = (loss(moved(step)) - loss(moved(-step))) / f64::from(2.0 * step);
        assert!((slope / f64::from(length) - 1.0).abs() < 0.1, "{slope} {length}");
        // A step against the gradient lowers the loss: the images are then classified as true with a higher probability.
        assert!(loss(moved(-0.5)) < loss(pixels.clone()));
    }

    #[test]
    fn entropy_by_hand() {
        let device = Device::flex();
        let logits = Tensor::<2>::from_data([[0.0f32], [2.0]], &device);
        let expected = (2f32.ln() + (1.0 + (-2f32).exp()).ln()) / 2.0;
        assert!((entropy(logits.clone(), 1.0).into_scalar::<f32>() - expected).abs() < 1e-5);
        let expected = (2f32.ln() + (1.0 + 2f32.exp()).ln()) / 2.0;
        assert!((entropy(logits, 0.0).into_scalar::<f32>() - expected).abs() < 1e-5);
    }
}
