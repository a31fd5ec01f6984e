//! The numbers from which the probability of a pose is computed.

use sixfold_align::Evidence;
use sixfold_estimator::PoseEstimate;

/// Number of values.
const COUNT: usize = 20;

/// Their names, in order.
pub const NAMES: [&str; COUNT] = [
    "depth",
    "boundary",
    "normals",
    "visible",
    "total",
    "pixels",
    "pierced",
    "relief",
    "on_plane",
    "edges",
    "background_edges",
    "correlation",
    "tint",
    "similarity",
    "agreement",
    "gap_here",
    "gap_elsewhere",
    "distance",
    "recognised",
    "support",
];

/// Whether a larger value makes a pose more probable: a fit with the opposite sign has learned artefacts of its scenes.
pub(crate) const SPEAKS_FOR: [bool; COUNT] = [
    true, true, true, true, true, true, false, true, false, true, false, true, false, true, true, true, true,
    false, true, true,
];
/// Numbers from the depth image.
pub(crate) const OF_DEPTH: std::ops::Range<usize> = 0..9;
/// Numbers from the colour image.
pub(crate) const OF_COLOR: std::ops::Range<usize> = 9..14;
/// Numbers from the comparison with other poses.
pub(crate) const OF_OTHERS: std::ops::Range<usize> = 14..17;
/// The number from the pose itself.
pub(crate) const OF_POSE: std::ops::Range<usize> = 17..18;

/// The numbers from a search of the whole colour image.
pub(crate) const OF_SEARCH: std::ops::Range<usize> = 18..20;

/// The numbers of a pose, in the order of [`NAMES`]; `None` where one is not known.
pub type Numbers = [Option<f64>; COUNT];

/// Larger gaps to other poses are clipped to this; chosen by hand, not swept.
const MAX_GAP: f64 = 0.4;
/// Larger differences in tint are clipped to this: lamps and cameras colour images too. Chosen by hand; not swept.
const MAX_TINT: f64 = 0.15;

/// What a method on colour reports for its pose: how similar the image is to the object rendered there; how much more similar than elsewhere in
/// the image, by features that recognise things; and how many of its other searches ended in about the same pose. The last two are those of a
/// search of the whole image by views (`recognised`, `support`); it has no support if several instances are searched.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Reported {
    pub similarity: Option<f64>,
    pub recognised: Option<f64>,
    pub support: Option<f64>,
}

impl Reported {
    pub(crate) fn of(estimate: &PoseEstimate, one_instance: bool) -> Reported {
        let number = |name: &str| estimate.details.get(name).and_then(serde_json::Value::as_f64);
        Reported {
            similarity: number("similarity"),
            recognised: number("recognised"),
            support: number("support").filter(|_| one_instance),
        }
    }
}

/// The numbers from the image and the pose, without the other poses. `distance` is that of the object from the camera, in diameters: without
/// depth the error along the view axis is a few hundredths of the distance, so a small object far away is seldom within a tenth of its diameter,
/// however well its outline fits.
pub(crate) fn of_evidence(evidence: &Evidence, reported: &Reported, distance: f64) -> Numbers {
    let mut numbers = [None; COUNT];
    if let Some(depth) = &evidence.depth {
        let score = &depth.score;
        let rendered = score.rendered.max(1) as f64;
        let values = [
            score.depth,
            score.boundary,
            score.normals,
            score.visible_fraction().sqrt(),
            score.total.sqrt(),
            (1.0 + score.inliers as f64).ln(),
            score.pierced as f64 / rendered,
            depth.relief.sqrt(),
            depth.on_plane,
        ];
        for (place, value) in numbers[OF_DEPTH].iter_mut().zip(values) {
            *place = Some(value);
        }
    }
    if let Some(color) = &evidence.color {
        let values = [
            Some(color.edges),
            Some(color.background_edges),
            Some(color.correlation),
            color.tint.map(|t| t.min(MAX_TINT)),
        ];
        numbers[OF_COLOR.start..OF_COLOR.start + values.len()].copy_from_slice(&values);
        numbers[OF_COLOR.end - 1] = reported.similarity;
        numbers[OF_SEARCH].copy_from_slice(&[reported.recognised, reported.support]);
    }
    if evidence.depth.is_none() {
        numbers[OF_POSE.start] = Some(distance.ln());
    }
    numbers
}

/// A single score of a pose before the comparison with others: the ranking of the verification if there is depth, otherwise edges
/// and similarity.
pub(crate) fn strength(evidence: &Evidence, similarity: Option<f64>) -> f64 {
    match (&evidence.depth, &evidence.color) {
        (Some(depth), _) => depth.score.ranking(),
        (None, Some(color)) => 0.5 * (color.edges - color.background_edges) + similarity.unwrap_or(0.0),
        (None, None) => 0.0,
    }
}

/// Adds the numbers from the other poses: how many other methods agree, and by how much this one is stronger than the strongest
/// other at the same place and elsewhere.
pub(crate) fn add_others(numbers: &mut Numbers, agreement: Option<f64>, here: f64, elsewhere: Option<f64>) {
    let gap = |value: f64| value.clamp(-MAX_GAP, MAX_GAP);
    numbers[OF_OTHERS].copy_from_slice(&[agreement, Some(gap(here)), elsewhere.map(gap)]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distance_counts_without_depth_only() {
        let none = Reported::default();
        let without = of_evidence(&Evidence { depth: None, color: None, pixels: vec![] }, &none, 5.0);
        assert_eq!(without[OF_POSE.start], Some(5.0_f64.ln()));
        let measured = sixfold_align::DepthEvidence {
            score: sixfold_align::VerificationScore::default(),
            relief: 0.5,
            on_plane: 0.0,
        };
        let with = of_evidence(&Evidence { depth: Some(measured), color: None, pixels: vec![] }, &none, 5.0);
        assert_eq!(with[OF_POSE.start], None);
    }

    #[test]
    fn what_a_search_of_the_image_reports_counts_with_a_colour_image_only() {
        let mut estimate = PoseEstimate::new(sixfold_geometry::Pose::identity(), 0.5);
        for (name, value) in [("similarity", 0.4), ("recognised", 0.2), ("support", 0.7)] {
            estimate.details.insert(name.to_owned(), value.into());
        }
        let of = |color, one_instance| {
            let reported = Reported::of(&estimate, one_instance);
            let numbers = of_evidence(&Evidence { depth: None, color, pixels: vec![] }, &reported, 5.0);
            ["similarity", "recognised", "support"]
                .map(|name| numbers[NAMES.iter().position(|n| *n == name).unwrap()])
        };
        let color =
            sixfold_align::ColorEvidence { edges: 0.8, background_edges: 0.1, correlation: 0.5, tint: None };
        assert_eq!(of(Some(color), true), [Some(0.4), Some(0.2), Some(0.7)]);
        // Several instances are supported by searches of their own.
        assert_eq!(of(Some(color), false), [Some(0.4), Some(0.2), None]);
        assert_eq!(of(None, true), [None; 3]);
    }
}
