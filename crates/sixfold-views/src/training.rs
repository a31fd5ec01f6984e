//! The training: a point of a template must be matched to itself in the photograph, and a point of the photograph to itself among
//! those of both templates (InfoNCE: Van den Oord, Li and Vinyals 2018).

use burn::tensor::{Device, Tensor, TensorData, activation};
use serde::{Deserialize, Serialize};
use sixfold_nn::learner::{Checkpointed, Learner};
use sixfold_nn::options::{OptionError, Pace, TrainingOptions};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};
use sixfold_nn::xfeat::{CELL, CHANNELS, MULTIPLE};
use sixfold_synth::augment::Backgrounds;

use crate::network::{INPUTS, ViewNetwork};
use crate::samples::{POINTS, Sample, make_sample};

/// Added to a logit to exclude a cell.
const EXCLUDED: f32 = -1e4;

/// Options of the training. All of them affect the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewsTrainingOptions {
    /// Steps, learning rate, seed.
    #[serde(flatten)]
    pub common: TrainingOptions,
    /// Side of the crops, pixels; a multiple of 32.
    pub side: usize,
    /// Samples per step, each with a photograph and two templates.
    pub batch: usize,
    /// Temperature by which products of features are divided before the softmax.
    pub temperature: f32,
}

impl Default for ViewsTrainingOptions {
    fn default() -> Self {
        ViewsTrainingOptions {
            common: TrainingOptions {
                steps: 12_000,
                learning_rate: 1e-3,
                warm_up: 200,
                weight_decay: 1e-4,
                max_grad_norm: Some(5.0),
                seed: 0,
            },
            side: 160,
            batch: 8,
            temperature: 0.07,
        }
    }
}

impl ViewsTrainingOptions {
    /// Checks every number.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.common.check()?;
        let fits = self.side.is_multiple_of(MULTIPLE) && (MULTIPLE..=512).contains(&self.side);
        OptionError::unless(fits, "side", self.side, "a multiple of 32 from 32 to 512 pixels")?;
        OptionError::unless_samples("batch", self.batch, 1, "1 or more")?;
        let temperature = self.temperature;
        OptionError::unless(
            (0.01..=10.0).contains(&temperature),
            "temperature",
            temperature,
            "a number from 0.01 to 10",
        )
    }
}

/// A batch as tensor data; `B` samples, `K` points, `N` cells in a crop.
#[derive(Debug, Clone)]
pub struct Batch {
    count: usize,
    /// Photographs, first and second templates, `3 B x 3 x side x side`.
    inputs: Vec<f32>,
    /// `B x K x N`, 1 at the cell of the first template.
    cells: Vec<f32>,
    /// `B x K x N`, weights of the photograph's cells.
    places: Vec<f32>,
    /// `B x K x 2 N`, added to the logits of the templates' cells.
    excluded: Vec<f32>,
}

impl Batch {
    fn of(samples: &[Sample], cells: usize) -> Batch {
        let count = samples.len();
        let mut batch = Batch {
            count,
            inputs: (0..3)
                .flat_map(|k| samples.iter().flat_map(move |s| s.inputs[k].iter().copied()))
                .collect(),
            cells: vec![0.0; count * POINTS * cells],
            places: vec![0.0; count * POINTS * cells],
            excluded: vec![EXCLUDED; count * POINTS * 2 * cells],
        };
        for (b, sample) in samples.iter().enumerate() {
            for k in 0..POINTS {
                let row = b * POINTS + k;
                batch.cells[row * cells + sample.cells[k]] = 1.0;
                for (cell, weight) in sample.places[k] {
                    batch.places[row * cells + cell] += weight;
                }
                let excluded = &mut batch.excluded[row * 2 * cells..(row + 1) * 2 * cells];
                for (value, other) in excluded.iter_mut().zip(&sample.others[k]) {
                    if *other {
                        *value = 0.0;
                    }
                }
                excluded[sample.cells[k]] = 0.0;
            }
        }
        batch
    }
}

/// A network in training.
pub struct ViewsTraining {
    learner: Learner<ViewNetwork>,
    options: ViewsTrainingOptions,
    /// How often the training logs and saves.
    pub pace: Pace,
    device: Device,
}

