//! Poses as a table for people, the same for every method.

use std::fmt::Write;

use crate::image::ImageReport;

/// The poses of one image and the objects not found, one line each.
pub fn pose_table(report: &ImageReport) -> String {
    let judged = report.poses.iter().any(|p| p.probability.is_some());
    let certainty = if judged { "probability" } else { "confidence" };
    let mut text = format!(
        "{:<24} {:>11} {:>8} {:>26} {:>8}\n",
        "object", certainty, "visible", "translation (m)", "seconds"
    );
    for pose in &report.poses {
        let t: Vec<String> = pose.camera_from_object[..3].iter().map(|r| format!("{:8.4}", r[3])).collect();
        let visible = pose.visibility().map_or_else(|| "-".into(), |v| format!("{:.0}%", 100.0 * v));
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{:<24} {:>11.3} {visible:>8} {:>26} {:>8.2}",
            pose.object,
            pose.probability.unwrap_or(pose.confidence),
            t.join(" "),
            pose.elapsed
        );
        if let Some(together) = pose.probability_with_alternatives.filter(|_| !pose.alternatives.is_empty()) {
            let poses = pose.alternatives.len() + 1;
            let _ = writeln!(
                text,
                "  ambiguous: {poses} possible poses (alternatives in --json), together {together:.3}"
            );
        }
    }
    for name in &report.not_found {
        let _ = writeln!(text, "{name:<24} not found");
    }
    text
}
