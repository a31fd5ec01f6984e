//! The training of GPD's network: random candidates, mirrored at random, binary cross entropy, AdamW.

use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor, TensorData};
use rand::RngExt;
use serde::Serialize;
use sixfold_geometry::random::stream;
use sixfold_grasp::learned::ClosingRegion;
use sixfold_nn::learner::{Checkpointed, Learner};
use sixfold_nn::options::{OptionError, Pace, TrainingOptions};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};

use crate::model::tensor;
use crate::network::{ARCHITECTURE, Gpd};
use crate::samples::Sample;

/// Candidates in a step, as in the paper's code.
const BATCH: usize = 64;

/// A network in training.
pub struct GpdTraining {
    learner: Learner<Gpd>,
    options: TrainingOptions,
    device: Device,
}

impl GpdTraining {
    /// Of a network whose tensors are on the autodiff `device`.
    pub(crate) fn new(network: Gpd, options: TrainingOptions, device: Device) -> Self {
        GpdTraining { learner: Learner::adam_w("network", network, &options), options, device }
    }

    pub(crate) fn into_network(self) -> Gpd {
        self.learner.into_network()
    }
}

impl Training for GpdTraining {
    type Samples = Vec<Sample<ClosingRegion>>;
    type Batch = Vec<(ClosingRegion, bool)>;

    fn plan(&self, samples: &Self::Samples) -> Result<Plan, TrainError> {
        #[derive(Serialize)]
        struct Settings<'a> {
            training: &'a TrainingOptions,
            architecture: &'a str,
            batch: usize,
        }
        let few = samples.len();
        OptionError::unless(few >= BATCH, "scenes", format!("{few} grasps in them"), "64 grasps or more")?;
        let settings = Settings { training: &self.options, architecture: ARCHITECTURE, batch: BATCH };
        Plan::new(&self.options, BATCH, Pace::default(), &settings)
    }

    fn batches<'a>(&self, samples: &'a Self::Samples) -> Batches<'a, Self::Batch> {
        let seed = self.options.seed;
        Box::new(move |step| {
            let mut random = stream(seed, step);
            (0..BATCH)
                .map(|_| {
                    let sample = &samples[random.random_range(0..samples.len())];
                    let [closing, across] = [(); 2].map(|()| random.random_range(0..2u32) == 1);
                    (sample.seen.mirrored(closing, across), sample.held)
                })
                .collect()
        })
    }

    fn step(&mut self, batch: Self::Batch, rate: f64) -> Losses {
        let images = tensor(batch.iter().map(|b| &b.0), batch.len(), &self.device);
        let held: Vec<f32> = batch.iter().map(|b| f32::from(u8::from(b.1))).collect();
        let logits = self.learner.network().forward(images);
        let values: Vec<f32> = logits
            .clone()
            .inner()
            .into_data()
            .try_to_vec()
            .unwrap_or_else(|error| unreachable!("f32 output: {error:?}"));
        let right = values.iter().zip(&held).filter(|(v, h)| (**v > 0.0) == (**h > 0.5)).count();
        let target = Tensor::<1>::from_data(TensorData::new(held, [batch.len()]), &self.device);
        // Stable for large logits of either sign.
        let loss = relu(logits.clone()) - logits.clone() * target + (logits.abs().neg().exp() + 1.0).log();
        let loss = loss.mean();
        let value = loss.clone().inner().into_scalar::<f32>();
        self.learner.descend(rate, loss);
        Losses::from([
            ("cross entropy".to_owned(), f64::from(value)),
            ("classified correctly".to_owned(), right as f64 / batch.len() as f64),
        ])
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        vec![&mut self.learner]
    }
}
