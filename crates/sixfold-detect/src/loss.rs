//! Losses on the network's raw output, with their gradients.
//!
//! Scores: the quality focal loss (Li et al. 2020, "Generalized focal loss", equation 2): a location learns to predict how well its
//! own box fits, so that the best of several boxes of an object also has the highest score. Boxes: one minus the generalised
//! overlap (Rezatofighi et al. 2019). Masks: cross entropy within the box (Bolya et al. 2019, section 3.1). A training step passes
//! the gradient to the network through the sum of output times gradient, whose derivative it is.

use crate::network::DetectorConfig;
use crate::targets::Targets;
use sixfold_geometry::stats::sigmoid;

/// Weights of the terms.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LossWeights {
    /// Weight of the score term.
    pub scores: f32,
    /// Weight of the box term.
    pub boxes: f32,
    /// Weight of the mask term.
    pub masks: f32,
}

impl Default for LossWeights {
    fn default() -> Self {
        LossWeights { scores: 1.0, boxes: 2.0, masks: 1.0 }
    }
}

/// Raw output of one image: planes row by row, level after level.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RawOutput<'a> {
    /// Logits of every level.
    pub scores: &'a [Vec<f32>],
    /// Sides, coefficients, bias of every level.
    pub boxes: &'a [Vec<f32>],
    /// Prototypes.
    pub prototypes: &'a [f32],
    /// Columns of a prototype.
    pub mask_width: usize,
}

/// Loss terms of one image, and the gradients in the shapes of the output.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LossValue {
    /// Score term, before its weight.
    pub scores: f64,
    /// Box term, before its weight.
    pub boxes: f64,
    /// Mask term, before its weight.
    pub masks: f64,
    /// Gradient of the weighted sum with respect to the logits.
    pub of_scores: Vec<Vec<f32>>,
    /// Gradient with respect to sides, coefficients and bias.
    pub of_boxes: Vec<Vec<f32>>,
    /// Gradient with respect to the prototypes.
    pub of_prototypes: Vec<f32>,
}

/// Logarithms of distances are clipped to this absolute value.
const LONGEST: f32 = 6.0;

/// Cross entropy of a logit and a target in 0..1, without overflow.
fn entropy(logit: f32, target: f32) -> f32 {
    logit.max(0.0) - logit * target + (-logit.abs()).exp().ln_1p()
}

/// Distance of a side from its location, in pixels, computed from the network's output.
pub(crate) fn distance(raw: f32, stride: f32) -> f32 {
    stride * raw.clamp(-LONGEST, LONGEST).exp()
}

/// Centre of a location in pixels; pixel centres are at whole numbers.
pub(crate) fn cell_centre(location: usize, width: usize, stride: f32) -> [f32; 2] {
    [location % width, location / width].map(|at| (at as f32 + 0.5) * stride - 0.5)
}

/// Overlap, generalised overlap, and the latter's derivatives with respect to left, top, right and bottom of `found`.
fn generalised_overlap(found: [f32; 4], truth: [f32; 4]) -> (f32, f32, [f32; 4]) {
    let [x0, y0, x1, y1] = found;
    let [tx0, ty0, tx1, ty1] = truth;
    let (w, h) = (x1.min(tx1) - x0.max(tx0), y1.min(ty1) - y0.max(ty0));
    let common = if w > 0.0 && h > 0.0 { w * h } else { 0.0 };
    let (fw, fh) = (x1 - x0, y1 - y0);
    let union = (fw * fh + (tx1 - tx0) * (ty1 - ty0) - common).max(1e-6);
    let (hull_w, hull_h) = (x1.max(tx1) - x0.min(tx0), y1.max(ty1) - y0.min(ty0));
    let hull = (hull_w * hull_h).max(1e-6);
    let overlap = common / union;
    let touching = common > 0.0;
    // Derivatives of the common area, the found box's area and the hull's area by each side; those by left and top are negative.
    let common_slopes = [
        if touching && x0 > tx0 { -h } else { 0.0 },
        if touching && y0 > ty0 { -w } else { 0.0 },
        if touching && x1 < tx1 { h } else { 0.0 },
        if touching && y1 < ty1 { w } else { 0.0 },
    ];
    let area_slopes = [-fh, -fw, fh, fw];
    let hull_slopes = [
        if x0 < tx0 { -hull_h } else { 0.0 },
        if y0 < ty0 { -hull_w } else { 0.0 },
        if x1 > tx1 { hull_h } else { 0.0 },
        if y1 > ty1 { hull_w } else { 0.0 },
    ];
    let slopes = std::array::from_fn(|i| {
        let of_union = area_slopes[i] - common_slopes[i];
        (common_slopes[i] * union - common * of_union) / (union * union)
            + (of_union * hull - union * hull_slopes[i]) / (hull * hull)
    });
    (overlap, overlap - 1.0 + union / hull, slopes)
}

