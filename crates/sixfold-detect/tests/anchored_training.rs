//! Small networks with anchors learn from the weights in `tests/anchored` or from EfficientNet-Lite0's, and a training that is interrupted and continues ends
//! with the same bytes as one that is not.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use burn::tensor::Device;
use serde_json::json;
use sixfold_data::TrainingObject;
use sixfold_detect::anchored::{AnchoredKind, AnchoredNetwork, AnchoredTraining};
use sixfold_detect::detect::DetectOptions;
use sixfold_detect::model::{ClassEntry, DetectorModel, DetectorUse};
use sixfold_detect::network::EncoderKind;
use sixfold_detect::recipe::{DetectorKind, DetectorRecipe};
use sixfold_detect::samples::{TrainingImageOptions, TrainingImageSource};
use sixfold_detect::training::DetectorTrainingOptions;
use sixfold_geometry::{RgbImage, Vec3};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_nn::choice::Choice;
use sixfold_nn::options::{Pace, TrainingOptions};
use sixfold_nn::recipe::Recipe;
use sixfold_nn::training::{Outcome, fit};
use sixfold_nn::weights::{ModelCard, read_card};
use sixfold_synth::augment::Backgrounds;

const SIDE: usize = 96;

fn weights(kind: AnchoredKind) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/anchored/{}.safetensors", kind.name()))
}

/// A flat box of one colour.
fn object(id: u32, color: [u8; 3]) -> TrainingObject {
    let corner = |i: usize| {
        let at = |axis: usize, half: f64| if i >> axis & 1 == 0 { -half } else { half };
        Vec3::from([at(0, 0.06), at(1, 0.04), at(2, 0.015)])
    };
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces = sides.iter().flat_map(|s| [[s[0], s[1], s[2]], [s[0], s[2], s[3]]]).collect();
    let mesh = Mesh::new((0..8).map(corner).collect(), faces).unwrap().with_colors(vec![color; 8]).unwrap();
    let info = ModelInfo { diameter: 0.14, ..ModelInfo::of_mesh(&mesh) };
    TrainingObject::new(id, mesh, info)
}

fn source() -> TrainingImageSource {
    let objects = vec![object(3, [220, 60, 40]), object(8, [40, 90, 220])];
    let options = TrainingImageOptions {
        size: SIDE,
        scale: [0.3, 0.6],
        max_pasted: 2,
        max_distractors: 1,
        ..TrainingImageOptions::default()
    };
    TrainingImageSource::new(objects, &[], &[], Backgrounds::procedural(), options).unwrap()
}

fn options(steps: u64, batch: usize, learning_rate: f64) -> DetectorTrainingOptions {
    let default = DetectorTrainingOptions::default();
    let common = TrainingOptions { steps, warm_up: 2, learning_rate, ..default.common };
    // All stages learn: nobody trained this ResNet.
    DetectorTrainingOptions { common, batch, encoder_rate: 1.0, frozen_stages: 0 }
}

/// Trains in `folder` until the end, or until step `stop_at`: the losses of every step, and the model when it finished.
fn run(
    folder: &Path,
    kind: AnchoredKind,
    options: DetectorTrainingOptions,
    stop_at: Option<u64>,
) -> (Vec<f64>, Option<PathBuf>) {
    run_on(EncoderKind::ResNet50, folder, kind, options, stop_at)
}

fn run_on(
    encoder: EncoderKind,
    folder: &Path,
    kind: AnchoredKind,
    options: DetectorTrainingOptions,
    stop_at: Option<u64>,
) -> (Vec<f64>, Option<PathBuf>) {
    let device = Device::flex().autodiff();
    let labels = if kind == AnchoredKind::RetinaNet { 2 } else { 3 };
    let network = match encoder {
        EncoderKind::ResNet50 => {
            AnchoredNetwork::pretrained(&weights(kind), kind, labels, 5, &device).unwrap().unwrap()
        }
        EncoderKind::Lite0 => AnchoredNetwork::on_lite0(kind, labels, 5, &device).unwrap(),
    };
    let mut training = AnchoredTraining::new(network, SIDE, options);
    training.pace = Pace { log_every: 1, checkpoint_every: 2, sample_threads: 2 };
    let (stop, mut losses) = (AtomicBool::new(false), vec![]);
    let outcome = fit(&mut training, &source(), &folder.join("training"), &stop, |record| {
        losses.push(record.losses.values().sum());
        stop.store(stop_at == Some(record.step), Ordering::Relaxed);
    });
    match outcome.unwrap() {
        Outcome::Finished(()) => {
            let path = folder.join("model.safetensors");
            let classes = vec![ClassEntry { id: 3 }, ClassEntry { id: 8 }];
            let usage = DetectorUse { longest_side: SIDE, threshold: 0.3 };
            let network = training.into_network();
            let card = ModelCard::new("", "test");
            DetectorModel::of_anchored(network, classes, usage, card).save(&path).unwrap();
            (losses, Some(path))
        }
        Outcome::Interrupted { .. } => (losses, None),
    }
}

