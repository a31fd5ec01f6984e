//! A discriminator and what teaches it, for trainings against one (equations 3.4 and 3.5).

use burn::optim::{AdamConfig, GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Tensor};
use rand::RngExt;
use sixfold_geometry::random::stream;
use sixfold_nn::checkpoint::{Checkpoint, CheckpointError, CheckpointWriter};

use crate::networks::{Discriminator, DiscriminatorConfig};

/// Tells generated images of coordinates from rendered ones, and learns to.
pub(crate) struct Critic {
    discriminator: Discriminator,
    optimiser: ModuleOptimizer,
    seed: u64,
    /// Its part of a checkpoint.
    name: String,
}

impl Critic {
    /// A new one; `name` is its part of checkpoints.
    pub fn new(name: impl Into<String>, seed: u64, device: &Device) -> Self {
        let discriminator = DiscriminatorConfig { seed }.init(device);
        Critic { discriminator, optimiser: AdamConfig::new().init(), seed, name: name.into() }
    }

    /// One step on generated, then on rendered coordinates (`batch x 3 x side x side`, of which no gradient is taken); its mean
    /// loss.
    pub fn teach(
        &mut self,
        generated: Tensor<4>,
        rendered: Tensor<4>,
        step: u64,
        rate: f64,
        device: &Device,
    ) -> f64 {
        // Soft labels, now and then turned round for a whole batch, as in the author's code.
        let mut random = stream(self.seed, step + 1);
        let mut sum = 0.0;
        for (images, true_label) in [(generated, false), (rendered, true)] {
            let label = if true_label != (random.random::<f32>() < 0.2) {
                random.random_range(0.9..1.0)
            } else {
                random.random_range(0.0..0.1)
            };
            let images = Tensor::from_data(images.into_data(), device);
            let loss = entropy(self.discriminator.forward(images), label);
            sum += 0.5 * f64::from(loss.clone().inner().into_scalar::<f32>());
            let gradients = GradientsParams::from_grads(loss.backward(), &self.discriminator);
            self.discriminator = self.optimiser.step(rate, self.discriminator.clone(), gradients);
        }
        sum
    }

    /// How far it is from taking generated coordinates for rendered ones: the generator's adversarial loss.
    pub fn doubt(&self, generated: Tensor<4>) -> Tensor<1> {
        entropy(self.discriminator.forward(generated), 1.0)
    }

    /// Adds it to a checkpoint.
    pub fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError> {
        checkpoint.module(&self.name, &self.discriminator)?.optimiser(&self.name, &self.optimiser)
    }

    /// As it was in a checkpoint.
    pub fn restore(self, checkpoint: &Checkpoint) -> Result<Self, CheckpointError> {
        Ok(Critic {
            discriminator: checkpoint.module(&self.name, self.discriminator)?,
            optimiser: checkpoint.optimiser(&self.name, self.optimiser)?,
            ..self
        })
    }
}

/// Mean binary cross entropy of logits against one label.
fn entropy(logits: Tensor<2>, label: f32) -> Tensor<1> {
    let positive = logits.clone().clamp_min(0.0);
    let rest = logits.clone().abs().neg().exp().log1p();
    (positive - logits.mul_scalar(label) + rest).mean()
}
