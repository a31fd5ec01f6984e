//! A discriminator in training, and the losses of a training against it (equations 3.4 and 3.5).

use burn::tensor::{Device, Tensor};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_nn::learner::Learner;

use crate::networks::{Discriminator, DiscriminatorConfig};

/// Distinguishes generated images of coordinates from rendered ones, and learns to.
pub(crate) struct Critic {
    pub learner: Learner<Discriminator>,
    seed: u64,
}

impl Critic {
    /// A new one; `name` is its part of checkpoints.
    pub fn new(name: impl Into<String>, seed: u64, device: &Device) -> Self {
        Critic { learner: Learner::adam(name, DiscriminatorConfig { seed }.init(device)), seed }
    }

    /// One step on generated, then on rendered coordinates (`batch x 3 x side x side`, of which no gradient is taken); its mean
    /// loss.
    pub fn step(
        &mut self,
        generated: Tensor<4>,
        rendered: Tensor<4>,
        step: u64,
        rate: f64,
        device: &Device,
    ) -> f64 {
        // Soft labels, now and then swapped for a whole batch, as in the author's code.
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        random.set_stream(step + 1);
        let mut sum = 0.0;
        for (images, true_label) in [(generated, false), (rendered, true)] {
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

    /// The generator's adversarial loss: how surely generated coordinates are recognised as such.
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
