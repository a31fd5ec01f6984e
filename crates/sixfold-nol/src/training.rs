//! The training: samples through the network, the losses of equations 4.1 and 4.2, AdamW.

use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_nn::choice::Choice;
use sixfold_nn::critic::Critic;
use sixfold_nn::learner::{Checkpointed, Learner};
use sixfold_nn::options::{OptionError, Pace, TrainingOptions};
use sixfold_nn::recurrent::gather;
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};
use sixfold_synth::augment::Backgrounds;

use crate::loss::{Perceptual, WEIGHTS, image_loss, smooth_loss, squared_error};
use crate::network::{Blend, COLOURS, Network, Parts};
use crate::preview::Preview;
use crate::samples::{Batch, ViewBatchOptions, ViewSampleOptions};

/// Options of the training. All of them affect the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NolTrainingOptions {
    /// Steps, learning rate, seed.
    #[serde(flatten)]
    pub common: TrainingOptions,
    /// Weights of colours, features and smoothness.
    pub weights: [f64; 3],
    /// Weight of the adversarial loss against a discriminator, which is trained together with the network; 0 for none.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub adversarial: f64,
    /// How samples are made.
    pub samples: ViewSampleOptions,
    /// Samples per step.
    pub batch: ViewBatchOptions,
}

impl Default for NolTrainingOptions {
    fn default() -> Self {
        NolTrainingOptions {
            common: TrainingOptions {
                steps: 5000,
                learning_rate: 2e-3,
                warm_up: 100,
                weight_decay: 1e-4,
                max_grad_norm: Some(5.0),
                seed: 0,
            },
            weights: WEIGHTS,
            adversarial: 0.0,
            samples: ViewSampleOptions::default(),
            batch: ViewBatchOptions {
                sides: vec![96, 128, 160],
                min_sources: 1,
                max_sources: 8,
                sources: 10,
                max_samples: 4,
            },
        }
    }
}

impl NolTrainingOptions {
    /// The dissertation's options (section 4.3.3): one target with eight sources of 256x256 pixels in a step, all of them with
    /// rough poses; 35 epochs of 10,000 images.
    pub fn published() -> Self {
        let default = Self::default();
        NolTrainingOptions {
            common: TrainingOptions { steps: 350_000, learning_rate: 1e-3, ..default.common },
            samples: ViewSampleOptions::published(),
            batch: ViewBatchOptions {
                sides: vec![256],
                min_sources: 8,
                max_sources: 8,
                sources: 8,
                max_samples: 1,
            },
            ..default
        }
    }

    /// The same with the losses of one column of table 4.6.
    pub(crate) fn with_losses(self, losses: NolLosses) -> Self {
        let [colours, features, smoothness] = WEIGHTS;
        let (weights, adversarial) = match losses {
            NolLosses::L1 => ([colours, 0.0, 0.0], 0.0),
            NolLosses::Image => ([colours, features, 0.0], 0.0),
            NolLosses::Smooth => ([colours, features, smoothness], 0.0),
            NolLosses::Gan => ([colours, features, smoothness], 1.0),
        };
        NolTrainingOptions { weights, adversarial, ..self }
    }

    /// Checks every number.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.common.check()?;
        let sides = &self.batch.sides;
        let fits = |side: &usize| side.is_multiple_of(16) && (32..=1024).contains(side);
        let expected = "multiples of 16 from 32 to 1024 pixels";
        let all = !sides.is_empty() && sides.iter().all(fits);
        OptionError::unless(all, "batch.sides", format!("{sides:?}"), expected)?;
        let sources = self.batch.max_sources;
        OptionError::unless((1..=16).contains(&sources), "batch.max_sources", sources, "1 to 16")?;
        let minimum = self.batch.min_sources;
        let expected = "1 to batch.max_sources";
        OptionError::unless((1..=sources).contains(&minimum), "batch.min_sources", minimum, expected)?;
        OptionError::unless_weight("adversarial", self.adversarial)?;
        self.weights.iter().try_for_each(|weight| OptionError::unless_weight("weights", *weight))
    }
}

fn is_zero(weight: &f64) -> bool {
    *weight == 0.0
}

/// Which losses a training sums: the columns of table 4.6, each with one more.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NolLosses {
    /// Colours alone.
    L1,
    /// Equation 4.1: colours and features.
    Image,
    /// Equations 4.1 and 4.2: with smoothness.
    Smooth,
    /// With an adversarial loss. The dissertation does not state its weight; it is 1 here.
    Gan,
}

impl Choice for NolLosses {
    const ALL: &'static [NolLosses] = &[NolLosses::L1, NolLosses::Image, NolLosses::Smooth, NolLosses::Gan];

    fn name(self) -> &'static str {
        match self {
            NolLosses::L1 => "l1",
            NolLosses::Image => "image",
            NolLosses::Smooth => "smooth",
            NolLosses::Gan => "gan",
        }
    }

    fn help(self) -> &'static str {
        match self {
            NolLosses::L1 => "L1 of the colours alone",
            NolLosses::Image => "Colours and features (equation 4.1)",
            NolLosses::Smooth => "As image, plus smoothness (equation 4.2)",
            NolLosses::Gan => "As smooth, plus a discriminator that is trained with the network",
        }
    }
}

