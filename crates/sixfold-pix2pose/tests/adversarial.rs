//! Training against a discriminator, with a generator of one convolution in place of the dissertation's.

use burn::module::Module;
use burn::tensor::activation::{sigmoid, tanh};
use burn::tensor::{Device, Tensor};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sixfold_data::TrainingObject;
use sixfold_geometry::Vec3;
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig};
use sixfold_nn::options::Pace;
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Outcome, fit};
use sixfold_nn::weights::{ModelCard, save_weights};
use sixfold_pix2pose::adversarial::{AdversarialOptions, AdversarialTraining, Generator};
use sixfold_pix2pose::networks::GeneratorOutput;
use sixfold_pix2pose::object::SymmetryMap;
use sixfold_pix2pose::samples::{SampleOptions, SampleSource};
use sixfold_render::BoundingBoxScale;
use sixfold_synth::augment::Backgrounds;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

#[derive(Module, Debug)]
struct Small {
    conv: Conv,
}

impl Generator for Small {
    fn generate(&self, x: Tensor<4>) -> GeneratorOutput {
        let y = self.conv.forward(x);
        GeneratorOutput { coordinates: tanh(y.clone().narrow(1, 0, 3)), error: sigmoid(y.narrow(1, 3, 1)) }
    }
    fn input(rgb: &[f32]) -> Vec<f32> {
        rgb.iter().map(|v| 2.0 * v - 1.0).collect()
    }
}

fn source() -> (SampleSource, Vec<SymmetryMap>) {
    let vertices = vec![
        Vec3::new(-0.05, -0.04, 0.0),
        Vec3::new(0.05, -0.03, 0.0),
        Vec3::new(0.0, 0.06, 0.0),
        Vec3::new(0.01, 0.0, 0.08),
    ];
    let mesh = Mesh::new(vertices, vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]).unwrap();
    let (low, high) = mesh.bounding_box();
    let scale = BoundingBoxScale::of_corners(&low, &high);
    let info = ModelInfo::of_mesh(&mesh);
    let pool = SymmetryMap::pool(&info, &scale);
    let options = SampleOptions { random_color_probability: 1.0, ..SampleOptions::default() };
    let objects = vec![TrainingObject { id: 1, mesh, info, scale }];
    (SampleSource::new(objects, vec![], Backgrounds::procedural(), options).unwrap(), pool)
}

/// The losses of every step, and the weight file's bytes when it finished.
type Run = (Vec<BTreeMap<String, f64>>, Option<Vec<u8>>);

fn run(folder: &Path, options: &AdversarialOptions, stop_at: Option<u64>) -> Result<Run, TrainError> {
    let (source, pool) = source();
    let device = Device::flex().autodiff();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let generator =
        Small { conv: ConvConfig::new([3, 4], 3, Activation::Linear).init(0.3, &mut rng, &device) };
    let stop = AtomicBool::new(false);
    let mut losses = vec![];
    let mut training = AdversarialTraining::new(generator, pool, options.clone(), device);
    training.pace = Pace { log_every: 1, checkpoint_every: 2, ..training.pace };
    let outcome = fit(&mut training, &source, &folder.join("training"), &stop, |record| {
        losses.push(record.losses.clone());
        if stop_at == Some(record.step) {
            stop.store(true, Ordering::Relaxed);
        }
    })?;
    let bytes = match outcome {
        Outcome::Finished(()) => {
            let generator = training.into_network();
            let file = folder.join("model.safetensors");
            save_weights(&generator, &ModelCard::new("test", "test"), &file).unwrap();
            Some(std::fs::read(file).unwrap())
        }
        Outcome::Interrupted { step } => {
            assert_eq!(Some(step), stop_at);
            None
        }
    };
    Ok((losses, bytes))
}

fn options(steps: u64) -> AdversarialOptions {
    AdversarialOptions { steps, batch: 2, learning_rate: 1e-2, ..AdversarialOptions::default() }
}

#[test]
fn interrupted_and_resumed_it_ends_with_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let (losses, straight) = run(&folder.path().join("a"), &options(3), None).unwrap();
    assert_eq!(losses.len(), 3);
    for name in ["adversarial", "coordinates", "discriminator", "error"] {
        assert!(losses.iter().all(|l| l[name].is_finite() && l[name] > 0.0), "{name}: {losses:?}");
    }
    assert!(run(&folder.path().join("b"), &options(3), Some(1)).unwrap().1.is_none());
    let (_, resumed) = run(&folder.path().join("b"), &options(3), None).unwrap();
    assert_eq!(straight, resumed);

    // Without a discriminator the same seed ends elsewhere, and the folder of the other training is refused.
    let alone = AdversarialOptions { adversarial: false, ..options(3) };
    let error = run(&folder.path().join("b"), &alone, None).unwrap_err().to_string();
    assert!(error.contains("training with other options"), "{error}");
    let (losses, without) = run(&folder.path().join("c"), &alone, None).unwrap();
    assert!(losses.iter().all(|l| !l.contains_key("discriminator") && !l.contains_key("adversarial")));
    assert_ne!(straight, without);
}

#[test]
fn the_reconstruction_falls() {
    let folder = tempfile::tempdir().unwrap();
    let (losses, _) = run(folder.path(), &AdversarialOptions { batch: 4, ..options(24) }, None).unwrap();
    let mean = |part: &[BTreeMap<String, f64>]| {
        part.iter().map(|l| l["coordinates"]).sum::<f64>() / part.len() as f64
    };
    let (first, last) = (mean(&losses[..4]), mean(&losses[20..]));
    assert!(last < 0.9 * first, "{first} {last}");
}
