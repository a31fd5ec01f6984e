//! What the demo says of poses from colour alone, beside those from depth; `colour_poses.rs` finds them.

use std::path::PathBuf;

use serde::Serialize;

#[derive(Serialize)]
pub(super) struct Row {
    pub image: String,
    pub object: u32,
    pub add_s_mm: f64,
    pub add_s_of_diameter: f64,
    pub confidence: f64,
    pub seconds: f64,
}

/// Poses from colour, or why there are none.
#[derive(Serialize)]
pub(super) struct Colour {
    pub weights: Option<PathBuf>,
    /// Weights of the detector; without them boxes are the ground truth's.
    pub detector: Option<PathBuf>,
    pub poses: Vec<Row>,
    pub correct: usize,
    /// Targets in colour images that were looked for.
    pub targets: usize,
    pub pictures: Vec<PathBuf>,
    /// Why there are no poses.
    pub reason: Option<String>,
}

impl Colour {
    /// No poses.
    pub fn none(weights: Option<PathBuf>, reason: String) -> Colour {
        Colour {
            weights,
            detector: None,
            poses: vec![],
            correct: 0,
            targets: 0,
            pictures: vec![],
            reason: Some(reason),
        }
    }
}

/// Errors beside those from depth, found by image and object.
pub(super) fn print_table(colour: &Colour, of_depth: impl Fn(&str, u32) -> Option<f64>) {
    if let Some(reason) = &colour.reason {
        println!("\nPoses from colour alone (Pix2Pose): none: {reason}");
        return;
    }
    let boxes = match colour.detector {
        Some(_) => "in the boxes that the detector finds",
        None => "in the boxes of the ground truth",
    };
    println!("\nPoses from colour alone (Pix2Pose), {boxes}; last column: the errors from depth above");
    println!(
        "{:>10} {:>7} {:>12} {:>10} {:>11} {:>8} {:>11}",
        "image", "object", "error (mm)", "of diam.", "confidence", "seconds", "from depth"
    );
    for r in &colour.poses {
        let depth = of_depth(&r.image, r.object).map_or_else(|| "-".into(), |s| format!("{:.1}%", 100.0 * s));
        println!(
            "{:>10} {:>7} {:>12.1} {:>9.1}% {:>11.3} {:>8.2} {depth:>11}",
            r.image,
            r.object,
            r.add_s_mm,
            100.0 * r.add_s_of_diameter,
            r.confidence,
            r.seconds
        );
    }
    println!("{} of {} poses from colour within 10 % of the diameter", colour.correct, colour.targets);
}