/// The result of a forward pass of a batch.
pub(crate) struct Passed {
    /// X^S and the weights.
    pub blend: Blend,
    /// X^phi, or X^D without decoder: `B x 3 x side x side`, -1 to 1.
    pub image: Tensor<4>,
    /// X^GT.
    pub target: Tensor<4>,
    /// M^D, `B x 1 x side x side`.
    pub mask: Tensor<4>,
}

/// Forward pass of a batch, on `device`.
pub(crate) fn pass(network: &Network, batch: Batch, device: &Device) -> Passed {
    let (side, sources, samples) = (batch.side, batch.sources, batch.samples);
    let all = sources * samples;
    let tensor = |values: Vec<f32>, count: usize, channels: usize| {
        Tensor::<4>::from_data(TensorData::new(values, [count, channels, side, side]), device)
    };
    let valid: Vec<f32> = batch.cosines.iter().map(|c| f32::from(u8::from(*c > 0.0))).collect();
    let valid = tensor(valid, all, 1);
    let maps = network.encode(tensor(batch.images, all, COLOURS));
    let mut channels = vec![tensor(batch.colours, all, COLOURS)];
    channels.extend(maps.into_iter().map(|map| gather(map, batch.places.clone())));
    channels.push(tensor(batch.cosines, all, 1));
    let blend = network.blend(Tensor::cat(channels, 1), valid.clone(), sources);
    let mask = valid.reshape([sources, samples, side, side]).sum_dim(0).clamp_max(1.0);
    let colours = blend.sum.clone().narrow(1, 0, COLOURS);
    let image = network.decode(blend.sum.clone()).unwrap_or(colours);
    Passed {
        blend,
        image,
        target: tensor(batch.target, samples, COLOURS),
        mask: mask.reshape([samples, 1, side, side]),
    }
}

/// A network in training.
pub struct NolTraining {
    learner: Learner<Network>,
    critic: Option<Critic>,
    parts: Parts,
    perceptual: Perceptual,
    preview: Option<Preview>,
    options: NolTrainingOptions,
    /// How often the training logs and saves.
    pub pace: Pace,
    device: Device,
}

impl NolTraining {
    /// Starts the training of a network with these `parts` whose tensors are on the autodiff `device`; `perceptual` is the loss on
    /// features.
    pub fn new(
        network: Network,
        parts: Parts,
        perceptual: Perceptual,
        options: NolTrainingOptions,
        device: Device,
    ) -> Self {
        let learner = Learner::adam_w("network", network, &options.common);
        let pace = Pace { checkpoint_every: 100, ..Pace::default() };
        let critic =
            (options.adversarial > 0.0).then(|| Critic::new("discriminator", options.common.seed, &device));
        NolTraining { learner, critic, parts, perceptual, preview: None, options, pace, device }
    }

    /// Writes `preview.png` next to every checkpoint. It has one row per synthetic object with textures from `textures`: sources,
    /// the true target, the sources' average, X^D, X^phi.
    pub(crate) fn with_preview(mut self, textures: &Backgrounds) -> Self {
        self.preview = Some(Preview::new(textures, &self.options.samples, self.options.common.seed));
        self
    }

    /// The trained network.
    pub fn into_network(self) -> Network {
        self.learner.into_network()
    }
}

impl Training for NolTraining {
    /// Textures of objects, backgrounds and clutter.
    type Samples = Backgrounds;
    type Batch = Batch;

    fn plan(&self, textures: &Backgrounds) -> Result<Plan, TrainError> {
        let options = &self.options;
        options.check()?;
        let settings = Settings {
            training: options,
            architecture: self.learner.network().architecture(),
            parts: self.parts,
            textures: textures.images(),
        };
        Plan::new(&options.common, 1, self.pace, &settings)
    }