/// Loss of one image. Score and box terms are divided by `positives`, the number of locations of objects in the whole batch, mask
/// terms by `masks`, the number of masks that are learned.
///
/// # Panics
/// If the shapes of output and targets differ.
pub(crate) fn loss(
    raw: &RawOutput<'_>,
    targets: &Targets,
    config: &DetectorConfig,
    weights: &LossWeights,
    positives: usize,
    masks: usize,
) -> LossValue {
    let per_location = 1.0 / positives.max(1) as f32;
    let mut value = LossValue {
        scores: 0.0,
        boxes: 0.0,
        masks: 0.0,
        of_scores: raw.scores.iter().map(|v| vec![0.0; v.len()]).collect(),
        of_boxes: raw.boxes.iter().map(|v| vec![0.0; v.len()]).collect(),
        of_prototypes: vec![0.0; raw.prototypes.len()],
    };
    // Boxes, and the overlap that every location has reached.
    let mut reached: Vec<Vec<(usize, usize, f32)>> = vec![vec![]; config.levels];
    for p in &targets.positives {
        let [width, height] = targets.grids[p.level];
        let locations = width * height;
        let stride = config.stride(p.level) as f32;
        let [x, y] = cell_centre(p.location, width, stride);
        let sides: [f32; 4] = std::array::from_fn(|i| raw.boxes[p.level][i * locations + p.location]);
        let far = sides.map(|side| distance(side, stride));
        let found = [x - far[0], y - far[1], x + far[2], y + far[3]];
        let instance = &targets.instances[p.instance];
        let (overlap, generalised, slopes) = generalised_overlap(found, instance.corners);
        value.boxes += f64::from((1.0 - generalised) * per_location);
        for i in 0..4 {
            if sides[i].abs() >= LONGEST {
                continue;
            }
            let outward = if i < 2 { -far[i] } else { far[i] };
            value.of_boxes[p.level][i * locations + p.location] =
                -weights.boxes * slopes[i] * outward * per_location;
        }
        reached[p.level].push((instance.class, p.location, overlap));
    }
    for (level, logits) in raw.scores.iter().enumerate() {
        let locations = targets.grids[level][0] * targets.grids[level][1];
        assert_eq!(logits.len(), config.classes * locations);
        let mut aims = vec![0.0f32; logits.len()];
        for (class, location, overlap) in &reached[level] {
            aims[class * locations + location] = *overlap;
        }
        let gradient = &mut value.of_scores[level];
        let mut sum = 0.0f64;
        for (index, ((logit, aim), gradient)) in logits.iter().zip(&aims).zip(gradient).enumerate() {
            if targets.ignored[level][index % locations] {
                continue;
            }
            let score = sigmoid(*logit);
            let (off, cost) = (score - aim, entropy(*logit, *aim));
            sum += f64::from(off * off * cost);
            *gradient =
                weights.scores * per_location * (2.0 * off * score * (1.0 - score) * cost + off * off * off);
        }
        value.scores += sum * f64::from(per_location);
    }
    mask_loss(raw, targets, config, weights.masks, masks, &mut value);
    value
}

