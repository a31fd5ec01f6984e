//! A network with its optimiser: steps of both, and their sections of a checkpoint.

use burn::grad_clipping::GradientClippingConfig;
use burn::module::Module;
use burn::optim::{AdamConfig, AdamWConfig, GradientsParams, ModuleOptimizer};
use burn::tensor::Tensor;

use crate::checkpoint::{Checkpoint, CheckpointError, CheckpointWriter};
use crate::options::TrainingOptions;
use crate::parameters::{Changeable, Network, Parameters, gradients_of};

/// State that is saved to and restored from a checkpoint.
pub trait Checkpointed {
    /// Adds the state to a checkpoint.
    ///
    /// # Errors
    /// [`CheckpointError`].
    fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError>;

    /// Restores the state from a checkpoint.
    ///
    /// # Errors
    /// [`CheckpointError`].
    fn restore(&mut self, checkpoint: &Checkpoint) -> Result<(), CheckpointError>;
}

/// A network in training, on an autodiff device, with the optimiser of all its parameters.
pub struct Learner<N> {
    name: String,
    network: N,
    optimiser: ModuleOptimizer,
}

impl<N: Module> Learner<N> {
    /// With AdamW and these options. `name` identifies both in checkpoints.
    pub fn adam_w(name: impl Into<String>, network: N, options: &TrainingOptions) -> Self {
        let clip = options.max_grad_norm.map(GradientClippingConfig::Norm);
        let config = AdamWConfig::new().with_weight_decay(options.weight_decay).with_grad_clipping(clip);
        Learner { name: name.into(), network, optimiser: config.init() }
    }

    /// With Adam (Kingma and Ba 2015), its published moments, without weight decay and gradient clipping.
    pub fn adam(name: impl Into<String>, network: N) -> Self {
        Learner { name: name.into(), network, optimiser: AdamConfig::new().init() }
    }

    /// The current network.
    pub fn network(&self) -> &N {
        &self.network
    }

    /// Changes the network other than by a training step, for example by freezing parts of it.
    pub fn change(&mut self, change: impl FnOnce(N) -> N) {
        self.network = change(self.network.clone());
    }

    /// The trained network, off the autodiff device.
    pub fn into_network(self) -> N {
        self.network.valid()
    }

    /// One training step on the gradients of `loss` (a scalar) at a learning rate.
    pub fn descend(&mut self, rate: f64, loss: Tensor<1>) {
        let gradients = gradients_of(&mut loss.backward(), &self.network);
        self.step(rate, gradients);
    }

    /// One training step of the whole network at a learning rate.
    pub fn step(&mut self, rate: f64, gradients: GradientsParams) {
        self.step_part(rate, gradients, |network| network);
    }

    /// One training step of a part of the network, such as a pretrained encoder with its own rate.
    pub fn step_part<P: Module>(
        &mut self,
        rate: f64,
        gradients: GradientsParams,
        part: impl FnOnce(&mut N) -> &mut P,
    ) {
        let part = part(&mut self.network);
        let mut changed = Network::new(part.clone());
        step(&mut self.optimiser, rate, &mut changed, gradients);
        *part = changed.into_inner();
    }
}

fn step(optimiser: &mut ModuleOptimizer, rate: f64, part: &mut dyn Changeable, gradients: GradientsParams) {
    optimiser.step(rate, Parameters::of(part.shown()), gradients).put_into(part);
}

impl<N: Module> Checkpointed for Learner<N> {
    fn save(&self, checkpoint: CheckpointWriter) -> Result<CheckpointWriter, CheckpointError> {
        checkpoint.module(&self.name, &self.network)?.optimiser(&self.name, &self.optimiser)
    }

    fn restore(&mut self, checkpoint: &Checkpoint) -> Result<(), CheckpointError> {
        self.network = checkpoint.module(&self.name, self.network.clone())?;
        self.optimiser = checkpoint.optimiser(&self.name, self.optimiser.clone())?;
        Ok(())
    }
}
