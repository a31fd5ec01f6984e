//! Small networks with torchvision's weights give torchvision's detections. `tests/anchored` is written by
//! `checks/anchored_vs_torchvision.py --fixtures FOLDER` with torchvision 0.21, which also compares the networks in full size.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use sixfold_detect::anchored::{AnchoredConfig, AnchoredDetection, AnchoredKind, AnchoredNetwork, Thresholds};
use sixfold_geometry::RgbImage;
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

/// The weights under other names or of other shapes.
fn changed(
    from: &Path,
    to: &Path,
    change: impl Fn(&str, Vec<usize>) -> Option<(String, Vec<usize>)>,
) -> PathBuf {
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
        let file = changed(&weights(*kind), &folder.path().join("old.safetensors"), |name, shape| {
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
    let of = |change: &dyn Fn(&str, Vec<usize>) -> Option<(String, Vec<usize>)>| {
        let file = changed(&weights(kind), &folder.path().join("wrong.safetensors"), change);
        load(&file, &config(kind)).unwrap_err().to_string()
    };
    let error = of(&|name, shape| (!name.contains("mask_head.2.0.bias")).then(|| (name.to_owned(), shape)));
    for word in ["wrong.safetensors", "roi_heads.mask_head.2.0.bias", "expected shape [8]", "found no tensor"] {
        assert!(error.contains(word), "{word} is not in {error}");
    }
    let error = of(&|name, shape| {
        let flat = name == "roi_heads.box_head.fc7.weight";
        Some((name.to_owned(), if flat { vec![256] } else { shape }))
    });
    for word in ["roi_heads.box_head.fc7.weight", "expected shape [16, 16]", "found [256]", "maskrcnn_resnet50_fpn"] {
        assert!(error.contains(word), "{word} is not in {error}");
    }
    // Weights of one network are not those of another.
    let error = load(&weights(AnchoredKind::FasterRcnn), &config(kind)).unwrap_err().to_string();
    assert!(error.contains("tensor roi_heads.mask_head.0.0.weight"), "{error}");
    let error = load(&weights(kind), &config(AnchoredKind::FasterRcnn)).unwrap_err().to_string();
    assert!(error.contains("expected no tensor of that name"), "{error}");
}

#[test]
fn a_file_tells_which_network_it_holds() {
    let folder = tempfile::tempdir().unwrap();
    // Too small for the network of full size, which the message names.
    for kind in AnchoredKind::ALL {
        let error = AnchoredNetwork::recognised(&weights(*kind), 0.0).unwrap_err().to_string();
        assert!(error.contains(kind.torchvision()) && error.contains("backbone.body.conv1.weight"), "{error}");
    }
    let file = changed(&weights(AnchoredKind::RetinaNet), &folder.path().join("other.safetensors"), |name, shape| {
        name.starts_with("backbone").then(|| (name.to_owned(), shape))
    });
    assert!(AnchoredNetwork::recognised(&file, 0.0).unwrap().is_none());
}
