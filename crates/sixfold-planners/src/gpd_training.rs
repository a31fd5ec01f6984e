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
    /// Starts the training of a network whose tensors are on the autodiff `device`.
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
        // Numerically stable for large logits of either sign.
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

#[cfg(test)]
mod tests {
    use sixfold_geometry::{Camera, DepthImage, Mask, Plane, PointCloud, Vec3};
    use sixfold_grasp::{AntipodalQuality, Grasp, GraspView, Gripper, gripper_pose};

    use super::*;
    use crate::network::GpdConfig;

    /// A wall across the closing direction: held if it is near the centre between the pads.
    fn sample(number: u64) -> Sample<ClosingRegion> {
        let gripper = Gripper::built_in("jaws-140").unwrap();
        let x = stream(1, number).random_range(-0.06..0.06);
        let mut object = PointCloud::default();
        for (i, k) in (-7..=7).flat_map(|i| (0..=10).map(move |k| (i, k))) {
            object.points.push(Vec3::new(x, 0.003 * f64::from(i), 0.5 - 0.003 * f64::from(k)));
            object.normals.push(Vec3::x());
        }
        let view = GraspView {
            camera: Camera::new(500.0, 500.0, 31.5, 31.5, 64, 64).unwrap(),
            depth: DepthImage::filled(64, 64, 0.0),
            mask: Mask::filled(64, 64, false),
            table: Some(Plane { normal: -Vec3::z(), offset: -0.6 }),
            object,
            obstacles: PointCloud::default(),
            step: 0.003,
            cut_by_edge: false,
        };
        let pose = gripper_pose(&Vec3::new(0.0, 0.0, 0.5), &Vec3::z(), &Vec3::x()).unwrap();
        let quality = AntipodalQuality { alignment: 0.0, support: 0.0, centring: 0.5, observed: 1.0 };
        let grasp = Grasp { camera_from_gripper: pose, opening: 0.14, width: 0.01, quality };
        let seen = ClosingRegion::new(&view, &gripper, &grasp);
        Sample { seen, held: x.abs() < 0.03, scene: number }
    }

    #[test]
    fn central_walls_are_classified() {
        let samples: Vec<Sample<ClosingRegion>> = (0..128).map(sample).collect();
        let device = Device::flex().autodiff();
        let options = crate::recipe::GpdRecipe::default().options();
        let mut training = GpdTraining::new(GpdConfig.init(1, &device), options, device);
        let batches = training.batches(&samples);
        let losses: Vec<Losses> = (0..25).map(|step| training.step(batches(step), 1e-3)).collect();
        let of = |name: &str| losses.iter().map(|l| l[name]).collect::<Vec<f64>>();
        println!("{:.3?} {:.2?}", of("cross entropy"), of("classified correctly"));
        assert!(of("cross entropy")[24] < 0.5 * of("cross entropy")[0], "{:?}", of("cross entropy"));
        assert!(of("classified correctly")[24] > 0.85, "{:?}", of("classified correctly"));
    }
}
