//! Training images a second of the compact detector, samples included, on renders of a synthetic object.
//!
//!     cargo run --release -p sixfold-detect --example bench_training -- [STEPS]

use std::error::Error;
use std::sync::atomic::AtomicBool;

use burn::tensor::Device;
use sixfold_data::TrainingObject;
use sixfold_detect::network::{DetectorConfig, Encoder};
use sixfold_detect::samples::{TrainingImageOptions, TrainingImageSource};
use sixfold_detect::training::{DetectorTraining, DetectorTrainingOptions};
use sixfold_geometry::Vec3;
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::training::fit;
use sixfold_synth::augment::Backgrounds;

fn main() -> Result<(), Box<dyn Error>> {
    let steps = std::env::args().nth(1).map_or(Ok(60), |text| text.parse())?;
    let vertices = [[-0.05, -0.04, 0.0], [0.05, -0.03, 0.0], [0.0, 0.06, 0.0], [0.01, 0.0, 0.08]]
        .map(Vec3::from)
        .to_vec();
    let mesh = Mesh::new(vertices, vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])?;
    let objects =
        vec![TrainingObject::new(1, mesh.clone(), ModelInfo { diameter: 0.12, ..ModelInfo::of_mesh(&mesh) })];
    let options = TrainingImageOptions { random_color_probability: 1.0, ..TrainingImageOptions::default() };
    let source = TrainingImageSource::new(objects, &[], &[], Backgrounds::procedural(), options)?;
    let device = Device::flex().autodiff();
    let config = DetectorConfig::compact(1);
    let network = config.init_with(Encoder::Lite0(imagenet_encoder(&device)?), 1, &device);
    let mut options = DetectorTrainingOptions::default();
    options.common.steps = steps;
    let mut training = DetectorTraining::new(network, config, source.options().size, options, device);
    training.pace.log_every = 20;
    let folder = std::env::temp_dir().join(format!("sixfold-bench-training-{}", std::process::id()));
    let stop = AtomicBool::new(false);
    fit(&mut training, &source, &folder, &stop, |record| {
        println!("step {}: {:.1} images/s, {:?}", record.step, record.samples_per_second, record.losses);
    })?;
    Ok(std::fs::remove_dir_all(folder)?)
}
