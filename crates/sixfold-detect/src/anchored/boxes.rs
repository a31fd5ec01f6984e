//! Boxes as left, top, right and bottom: their code relative to an anchor (Girshick et al. 2014, appendix C), clipping, overlap and
//! suppression of overlapping ones.

use std::collections::BTreeMap;

use super::config::Thresholds;

/// Left, top, right and bottom in pixels; a pixel's border lies on whole numbers, as in COCO.
pub(super) type Corners = [f32; 4];

/// Codes of width and height are cut to this, so that exp does not overflow: a box of 16 pixels becomes one of 1000 (Girshick's code).
const MAX_LOG_SIZE: f64 = 4.135_166_556_742_356;
/// Up to so many boxes, suppression shifts the groups apart; more are suppressed group by group (torchvision's `batched_nms`, 4000
/// numbers). The two differ in rounding alone.
const MAX_SHIFTED: usize = 1000;

/// A box from its code relative to a box `of`; the code is divided by `weights` first.
pub(super) fn decode(code: [f32; 4], of: &Corners, weights: [f32; 4]) -> Corners {
    let [w, h] = [of[2] - of[0], of[3] - of[1]];
    let [x, y] = [of[0] + 0.5 * w, of[1] + 0.5 * h];
    let [dx, dy] = [code[0] / weights[0], code[1] / weights[1]];
    let [dw, dh] = [code[2] / weights[2], code[3] / weights[3]].map(|d| d.min(MAX_LOG_SIZE as f32));
    let [x, y] = [dx * w + x, dy * h + y];
    let [w, h] = [0.5 * (dw.exp() * w), 0.5 * (dh.exp() * h)];
    [x - w, y - h, x + w, y + h]
}

/// The box within an image of so many rows and columns.
pub(super) fn clipped(c: Corners, [rows, columns]: [usize; 2]) -> Corners {
    let [right, bottom] = [columns as f32, rows as f32];
    [c[0].clamp(0.0, right), c[1].clamp(0.0, bottom), c[2].clamp(0.0, right), c[3].clamp(0.0, bottom)]
}

/// Whether both sides have at least this length.
pub(super) fn is_large(c: &Corners, side: f32) -> bool {
    c[2] - c[0] >= side && c[3] - c[1] >= side
}

pub(super) fn area(c: &Corners) -> f32 {
    (c[2] - c[0]) * (c[3] - c[1])
}

/// Intersection over union; not a number for two empty boxes.
pub(super) fn overlap(a: &Corners, b: &Corners) -> f32 {
    let w = (a[2].min(b[2]) - a[0].max(b[0])).max(0.0);
    let h = (a[3].min(b[3]) - a[1].max(b[1])).max(0.0);
    w * h / (area(a) + area(b) - w * h)
}

/// The numbers of `scores` from the largest on; equal ones keep their order.
pub(super) fn by_score(scores: &[f32]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..scores.len()).collect();
    order.sort_by(|a, b| scores[*b].total_cmp(&scores[*a]));
    order
}

/// The `most` largest of `scores`, largest first; of equal ones the first.
pub(super) fn largest(scores: &[f32], most: usize) -> Vec<usize> {
    let larger = |a: &usize, b: &usize| scores[*b].total_cmp(&scores[*a]).then(a.cmp(b));
    let mut order: Vec<usize> = (0..scores.len()).collect();
    if most < order.len() {
        order.select_nth_unstable_by(most, larger);
        order.truncate(most);
    }
    order.sort_unstable_by(larger);
    order
}

/// Boxes that no better one overlaps by more than `limit`, best first.
fn suppress(boxes: &[Corners], scores: &[f32], limit: f64) -> Vec<usize> {
    let order = by_score(scores);
    let mut suppressed = vec![false; boxes.len()];
    let mut kept = vec![];
    for (place, best) in order.iter().enumerate() {
        if suppressed[*best] {
            continue;
        }
        kept.push(*best);
        for worse in &order[place + 1..] {
            if !suppressed[*worse] && f64::from(overlap(&boxes[*best], &boxes[*worse])) > limit {
                suppressed[*worse] = true;
            }
        }
    }
    kept
}

/// Non-maximum suppression in each group by itself: the numbers of the boxes that stay, best first.
pub(super) fn suppress_in_groups(
    boxes: &[Corners],
    scores: &[f32],
    groups: &[usize],
    limit: f64,
) -> Vec<usize> {
    if boxes.len() <= MAX_SHIFTED {
        let farthest = boxes.iter().flatten().copied().fold(f32::NEG_INFINITY, f32::max);
        let shifted: Vec<Corners> = boxes
            .iter()
            .zip(groups)
            .map(|(c, group)| c.map(|v| v + *group as f32 * (farthest + 1.0)))
            .collect();
        return suppress(&shifted, scores, limit);
    }
    let mut kept = vec![];
    for group in 0..=groups.iter().copied().max().unwrap_or(0) {
        let of_group: Vec<usize> = (0..boxes.len()).filter(|i| groups[*i] == group).collect();
        let its_boxes: Vec<Corners> = of_group.iter().map(|i| boxes[*i]).collect();
        let its_scores: Vec<f32> = of_group.iter().map(|i| scores[*i]).collect();
        kept.extend(suppress(&its_boxes, &its_scores, limit).into_iter().map(|i| of_group[i]));
    }
    kept.sort_unstable_by(|a, b| scores[*b].total_cmp(&scores[*a]).then(a.cmp(b)));
    kept
}

