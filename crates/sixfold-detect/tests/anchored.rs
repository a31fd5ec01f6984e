//! Small networks with torchvision's weights give torchvision's detections. `tests/anchored` is written by
//! `checks/anchored_vs_torchvision.py --fixtures FOLDER` with torchvision 0.21, which also compares the networks in full size.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use sixfold_detect::anchored::{
    AnchoredConfig, AnchoredDetection, AnchoredKind, AnchoredNetwork, Thresholds,
};
use sixfold_detect::detect::DetectOptions;
use sixfold_detect::model::{DetectorModel, ModelError};
use sixfold_detect::torchvision::objects_file;
use sixfold_geometry::{Rect, RgbImage};
use sixfold_nn::choice::Choice;
use sixfold_nn::pretrained::{PretrainedError, PretrainedFile};

/// Scores and probabilities.
const TOLERANCE: f32 = 1e-4;
/// Of pixels: torchvision in single precision differs by up to 5.4e-4 from itself in double precision on these images.
const BOX_TOLERANCE: f32 = 3e-4;

fn config(kind: AnchoredKind) -> AnchoredConfig {
    AnchoredConfig {
        blocks: [1; 4],
        width: 4,
        pyramid: 8,
        hidden: 16,
        min_side: 96,
        max_side: 160,
        ..AnchoredConfig::new(kind, 4)
    }
}

fn thresholds(kind: AnchoredKind) -> Thresholds {
    let most = if kind == AnchoredKind::MaskRcnn { 8 } else { 30 };
    Thresholds { most, ..config(kind).thresholds() }
}

fn weights(kind: AnchoredKind) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/anchored/{}.safetensors", kind.name()))
}

fn load(path: &Path, config: &AnchoredConfig) -> Result<AnchoredNetwork, PretrainedError> {
    AnchoredNetwork::from_pytorch(&PretrainedFile::open(path)?, config, &Device::flex())
}

/// The image that the script makes by the same rule.
fn pattern(columns: usize, rows: usize) -> RgbImage {
    let value = |x: usize, y: usize, c: usize| (((3 * x + 5 * y * (c + 1)) ^ (x * y / 16)) % 256) as u8;
    RgbImage::from_fn(columns, rows, |x, y| [0, 1, 2].map(|c| value(x, y, c)))
}

fn images() -> [RgbImage; 2] {
    [pattern(90, 70), pattern(61, 110)]
}

/// A file's tensors as `f32`.
fn tensors(path: &Path) -> BTreeMap<String, Vec<f32>> {
    let bytes = std::fs::read(path).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let numbers = |t: TensorView<'_>| {
        assert_eq!(t.dtype(), Dtype::F32);
        t.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
    };
    file.tensors().into_iter().map(|(name, t)| (name, numbers(t))).collect()
}

fn close(found: &[f32], expected: &[f32], tolerance: f32, what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!((f - e).abs() <= tolerance, "{what}, number {i}: {f}, torchvision {e}");
    }
}

fn check(kind: AnchoredKind, number: usize, image: &RgbImage, found: &[AnchoredDetection]) {
    let expected = tensors(&weights(kind).with_file_name(format!("{}-detections.safetensors", kind.name())));
    let of = |name: &str| &expected[&format!("{number} {name}")];
    let what = |name: &str| format!("{}, image {number}, {name}", kind.name());
    let labels: Vec<f32> = found.iter().map(|d| d.label as f32).collect();
    assert_eq!(&labels, of("labels"), "{}", what("labels"));
    let scores: Vec<f32> = found.iter().map(|d| d.score).collect();
    close(&scores, of("scores"), TOLERANCE, &what("scores"));
    let boxes: Vec<f32> = found.iter().flat_map(|d| d.corners).collect();
    close(&boxes, of("boxes"), BOX_TOLERANCE, &what("boxes"));
    if kind != AnchoredKind::MaskRcnn {
        assert!(found.iter().all(|d| d.mask.is_none()));
        return;
    }
    let masks: Vec<f32> = found.iter().flat_map(|d| d.mask.clone().unwrap().values).collect();
    close(&masks, of("masks"), TOLERANCE, &what("masks"));
    // The best one in the whole image.
    let part = found[0].mask.clone().unwrap().pasted(&found[0].corners, image.size());
    let (columns, rows) = image.size();
    let mut pasted = vec![0.0; columns * rows];
    for (i, value) in part.values.iter().enumerate() {
        pasted[(part.corner[1] + i / part.size[0]) * columns + part.corner[0] + i % part.size[0]] = *value;
    }
    close(&pasted, of("pasted"), TOLERANCE, &what("mask in the image"));
}

