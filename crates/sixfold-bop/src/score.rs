//! From pose errors to scores: matching, recall, average precision, area under the accuracy curve.
//!
//! Definitions: Hodan et al. 2018 (localisation), the BOP Challenges 2019 and 2024, Xiang et al. 2018 (PoseCNN, AUC).

use std::cmp::Ordering;

/// The thresholds .05, .10 ... .50 as `start + i * step`, bit for bit those of the BOP Challenge.
pub(crate) fn fractions_05_to_50() -> Vec<f64> {
    (0..10).map(|i| 0.05 + f64::from(i) * 0.05).collect()
}

/// The thresholds 5, 10 ... 50 pixels of MSPD.
pub(crate) fn pixels_5_to_50() -> Vec<f64> {
    (1..=10).map(|i| f64::from(5 * i)).collect()
}

/// Sorts by falling score; equal scores keep their order.
pub(crate) fn by_falling_score<T>(items: &mut [T], score: impl Fn(&T) -> f64) {
    items.sort_by(|a, b| score(b).partial_cmp(&score(a)).unwrap_or(Ordering::Equal));
}

/// Matches estimates to ground truth greedily (Hodan et al. 2018): in order of falling score, each takes the free and
/// valid ground truth with the smallest error below `threshold`.
///
/// `errors[estimate][ground truth]`, estimates sorted by falling score. Returns the ground truth of each estimate.
pub(crate) fn greedy_matches(errors: &[Vec<f64>], valid: &[bool], threshold: f64) -> Vec<Option<usize>> {
    let mut taken = vec![false; valid.len()];
    let mut matches = Vec::with_capacity(errors.len());
    for row in errors {
        let (mut best, mut found) = (threshold, None);
        for (g, &error) in row.iter().enumerate() {
            if valid[g] && !taken[g] && error < best {
                (best, found) = (error, Some(g));
            }
        }
        if let Some(g) = found {
            taken[g] = true;
        }
        matches.push(found);
    }
    matches
}

/// Average precision with COCO's 101 recall steps, as the BOP Challenge 2024 computes it.
///
/// `right` states for each detection, in order of falling score, whether it is matched; `positives` is the number of
/// ground-truth poses. `None` without ground truth.
pub fn average_precision(right: &[bool], positives: usize) -> Option<f64> {
    if positives == 0 {
        return None;
    }
    let mut curve = Vec::with_capacity(right.len());
    let mut count = 0usize;
    for (i, &r) in right.iter().enumerate() {
        count += usize::from(r);
        curve.push((count as f64 / positives as f64, count as f64 / (i + 1) as f64));
    }
    // Recall never falls along the list, so the best precision at a recall or above is the best of a tail.
    let mut best = 0.0f64;
    for (_, precision) in curve.iter_mut().rev() {
        best = best.max(*precision);
        *precision = best;
    }
    let at = |i: usize| {
        let wanted = if i == 100 { 1.0 } else { i as f64 * 0.01 };
        curve.get(curve.partition_point(|&(recall, _)| recall < wanted)).map_or(0.0, |&(_, p)| p)
    };
    Some((0..=100).map(at).sum::<f64>() / 101.0)
}

/// The area under the accuracy-threshold curve from zero to `largest` (PoseCNN: 0.1 m), in `0..=1`, as PoseCNN's
/// toolbox computes it in the manner of PASCAL VOC: a step curve that rises at every error to the accuracy there.
///
/// Missing estimates are infinite errors; they count. `None` for an empty list.
pub fn area_under_accuracy(errors: &[f64], largest: f64) -> Option<f64> {
    if errors.is_empty() {
        return None;
    }
    let mut below: Vec<f64> = errors.iter().copied().filter(|e| *e <= largest).collect();
    below.sort_by(f64::total_cmp);
    let total = errors.len() as f64;
    let mut area = 0.0;
    let mut from = 0.0;
    for (i, &error) in below.iter().enumerate() {
        // The accuracy at this error applies from the previous error on: VOC's monotone envelope.
        area += (error - from) * (i + 1) as f64 / total;
        from = error;
    }
    area += (largest - from) * below.len() as f64 / total;
    Some(area / largest)
}

/// How many of `errors` are below `threshold`, as a fraction; `None` for an empty list.
pub fn recall_below(errors: &[f64], threshold: f64) -> Option<f64> {
    let count = errors.iter().filter(|e| **e < threshold).count();
    (!errors.is_empty()).then(|| count as f64 / errors.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_surer_estimate_takes_the_nearer_pose() {
        let errors = vec![vec![0.3, 0.1], vec![0.2, 0.05], vec![0.01, 0.01]];
        assert_eq!(greedy_matches(&errors, &[true, true], 0.5), [Some(1), Some(0), None]);
        // Below, not at, the threshold.
        assert_eq!(greedy_matches(&errors, &[true, true], 0.1), [None, Some(1), Some(0)]);
        assert_eq!(greedy_matches(&errors, &[true, false], 0.5), [Some(0), None, None]);
    }

    #[test]
    fn average_precision_by_hand() {
        // Right, wrong, right of 4: precision 1 up to recall .25 (26 steps), 2/3 up to .5 (25 steps), then 0.
        let found = average_precision(&[true, false, true], 4).unwrap();
        assert!((found - (26.0 + 25.0 * 2.0 / 3.0) / 101.0).abs() < 1e-12, "{found}");
        assert_eq!(average_precision(&[], 4), Some(0.0));
        assert_eq!(average_precision(&[true], 0), None);
        assert_eq!(average_precision(&[true; 3], 3), Some(1.0));
    }

    #[test]
    fn area_under_accuracy_by_hand() {
        // Errors 2 and 6 cm and one missing: 1/3 up to 2 cm, 2/3 up to 6 cm and on to 10 cm.
        let found = area_under_accuracy(&[0.06, f64::INFINITY, 0.02], 0.1).unwrap();
        assert!((found - (0.02 / 3.0 + 0.08 * 2.0 / 3.0) / 0.1).abs() < 1e-12, "{found}");
        assert_eq!(area_under_accuracy(&[0.0, 0.0], 0.1), Some(1.0));
        assert_eq!(area_under_accuracy(&[f64::INFINITY, f64::NAN], 0.1), Some(0.0));
        assert_eq!(area_under_accuracy(&[], 0.1), None);
        assert_eq!(recall_below(&[0.1, 0.2, f64::INFINITY], 0.2), Some(1.0 / 3.0));
    }

    #[test]
    fn thresholds_are_the_challenge_s() {
        // numpy.arange(.05, .51, .05): the third and the sixth carry a last digit.
        let found = fractions_05_to_50();
        assert_eq!(found.len(), 10);
        assert_eq!((found[2], found[5], found[9]), (0.15000000000000002, 0.3, 0.5));
        assert_eq!(pixels_5_to_50()[9], 50.0);
    }
}