fn mask_loss(
    raw: &RawOutput<'_>,
    targets: &Targets,
    config: &DetectorConfig,
    weight: f32,
    masks: usize,
    value: &mut LossValue,
) {
    let count = config.prototypes;
    let plane = raw.prototypes.len() / count.max(1);
    let mut gradient = vec![];
    for p in targets.mask_positives.iter().map(|p| &targets.positives[*p]) {
        let locations = targets.grids[p.level][0] * targets.grids[p.level][1];
        let at = |k: usize| (4 + k) * locations + p.location;
        let mask = &targets.masks[p.instance];
        let pixels = mask.fractions.len();
        let scale = 1.0 / (masks.max(1) * pixels) as f32;
        let bias = raw.boxes[p.level][at(count)];
        let mut logits = vec![bias; pixels];
        let rows = || {
            (0..mask.size[1]).map(|row| {
                let start = (mask.corner[1] + row) * raw.mask_width + mask.corner[0];
                (row * mask.size[0], start)
            })
        };
        for k in 0..count {
            let coefficient = raw.boxes[p.level][at(k)];
            for (to, from) in rows() {
                let source = &raw.prototypes[k * plane + from..][..mask.size[0]];
                logits[to..to + mask.size[0]].iter_mut().zip(source).for_each(|(l, s)| *l += coefficient * s);
            }
        }
        gradient.clear();
        for (logit, fraction) in logits.iter().zip(&mask.fractions) {
            value.masks += f64::from(scale * entropy(*logit, *fraction));
            gradient.push(weight * scale * (sigmoid(*logit) - fraction));
        }
        value.of_boxes[p.level][at(count)] += gradient.iter().sum::<f32>();
        for k in 0..count {
            let coefficient = raw.boxes[p.level][at(k)];
            let mut sum = 0.0;
            for (to, from) in rows() {
                let place = k * plane + from;
                let source = &raw.prototypes[place..][..mask.size[0]];
                let target = &mut value.of_prototypes[place..][..mask.size[0]];
                for ((g, s), t) in gradient[to..to + mask.size[0]].iter().zip(source).zip(target) {
                    sum += g * s;
                    *t += g * coefficient;
                }
            }
            value.of_boxes[p.level][at(k)] += sum;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::targets::{Annotation, Instance};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    struct Case {
        config: DetectorConfig,
        targets: Targets,
        scores: Vec<Vec<f32>>,
        boxes: Vec<Vec<f32>>,
        prototypes: Vec<f32>,
    }

    fn case() -> Case {
        let config = DetectorConfig { prototypes: 3, ..DetectorConfig::compact(2) };
        let mut labels = vec![0u8; 64 * 64];
        for y in 8..40 {
            labels[y * 64 + 10..y * 64 + 35].fill(1);
            labels[y * 64 + 40..y * 64 + 60].fill(2);
        }
        labels[63 * 64..].fill(255);
        let instances = vec![
            Instance { class: 1, corners: [10.0, 8.0, 34.0, 39.0] },
            Instance { class: 0, corners: [40.0, 8.0, 59.0, 39.0] },
        ];
        let targets = Targets::new(&Annotation { size: [64, 64], labels, instances }, &config);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut numbers = |n: usize| -> Vec<f32> { (0..n).map(|_| rng.random_range(-1.0..1.0)).collect() };
        let areas = [64, 16, 4];
        let scores = areas.iter().map(|a| numbers(2 * a)).collect();
        let boxes = areas.iter().map(|a| numbers(8 * a)).collect();
        Case { config, targets, scores, boxes, prototypes: numbers(3 * 256) }
    }

    impl Case {
        fn value(&self) -> LossValue {
            let raw = RawOutput {
                scores: &self.scores,
                boxes: &self.boxes,
                prototypes: &self.prototypes,
                mask_width: 16,
            };
            let weights = LossWeights::default();
            let (positives, masks) = (self.targets.positives.len(), self.targets.mask_positives.len());
            loss(&raw, &self.targets, &self.config, &weights, positives, masks)
        }
    }

    /// The derivative of the terms in `which` by finite differences in one number.
    fn slope(
        case: &mut Case,
        place: impl Fn(&mut Case) -> &mut f32,
        term: impl Fn(&LossValue) -> f64,
    ) -> f64 {
        let step = 1e-2;
        let before = *place(case);
        let mut at = |v: f32| {
            *place(case) = v;
            term(&case.value())
        };
        let slope = (at(before + step) - at(before - step)) / f64::from(2.0 * step);
        *place(case) = before;
        slope
    }

    #[test]
    fn gradients_are_the_slopes_of_the_losses() {
        let mut case = case();
        let value = case.value();
        // The target of a score is the overlap of the box, but no gradient flows through it.
        for level in 0..3 {
            for i in 0..case.scores[level].len() {
                let expected = slope(&mut case, |c| &mut c.scores[level][i], |v| v.scores);
                let found = f64::from(value.of_scores[level][i]);
                assert!((expected - found).abs() < 1e-4, "score {level} {i}: {expected} {found}");
            }
            for i in 0..case.boxes[level].len() {
                let term = |v: &LossValue| 2.0 * v.boxes + v.masks;
                let expected = slope(&mut case, |c| &mut c.boxes[level][i], term);
                let found = f64::from(value.of_boxes[level][i]);
                assert!(
                    (expected - found).abs() < 2e-3 * expected.abs().max(0.1),
                    "box {level} {i}: {expected} {found}"
                );
            }
        }
        for i in 0..case.prototypes.len() {
            let expected = slope(&mut case, |c| &mut c.prototypes[i], |v| v.masks);
            assert!((expected - f64::from(value.of_prototypes[i])).abs() < 1e-5);
        }
        assert!(value.of_boxes[0].iter().any(|g| *g != 0.0) && value.of_prototypes.iter().any(|g| *g != 0.0));
        // Ignored locations do not contribute: the last row of the finest level.
        assert!(case.targets.ignored[0][56..].iter().all(|i| *i == (value.of_scores[0][56] == 0.0)));
    }

    #[test]
    fn the_generalised_overlap_is_that_of_the_paper() {
        let (overlap, generalised, _) = generalised_overlap([0.0, 0.0, 2.0, 2.0], [1.0, 1.0, 3.0, 3.0]);
        assert!((overlap - 1.0 / 7.0).abs() < 1e-6);
        assert!((generalised - (1.0 / 7.0 - 2.0 / 9.0)).abs() < 1e-6);
        let (overlap, generalised, slopes) = generalised_overlap([0.0, 0.0, 1.0, 1.0], [2.0, 0.0, 3.0, 1.0]);
        assert_eq!(overlap, 0.0);
        assert!((generalised + 1.0 / 3.0).abs() < 1e-6);
        // For disjoint boxes there is still a gradient that moves the right side towards the truth.
        assert!(slopes[2] > 0.0);
    }

    #[test]
    fn the_best_output_costs_next_to_nothing() {
        let mut case = case();
        for level in 0..3 {
            case.scores[level].fill(-20.0);
        }
        for p in case.targets.positives.clone() {
            let width = case.targets.grids[p.level][0];
            let locations = width * case.targets.grids[p.level][1];
            let stride = case.config.stride(p.level) as f32;
            let [x, y] = cell_centre(p.location, width, stride);
            let [left, top, right, bottom] = case.targets.instances[p.instance].corners;
            let class = case.targets.instances[p.instance].class;
            case.scores[p.level][class * locations + p.location] = 20.0;
            for (i, side) in [x - left, y - top, right - x, bottom - y].into_iter().enumerate() {
                case.boxes[p.level][i * locations + p.location] = (side / stride).ln();
            }
        }
        let value = case.value();
        assert!(value.scores < 1e-4 && value.boxes < 1e-4, "{} {}", value.scores, value.boxes);
    }
}