#[test]
fn detections_are_those_of_torchvision() {
    for kind in AnchoredKind::ALL {
        let network = load(&weights(*kind), &config(*kind)).unwrap();
        for (number, image) in images().iter().enumerate() {
            check(*kind, number, image, &network.detect(image, &thresholds(*kind), true));
        }
    }
}

#[test]
fn pickled_weights_are_the_same() {
    let kind = AnchoredKind::FasterRcnn;
    let network = load(&weights(kind).with_extension("pth"), &config(kind)).unwrap();
    let image = &images()[1];
    check(kind, 1, image, &network.detect(image, &thresholds(kind), true));
}

#[test]
fn any_number_of_threads_gives_the_same_detections_and_empty_images_none() {
    let kind = AnchoredKind::MaskRcnn;
    let network = load(&weights(kind), &config(kind)).unwrap();
    let image = pattern(90, 70);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| network.detect(&image, &thresholds(kind), true))
    };
    assert!(run(1) == run(3));
    assert!(network.detect(&RgbImage::filled(0, 0, [0; 3]), &thresholds(kind), true).is_empty());
    assert!(network.detect(&RgbImage::filled(1, 1, [9; 3]), &thresholds(kind), false).len() <= 8);
}

/// Another name and shape of a tensor, or that it is left out.
type Change<'a> = &'a dyn Fn(&str, Vec<usize>) -> Option<(String, Vec<usize>)>;

/// The weights under other names or of other shapes.
fn changed(from: &Path, to: &Path, change: Change<'_>) -> PathBuf {
    let bytes = std::fs::read(from).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let all = file.tensors();
    let views = all.iter().filter_map(|(name, t)| {
        let (name, shape) = change(name, t.shape().to_vec())?;
        Some((name, TensorView::new(t.dtype(), shape, t.data()).unwrap()))
    });
    std::fs::write(to, safetensors::serialize(views, None).unwrap()).unwrap();
    to.to_path_buf()
}

/// Names of older versions of torchvision.
fn old(name: &str) -> String {
    let mut name = name.replace("rpn.head.conv.0.0.", "rpn.head.conv.");
    for level in 0..4 {
        for blocks in ["inner_blocks", "layer_blocks"] {
            name = name.replace(&format!("{blocks}.{level}.0."), &format!("{blocks}.{level}."));
        }
        let head = format!("roi_heads.mask_head.{level}.0.");
        name = name.replace(&head, &format!("roi_heads.mask_head.mask_fcn{}.", level + 1));
        if let Some((stem, last)) = name.split_once(&format!("_head.conv.{level}.0.")) {
            return format!("{stem}_head.conv.{}.{last}", 2 * level);
        }
    }
    name
}

#[test]
fn names_of_older_versions_are_understood() {
    let folder = tempfile::tempdir().unwrap();
    for kind in AnchoredKind::ALL {
        let file = changed(&weights(*kind), &folder.path().join("old.safetensors"), &|name, shape| {
            Some((format!("model.{}", old(name)), shape))
        });
        let names = |path: &Path| -> Vec<String> {
            PretrainedFile::open(path).unwrap().tensors().map(|(name, _)| name.to_owned()).collect()
        };
        assert_eq!(names(&file).iter().filter(|n| n.contains(".0.0.")).count(), 0);
        assert_ne!(names(&file), names(&weights(*kind)));
        let network = load(&file, &config(*kind)).unwrap();
        let image = &images()[0];
        check(*kind, 0, image, &network.detect(image, &thresholds(*kind), true));
    }
}

