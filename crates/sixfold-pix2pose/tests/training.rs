//! A training that is interrupted and continues ends with the same numbers as one that is not.

use burn::tensor::Device;
use sixfold_data::TrainingObject;
use sixfold_geometry::Vec3;
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_nn::options::{Pace, TrainingOptions};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Outcome, fit};
use sixfold_nn::weights::{ModelCard, save_weights};
use sixfold_pix2pose::networks::CompactConfig;
use sixfold_pix2pose::object::SymmetryMap;
use sixfold_pix2pose::samples::{SampleOptions, SampleSource};
use sixfold_pix2pose::training::{CompactTraining, Pix2PoseTrainingOptions};
use sixfold_render::BoundingBoxScale;
use sixfold_synth::augment::Backgrounds;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

fn source() -> (SampleSource, Vec<Vec<SymmetryMap>>) {
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
    let pools = vec![SymmetryMap::pool(&info, &scale)];
    let objects = vec![TrainingObject { id: 1, mesh, info, scale }];
    let options = SampleOptions {
        size: 64,
        target_size: Some(32),
        random_color_probability: 1.0,
        ..SampleOptions::default()
    };
    (SampleSource::new(objects, vec![], Backgrounds::procedural(), options).unwrap(), pools)
}

/// Trains in `folder`, stopping after step `stop_at`; the weight file's bytes when it finished.
fn run(
    folder: &Path,
    options: &Pix2PoseTrainingOptions,
    stop_at: Option<u64>,
) -> Result<Option<Vec<u8>>, TrainError> {
    let (source, pools) = source();
    let device = Device::flex().autodiff();
    let network = CompactConfig { objects: 1 }.init_random(3, &device);
    let stop = AtomicBool::new(false);
    let mut training = CompactTraining::new(network, pools, 64, options.clone(), device);
    training.pace = Pace { log_every: 1, checkpoint_every: 3, ..training.pace };
    let outcome = fit(&mut training, &source, &folder.join("training"), &stop, |record| {
        if stop_at == Some(record.step) {
            stop.store(true, Ordering::Relaxed);
        }
    })?;
    Ok(match outcome {
        Outcome::Finished(()) => {
            let file = folder.join("model.safetensors");
            save_weights(&training.into_network(), &ModelCard::new("test", "test"), &file).unwrap();
            Some(std::fs::read(file).unwrap())
        }
        Outcome::Interrupted { step } => {
            assert_eq!(Some(step), stop_at);
            None
        }
    })
}

#[test]
fn interrupted_and_resumed_it_ends_with_the_same_bytes() {
    let default = Pix2PoseTrainingOptions::default();
    let common = TrainingOptions { steps: 4, warm_up: 1, ..default.common.clone() };
    let options = Pix2PoseTrainingOptions { common, per_object: 2, ..default };
    let folder = tempfile::tempdir().unwrap();
    let straight = run(&folder.path().join("a"), &options, None).unwrap().unwrap();
    assert!(run(&folder.path().join("b"), &options, Some(2)).unwrap().is_none());
    let resumed = run(&folder.path().join("b"), &options, None).unwrap().unwrap();
    assert_eq!(straight, resumed);
    let mut shorter = options.clone();
    shorter.common.steps = 2;
    assert_ne!(straight, run(&folder.path().join("c"), &shorter, None).unwrap().unwrap());

    // The same against discriminators, which are part of the checkpoints.
    let against = Pix2PoseTrainingOptions { adversarial: 0.01, ..options.clone() };
    let contested = run(&folder.path().join("d"), &against, None).unwrap().unwrap();
    assert_ne!(contested, straight);
    assert!(run(&folder.path().join("e"), &against, Some(3)).unwrap().is_none());
    assert_eq!(run(&folder.path().join("e"), &against, None).unwrap().unwrap(), contested);
    let negative = Pix2PoseTrainingOptions { adversarial: -1.0, ..options.clone() };
    let error = run(&folder.path().join("f"), &negative, None).unwrap_err().to_string();
    assert!(error.contains("adversarial"), "{error}");

    let mut other = options;
    other.common.learning_rate = 0.1;
    let error = run(&folder.path().join("b"), &other, None).unwrap_err().to_string();
    assert!(error.contains("learning_rate was 0.002, is 0.1"), "{error}");
}