#[test]
fn losses_fall() {
    for kind in AnchoredKind::ALL {
        let folder = tempfile::tempdir().unwrap();
        let (losses, path) = run(folder.path(), *kind, options(60, 2, 3e-3), None);
        let mean = |of: &[f64]| of.iter().sum::<f64>() / of.len() as f64;
        let (first, last) = (mean(&losses[..5]), mean(&losses[55..]));
        assert!(losses.iter().all(|l| l.is_finite()) && last < 0.7 * first, "{kind:?}: {first} to {last}");
        let model = DetectorModel::load(&path.unwrap()).unwrap();
        assert_eq!((model.id_of(0), model.id_of(1)), (3, 8));
        let found = model.detect(&RgbImage::filled(80, 60, [90; 3]), &model.options()).unwrap();
        assert!(found.len() <= 100);
    }
}

#[test]
fn losses_fall_on_lite0_and_the_file_gives_the_same_network_again() {
    // Faster R-CNN is part of Mask R-CNN.
    for kind in [AnchoredKind::MaskRcnn, AnchoredKind::RetinaNet] {
        let folder = tempfile::tempdir().unwrap();
        let options = options(30, 2, 1e-3);
        let options = DetectorTrainingOptions { encoder_rate: 0.3, frozen_stages: 2, ..options };
        let (losses, path) = run_on(EncoderKind::Lite0, folder.path(), kind, options, None);
        let mean = |of: &[f64]| of.iter().sum::<f64>() / of.len() as f64;
        let (first, last) = (mean(&losses[..5]), mean(&losses[25..]));
        assert!(losses.iter().all(|l| l.is_finite()) && last < 0.8 * first, "{kind:?}: {first} to {last}");
        let path = path.unwrap();
        assert_eq!(read_card(&path).unwrap().extra["network"]["encoder"], json!("lite0"));
        let model = DetectorModel::load(&path).unwrap();
        let image = RgbImage::from_fn(80, 60, |x, y| [(3 * x) as u8, (4 * y) as u8, 90]);
        let all = DetectOptions { threshold: 1e-3, masks: true, ..model.options() };
        let found = model.detect(&image, &all).unwrap();
        assert!(!found.is_empty());
        assert_eq!(found[0].mask.is_some(), kind == AnchoredKind::MaskRcnn);
        let again = folder.path().join("again.safetensors");
        model.save(&again).unwrap();
        assert!(std::fs::read(&path).unwrap() == std::fs::read(&again).unwrap());
        assert!(DetectorModel::load(&again).unwrap().detect(&image, &all).unwrap() == found);
    }
}

#[test]
fn cards_on_lite0_with_impossible_numbers_are_refused() {
    let (kind, device) = (AnchoredKind::RetinaNet, Device::flex());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let network = AnchoredNetwork::on_lite0(kind, 1, 5, &device).unwrap();
    let usage = DetectorUse { longest_side: SIDE, threshold: 0.3 };
    let model =
        DetectorModel::of_anchored(network, vec![ClassEntry { id: 3 }], usage, ModelCard::new("", ""));
    model.save(&path).unwrap();
    let whole = std::fs::read(&path).unwrap();
    let cases: &[(Change, &[&str])] = &[
        (|c| c.extra["network"]["width"] = json!(64), &["`extra.network.width`", "0 with lite0", "found 64"]),
        (|c| c.extra["network"]["blocks"] = json!([3, 4, 6, 3]), &["`extra.network.blocks`", "0 with lite0"]),
        (|c| c.extra["network"]["encoder"] = json!("res_net50"), &["`extra.network.width`", "found 0"]),
        (|c| c.extra["network"]["encoder"] = json!("vgg"), &["`extra.network`", "vgg"]),
        (|c| c.extra["network"]["pyramid"] = json!(1024), &["`extra.network`", "that the file holds"]),
    ];
    refused(&path, &whole, cases);
}

#[test]
fn interrupted_and_resumed_it_ends_with_the_same_bytes_on_any_number_of_threads() {
    let kind = AnchoredKind::MaskRcnn;
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let few = || options(4, 2, 1e-3);
    let bytes = |path: Option<PathBuf>| std::fs::read(path.unwrap()).unwrap();
    let whole = bytes(run(&path("a"), kind, few(), None).1);
    assert!(run(&path("b"), kind, few(), Some(3)).1.is_none());
    assert!(whole == bytes(run(&path("b"), kind, few(), None).1));
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert!(whole == bytes(one.install(|| run(&path("c"), kind, few(), None).1)));
}

