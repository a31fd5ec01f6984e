//! How well a planner distinguishes grasps that hold from others, on trials that were not used in its training.

use serde::{Deserialize, Serialize};

/// Quality on one group of trials.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GroupQuality {
    /// Number of candidates.
    pub candidates: usize,
    /// Fraction of them that held.
    pub held: f64,
    /// The probability that a candidate that held has a higher score than one that did not (area under the ROC curve; Hanley and
    /// McNeil 1982).
    pub auc: f64,
    /// Fraction that held among the best quarter by score.
    pub precision: f64,
    /// Fraction of the scenes whose best candidate by score held.
    pub first: f64,
}

/// Quality on objects of the training's families, and on shapes of no family.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PlannerQuality {
    /// New members of the families.
    pub new_members: GroupQuality,
    /// New shapes.
    pub new_shapes: GroupQuality,
}

impl PlannerQuality {
    /// Names and values, for display.
    pub fn scores(&self) -> Vec<(String, f64)> {
        let of = |name: &str, q: &GroupQuality| {
            [
                ("fraction that held", q.held),
                ("area under the ROC curve", q.auc),
                ("precision of the best quarter", q.precision),
                ("first grasp of a scene held", q.first),
            ]
            .map(|(what, value)| (format!("{name}: {what}"), value))
        };
        let (members, shapes) = (of("new members", &self.new_members), of("new shapes", &self.new_shapes));
        members.into_iter().chain(shapes).collect()
    }
}

/// Quality of candidates, given as score, whether it held, and scene (those of one scene are consecutive).
pub(crate) fn group_quality(scored: &[(f64, bool, u64)]) -> GroupQuality {
    let mut order: Vec<&(f64, bool, u64)> = scored.iter().collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0));
    let fraction =
        |of: &[&(f64, bool, u64)]| of.iter().filter(|s| s.1).count() as f64 / of.len().max(1) as f64;
    let best: Vec<&(f64, bool, u64)> = scored
        .chunk_by(|a, b| a.2 == b.2)
        // Ties go to the first.
        .filter_map(|scene| scene.iter().reduce(|a, b| if b.0 > a.0 { b } else { a }))
        .collect();
    GroupQuality {
        candidates: scored.len(),
        held: fraction(&order),
        auc: auc(&order),
        precision: fraction(&order[..scored.len().div_ceil(4)]),
        first: fraction(&best),
    }
}

/// By ranks; equal scores count half. One half if all held or none.
fn auc(order: &[&(f64, bool, u64)]) -> f64 {
    let (mut good, mut bad, mut area) = (0.0, 0.0, 0.0);
    for equal in order.chunk_by(|a, b| a.0 == b.0) {
        let held = equal.iter().filter(|s| s.1).count() as f64;
        let lost = equal.len() as f64 - held;
        area += lost * (good + 0.5 * held);
        good += held;
        bad += lost;
    }
    if good * bad > 0.0 { area / (good * bad) } else { 0.5 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_few_candidates_by_hand() {
        let scored = [
            (0.9, true, 0),
            (0.8, false, 0),
            (0.3, true, 1),
            (0.7, false, 1),
            (0.3, false, 2),
            (0.1, true, 3),
        ];
        let q = group_quality(&scored);
        // Pairs of one that held and one that did not: 0.9 before all three; 0.3 before none, equal to one; 0.1 before none.
        assert!((q.auc - 3.5 / 9.0).abs() < 1e-12, "{}", q.auc);
        assert_eq!((q.candidates, q.held, q.precision, q.first), (6, 0.5, 0.5, 0.5));
        assert_eq!(group_quality(&[]).auc, 0.5);
    }
}
