//! COCO's twelve numbers for detections: boxes, then masks, as JSON.
//!
//!     cargo run -p sixfold-bop --example coco_scores -- GROUND_TRUTH.json DETECTIONS.json

use std::error::Error;
use std::path::Path;

use sixfold_bop::{CocoGroundTruth, IouType, ReadDetections, evaluate_coco, read_detections};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [ground_truth, detections] = &args[..] else {
        return Err("usage: coco_scores GROUND_TRUTH.json DETECTIONS.json".into());
    };
    let mut truth = CocoGroundTruth::default();
    truth.add_scene(0, &std::fs::read(ground_truth)?, Path::new(ground_truth))?;
    let found = read_detections(Path::new(detections), &ReadDetections::default())?.detections;
    let both = [IouType::Box, IouType::Mask].map(|iou_type| evaluate_coco(&truth, &found, iou_type));
    println!("{}", serde_json::json!({ "box": both[0], "mask": both[1] }));
    Ok(())
}
