//! The training: regions and templates through the network, the losses of equations 5.3 to 5.6, AdamW.

use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_nn::learner::{Checkpointed, Learner};
use sixfold_nn::options::{OptionError, Pace, TrainingOptions};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};

use crate::loss::{GAMMA, column, cross_loss, distance_loss, mask_loss, pair_loss, triplet_loss};
use crate::network::{MAP, Network, masked};
use crate::patch::PLANES;
use crate::samples::{Augmentation, Batch, DepthPoolOptions, PairBatchOptions, Pool};

/// Options of the training. All of them affect the result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MttmTrainingOptions {
    /// Steps, learning rate, seed.
    #[serde(flatten)]
    pub common: TrainingOptions,
    /// Contents of a batch.
    pub batch: PairBatchOptions,
    /// Weight of the positive templates of all other objects in the batch as negative ones (equation 5.3), in addition to the
    /// triplets.
    pub cross: f64,
    /// Weight of the loss of the reference point's position, and of the loss of matching; 0 for the dissertation's.
    pub offset: f64,
    /// See `offset`.
    pub matching: f64,
}

impl Default for MttmTrainingOptions {
    fn default() -> Self {
        MttmTrainingOptions {
            common: TrainingOptions {
                steps: 8000,
                learning_rate: 1e-3,
                warm_up: 200,
                weight_decay: 1e-4,
                max_grad_norm: Some(5.0),
                seed: 0,
            },
            batch: PairBatchOptions::default(),
            cross: 1.0,
            offset: 4.0,
            matching: 0.5,
        }
    }
}

impl MttmTrainingOptions {
    /// The dissertation's losses alone (equation 5.6), half of the negative templates of other objects (equation 5.4), and about 25
    /// epochs of 20,000 scenes.
    pub fn published() -> Self {
        MttmTrainingOptions {
            common: TrainingOptions { steps: 100_000, learning_rate: 1e-4, ..Self::default().common },
            batch: PairBatchOptions {
                anchors: 16,
                without_object: 0,
                other_objects: 0.5,
                augmentation: Augmentation::published(),
            },
            cross: 0.0,
            offset: 0.0,
            matching: 0.0,
        }
    }

    /// Checks every number.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.common.check()?;
        OptionError::unless_samples("anchors", self.batch.anchors, 2, "2 or more")?;
        OptionError::unless_fraction("other_objects", self.batch.other_objects)?;
        OptionError::unless_weight("cross", self.cross)?;
        OptionError::unless_weight("offset", self.offset)?;
        OptionError::unless_weight("matching", self.matching)
    }
}

/// A network in training.
pub struct MttmTraining {
    learner: Learner<Network>,
    options: MttmTrainingOptions,
    /// How often the training logs and saves.
    pub pace: Pace,
    device: Device,
}

impl MttmTraining {
    /// Starts the training of a network whose tensors are on the autodiff `device`.
    pub fn new(network: Network, options: MttmTrainingOptions, device: Device) -> Self {
        let learner = Learner::adam_w("network", network, &options.common);
        MttmTraining { learner, options, pace: Pace::default(), device }
    }

    /// The trained network.
    pub fn into_network(self) -> Network {
        self.learner.into_network()
    }

    fn patches(&self, values: Vec<f32>) -> Tensor<4> {
        let side = self.learner.network().side();
        let count = values.len() / (PLANES * side * side);
        Tensor::from_data(TensorData::new(values, [count, PLANES, side, side]), &self.device)
    }

    fn cells(&self, values: Vec<f32>) -> Tensor<4> {
        let count = values.len() / (MAP * MAP);
        Tensor::from_data(TensorData::new(values, [count, 1, MAP, MAP]), &self.device)
    }

    fn rows(&self, values: Vec<f32>, length: usize) -> Tensor<2> {
        let count = values.len() / length;
        Tensor::from_data(TensorData::new(values, [count, length]), &self.device)
    }
}

