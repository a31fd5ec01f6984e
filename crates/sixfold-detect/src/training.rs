//! The training of a detector: one image at a time through the network, gradients summed over a batch, AdamW.

use crate::anchored::{AnchoredImage, AnchoredTraining};
use crate::loss::{LossWeights, RawOutput, loss};
use crate::network::{Detector, DetectorConfig, DetectorOutput, MASK_STRIDE};
use crate::samples::{TrainingImageOptions, TrainingImageSource};
use crate::targets::Targets;
use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sixfold_nn::learner::{Checkpointed, Learner};
use sixfold_nn::options::{OptionError, Pace, TrainingOptions};
use sixfold_nn::parameters::{GradientSum, gradients_of};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};

/// Options of the training. All of them affect the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DetectorTrainingOptions {
    /// Steps, learning rate of pyramid and heads, seed.
    #[serde(flatten)]
    pub common: TrainingOptions,
    /// Images in a step, 1 or more.
    pub batch: usize,
    /// Learning rate of the pretrained encoder as a fraction of the learning rate, 0 to 1.
    pub encoder_rate: f64,
    /// Number of frozen stages of the encoder, 0 to 5.
    pub frozen_stages: usize,
}

impl Default for DetectorTrainingOptions {
    fn default() -> Self {
        DetectorTrainingOptions {
            common: TrainingOptions {
                steps: 8000,
                learning_rate: 2e-3,
                warm_up: 200,
                weight_decay: 1e-4,
                max_grad_norm: Some(10.0),
                seed: 0,
            },
            batch: 4,
            encoder_rate: 0.3,
            frozen_stages: 2,
        }
    }
}

impl DetectorTrainingOptions {
    /// Checks every number.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.common.check()?;
        OptionError::unless_samples("batch", self.batch, 1, "1 or more")?;
        OptionError::unless_frozen_stages(self.frozen_stages)?;
        OptionError::unless_fraction("encoder_rate", self.encoder_rate)
    }
}

/// An image as the network's input, and its targets.
pub struct TrainingImage {
    input: Vec<f32>,
    targets: Targets,
}

/// A network in training.
pub struct DetectorTraining {
    learner: Learner<Detector>,
    config: DetectorConfig,
    options: DetectorTrainingOptions,
    /// How often the training logs and saves.
    pub pace: Pace,
    side: usize,
    device: Device,
}

impl DetectorTraining {
    /// Starts the training of a network created by `config` on the autodiff `device`, with images of `side` pixels.
    pub fn new(
        network: Detector,
        config: DetectorConfig,
        side: usize,
        options: DetectorTrainingOptions,
        device: Device,
    ) -> Self {
        let learner = Learner::adam_w("network", network.freeze(options.frozen_stages), &options.common);
        let pace = Pace { sample_threads: 2, ..Pace::default() };
        DetectorTraining { learner, config, options, pace, side, device }
    }

    /// The trained network and its configuration.
    pub fn into_network(self) -> (Detector, DetectorConfig) {
        (self.learner.into_network(), self.config)
    }
}

fn numbers(tensor: &Tensor<4>) -> Vec<f32> {
    let data = tensor.clone().inner().into_data();
    data.try_to_vec().unwrap_or_else(|error| unreachable!("f32 output: {error:?}"))
}

/// Losses of one image, and the gradients of the encoder and of the other parameters.
struct ImageGradients {
    terms: [f64; 3],
    encoder: GradientsParams,
    heads: GradientsParams,
}

