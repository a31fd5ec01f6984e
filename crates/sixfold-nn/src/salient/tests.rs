use std::fs;

use super::*;
use crate::weights::{ModelCard, save_weights};

/// Result of onnxruntime 1.32 with the package's weights for the image below: column, row, value.
const EXPECTED: [(usize, usize, f32); 11] = [
    (0, 0, 0.0011),
    (180, 140, 0.9999),
    (180, 70, 0.3338),
    (111, 140, 0.9008),
    (108, 140, 0.0024),
    (20, 300, 0.0000),
    (180, 209, 0.9602),
    (200, 205, 0.9992),
    (230, 90, 0.0708),
    (250, 140, 0.2801),
    (125, 100, 0.9981),
];

/// A bright disk on a dark texture.
fn disk() -> RgbImage {
    RgbImage::from_fn(SIDE, SIDE, |x, y| {
        let (dx, dy) = (x as i64 - 180, y as i64 - 140);
        if dx * dx + dy * dy < 70 * 70 {
            return [230, 150, 50];
        }
        [0, 1, 2].map(|c| ((x * x / 7 + y * 13 + x * y / 5 + c * 5) % 17 * 5) as u8)
    })
}

fn network() -> SalientNetwork {
    SalientNetwork::shipped(&Device::default()).unwrap()
}

/// `checks/salient_vs_onnxruntime.py` compares whole maps in full precision to 1e-4; the shipped weights are rounded to half
/// precision.
#[test]
fn the_built_in_weights_agree_with_onnxruntime() {
    let seen = network().salience(&disk()).unwrap();
    for (x, y, value) in EXPECTED {
        let found = seen.probability[(x, y)];
        assert!((found - value).abs() < 0.01, "column {x}, row {y}: {found}, not {value}");
    }
    assert!(seen.lowest < 0.001 && seen.highest > 0.999, "{} to {}", seen.lowest, seen.highest);
}

#[test]
fn a_rectangle_is_segmented_alone_and_placed_in_the_image() {
    let network = network();
    let image = disk();
    let rect = Rect { x: 90.2, y: 40.0, width: 180.0, height: 200.0 };
    let seen = network.salience_in(&image, rect).unwrap();
    let crop = RgbImage::from_fn(180, 200, |x, y| image[(90 + x, 40 + y)]);
    let alone = network.salience(&crop).unwrap();
    assert_eq!((seen.lowest, seen.highest), (alone.lowest, alone.highest));
    assert_eq!(seen.probability.size(), (SIDE, SIDE));
    for (x, y) in [(90, 40), (180, 140), (269, 239)] {
        assert_eq!(seen.probability[(x, y)], alone.probability[(x - 90, y - 40)]);
    }
    for at in [(89, 140), (270, 140), (180, 39), (180, 240)] {
        assert_eq!((seen.probability[at], seen.relative()[at]), (0.0, 0.0));
    }
    let mask = seen.mask(0.5);
    let disk = Mask::from_fn(SIDE, SIDE, |x, y| image[(x, y)] == [230, 150, 50]);
    let count = |f: fn(bool, bool) -> bool| {
        mask.as_slice().iter().zip(disk.as_slice()).filter(|(a, b)| f(**a, **b)).count() as f64
    };
    let iou = count(|a, b| a && b) / count(|a, b| a || b);
    assert!(iou > 0.9, "{iou}");
}

#[test]
fn images_of_any_size_and_none() {
    let network = network();
    for (width, height) in [(1, 1), (7, 500), (641, 3)] {
        let seen = network.salience(&RgbImage::filled(width, height, [0, 0, 0])).unwrap();
        assert_eq!(seen.probability.size(), (width, height));
        assert!(seen.probability.as_slice().iter().all(|v| (0.0..=1.0).contains(v)));
    }
    let empty = network.salience(&RgbImage::filled(0, 5, [0; 3])).unwrap_err();
    assert_eq!(empty.to_string(), "image: expected at least one pixel, found 0x5");
    let image = disk();
    for rect in
        [[-20.0, 0.0, 20.4, 9.0], [0.0, 320.0, 5.0, 5.0], [3.0, 3.0, -1.0, 4.0], [f64::NAN, 0.0, 9.0, 9.0]]
    {
        let [x, y, width, height] = rect;
        let error = network.salience_in(&image, Rect { x, y, width, height }).unwrap_err().to_string();
        assert!(error.contains("image of 320x320") && error.contains("give a rectangle within"), "{error}");
    }
}

#[test]
fn values_that_are_all_equal_are_not_stretched() {
    let salience = Salience { probability: Image::filled(3, 2, 0.25), lowest: 0.25, highest: 0.25 };
    assert!(salience.relative().as_slice().iter().all(|v| *v == 0.0));
    let probability = Image::from_fn(3, 1, |x, _| [0.1, 0.2, 0.5][x]);
    let salience = Salience { probability, lowest: 0.1, highest: 0.5 };
    assert_eq!(salience.mask(0.5).as_slice(), [false, false, true]);
    assert_eq!(salience.relative().as_slice()[2], 1.0);
}

#[test]
fn weight_files_that_do_not_fit_are_refused() {
    let device = Device::default();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("weights.safetensors");
    let error = |path: &Path| SalientNetwork::load(path, &device).unwrap_err();
    assert!(matches!(error(&path), WeightsError::Read { .. }));
    fs::write(&path, &WEIGHTS[..WEIGHTS.len() / 2]).unwrap();
    assert!(matches!(error(&path), WeightsError::Broken { .. }));
    fs::write(&path, b"").unwrap();
    assert!(matches!(error(&path), WeightsError::Broken { .. }));
    fs::write(&path, include_bytes!("../../weights/xfeat.safetensors")).unwrap();
    let text = error(&path).to_string();
    assert!(text.contains("expected weights of u2netp, found weights of xfeat"), "{text}");
    // The right card with another network's tensors.
    let other = crate::xfeat::XFeat::shipped(&device).unwrap();
    save_weights(&other, &ModelCard::new(ARCHITECTURE, ""), &path).unwrap();
    let text = error(&path).to_string();
    assert!(
        text.contains("tensor encoder.0.input.weight: expected shape [64, 3, 3, 3], found no tensor"),
        "{text}"
    );
    fs::write(&path, WEIGHTS).unwrap();
    SalientNetwork::load(&path, &device).unwrap();
}
