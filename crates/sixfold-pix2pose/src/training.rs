//! The training of the compact network: its steps and batches.

use crate::loss::{LossOptions, OutputKind, Targets, loss};
use crate::model::network_input;
use crate::networks::Compact;
use crate::object::SymmetryMap;
use crate::samples::SampleSource;
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_nn::critic::Critic;
use sixfold_nn::learner::{Checkpointed, Learner};
use sixfold_nn::options::{OptionError, Pace, TrainingOptions};
use sixfold_nn::parameters::{GradientSum, gradients_of};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};

/// Options of the training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pix2PoseTrainingOptions {
    /// Steps, learning rate of the decoders, seed.
    #[serde(flatten)]
    pub common: TrainingOptions,
    /// Images of every object in a step, 1 or more.
    pub per_object: usize,
    /// Learning rate of the pretrained encoder as a fraction of the learning rate, 0 to 1.
    pub encoder_rate: f64,
    /// Number of frozen stages of the encoder, 0 to 5.
    pub frozen_stages: usize,
    /// Use the transformer loss (equation 3.2); otherwise plain L1 (equation 3.1).
    pub transformer_loss: bool,
    /// Weight of the adversarial loss (equation 3.4) against that of the coordinates; 0 trains without discriminators. The
    /// dissertation's is 0.01. There is one discriminator per object; its input are the coordinates within the object's whole
    /// silhouette.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub adversarial: f32,
}

/// Cards and checkpoints omit unused options.
fn is_zero(weight: &f32) -> bool {
    *weight == 0.0
}

impl Default for Pix2PoseTrainingOptions {
    fn default() -> Self {
        Pix2PoseTrainingOptions {
            common: TrainingOptions {
                steps: 8000,
                learning_rate: 2e-3,
                warm_up: 100,
                weight_decay: 1e-4,
                max_grad_norm: None,
                seed: 0,
            },
            per_object: 4,
            encoder_rate: 0.3,
            frozen_stages: 2,
            transformer_loss: true,
            adversarial: 0.0,
        }
    }
}

impl Pix2PoseTrainingOptions {
    /// Checks every number.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.common.check()?;
        OptionError::unless_samples("per_object", self.per_object, 1, "1 or more")?;
        OptionError::unless_frozen_stages(self.frozen_stages)?;
        OptionError::unless_weight("adversarial", f64::from(self.adversarial))?;
        OptionError::unless_fraction("encoder_rate", self.encoder_rate)
    }
}

/// A batch: images of all objects, one object after another.
pub struct CompactBatch {
    rgb: Vec<f32>,
    coordinates: Vec<f32>,
    object: Vec<f32>,
    visible: Vec<f32>,
    step: u64,
}

fn make_batch(source: &SampleSource, options: &Pix2PoseTrainingOptions, step: u64) -> CompactBatch {
    let mut batch = CompactBatch { rgb: vec![], coordinates: vec![], object: vec![], visible: vec![], step };
    for object in 0..source.objects() {
        for image in 0..options.per_object {
            let sample =
                source.sample(object, options.common.seed, step * options.per_object as u64 + image as u64);
            batch.rgb.extend(network_input(&sample.rgb));
            batch.coordinates.extend(sample.coordinates);
            batch.object.extend(sample.object);
            batch.visible.extend(sample.visible);
        }
    }
    batch
}

/// The compact network in training, with one discriminator per object or none.
pub struct CompactTraining {
    learner: Learner<Compact>,
    critics: Vec<Critic>,
    pools: Vec<Vec<SymmetryMap>>,
    /// Side of the input, pixels.
    side: usize,
    options: Pix2PoseTrainingOptions,
    /// How often the training logs and saves.
    pub pace: Pace,
    device: Device,
}

impl CompactTraining {
    /// Starts the training of a network on the autodiff `device` with an input of `side` pixels; `pools` has every object's
    /// symmetries, the identity first.
    pub fn new(
        network: Compact,
        pools: Vec<Vec<SymmetryMap>>,
        side: usize,
        options: Pix2PoseTrainingOptions,
        device: Device,
    ) -> Self {
        let critic = |o| Critic::new(format!("discriminator-{o}"), options.common.seed, &device);
        let critics = if options.adversarial > 0.0 { (0..pools.len()).map(critic).collect() } else { vec![] };
        let learner = Learner::adam_w("network", network.freeze(options.frozen_stages), &options.common);
        let pace = Pace { sample_threads: 2, ..Pace::default() };
        CompactTraining { learner, critics, pools, side, options, pace, device }
    }

    /// The trained network.
    pub fn into_network(self) -> Compact {
        self.learner.into_network()
    }

    fn check(&self, source: &SampleSource) -> Result<(), OptionError> {
        self.options.check()?;
        let (pools, decoders) = (&self.pools, self.learner.network().decoders.len());
        let fits = pools.len() == source.objects() && pools.iter().all(|pool| !pool.is_empty());
        let expected = "one list with the identity for every object";
        OptionError::unless(fits, "pools", format!("{} lists", pools.len()), expected)?;
        let found = format!("{decoders} decoders for {} objects", pools.len());
        OptionError::unless(decoders == pools.len(), "network", found, "one decoder an object")?;
        let (side, target) = (source.options().size, source.options().target());
        let fits = side == self.side && side.is_multiple_of(16) && target * 2 == side;
        let expected = "a multiple of 16 with targets of half the side";
        OptionError::unless(fits, "size", format!("{side} and {target}"), expected)
    }
}