impl Training for MttmTraining {
    type Samples = Pool;
    type Batch = Batch;

    fn plan(&self, pool: &Pool) -> Result<Plan, TrainError> {
        let options = &self.options;
        options.check()?;
        let regions = pool.with_object().len();
        OptionError::unless(regions >= 8, "regions", regions, "at least 8 with an object")?;
        let (side, expected) = (pool.options().anchors.side, self.learner.network().side());
        let found = format!("regions of {side}, network of {expected}");
        let fits = side == expected;
        OptionError::unless(fits, "anchors.side", found, "the side of the network's input, pixels")?;
        let settings = Settings {
            training: options,
            pool: pool.options(),
            anchors: regions,
            architecture: self.learner.network().architecture(),
            gamma: GAMMA,
        };
        Plan::new(&options.common, options.batch.anchors, self.pace, &settings)
    }

    fn batches<'a>(&self, pool: &'a Pool) -> Batches<'a, Batch> {
        let (options, seed) = (self.options.batch, self.options.common.seed);
        Box::new(move |step| Batch::of_step(pool, &options, seed, step))
    }

    fn step(&mut self, batch: Batch, rate: f64) -> Losses {
        let options = &self.options;
        let count = batch.objects.len();
        let others = options.batch.without_object;
        let network = self.learner.network();

        // Everything goes through the first part of the network at once.
        let values = [batch.regions, batch.positives, batch.negatives].concat();
        let maps = network.maps(self.patches(values));
        let part = |start: usize, count: usize| maps.clone().narrow(0, start, count);
        let regions = part(0, count);
        let region_masks = self.cells(batch.region_masks);
        let positives = masked(part(count + others, count), self.cells(batch.positive_masks));
        let negatives = masked(part(2 * count + others, count), self.cells(batch.negative_masks));

        // Descriptors of regions as they are (the first matching) and without their background (the second).
        let bare = masked(regions.clone(), region_masks.clone());
        let all = Tensor::cat(vec![regions.clone(), bare, positives.clone(), negatives.clone()], 0);
        let descriptors = network.descriptor(all);
        let rows = |k: usize| descriptors.clone().narrow(0, k * count, count);
        let (positive, negative) = (rows(2), rows(3));
        let counts: Vec<f32> = batch.margins.iter().map(|m| f32::from(u8::from(*m > 0.0))).collect();
        let margins = column(batch.margins, &self.device);
        let counts = column(counts, &self.device);
        let different: Vec<f32> = batch
            .objects
            .iter()
            .flat_map(|a| batch.objects.iter().map(move |b| f32::from(u8::from(a != b))))
            .collect();
        let different = self.rows(different, count);
        let both = |of: &dyn Fn(&Tensor<2>) -> Tensor<1>| (of(&rows(0)) + of(&rows(1))) * 0.5;
        let triplet =
            both(&|region| triplet_loss(region, &positive, &negative, margins.clone(), counts.clone()));
        let cross = both(&|region| cross_loss(region, &positive, different.clone()));
        let pair = both(&|region| pair_loss(region, &positive));

        // Pairs: with the positive template, the negative one, a template of another object; regions without an object.
        let mut left = vec![regions.clone(), regions.clone()];
        let mut right = vec![positives.clone(), negatives];
        let mut truth: Vec<f32> = vec![1.0; count];
        truth.extend(vec![0.0; count]);
        let third = count / 2;
        if options.matching > 0.0 && third > 0 {
            // The next objects' templates, without an object's own.
            left.push(regions.narrow(0, 0, third));
            right.push(positives.clone().narrow(0, third, third));
            truth.extend(
                (0..third).map(|k| f32::from(u8::from(batch.objects[k] == batch.objects[third + k]))),
            );
            let empty = others.min(count);
            if empty > 0 {
                left.push(part(count, empty));
                right.push(positives.narrow(0, 0, empty));
                truth.extend(vec![0.0; empty]);
            }
        }
        let compared = network.compare(Tensor::cat(left, 0), Tensor::cat(right, 0));
        let mask = mask_loss(compared.mask.narrow(0, 0, count), region_masks);
        let rotation = distance_loss(compared.rotation.narrow(0, 0, count), self.rows(batch.rotations, 4));
        let offset = distance_loss(compared.offset.narrow(0, 0, count), self.rows(batch.offsets, 3));
        let matching = mask_loss(compared.matching, column(truth, &self.device));

        let numbers = [&triplet, &cross, &pair, &mask, &rotation, &offset, &matching].map(|t| {
            let value: Vec<f32> = t.clone().inner().into_data().try_to_vec().unwrap_or_default();
            value.first().map_or(f64::NAN, |v| f64::from(*v))
        });
        let sum = triplet
            + cross * options.cross
            + pair
            + mask
            + rotation
            + offset * options.offset
            + matching * options.matching;
        self.learner.descend(rate, sum);
        ["triplet", "other objects", "pair", "mask", "rotation", "offset", "matching"]
            .into_iter()
            .map(str::to_owned)
            .zip(numbers)
            .collect()
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        vec![&mut self.learner]
    }
}

