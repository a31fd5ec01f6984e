//! A detector learns two synthetic objects from renders, and a training that is interrupted and continues ends with the same
//! numbers as one that is not.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use burn::tensor::Device;
use sixfold_data::TrainingObject;
use sixfold_detect::detect::DetectOptions;
use sixfold_detect::model::{ClassEntry, DetectorModel, DetectorUse, ModelError};
use sixfold_detect::network::{DetectorConfig, Encoder};
use sixfold_detect::samples::{TrainingImageOptions, TrainingImageSource};
use sixfold_detect::training::{DetectorTraining, DetectorTrainingOptions};
use sixfold_geometry::{Image, RgbImage, Vec3};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::options::{Pace, TrainingOptions};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Outcome, fit};
use sixfold_nn::weights::ModelCard;
use sixfold_synth::augment::Backgrounds;

/// A pyramid or a flat box of one colour.
fn object(id: u32, pyramid: bool, color: [u8; 3]) -> TrainingObject {
    let (vertices, faces): (Vec<[f64; 3]>, Vec<[u32; 3]>) = if pyramid {
        let corners = [[-0.05, -0.05, 0.0], [0.05, -0.05, 0.0], [0.05, 0.05, 0.0], [-0.05, 0.05, 0.0]];
        let tip = [[0.0, 0.0, 0.09]];
        let sides = [[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]];
        (corners.into_iter().chain(tip).collect(), sides.to_vec())
    } else {
        let corner = |i: usize| {
            let at = |axis: usize, half: f64| if i >> axis & 1 == 0 { -half } else { half };
            [at(0, 0.06), at(1, 0.04), at(2, 0.015)]
        };
        let corners = (0..8).map(corner).collect();
        let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        (corners, sides.iter().flat_map(|s| [[s[0], s[1], s[2]], [s[0], s[2], s[3]]]).collect())
    };
    let colors = vec![color; vertices.len()];
    let mesh = Mesh::new(vertices.into_iter().map(Vec3::from).collect(), faces).unwrap();
    let mesh = mesh.with_colors(colors).unwrap();
    let info = ModelInfo { diameter: 0.14, ..ModelInfo::of_mesh(&mesh) };
    TrainingObject::new(id, mesh, info)
}

fn source(size: usize) -> TrainingImageSource {
    let objects = vec![object(3, true, [220, 60, 40]), object(8, false, [40, 90, 220])];
    let options = TrainingImageOptions {
        size,
        scale: [0.3, 0.6],
        max_pasted: 3,
        max_distractors: 1,
        ..TrainingImageOptions::default()
    };
    TrainingImageSource::new(objects, &[], &[], Backgrounds::procedural(), options).unwrap()
}

/// Trains in `folder`, stopping after step `stop_at`; the weight file's path when it finished.
fn run(
    folder: &Path,
    size: usize,
    options: &DetectorTrainingOptions,
    stop_at: Option<u64>,
) -> Result<Option<std::path::PathBuf>, TrainError> {
    let device = Device::flex().autodiff();
    let config = DetectorConfig::compact(2);
    let network = config.init_with(Encoder::Lite0(imagenet_encoder(&device).unwrap()), 5, &device);
    let stop = AtomicBool::new(false);
    let mut training = DetectorTraining::new(network, config, size, options.clone(), device);
    training.pace = Pace { log_every: 1, checkpoint_every: 3, sample_threads: 2 };
    let outcome = fit(&mut training, &source(size), &folder.join("training"), &stop, |record| {
        stop.store(stop_at == Some(record.step), Ordering::Relaxed);
    })?;
    Ok(match outcome {
        Outcome::Finished(()) => {
            let (network, config) = training.into_network();
            let path = folder.join("model.safetensors");
            let classes = vec![ClassEntry { id: 3 }, ClassEntry { id: 8 }];
            let card = ModelCard::new("", "test");
            DetectorModel::new(network, config, classes, DetectorUse::default(), card).save(&path).unwrap();
            Some(path)
        }
        Outcome::Interrupted { step } => {
            assert_eq!(Some(step), stop_at);
            None
        }
    })
}

fn short(steps: u64, warm_up: u64) -> DetectorTrainingOptions {
    let default = DetectorTrainingOptions::default();
    DetectorTrainingOptions { common: TrainingOptions { steps, warm_up, ..default.common }, ..default }
}