impl Training for CompactTraining {
    type Samples = SampleSource;
    type Batch = CompactBatch;

    fn plan(&self, source: &SampleSource) -> Result<Plan, TrainError> {
        self.check(source)?;
        let images = self.options.per_object * self.pools.len();
        Plan::new(&self.options.common, images, self.pace, &self.options)
    }

    fn batches<'a>(&self, source: &'a SampleSource) -> Batches<'a, CompactBatch> {
        let options = self.options.clone();
        Box::new(move |step| make_batch(source, &options, step))
    }

    fn step(&mut self, batch: CompactBatch, rate: f64) -> Losses {
        let Self { learner, critics, pools, options, device, .. } = self;
        let (side, device, network) = (self.side, &*device, learner.network());
        let count = options.per_object;
        let images = pools.len() * count;
        let kind = OutputKind::Compact;
        let loss_options = LossOptions::of(kind);
        let mut sums = [0.0; 3];
        let mut adversarial = [0.0; 2];
        // One object at a time: their images together would not fit into the processor's caches, and this network is bound by
        // memory bandwidth.
        let mut encoder_gradients = GradientSum::new();
        let mut decoder_gradients = GradientSum::new();
        let mut rgb = batch.rgb.as_slice();
        for (object, pool) in pools.iter().enumerate() {
            let (images_of_object, rest) = rgb.split_at(count * 3 * side * side);
            rgb = rest;
            let input = TensorData::new(images_of_object.to_vec(), [count, 3, side, side]);
            let output = network.forward(Tensor::from_data(input, device), &[(object, count)]).remove(0);
            let dims = output.dims();
            let pixels = dims[2] * dims[3];
            let range = |width: usize| object * count * width * pixels..(object + 1) * count * width * pixels;
            let targets = Targets {
                coordinates: &batch.coordinates[range(3)],
                object: &batch.object[range(1)],
                visible: &batch.visible[range(1)],
            };
            let raw = output.clone().inner().into_data();
            let raw = raw.as_slice::<f32>().unwrap_or_else(|error| unreachable!("f32 output: {error:?}"));
            let pool = if options.transformer_loss { &pool[..] } else { &pool[..1] };
            let value = loss(raw, &targets, pixels, pool, kind, &loss_options, 1.0 / images as f32);
            for (sum, term) in sums.iter_mut().zip([value.coordinates, value.error, value.visibility]) {
                *sum += term / pools.len() as f64;
            }
            let gradient = Tensor::<4>::from_data(TensorData::new(value.gradient, dims), device);
            let mut total = (output.clone() * gradient).sum();
            if let Some(critic) = critics.get_mut(object) {
                let [_, _, height, width] = dims;
                let of = |values: &[f32], channels: usize| {
                    let shape = [count, channels, height, width];
                    Tensor::<4>::from_data(TensorData::new(values.to_vec(), shape), device)
                };
                let silhouette = of(targets.object, 1);
                let rendered = of(targets.coordinates, 3) * silhouette.clone();
                let generated = output.narrow(1, 0, 3) * silhouette;
                adversarial[0] += critic.step(generated.clone().detach(), rendered, batch.step, rate, device);
                let loss = critic.generator_loss(generated);
                adversarial[1] += f64::from(loss.clone().inner().into_scalar::<f32>());
                total = total + loss.mul_scalar(options.adversarial * count as f32 / images as f32);
            }
            let mut gradients = total.backward();
            let of_encoder = gradients_of(&mut gradients, &network.encoder);
            let of_decoders = gradients_of(&mut gradients, &network.decoders);
            encoder_gradients.add(&network.encoder, of_encoder);
            decoder_gradients.add(&network.decoders, of_decoders);
        }
        let encoder_rate = rate * options.encoder_rate;
        learner.step_part(encoder_rate, encoder_gradients.into_gradients(), |network| &mut network.encoder);
        learner.step_part(rate, decoder_gradients.into_gradients(), |network| &mut network.decoders);
        let mut losses = Losses::from(
            [("coordinates", sums[0]), ("error", sums[1]), ("visibility", sums[2])]
                .map(|(name, value)| (name.to_string(), value)),
        );
        if !critics.is_empty() {
            let [discriminator, generator] = adversarial.map(|sum| sum / pools.len() as f64);
            losses.insert("discriminator".to_string(), discriminator);
            losses.insert("adversarial".to_string(), generator);
        }
        losses
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        let mut learners: Vec<&mut dyn Checkpointed> = vec![&mut self.learner];
        learners.extend(self.critics.iter_mut().map(|critic| &mut critic.learner as &mut dyn Checkpointed));
        learners
    }

    fn restored(&mut self) {
        let stages = self.options.frozen_stages;
        self.learner.change(|network| network.freeze(stages));
    }
}