/// Everything that affects the result.
#[derive(Serialize)]
struct Settings<'a> {
    #[serde(flatten)]
    training: &'a MttmTrainingOptions,
    pool: &'a DepthPoolOptions,
    anchors: usize,
    architecture: &'static str,
    gamma: f64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::CompactConfig;
    use crate::quality::quality;
    use crate::samples::Arrangement;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use sixfold_geometry::{Pose, Vec3};
    use sixfold_mesh::Mesh;
    use sixfold_nn::training::{Outcome, fit};
    use sixfold_synth::shapes::{Family, member};
    use std::path::Path;
    use std::sync::atomic::{AtomicBool, Ordering};

    /// Household shapes side by side on a table.
    fn pool() -> Pool {
        let meshes: Vec<Mesh> = [Family::Mug, Family::Box, Family::Drill, Family::Can]
            .iter()
            .map(|f| member(*f, &mut ChaCha8Rng::seed_from_u64(3)).unwrap().mesh)
            .collect();
        let arrangement: Arrangement = (0..4)
            .map(|k| {
                let place = Vec3::new(0.16 * f64::from(k % 2) - 0.08, 0.2 * f64::from(k / 2) - 0.1, 0.0);
                (k as usize, Pose::from_translation(place))
            })
            .collect();
        let options = DepthPoolOptions { views: 3, ..DepthPoolOptions::for_side(CompactConfig::SIDE) };
        Pool::new(&meshes, &[arrangement.clone(), arrangement], &options, &()).unwrap()
    }

    #[test]
    fn on_one_batch_every_loss_falls() {
        let pool = pool();
        let device = Device::flex().autodiff();
        let batch = PairBatchOptions { anchors: 6, without_object: 2, ..PairBatchOptions::default() };
        let options = MttmTrainingOptions { batch, ..MttmTrainingOptions::default() };
        let network = Network::Compact(CompactConfig.init(3, &device));
        let mut training = MttmTraining::new(network, options.clone(), device);
        let losses: Vec<Losses> =
            (0..30).map(|_| training.step(Batch::of_step(&pool, &options.batch, 1, 0), 1e-3)).collect();
        let ratios: Vec<(&str, f64)> = ["triplet", "other objects", "mask", "rotation", "offset", "matching"]
            .into_iter()
            .map(|name| (name, losses[29][name] / losses[0][name]))
            .collect();
        println!("{ratios:.2?}");
        // The matching head learns last in a new network.
        let most = |name: &str| if name == "matching" { 1.0 } else { 0.6 };
        assert!(ratios.iter().all(|(name, ratio)| *ratio < most(name)), "{ratios:?}");
    }

    #[test]
    fn it_resumes_from_its_last_checkpoint() {
        let pool = pool();
        assert!(pool.with_object().len() >= 12, "{}", pool.with_object().len());
        assert!(!pool.without_object().is_empty());
        let device = Device::flex().autodiff();
        let batch = PairBatchOptions { anchors: 6, without_object: 2, ..PairBatchOptions::default() };
        let default = MttmTrainingOptions::default();
        let common = TrainingOptions { steps: 24, warm_up: 2, ..default.common.clone() };
        let options = MttmTrainingOptions { common, batch, ..default };
        let go = |folder: &Path, stop_at: Option<u64>| {
            let stop = AtomicBool::new(false);
            let network = Network::Compact(CompactConfig.init(3, &device));
            let mut training = MttmTraining::new(network, options.clone(), device.clone());
            training.pace = Pace { checkpoint_every: 5, log_every: 4, sample_threads: 1 };
            let mut records = vec![];
            let outcome = fit(&mut training, &pool, folder, &stop, |r| {
                stop.store(stop_at.is_some_and(|s| r.step >= s), Ordering::Relaxed);
                records.push(r.losses["mask"]);
            });
            (outcome.unwrap(), records, training.into_network())
        };
        let folder = tempfile::tempdir().unwrap();
        let (Outcome::Finished(()), losses, straight) = go(&folder.path().join("a"), None) else { panic!() };
        assert!(losses.iter().all(|l: &f64| l.is_finite()), "{losses:?}");
        let b = folder.path().join("b");
        assert!(matches!(go(&b, Some(8)).0, Outcome::Interrupted { step: 8 }));
        let (Outcome::Finished(()), _, resumed) = go(&b, None) else { panic!() };
        assert_eq!(quality(&straight, &pool), quality(&resumed, &pool));
    }

    #[test]
    fn half_of_the_published_negatives_are_of_other_objects_with_the_margin_gamma() {
        let pool = pool();
        let options = MttmTrainingOptions::published();
        assert_eq!((options.cross, options.offset, options.matching), (0.0, 0.0, 0.0));
        let size = PLANES * CompactConfig::SIDE * CompactConfig::SIDE;
        let (mut others, mut own) = (0, 0);
        for step in 0..8 {
            let batch = Batch::of_step(&pool, &options.batch, 3, step);
            for (k, margin) in batch.margins.iter().enumerate() {
                let template = |of: &[f32], k: usize| of[k * size..(k + 1) * size].to_vec();
                let negative = template(&batch.negatives, k);
                // Whose positive template it is.
                let whose = (0..batch.objects.len()).find(|&j| template(&batch.positives, j) == negative);
                if *margin == GAMMA as f32 {
                    assert_ne!(batch.objects[whose.unwrap()], batch.objects[k], "{step} {k}");
                    others += 1;
                } else {
                    // 2 delta, which is pi at most; 0 where there is no template.
                    assert!(whose.is_none() && (0.0..=std::f32::consts::PI).contains(margin), "{margin}");
                    own += 1;
                }
            }
        }
        assert!((40..=88).contains(&others) && others + own == 128, "{others} of 128");
        // By default negative templates are of the same object only.
        let batch = Batch::of_step(&pool, &PairBatchOptions::default(), 3, 0);
        assert!(batch.margins.iter().all(|m| *m < GAMMA as f32));
    }

    #[test]
    fn batches_are_a_function_of_seed_and_step() {
        let pool = pool();
        let batch = |step| Batch::of_step(&pool, &PairBatchOptions::default(), 7, step);
        assert_eq!(batch(3), batch(3));
        assert_ne!(batch(3), batch(4));
        // A pair's labels must agree with its patches: the object's cells are known in region and template.
        let b = batch(5);
        let on_object = b.region_masks.iter().filter(|m| **m > 0.5).count();
        assert!(on_object > 40 * 15, "{on_object}");
        assert!(
            b.rotations
                .chunks(4)
                .all(|q| (q.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-4 && q[0] > 0.9)
        );
        assert!(b.offsets.iter().all(|v| v.abs() < 0.6));
    }
}
