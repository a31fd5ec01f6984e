//! Detections and their ground truth: no text may make a parser or the scores panic.
#![no_main]

use std::path::Path;

use sixfold_bop::{CocoGroundTruth, IouType, ReadDetections, evaluate_coco, parse_detections};

libfuzzer_sys::fuzz_target!(|text: &[u8]| {
    let path = Path::new("fuzz.json");
    let options = ReadDetections { lenient: true, image_size: Some((64, 48)) };
    let found = parse_detections(text, path, &options).unwrap_or_default();
    let mut truth = CocoGroundTruth::default();
    let _ = truth.add_scene(0, text, path);
    let _ = evaluate_coco(&truth, &found.detections, IouType::Box);
    let _ = evaluate_coco(&truth, &found.detections, IouType::Mask);
});