impl DetectorTraining {
    /// Forward and backward pass of one image. `network` is this thread's own copy ([`Module::fork`]): Burn treats graphs that
    /// share parameters as one, and two threads that build and traverse it deadlock.
    fn gradients(
        &self,
        network: &Detector,
        image: &TrainingImage,
        positives: usize,
        masks: usize,
    ) -> ImageGradients {
        let side = self.side;
        let input = TensorData::new(image.input.clone(), [1, 3, side, side]);
        let DetectorOutput { scores, boxes, prototypes } =
            network.forward(Tensor::from_data(input, &self.device));
        let raw_scores: Vec<Vec<f32>> = scores.iter().map(numbers).collect();
        let raw_boxes: Vec<Vec<f32>> = boxes.iter().map(numbers).collect();
        let raw_prototypes = numbers(&prototypes);
        let raw = RawOutput {
            scores: &raw_scores,
            boxes: &raw_boxes,
            prototypes: &raw_prototypes,
            mask_width: side / MASK_STRIDE,
        };
        let value = loss(&raw, &image.targets, &self.config, &LossWeights::default(), positives, masks);
        let terms = [value.scores, value.boxes, value.masks];
        let gradients = value.of_scores.into_iter().chain(value.of_boxes).chain([value.of_prototypes]);
        let outputs = scores.into_iter().chain(boxes).chain([prototypes]);
        let products = outputs.zip(gradients).map(|(out, gradient)| {
            let dims = out.dims();
            (out * Tensor::from_data(TensorData::new(gradient, dims), &self.device)).sum()
        });
        let Some(sum) = products.reduce(|a, b| a + b) else { unreachable!("a detector has levels") };
        let mut gradients = sum.backward();
        let encoder = gradients_of(&mut gradients, &network.encoder);
        let heads = gradients_of(&mut gradients, network);
        ImageGradients { terms, encoder, heads }
    }
}

impl Training for DetectorTraining {
    type Samples = TrainingImageSource;
    type Batch = Vec<TrainingImage>;

    fn plan(&self, source: &TrainingImageSource) -> Result<Plan, TrainError> {
        let options = &self.options;
        options.check()?;
        let (side, alignment) = (source.options().size, self.config.alignment());
        let found = format!("{side} pixels with a stride of {alignment}");
        let expected = "a multiple of the coarsest level's stride";
        let fits = side == self.side && side.is_multiple_of(alignment);
        OptionError::unless(fits, "size", found, expected)?;
        let settings = Settings {
            training: options,
            network: &self.config,
            samples: source.options(),
            photographs: source.photographs(),
        };
        Plan::new(&options.common, options.batch, self.pace, &settings)
    }

    fn batches<'a>(&self, source: &'a TrainingImageSource) -> Batches<'a, Self::Batch> {
        let (config, options) = (self.config.clone(), self.options.clone());
        Box::new(move |step| make_batch(source, &config, &options, step))
    }

    fn step(&mut self, batch: Self::Batch, rate: f64) -> Losses {
        let count = |of: fn(&Targets) -> usize| batch.iter().map(|i| of(&i.targets)).sum::<usize>();
        let positives = count(|t| t.positives.len());
        let masks = count(|t| t.mask_positives.len());
        // One image per thread: a batch in one tensor would not fit into the processor's caches, and many operations between
        // convolutions run on one thread. These are separate threads, not rayon's pool, whose kernels must not wait for a whole
        // image.
        let threads = rayon::current_num_threads().clamp(1, batch.len().max(1));
        let (training, network) = (&*self, self.learner.network());
        let parts: Vec<Vec<ImageGradients>> = std::thread::scope(|scope| {
            let workers: Vec<_> = (0..threads)
                .map(|first| {
                    let images = batch.iter().skip(first).step_by(threads);
                    let network = network.clone().fork(&training.device);
                    scope.spawn(move || {
                        images.map(|i| training.gradients(&network, i, positives, masks)).collect()
                    })
                })
                .collect();
            let join = |worker: std::thread::ScopedJoinHandle<'_, _>| match worker.join() {
                Ok(parts) => parts,
                Err(panic) => std::panic::resume_unwind(panic),
            };
            workers.into_iter().map(join).collect()
        });
        // Summed in the order of the images, independent of the threads.
        let mut of_encoder = GradientSum::new();
        let mut of_heads = GradientSum::new();
        let mut sums = [0.0; 3];
        let mut parts: Vec<_> = parts.into_iter().map(Vec::into_iter).collect();
        for image in 0..batch.len() {
            let Some(part) = parts[image % threads].next() else { continue };
            sums.iter_mut().zip(part.terms).for_each(|(sum, term)| *sum += term);
            of_encoder.add(&network.encoder, part.encoder);
            of_heads.add(network, part.heads);
        }
        let encoder_rate = rate * self.options.encoder_rate;
        self.learner.step_part(encoder_rate, of_encoder.into_gradients(), |network| &mut network.encoder);
        self.learner.step(rate, of_heads.into_gradients());
        [("scores", sums[0]), ("boxes", sums[1]), ("masks", sums[2])]
            .map(|(name, value)| (name.to_string(), value))
            .into()
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        vec![&mut self.learner]
    }

    fn restored(&mut self) {
        let stages = self.options.frozen_stages;
        self.learner.change(|network| network.freeze(stages));
    }
}