#[test]
fn interrupted_and_resumed_it_ends_with_the_same_bytes() {
    let options = DetectorTrainingOptions { batch: 3, ..short(4, 1) };
    let folder = tempfile::tempdir().unwrap();
    let bytes = |path: Option<std::path::PathBuf>| std::fs::read(path.unwrap()).unwrap();
    let straight = bytes(run(&folder.path().join("a"), 64, &options, None).unwrap());
    assert!(run(&folder.path().join("b"), 64, &options, Some(2)).unwrap().is_none());
    assert!(straight == bytes(run(&folder.path().join("b"), 64, &options, None).unwrap()));
    let common = TrainingOptions { learning_rate: 0.1, ..options.common.clone() };
    let other = DetectorTrainingOptions { common, ..options };
    let error = run(&folder.path().join("b"), 64, &other, None).unwrap_err().to_string();
    assert!(error.contains("learning_rate was 0.002, is 0.1"), "{error}");
}

#[test]
fn it_learns_two_objects() {
    let options = short(280, 20);
    let folder = tempfile::tempdir().unwrap();
    let path = run(folder.path(), 128, &options, None).unwrap().unwrap();
    let model = DetectorModel::load(&path).unwrap();
    assert_eq!((model.id_of(0), model.id_of(1)), (3, 8));
    assert!(matches!(model.check_object(5).unwrap_err(), ModelError::UnknownObject { id: 5, .. }));
    let test = source(128);
    let (mut found, mut objects, mut wrong, mut agreement) = (0, 0, 0, 0.0);
    for number in 0..40 {
        let sample = test.sample(99, number);
        let plane = 128 * 128;
        let image: RgbImage = Image::from_fn(128, 128, |x, y| {
            [0, 1, 2].map(|c| (sample.rgb[c * plane + y * 128 + x] * 255.0).round() as u8)
        });
        let detected = model.detect(&image, &DetectOptions { threshold: 0.4, ..model.options() }).unwrap();
        let mut taken = vec![false; sample.annotation.instances.len()];
        for d in &detected {
            let hit = sample.annotation.instances.iter().position(|i| {
                let [l, t, r, b] = i.corners.map(f64::from);
                let truth = sixfold_geometry::Rect { x: l, y: t, width: r - l, height: b - t };
                i.class == d.class && truth.iou(&d.bbox) >= 0.5
            });
            match hit.filter(|i| !taken[*i]) {
                Some(index) => {
                    taken[index] = true;
                    let mask = d.mask.as_ref().unwrap();
                    let (mut both, mut either) = (0.0, 0.0f64);
                    for (label, inside) in sample.annotation.labels.iter().zip(mask.as_slice()) {
                        let truth = usize::from(*label) == index + 1;
                        both += f64::from(truth && *inside);
                        either += f64::from(truth || *inside);
                    }
                    agreement += both / either.max(1.0);
                }
                None => wrong += 1,
            }
        }
        objects += taken.len();
        found += taken.iter().filter(|t| **t).count();
    }
    let agreement = agreement / found.max(1) as f64;
    assert!(found as f64 >= 0.6 * objects as f64, "{found} of {objects} found");
    assert!(wrong as f64 <= 0.5 * objects as f64, "{wrong} wrong detections for {objects} objects");
    assert!(agreement > 0.6, "masks agree by {agreement}");
}

#[test]
fn samples_are_a_function_of_their_number() {
    let (a, b) = (source(96), source(96));
    for number in 0..12 {
        let sample = a.sample(4, number);
        assert!(sample == b.sample(4, number));
        assert!(sample.rgb.iter().all(|v| (0.0..=1.0).contains(v)));
        let annotation = &sample.annotation;
        for (index, instance) in annotation.instances.iter().enumerate() {
            let pixels: Vec<usize> = (0..annotation.labels.len())
                .filter(|i| usize::from(annotation.labels[*i]) == index + 1)
                .collect();
            assert!(pixels.len() >= 64);
            let left = pixels.iter().map(|i| i % 96).min().unwrap() as f32;
            let bottom = pixels.iter().map(|i| i / 96).max().unwrap() as f32;
            assert_eq!((instance.corners[0], instance.corners[3]), (left, bottom));
        }
    }
    assert!(a.sample(4, 0) != a.sample(5, 0));
    // Without a mesh to render and a photograph there is nothing to see.
    let bare = object(3, true, [0; 3]);
    let plain = Mesh::new(bare.mesh.vertices().to_vec(), bare.mesh.faces().to_vec()).unwrap();
    let grey = TrainingObject { mesh: plain, ..bare };
    let options = TrainingImageOptions { size: 64, ..TrainingImageOptions::default() };
    let error = TrainingImageSource::new(vec![grey], &[], &[], Backgrounds::procedural(), options.clone())
        .unwrap_err();
    assert!(error.to_string().contains("object 3"), "{error}");
    let wrong = TrainingImageOptions { size: 50, ..options };
    let objects = vec![object(3, true, [9; 3])];
    let error = TrainingImageSource::new(objects, &[], &[], Backgrounds::procedural(), wrong).unwrap_err();
    assert!(error.to_string().contains("size: found 50"), "{error}");
}