#[test]
fn what_does_not_fit_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let kind = AnchoredKind::MaskRcnn;
    let of = |change: Change<'_>| {
        let file = changed(&weights(kind), &folder.path().join("wrong.safetensors"), change);
        load(&file, &config(kind)).unwrap_err().to_string()
    };
    let error = of(&|name, shape| (!name.contains("mask_head.2.0.bias")).then(|| (name.to_owned(), shape)));
    for word in ["wrong.safetensors", "roi_heads.mask_head.2.0.bias", "expected shape [8]", "found no tensor"]
    {
        assert!(error.contains(word), "{word} is not in {error}");
    }
    let error = of(&|name, shape| {
        let flat = name == "roi_heads.box_head.fc7.weight";
        Some((name.to_owned(), if flat { vec![256] } else { shape }))
    });
    for word in
        ["roi_heads.box_head.fc7.weight", "expected shape [16, 16]", "found [256]", "maskrcnn_resnet50_fpn"]
    {
        assert!(error.contains(word), "{word} is not in {error}");
    }
    // Weights of one network are not those of another.
    let error = load(&weights(AnchoredKind::FasterRcnn), &config(kind)).unwrap_err().to_string();
    assert!(error.contains("tensor roi_heads.mask_head.0.0.weight"), "{error}");
    let error = load(&weights(kind), &config(AnchoredKind::FasterRcnn)).unwrap_err().to_string();
    assert!(error.contains("expected no tensor of that name"), "{error}");
}

#[test]
fn a_file_tells_which_network_it_holds_and_its_sizes() {
    let folder = tempfile::tempdir().unwrap();
    for kind in AnchoredKind::ALL {
        let sides = |config: &mut AnchoredConfig| (config.min_side, config.max_side) = (96, 160);
        let network = AnchoredNetwork::recognised(&weights(*kind), sides).unwrap().unwrap();
        let hidden = if *kind == AnchoredKind::RetinaNet { 0 } else { 16 };
        // Normalisations without a count of batches count as frozen.
        assert_eq!(*network.config(), AnchoredConfig { hidden, norm_epsilon: 0.0, ..config(*kind) });
        let counted = changed(&weights(*kind), &folder.path().join("counted.safetensors"), &|name, shape| {
            let counts = name == "backbone.body.bn1.bias";
            Some((
                if counts { "backbone.body.bn1.num_batches_tracked".to_owned() } else { name.to_owned() },
                shape,
            ))
        });
        // The bias is missing then, but the sizes are known before.
        let mut epsilon = None;
        let error = AnchoredNetwork::recognised(&counted, |config| epsilon = Some(config.norm_epsilon));
        assert_eq!(epsilon, Some(1e-5));
        assert!(error.unwrap_err().to_string().contains("tensor backbone.body.bn1.bias"));
    }
    let file = changed(
        &weights(AnchoredKind::RetinaNet),
        &folder.path().join("other.safetensors"),
        &|name, shape| name.starts_with("backbone").then(|| (name.to_owned(), shape)),
    );
    assert!(AnchoredNetwork::recognised(&file, |_| ()).unwrap().is_none());
    let error = DetectorModel::load(&file).unwrap_err().to_string();
    assert!(error.contains("other.safetensors") && error.contains("retinanet_resnet50_fpn"), "{error}");
}

/// Weights in a folder with this text beside them.
fn beside(folder: &Path, kind: AnchoredKind, text: &str) -> PathBuf {
    let file = folder.join("detector.safetensors");
    std::fs::copy(weights(kind), &file).unwrap();
    std::fs::write(objects_file(&file), text).unwrap();
    file
}