/// The training of a detector of any kind.
pub enum AnyTraining {
    /// Without anchors.
    Anchorless(Box<DetectorTraining>),
    /// With anchors.
    Anchored(Box<AnchoredTraining>),
}

/// The batch of a step of [`AnyTraining`].
pub enum AnyBatch {
    /// Without anchors.
    Anchorless(Vec<TrainingImage>),
    /// With anchors.
    Anchored(Vec<AnchoredImage>),
}

impl Training for AnyTraining {
    type Samples = TrainingImageSource;
    type Batch = AnyBatch;

    fn plan(&self, source: &TrainingImageSource) -> Result<Plan, TrainError> {
        match self {
            AnyTraining::Anchorless(training) => training.plan(source),
            AnyTraining::Anchored(training) => training.plan(source),
        }
    }

    fn batches<'a>(&self, source: &'a TrainingImageSource) -> Batches<'a, AnyBatch> {
        match self {
            AnyTraining::Anchorless(training) => {
                let batches = training.batches(source);
                Box::new(move |step| AnyBatch::Anchorless(batches(step)))
            }
            AnyTraining::Anchored(training) => {
                let batches = training.batches(source);
                Box::new(move |step| AnyBatch::Anchored(batches(step)))
            }
        }
    }

    fn step(&mut self, batch: AnyBatch, rate: f64) -> Losses {
        match (self, batch) {
            (AnyTraining::Anchorless(training), AnyBatch::Anchorless(batch)) => training.step(batch, rate),
            (AnyTraining::Anchored(training), AnyBatch::Anchored(batch)) => training.step(batch, rate),
            _ => unreachable!("a training makes its own batches"),
        }
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        match self {
            AnyTraining::Anchorless(training) => training.learners(),
            AnyTraining::Anchored(training) => training.learners(),
        }
    }

    fn restored(&mut self) {
        match self {
            AnyTraining::Anchorless(training) => training.restored(),
            AnyTraining::Anchored(training) => training.restored(),
        }
    }
}

/// The images of a step.
fn make_batch(
    source: &TrainingImageSource,
    config: &DetectorConfig,
    options: &DetectorTrainingOptions,
    step: u64,
) -> Vec<TrainingImage> {
    let side = source.options().size;
    (0..options.batch as u64)
        .map(|image| {
            let sample = source.sample(options.common.seed, step * options.batch as u64 + image);
            let targets = Targets::new(&sample.annotation, config);
            let mut input = sample.rgb;
            config.input(&mut input, side * side);
            TrainingImage { input, targets }
        })
        .collect()
}

/// Everything that affects the result.
#[derive(Serialize)]
struct Settings<'a> {
    #[serde(flatten)]
    training: &'a DetectorTrainingOptions,
    network: &'a DetectorConfig,
    samples: &'a TrainingImageOptions,
    photographs: usize,
}

/// Milliseconds to generate one training image, averaged over `count`, on all threads (for benchmarks).
pub fn sample_time(source: &TrainingImageSource, count: u64) -> f64 {
    let start = std::time::Instant::now();
    (0..count).into_par_iter().for_each(|n| drop(source.sample(0, n)));
    1000.0 * start.elapsed().as_secs_f64() / count as f64
}
