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

#[cfg(test)]
mod tests {
    use sixfold_estimator::PoseEstimate;
    use sixfold_geometry::{Pose, Vec3};

    use super::*;
    use crate::image::FoundPose;

    fn table(poses: Vec<FoundPose>) -> Vec<String> {
        let report =
            ImageReport { poses, not_found: vec!["cup".to_owned()], overlay: None, diagnostics: [].into() };
        pose_table(&report).lines().map(str::to_owned).collect()
    }

    #[test]
    fn only_an_ambiguous_pose_has_a_line_for_its_alternatives() {
        let at = |x, probability| PoseEstimate {
            probability: Some(probability),
            ..PoseEstimate::new(Pose::from_translation(Vec3::new(x, 0.0, 0.75)), probability)
        };
        let mug = PoseEstimate { alternatives: vec![at(0.1, 0.25), at(0.2, 0.125)], ..at(0.0, 0.375) };
        let lines =
            table(vec![FoundPose::new("mug", 1.5, &mug), FoundPose::new("can", 1.5, &at(-0.25, 0.875))]);
        assert_eq!(lines.len(), 5, "{lines:?}");
        assert!(lines[0].contains("probability") && !lines[0].contains("confidence"), "{}", lines[0]);
        assert!(lines[1].starts_with("mug") && lines[1].contains(" 0.375 "), "{}", lines[1]);
        assert!(lines[2].contains("ambiguous: 3 possible poses") && lines[2].ends_with("together 0.750"));
        assert!(lines[3].contains(" 0.875 ") && lines[3].contains("-0.2500") && lines[3].contains("0.7500"));
        assert_eq!(lines[4], format!("{:<24} not found", "cup"));
        // A method without probabilities shows its confidence.
        let plain = PoseEstimate::new(Pose::identity(), 0.625);
        let lines = table(vec![FoundPose::new("can", 1.5, &plain)]);
        assert!(lines[0].contains("confidence") && lines[1].contains(" 0.625 "), "{lines:?}");
    }
}
