//! COCO scores of frozen cases, computed with pycocotools 2.0.11 (`checks/coco_vs_pycocotools.py --freeze`).

use std::path::{Path, PathBuf};

use sixfold_bop::{
    CocoGroundTruth, CocoScores, Detection, IouType, ReadDetections, evaluate_coco, read_detections,
};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

fn load(case: &str) -> (CocoGroundTruth, Vec<Detection>) {
    let path = fixture(&format!("{case}_truth.json"));
    let mut truth = CocoGroundTruth::default();
    truth.add_scene(0, &std::fs::read(&path).unwrap(), &path).unwrap();
    let path = fixture(&format!("{case}_detections.json"));
    (truth, read_detections(&path, &ReadDetections::default()).unwrap().detections)
}

fn assert_close(case: &str, found: &CocoScores, expected: &serde_json::Value) {
    let found = serde_json::to_value(found).unwrap();
    let names = expected.as_object().unwrap();
    assert_eq!(names.len(), 12);
    for (name, expected) in names {
        // pycocotools writes -1 if there is nothing to average.
        let found = found[name].as_f64().unwrap_or(-1.0);
        let expected = expected.as_f64().unwrap();
        assert!((found - expected).abs() < 1e-9, "{case} {name}: {found}, pycocotools says {expected}");
    }
}

#[test]
fn frozen_cases_score_as_with_pycocotools() {
    for case in ["coco_a", "coco_b"] {
        let (truth, detections) = load(case);
        let expected = std::fs::read_to_string(fixture(&format!("{case}_expected.json"))).unwrap();
        let expected: serde_json::Value = serde_json::from_str(&expected).unwrap();
        assert_close(case, &evaluate_coco(&truth, &detections, IouType::Box), &expected["box"]);
        assert_close(case, &evaluate_coco(&truth, &detections, IouType::Mask), &expected["mask"]);
    }
}

#[test]
fn perfect_detections_score_one_and_none_score_zero() {
    let (mut truth, _) = load("coco_a");
    truth.annotations.retain(|a| !a.iscrowd);
    let detect = |a: &sixfold_bop::Annotation| Detection {
        scene_id: a.scene_id,
        image_id: a.image_id,
        category_id: a.category_id,
        score: 0.5,
        bbox: Some(a.bbox),
        segmentation: a.segmentation.clone(),
        time: None,
    };
    let perfect: Vec<Detection> = truth.annotations.iter().map(detect).collect();
    for iou_type in [IouType::Box, IouType::Mask] {
        let scores = evaluate_coco(&truth, &perfect, iou_type);
        // The reference divides by count + epsilon.
        assert!(scores.ap.unwrap() > 1.0 - 1e-12 && scores.ar100 == Some(1.0), "{scores:?}");
        let scores = evaluate_coco(&truth, &[], iou_type);
        assert_eq!((scores.ap, scores.ar100), (Some(0.0), Some(0.0)));
        let scores = evaluate_coco(&CocoGroundTruth::default(), &perfect, iou_type);
        assert_eq!((scores.ap, scores.ar100), (None, None));
    }
}

#[test]
fn images_of_different_scenes_with_the_same_number_are_different_images() {
    let (mut truth, detections) = load("coco_a");
    let once = evaluate_coco(&truth, &detections, IouType::Box).ar100.unwrap();
    let path = fixture("coco_a_truth.json");
    truth.add_scene(7, &std::fs::read(&path).unwrap(), &path).unwrap();
    let twice = evaluate_coco(&truth, &detections, IouType::Box).ar100.unwrap();
    assert!((twice - 0.5 * once).abs() < 1e-12, "{twice} {once}");
}
