//! The training of DGCM-Net: pairs through the network, the losses of equations 6.2 to 6.4, AdamW.

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_nn::learner::{Checkpointed, Learner};
use sixfold_nn::options::{OptionError, Pace, TrainingOptions};
use sixfold_nn::schedule::LearningRate;
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};

use crate::alignment_loss::{Decoded, alignment_loss};
use crate::loss::{MARGIN, coordinate_loss, cross_loss, metric_loss};
use crate::networks::{Network, VIEW, numbers};
use crate::samples::{GraspPoolOptions, Pair, PairOptions, Pool};
use sixfold_synth::shapes::Family;

/// Options of the training. All of them affect the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DgcmTrainingOptions {
    /// Steps, learning rate, seed.
    #[serde(flatten)]
    pub common: TrainingOptions,
    /// Positive pairs in a step.
    pub pairs: usize,
    /// Negative pairs in a step.
    pub negatives: usize,
    /// Weight of the coordinates in equation 6.4.
    pub lambda: f64,
    /// Weight of equation 6.2 for all pairs of views in a batch that show different families, in addition to the rendered pairs.
    pub cross_pairs: f64,
    /// How pairs are sampled.
    pub samples: PairOptions,
    /// How often the learning rate is divided by ten, at equal intervals; 0: it follows a cosine.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub divisions: u64,
    /// Whether only the alignment of both views is trained, and everything else stays as it is.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub alignment_only: bool,
}

fn is_zero(number: &u64) -> bool {
    *number == 0
}

impl Default for DgcmTrainingOptions {
    fn default() -> Self {
        DgcmTrainingOptions {
            common: TrainingOptions {
                steps: 4000,
                learning_rate: 5e-4,
                warm_up: 200,
                weight_decay: 1e-4,
                max_grad_norm: Some(50.0),
                seed: 0,
            },
            pairs: 10,
            negatives: 3,
            lambda: 300.0,
            cross_pairs: 1.0,
            samples: PairOptions::default(),
            divisions: 0,
            alignment_only: false,
        }
    }
}

impl DgcmTrainingOptions {
    /// The dissertation's options (section 6.2.2): 25 positive and 25 negative pairs, Adam at a rate of 0.0001 that is divided by
    /// ten every 5 of 35 epochs, both losses with equal weights.
    pub fn published() -> Self {
        let default = Self::default();
        DgcmTrainingOptions {
            common: TrainingOptions {
                steps: 116_000,
                learning_rate: 1e-4,
                warm_up: 0,
                weight_decay: 0.0,
                max_grad_norm: None,
                ..default.common
            },
            divisions: 6,
            pairs: 25,
            negatives: 25,
            lambda: 1.0,
            cross_pairs: 0.0,
            ..default
        }
    }

    /// Pairs in a step: positive and negative ones.
    fn in_step(&self) -> (usize, usize) {
        (self.pairs, if self.alignment_only { 0 } else { self.negatives })
    }

    /// Checks every number.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.common.check()?;
        OptionError::unless_samples("pairs", self.pairs, 1, "1 or more")?;
        OptionError::unless_weight("lambda", self.lambda)?;
        OptionError::unless_weight("cross_pairs", self.cross_pairs)
    }
}

/// A network in training.
pub struct DgcmTraining {
    learner: Learner<Network>,
    options: DgcmTrainingOptions,
    /// How often the training logs and saves.
    pub pace: Pace,
    device: Device,
}

impl DgcmTraining {
    /// Starts the training of a network whose tensors are on the autodiff `device`.
    pub fn new(network: Network, options: DgcmTrainingOptions, device: Device) -> Self {
        let learner = Learner::adam_w("network", network, &options.common);
        DgcmTraining { learner, options, pace: Pace::default(), device }
    }

    fn images(&self, values: Vec<f32>, count: usize, channels: usize) -> Tensor<4> {
        let side = self.learner.network().side();
        Tensor::from_data(TensorData::new(values, [count, channels, side, side]), &self.device)
    }