#[test]
fn a_detector_gives_the_objects_of_its_labels() {
    let folder = tempfile::tempdir().unwrap();
    let kind = AnchoredKind::MaskRcnn;
    let sides = r#""norm_epsilon": 1e-5, "min_side": 96, "max_side": 160, "threshold": 0.05"#;
    let file = beside(folder.path(), kind, &format!("{{{sides}}}"));
    let model = DetectorModel::load(&file).unwrap();
    let ids = |model: &DetectorModel| model.classes().iter().map(|c| c.id).collect::<Vec<_>>();
    assert_eq!((ids(&model), model.usage().threshold), (vec![1, 2, 3], 0.05));
    assert_eq!(model.card().training_frames, None);
    let image = pattern(90, 70);
    let options = DetectOptions { max_detections: 8, ..model.options() };
    let found = model.detect(&image, &options).unwrap();
    let expected = load(&weights(kind), &config(kind)).unwrap().detect(&image, &thresholds(kind), true);
    assert_eq!(found.len(), expected.len());
    for (f, e) in found.iter().zip(&expected) {
        assert_eq!((model.id_of(f.class), f.score), (e.label as u32, e.score));
        let [left, top, right, bottom] = e.corners.map(f64::from);
        assert_eq!(f.bbox, Rect { x: left, y: top, width: right - left, height: bottom - top });
        let mask = e.mask.as_ref().unwrap().pasted(&e.corners, image.size()).mask(image.size());
        assert_eq!(f.mask.as_ref(), Some(&mask));
    }
    let several = DetectOptions { scales: 2, ..options };
    let message = model.detect(&image, &several).unwrap_err().to_string();
    assert!(message.contains("scales") && message.contains("expected 1"), "{message}");
    let none = DetectOptions { masks: false, ..options };
    assert!(model.detect(&image, &none).unwrap().iter().all(|d| d.mask.is_none()));

    // Two of the labels, whose detections are not crowded out by the others.
    let file = beside(folder.path(), kind, &format!(r#"{{"objects": {{"3": 8, "1": 20}}, {sides}}}"#));
    let model = DetectorModel::load(&file).unwrap();
    assert_eq!(ids(&model), [20, 8]);
    let found: Vec<u32> =
        model.detect(&image, &options).unwrap().iter().map(|d| model.id_of(d.class)).collect();
    assert_eq!(found.len(), 8);
    assert!(found.contains(&20) && found.contains(&8), "{found:?}");
    assert!(model.check_object(20).is_ok() && model.check_object(3).is_err());
    assert!(matches!(model.detect(&RgbImage::filled(0, 0, [0; 3]), &options), Err(ModelError::EmptyImage)));
}

#[test]
fn a_wrong_file_beside_the_weights_is_named() {
    let folder = tempfile::tempdir().unwrap();
    for (text, words) in [
        ("{", "EOF"),
        (r#"{"classes": 3}"#, "unknown field `classes`"),
        (r#"{"objects": {}}"#, "0 objects"),
        (r#"{"objects": {"0": 5}}"#, "label 0, but the weights have the labels 1 to 3"),
        (r#"{"objects": {"4": 5}}"#, "label 4, but"),
        (r#"{"objects": {"1": 5, "2": 5}}"#, "object 5 for the labels 1 and 2"),
        (r#"{"norm_epsilon": -1}"#, "norm_epsilon -1"),
        (r#"{"threshold": 2}"#, "threshold 2"),
        (r#"{"min_side": 0}"#, "min_side 0"),
        (r#"{"max_side": 99999}"#, "max_side 99999"),
    ] {
        let file = beside(folder.path(), AnchoredKind::FasterRcnn, text);
        let error = DetectorModel::load(&file).unwrap_err().to_string();
        assert!(
            error.contains("detector.objects.json") && error.contains(words),
            "{words} is not in {error}"
        );
    }
    // RetinaNet's labels begin with 0.
    let file = beside(folder.path(), AnchoredKind::RetinaNet, r#"{"objects": {"0": 5}}"#);
    assert_eq!(DetectorModel::load(&file).unwrap().id_of(0), 5);
    let error = DetectorModel::load(&folder.path().join("none.pth")).unwrap_err();
    assert!(matches!(error, ModelError::Weights(_)), "{error}");
}