    fn batches<'a>(&self, textures: &'a Backgrounds) -> Batches<'a, Batch> {
        let options = self.options.clone();
        let seed = options.common.seed;
        Box::new(move |step| Batch::of_step(textures, &options.samples, &options.batch, seed, step))
    }

    fn step(&mut self, batch: Batch, rate: f64) -> Losses {
        let (_, averaging) = batch.average();
        let number_of_step = batch.step;
        let out = pass(self.learner.network(), batch, &self.device);
        let (colours, features) =
            image_loss(out.image.clone(), out.target.clone(), out.mask.clone(), &self.perceptual);
        let smoothness = smooth_loss(out.blend.sum.clone(), out.mask.clone());
        let number = |t: &Tensor<1>| f64::from(t.clone().inner().into_scalar::<f32>());
        let error = |image: &Tensor<4>| {
            let (target, mask) = (out.target.clone().inner(), out.mask.clone().inner());
            f64::from(squared_error(image.clone().inner(), target, mask).into_scalar::<f32>())
        };
        let mut losses = vec![
            ("colours", number(&colours)),
            ("features", number(&features)),
            ("smoothness", number(&smoothness)),
            ("squared error", error(&out.blend.sum.clone().narrow(1, 0, COLOURS))),
            ("squared error decoded", error(&out.image)),
            ("squared error of averaging", averaging),
        ];
        let [of_colours, of_features, of_smoothness] = self.options.weights;
        let mut sum = colours * of_colours + features * of_features + smoothness * of_smoothness;
        if let Some(critic) = &mut self.critic {
            // Pixels that no source shows are left out of both.
            let (image, target) = (out.image * out.mask.clone(), out.target * out.mask);
            let critic_loss = critic.step(image.clone().detach(), target, number_of_step, rate, &self.device);
            let adversarial = critic.generator_loss(image);
            losses.extend([("discriminator", critic_loss), ("adversarial", number(&adversarial))]);
            sum = sum + adversarial * self.options.adversarial;
        }
        self.learner.descend(rate, sum);
        losses.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        let mut learners: Vec<&mut dyn Checkpointed> = vec![&mut self.learner];
        learners.extend(self.critic.iter_mut().map(|critic| &mut critic.learner as &mut dyn Checkpointed));
        learners
    }

    fn before_checkpoint(&mut self, folder: &Path) {
        if let Some(preview) = &self.preview {
            preview.draw(&self.learner.network().valid(), folder);
        }
    }
}

/// Everything that affects the result.
#[derive(Serialize)]
struct Settings<'a> {
    #[serde(flatten)]
    training: &'a NolTrainingOptions,
    architecture: &'static str,
    parts: Parts,
    textures: usize,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::{CHANNELS, CompactConfig};
    use sixfold_nn::training::{Outcome, fit};
    use std::sync::atomic::{AtomicBool, Ordering};

    fn options(steps: u64) -> NolTrainingOptions {
        let default = NolTrainingOptions::default();
        NolTrainingOptions {
            common: TrainingOptions { steps, warm_up: 2, ..default.common },
            batch: ViewBatchOptions {
                sides: vec![48, 64],
                min_sources: 1,
                max_sources: 3,
                sources: 4,
                max_samples: 2,
            },
            ..default
        }
    }

    fn training(options: &NolTrainingOptions) -> NolTraining {
        let device = Device::flex().autodiff();
        let network = Network::Compact(CompactConfig::default().init(3, &device).unwrap());
        let perceptual = Perceptual::of(&network, &device).unwrap();
        NolTraining::new(network, Parts::default(), perceptual, options.clone(), device)
    }

    #[test]
    fn on_one_batch_the_loss_falls() {
        let textures = Backgrounds::procedural();
        let mut options = options(1);
        // As in AdamW with its default options.
        options.common.max_grad_norm = None;
        let mut training = training(&options);
        let batch = Batch::of_step(&textures, &options.samples, &options.batch, 0, 4);
        let losses: Vec<f64> = (0..12)
            .map(|_| {
                let losses = training.step(batch.clone(), 2e-3);
                options.weights[0] * losses["colours"] + options.weights[1] * losses["features"]
            })
            .collect();
        assert!(losses[11] < 0.95 * losses[0], "{losses:?}");
    }

    #[test]
    fn it_resumes_from_its_last_checkpoint() {
        let textures = Backgrounds::procedural();
        let options = options(6);
        let go = |folder: &Path, stop_at: Option<u64>, sample_threads: usize| {
            let stop = AtomicBool::new(false);
            let mut training = training(&options).with_preview(&textures);
            training.pace = Pace { checkpoint_every: 4, log_every: 1, sample_threads };
            let outcome = fit(&mut training, &textures, folder, &stop, |r| {
                stop.store(stop_at.is_some_and(|s| r.step >= s), Ordering::Relaxed);
            });
            (outcome.unwrap(), training.into_network())
        };
        let numbers = |n: &Network| -> Vec<f32> {
            let device = Device::flex();
            let maps = n.encode(Tensor::<4>::ones([1, 3, 32, 32], &device) * 0.3);
            let x = Tensor::<4>::ones([2, CHANNELS, 8, 8], &device) * 0.2;
            let blend = n.blend(x, Tensor::ones([2, 1, 8, 8], &device), 2);
            let mut out: Vec<f32> = maps[3].clone().into_data().try_to_vec().unwrap();
            out.extend(n.decode(blend.sum).unwrap().into_data().try_to_vec::<f32>().unwrap());
            out
        };
        let folder = tempfile::tempdir().unwrap();
        let (Outcome::Finished(()), straight) = go(&folder.path().join("a"), None, 1) else { panic!() };
        let b = folder.path().join("b");
        assert!(matches!(go(&b, Some(3), 2).0, Outcome::Interrupted { step: 3 }));
        let (Outcome::Finished(()), resumed) = go(&b, None, 1) else { panic!() };
        assert_eq!(numbers(&straight), numbers(&resumed));
        assert!(b.join("preview.png").exists());
        let wrong = NolTrainingOptions {
            batch: ViewBatchOptions { sides: vec![50], ..options.batch.clone() },
            ..options.clone()
        };
        assert!(wrong.check().unwrap_err().to_string().contains("batch.sides"));
    }
}