    /// A step in which only the alignment learns: the rest of the network runs without gradients.
    fn step_of_alignment(&mut self, batch: Batch, rate: f64) -> Losses {
        let network = self.learner.network();
        let (pairs, seed) = (self.options.pairs, self.options.common.seed);
        let tensor = |values, channels| self.images(values, pairs, channels);
        let (target, mask) = (tensor(batch.target, 3), tensor(batch.mask, 1));
        let fixed = network.valid();
        let views = tensor(batch.input, VIEW);
        let vd_noc = tensor(batch.vd_noc, 3);
        let input = fixed.geometry(views.clone().inner());
        let experience = fixed.geometry(tensor(batch.experience, VIEW).inner()).feature;
        let code = fixed.vd_noc(vd_noc.clone().inner());
        let coordinates = Tensor::from_inner(fixed.decode(&input, experience, &code));
        let feature = Tensor::from_inner(input.feature);
        let decoded = Decoded { coordinates, views, feature, vd_noc };
        let Some(alignment) = network.alignment() else {
            unreachable!("a plan of a network without alignment is refused")
        };
        let aligned = alignment_loss(alignment, decoded, &target, &mask, (seed, batch.step));
        let losses = [
            ("error on the object", value(&aligned.before)),
            ("aligned error on the object", value(&aligned.after)),
        ];
        self.learner.descend(rate, aligned.sum);
        losses.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }

    /// The trained network.
    pub fn into_network(self) -> Network {
        self.learner.into_network()
    }
}

/// Pairs as tensor data: the positive ones first.
pub struct Batch {
    input: Vec<f32>,
    experience: Vec<f32>,
    vd_noc: Vec<f32>,
    target: Vec<f32>,
    mask: Vec<f32>,
    /// Families of both views of every pair.
    families: Vec<(Family, Family)>,
    /// Number of the step.
    step: u64,
}

fn make_batch(pool: &Pool, options: &DgcmTrainingOptions, step: u64) -> Batch {
    let mut batch = Batch {
        input: vec![],
        experience: vec![],
        vd_noc: vec![],
        target: vec![],
        mask: vec![],
        families: vec![],
        step,
    };
    let (positives, negatives) = options.in_step();
    for (positive, count) in [(true, positives as u64), (false, negatives as u64)] {
        for number in 0..count {
            let number = 2 * (step * count + number) + u64::from(positive);
            let pair: Pair = pool.pair(positive, &options.samples, options.common.seed, number);
            batch.families.push(pair.families);
            batch.input.extend(pair.input);
            batch.experience.extend(pair.experience);
            if positive {
                batch.vd_noc.extend(pair.vd_noc);
                batch.target.extend(pair.target);
                batch.mask.extend(pair.mask);
            }
        }
    }
    batch
}

/// A learning rate that is divided by ten `divisions` times, at equal intervals.
fn divided(common: &TrainingOptions, divisions: u64) -> LearningRate {
    // With very few steps some intervals are empty.
    let mut at: Vec<u64> = (1..=divisions).map(|n| n * common.steps / (divisions + 1)).collect();
    at.retain(|at| *at > 0);
    at.dedup();
    LearningRate::StepDecay { rate: common.learning_rate, factor: 0.1, at }
}

fn value(tensor: &Tensor<1>) -> f64 {
    numbers(&tensor.clone().inner()).first().map_or(f64::NAN, |v| f64::from(*v))
}

impl Training for DgcmTraining {
    type Samples = Pool;
    type Batch = Batch;

    fn plan(&self, pool: &Pool) -> Result<Plan, TrainError> {
        let options = &self.options;
        options.check()?;
        let views = pool.views().len();
        OptionError::unless(views >= 16, "views", views, "at least 16")?;
        let possible = !options.alignment_only || self.learner.network().alignment().is_some();
        OptionError::unless(possible, "alignment_only", "a network without", "a network with an alignment")?;
        let (side, expected) = (pool.options().crop.side, self.learner.network().side());
        let found = format!("views of {side}, network of {expected}");
        let fits = side == expected;
        OptionError::unless(fits, "crop.side", found, "the side of the network's input, pixels")?;
        let settings = Settings {
            training: options,
            pool: pool.options(),
            architecture: self.learner.network().architecture(),
            margin: MARGIN,
        };
        let (positives, negatives) = options.in_step();
        let plan = Plan::new(&options.common, positives + negatives, self.pace, &settings)?;
        Ok(match options.divisions {
            0 => plan,
            _ => Plan { schedule: divided(&options.common, options.divisions), ..plan },
        })
    }