impl ViewsTraining {
    /// Starts the training of a network whose tensors are on the autodiff `device`.
    pub fn new(network: ViewNetwork, options: ViewsTrainingOptions, device: Device) -> Self {
        let learner = Learner::adam_w("network", network, &options.common);
        let pace = Pace { checkpoint_every: 200, ..Pace::default() };
        ViewsTraining { learner, options, pace, device }
    }

    /// The trained network.
    pub fn into_network(self) -> ViewNetwork {
        self.learner.into_network()
    }

    fn cells(&self) -> usize {
        (self.options.side / CELL).pow(2)
    }

    /// Both losses of a batch, and the fraction of points whose best cell is at most one cell from the right one.
    fn losses(&self, batch: Batch) -> (Tensor<1>, Tensor<1>, f64) {
        let (count, cells, side) = (batch.count, self.cells(), self.options.side);
        let tensor = |values: Vec<f32>, shape: [usize; 3]| {
            Tensor::<3>::from_data(TensorData::new(values, shape), &self.device)
        };
        let inputs = TensorData::new(batch.inputs, [3 * count, INPUTS, side, side]);
        let features = self.learner.network().forward(Tensor::<4>::from_data(inputs, &self.device));
        let features = features.reshape([3 * count, CHANNELS, cells]);
        let unit = |x: Tensor<3>, axis: usize| {
            let length = (x.clone().square().sum_dim(axis) + 1e-8).sqrt();
            x / length
        };
        // Channels x cells for each of the three.
        let part = |k: usize| features.clone().narrow(0, k * count, count);
        let (photographs, first, second) = (part(0), part(1), part(2));
        let places = tensor(batch.places, [count, POINTS, cells]);
        let chosen = tensor(batch.cells, [count, POINTS, cells]);
        let scale = 1.0 / self.options.temperature;
        let points = unit(chosen.clone().matmul(first.clone().transpose()), 2);
        let logits = points.matmul(unit(photographs.clone(), 1)) * scale;
        let right = count as f32 * POINTS as f32;
        let accuracy = {
            let best = logits.clone().inner().argmax(2);
            hits(best.try_into_vec_as::<i32>().unwrap_or_default(), &places)
        };
        let there = -(activation::log_softmax(logits, 2) * places.clone()).sum() / right;
        let points = unit(places.matmul(photographs.transpose()), 2);
        let both = Tensor::cat(vec![unit(first, 1), unit(second, 1)], 2);
        let logits = points.matmul(both) * scale + tensor(batch.excluded, [count, POINTS, 2 * cells]);
        let log = activation::log_softmax(logits, 2).narrow(2, 0, cells);
        let back = -(log * chosen).sum() / right;
        (there, back, accuracy)
    }
}

/// The fraction of the best cells that are among the cells of the true position.
fn hits(best: Vec<i32>, places: &Tensor<3>) -> f64 {
    let [_, _, cells] = places.dims();
    let Ok(weights) = places.clone().inner().try_into_vec_as::<f32>() else { return 0.0 };
    let hit =
        |(row, cell): (usize, &i32)| weights.get(row * cells + *cell as usize).is_some_and(|w| *w > 0.0);
    best.iter().enumerate().filter(|(row, cell)| hit((*row, cell))).count() as f64 / best.len().max(1) as f64
}

impl Training for ViewsTraining {
    /// Textures, backgrounds and occluders.
    type Samples = Backgrounds;
    type Batch = Batch;

    fn plan(&self, textures: &Backgrounds) -> Result<Plan, TrainError> {
        self.options.check()?;
        let settings = serde_json::json!({ "training": self.options, "textures": textures.images() });
        Plan::new(&self.options.common, self.options.batch, self.pace, &settings)
    }

    fn batches<'a>(&self, textures: &'a Backgrounds) -> Batches<'a, Batch> {
        let (options, cells) = (self.options.clone(), self.cells());
        Box::new(move |step| {
            let first = step * options.batch as u64;
            let samples: Vec<Sample> = (0..options.batch as u64)
                .map(|i| make_sample(textures, options.side, options.common.seed, first + i))
                .collect();
            Batch::of(&samples, cells)
        })
    }

    fn step(&mut self, batch: Batch, rate: f64) -> Losses {
        let (there, back, accuracy) = self.losses(batch);
        let number = |t: &Tensor<1>| f64::from(t.clone().inner().into_scalar::<f32>());
        let losses = [("photograph", number(&there)), ("templates", number(&back)), ("accuracy", accuracy)];
        self.learner.descend(rate, there + back);
        losses.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        vec![&mut self.learner]
    }
}