#[test]
fn cards_with_impossible_numbers_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let kind = AnchoredKind::FasterRcnn;
    let file = run(folder.path(), kind, options(1, 1, 1e-3), None).1.unwrap();
    let whole = std::fs::read(&file).unwrap();
    assert_eq!(read_card(&file).unwrap().architecture, "detect-faster-rcnn");
    let cases: &[(Change, &[&str])] = &[
        (|c| c.extra["network"]["labels"] = json!(0), &["`extra.network.labels`", "found 0"]),
        (|c| c.extra["network"]["width"] = json!(200), &["`extra.network`", "that the file holds"]),
        (|c| c.extra["network"]["blocks"] = json!([1, 1, 1, 999]), &["`extra.network.blocks`", "999"]),
        (|c| c.extra["network"]["hidden"] = json!(1u64 << 60), &["`extra.network.hidden`"]),
        (|c| c.extra["network"]["min_side"] = json!(1), &["`extra.network.min_side`", "found 1"]),
        (|c| c.extra["network"]["kind"] = json!("mask-rcnn"), &["`extra.network.kind`"]),
        (|c| c.extra["network"]["norm_epsilon"] = json!(-1.0), &["`extra.network.norm_epsilon`"]),
        (|c| c.extra["labels"] = json!([1, 1]), &["`extra.labels`", "[1, 1]"]),
        (|c| c.extra["labels"] = json!([0, 1]), &["`extra.labels`"]),
        (|c| c.extra["labels"] = json!([1]), &["`extra.labels`", "for 2 objects"]),
        (|c| c.extra["use"]["threshold"] = json!(2.0), &["`extra.use.threshold`"]),
        (|c| c.objects[1] = json!({ "id": 3 }), &["`objects`", "object 3 twice"]),
    ];
    refused(&file, &whole, cases);
}

/// What is wrong with a card.
type Change = fn(&mut ModelCard);

/// A file with each of these changes to its card is refused in these words.
fn refused(file: &Path, whole: &[u8], cases: &[(Change, &[&str])]) {
    let card = read_card(file).unwrap();
    for (change, words) in cases {
        let mut card = card.clone();
        change(&mut card);
        // The card stands in the header of the file, whose length may change.
        let header = u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize;
        let mut parsed: serde_json::Value = serde_json::from_slice(&whole[8..8 + header]).unwrap();
        parsed["__metadata__"]["sixfold_card"] = json!(serde_json::to_string(&card).unwrap());
        let text = serde_json::to_vec(&parsed).unwrap();
        let parts = [&(text.len() as u64).to_le_bytes()[..], &text, &whole[8 + header..]];
        std::fs::write(file, parts.concat()).unwrap();
        let error = DetectorModel::load(file).unwrap_err().to_string();
        assert!(error.contains("model.safetensors"), "{error}");
        assert!(words.iter().all(|word| error.contains(word)), "{words:?} is not in {error}");
    }
}

#[test]
fn a_training_needs_weights_of_its_network() {
    let kind = DetectorKind::Anchored(AnchoredKind::FasterRcnn);
    let recipe = DetectorRecipe { network: kind, ..DetectorRecipe::default() };
    let error = recipe.check().unwrap_err().to_string();
    assert!(error.contains("encoder") && error.contains("ResNet-50"), "{error}");
    assert!(DetectorRecipe { encoder: Some("resnet50.pth".into()), ..recipe.clone() }.check().is_ok());
    let refused = |recipe: &DetectorRecipe| recipe.check().unwrap_err().to_string();
    let lite0 = DetectorRecipe { backbone: Some(EncoderKind::Lite0), ..recipe };
    assert!(lite0.check().is_ok());
    let error = refused(&DetectorRecipe { encoder: Some("resnet50.pth".into()), ..lite0.clone() });
    assert!(error.contains("encoder") && error.contains("backbone lite0"), "{error}");
    let error = refused(&DetectorRecipe { backbone: Some(EncoderKind::ResNet50), ..lite0.clone() });
    assert!(error.contains("encoder: found none"), "{error}");
    for network in [DetectorKind::Compact, DetectorKind::Retinanet] {
        let error = refused(&DetectorRecipe { network, ..lite0.clone() });
        assert!(error.contains("backbone") && error.contains(network.name()), "{error}");
    }
    let device = Device::flex();
    let other = weights(AnchoredKind::MaskRcnn);
    let found = AnchoredNetwork::pretrained(&other, AnchoredKind::FasterRcnn, 3, 0, &device).unwrap();
    assert!(found.is_none());
}