    fn batches<'a>(&self, pool: &'a Pool) -> Batches<'a, Batch> {
        let options = self.options.clone();
        Box::new(move |step| make_batch(pool, &options, step))
    }

    fn step(&mut self, batch: Batch, rate: f64) -> Losses {
        if self.options.alignment_only {
            return self.step_of_alignment(batch, rate);
        }
        let network = self.learner.network();
        let (pairs, seed) = (self.options.pairs, self.options.common.seed);
        let all = pairs + self.options.negatives;
        let tensor = |values, count, channels| self.images(values, count, channels);
        let input = network.geometry(tensor(batch.input, all, VIEW));
        let experience = network.geometry(tensor(batch.experience, all, VIEW));
        let (metric, near, far) = metric_loss(&input.feature, &experience.feature, pairs);
        let different: Vec<f32> = batch
            .families
            .iter()
            .flat_map(|a| batch.families.iter().map(|b| f32::from(u8::from(a.0 != b.1))))
            .collect();
        let different = Tensor::from_data(TensorData::new(different, [all, all]), &self.device);
        let cross = cross_loss(&input.feature, &experience.feature, different);
        let code = network.vd_noc(tensor(batch.vd_noc, pairs, 3));
        let features = experience.feature.narrow(0, 0, pairs);
        let input = input.narrow(0, pairs);
        let out = network.decode(&input, features, &code);
        let (target, mask) = (tensor(batch.target, pairs, 3), tensor(batch.mask, pairs, 1));
        let aligned = network.alignment().map(|alignment| {
            let (coordinates, feature) = (out.clone().detach(), input.feature.detach());
            let decoded = Decoded { coordinates, views: input.input, feature, vd_noc: code.input };
            alignment_loss(alignment, decoded, &target, &mask, (seed, batch.step))
        });
        let (coordinates, error) = coordinate_loss(out, target, mask);
        let mut losses = vec![
            ("metric", value(&metric)),
            ("cross pairs", value(&cross)),
            ("coordinates", value(&coordinates)),
            ("positive distance", value(&near)),
            ("negative distance", value(&far)),
            ("error on the object", value(&error)),
        ];
        let mut sum = metric + cross * self.options.cross_pairs + coordinates * self.options.lambda;
        if let Some(aligned) = aligned {
            losses.push(("aligned error on the object", value(&aligned.after)));
            sum = sum + aligned.sum * self.options.lambda;
        }
        self.learner.descend(rate, sum);
        losses.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        vec![&mut self.learner]
    }
}