/// A detection in the resized image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Found {
    pub label: usize,
    pub score: f32,
    pub corners: Corners,
}

/// Boxes with a score of their label, before suppression.
#[derive(Debug, Default)]
pub(super) struct Candidates {
    boxes: Vec<Corners>,
    scores: Vec<f32>,
    labels: Vec<usize>,
}

impl Candidates {
    pub(super) fn push(&mut self, found: Found) {
        self.boxes.push(found.corners);
        self.scores.push(found.score);
        self.labels.push(found.label);
    }

    /// What is left of them after suppression, best first.
    pub(super) fn suppressed(&self, thresholds: &Thresholds) -> Vec<Found> {
        let Thresholds { overlap, most, per_label, .. } = *thresholds;
        let mut of_label: BTreeMap<usize, usize> = BTreeMap::new();
        let mut found = vec![];
        for i in suppress_in_groups(&self.boxes, &self.scores, &self.labels, overlap) {
            let count = of_label.entry(self.labels[i]).or_default();
            if found.len() == most {
                break;
            }
            if *count < per_label {
                *count += 1;
                found.push(Found { label: self.labels[i], score: self.scores[i], corners: self.boxes[i] });
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn detections_are_limited_in_all_and_by_label() {
        let mut candidates = Candidates::default();
        for (i, label) in [1, 1, 2, 1, 2].into_iter().enumerate() {
            let x = 20.0 * i as f32;
            candidates.push(Found { label, score: 0.9 - 0.1 * i as f32, corners: [x, 0.0, x + 10.0, 10.0] });
        }
        let labels = |most: usize, per_label: usize| -> Vec<usize> {
            let thresholds = Thresholds { score: 0.0, overlap: 0.5, most, per_label };
            candidates.suppressed(&thresholds).iter().map(|f| f.label).collect()
        };
        assert_eq!(labels(9, 9), [1, 1, 2, 1, 2]);
        assert_eq!(labels(9, 1), [1, 2]);
        assert_eq!(labels(2, 9), [1, 1]);
    }

    #[test]
    fn a_code_moves_and_scales_a_box() {
        let of = [10.0, 20.0, 30.0, 60.0];
        assert_eq!(decode([0.0; 4], &of, [1.0; 4]), of);
        // A quarter of its width to the right, twice as high.
        let moved = decode([2.5, 0.0, 0.0, 5.0 * 2f32.ln()], &of, [10.0, 10.0, 5.0, 5.0]);
        let expected = [15.0, 0.0, 35.0, 80.0];
        assert!(moved.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-4), "{moved:?}");
        // At most 1000 / 16 as wide.
        let wide = decode([0.0, 0.0, 99.0, 0.0], &of, [1.0; 4]);
        assert!((wide[2] - wide[0] - 20.0 * 62.5).abs() < 1e-2, "{wide:?}");
    }

    #[test]
    fn groups_do_not_suppress_each_other_however_many_boxes_there_are() {
        let mut boxes = vec![[0.0, 0.0, 10.0, 10.0], [1.0, 0.0, 11.0, 10.0], [0.0, 0.0, 10.0, 10.0]];
        let mut scores = vec![0.5, 0.9, 0.4];
        let mut groups = vec![0, 0, 7];
        assert_eq!(suppress_in_groups(&boxes, &scores, &groups, 0.5), [1, 2]);
        assert_eq!(suppress_in_groups(&boxes, &scores, &groups, 0.9), [1, 0, 2]);
        assert!(suppress_in_groups(&[], &[], &[], 0.5).is_empty());
        for i in 0..1100 {
            let x = 20.0 * i as f32;
            boxes.push([x, 100.0, x + 10.0, 110.0]);
            scores.push(0.1);
            groups.push(3);
        }
        let kept = suppress_in_groups(&boxes, &scores, &groups, 0.5);
        assert_eq!((kept.len(), &kept[..4]), (1102, &[1, 2, 3, 4][..]));
    }

    #[test]
    fn the_largest_come_first_and_of_equal_ones_the_first() {
        let scores = [0.3, 0.9, 0.3, 0.5, 0.9];
        assert_eq!(largest(&scores, 9), [1, 4, 3, 0, 2]);
        assert_eq!(largest(&scores, 4), [1, 4, 3, 0]);
        assert_eq!(largest(&scores, 0), [0usize; 0]);
    }

    #[test]
    fn boxes_are_clipped_and_small_ones_known() {
        assert_eq!(clipped([-3.0, 2.0, 50.0, 30.0], [20, 40]), [0.0, 2.0, 40.0, 20.0]);
        assert!(is_large(&[0.0, 0.0, 1.0, 2.0], 1.0) && !is_large(&[0.0, 0.0, 1.0, 0.5], 1.0));
        assert!(!is_large(&[f32::NAN; 4], 0.0));
    }
}