/// Everything that affects the result.
#[derive(Serialize)]
struct Settings<'a> {
    #[serde(flatten)]
    training: &'a DgcmTrainingOptions,
    pool: &'a GraspPoolOptions,
    architecture: &'static str,
    margin: f64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::networks::CompactConfig;
    use sixfold_nn::training::{Outcome, fit};
    use std::path::Path;
    use std::sync::atomic::{AtomicBool, Ordering};

    #[test]
    fn the_published_rate_is_divided_by_ten_every_five_of_35_epochs() {
        let options = DgcmTrainingOptions::published();
        let rate = divided(&TrainingOptions { steps: 35_000, ..options.common }, options.divisions);
        for (epoch, expected) in
            [(0, 1e-4), (4, 1e-4), (5, 1e-5), (9, 1e-5), (10, 1e-6), (30, 1e-10), (34, 1e-10)]
        {
            let found = rate.at(epoch * 1000 + 500);
            assert!((found / expected - 1.0).abs() < 1e-9, "{epoch}: {found}");
        }
        assert_eq!((options.pairs, options.negatives, options.lambda), (25, 25, 1.0));
        for steps in 1..9 {
            let common = TrainingOptions { steps, ..DgcmTrainingOptions::published().common };
            assert!(divided(&common, options.divisions).check().is_ok(), "{steps}");
        }
    }

    #[test]
    fn on_one_batch_both_losses_fall() {
        let pool = Pool::new(&GraspPoolOptions { views: 64, ..GraspPoolOptions::default() }, &()).unwrap();
        let device = Device::flex().autodiff();
        let options = DgcmTrainingOptions { pairs: 2, negatives: 1, ..DgcmTrainingOptions::default() };
        let network = Network::Compact(CompactConfig.init(3, &device));
        let mut training = DgcmTraining::new(network, options.clone(), device);
        let losses: Vec<Losses> =
            (0..14).map(|_| training.step(make_batch(&pool, &options, 0), 5e-4)).collect();
        let of = |name: &str| losses.iter().map(|l| l[name]).collect::<Vec<f64>>();
        println!("{:.3?} {:.4?}", of("metric"), of("coordinates"));
        assert!(of("metric")[13] < 0.5 * of("metric")[0], "{:?}", of("metric"));
        assert!(of("coordinates")[13] < 0.8 * of("coordinates")[0], "{:?}", of("coordinates"));
    }

    #[test]
    fn the_alignment_learns_and_the_rest_stays() {
        let pool = Pool::new(&GraspPoolOptions { views: 64, ..GraspPoolOptions::default() }, &()).unwrap();
        let device = Device::flex().autodiff();
        let options =
            DgcmTrainingOptions { pairs: 4, alignment_only: true, ..DgcmTrainingOptions::default() };
        let network = Network::Compact(CompactConfig.init(3, &device));
        let code = |n: &Network| -> Vec<f32> {
            let x = Tensor::<4>::ones([1, VIEW, 96, 96], &Device::flex()) * 0.5;
            let code = n.vd_noc(x.clone().narrow(1, 0, 3));
            let view = n.geometry(x);
            let out = n.decode(&view, view.feature.clone(), &code);
            [numbers(&out), view.feature.into_data().try_to_vec().unwrap()].concat()
        };
        let before = code(&network.valid());
        let mut training = DgcmTraining::new(network, options.clone(), device);
        let losses: Vec<Losses> =
            (0..40).map(|_| training.step(make_batch(&pool, &options, 0), 1e-3)).collect();
        let of = |name: &str| losses.iter().map(|l| l[name]).collect::<Vec<f64>>();
        let (decoded, aligned) = (of("error on the object"), of("aligned error on the object"));
        println!("{decoded:.3?} {aligned:.3?}");
        assert!(decoded.iter().all(|error| *error == decoded[0]));
        assert!(aligned[39] < 0.7 * decoded[0] && aligned[39] < 0.7 * aligned[0], "{aligned:?}");
        assert_eq!(before, code(&training.into_network()));
    }

    #[test]
    fn it_resumes_from_its_last_checkpoint() {
        let pool = Pool::new(&GraspPoolOptions { views: 64, ..GraspPoolOptions::default() }, &()).unwrap();
        let device = Device::flex().autodiff();
        let default = DgcmTrainingOptions::default();
        let common = TrainingOptions { steps: 16, warm_up: 2, ..default.common.clone() };
        let options = DgcmTrainingOptions { common, pairs: 2, negatives: 1, ..default };
        let go = |folder: &Path, stop_at: Option<u64>| {
            let stop = AtomicBool::new(false);
            let network = Network::Compact(CompactConfig.init(3, &device));
            let mut training = DgcmTraining::new(network, options.clone(), device.clone());
            training.pace = Pace { checkpoint_every: 5, log_every: 4, sample_threads: 1 };
            let mut records = vec![];
            let outcome = fit(&mut training, &pool, folder, &stop, |r| {
                stop.store(stop_at.is_some_and(|s| r.step >= s), Ordering::Relaxed);
                records.push(r.losses["metric"]);
            });
            (outcome.unwrap(), records, training.into_network())
        };
        let numbers = |n: &Network| -> Vec<f32> {
            let x = Tensor::<4>::ones([1, VIEW, 96, 96], &Device::flex()) * 0.5;
            n.geometry(x).feature.into_data().try_to_vec().unwrap()
        };
        let folder = tempfile::tempdir().unwrap();
        let (Outcome::Finished(()), losses, straight) = go(&folder.path().join("a"), None) else { panic!() };
        assert!(losses.iter().all(|l: &f64| l.is_finite()), "{losses:?}");
        let b = folder.path().join("b");
        assert!(matches!(go(&b, Some(8)).0, Outcome::Interrupted { step: 8 }));
        let (Outcome::Finished(()), _, resumed) = go(&b, None) else { panic!() };
        assert_eq!(numbers(&straight), numbers(&resumed));
    }
}
