//! Losses on raw output with their gradients: cross entropy, its focal form (Lin et al. 2017, "Focal loss", equation 5), smooth L1
//! (Girshick 2015, equation 3) and L1 on codes of boxes, and the mask's cross entropy (He et al. 2017, section 3), with
//! torchvision's constants and divisors.
//!
//! A training step hands the gradient on to the network as the sum of output times gradient, whose derivative it is.

use sixfold_geometry::stats::sigmoid;

use super::boxes::Corners;
use super::heads::CODE_WEIGHTS;
use super::matching::{Match, encode};

/// Weight and exponent of the focal loss (Lin et al. 2017, section 5.1).
const ALPHA: f32 = 0.25;
const GAMMA: i32 = 2;
/// Where smooth L1 changes from a square to a straight line (torchvision).
const BETA: f32 = 1.0 / 9.0;

/// A loss and its gradient with respect to a tensor, in the tensor's order.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Term {
    pub value: f64,
    pub gradient: Vec<f32>,
}

impl Term {
    pub(super) fn zeros(length: usize) -> Term {
        Term { value: 0.0, gradient: vec![0.0; length] }
    }

    fn add(&mut self, at: usize, [value, slope]: [f32; 2], factor: f32) {
        self.value += f64::from(value * factor);
        self.gradient[at] += slope * factor;
    }
}

/// Cross entropy of a logit and a target in 0..1, and its slope.
fn entropy(logit: f32, target: f32) -> [f32; 2] {
    let value = logit.max(0.0) - logit * target + (-logit.abs()).exp().ln_1p();
    [value, sigmoid(logit) - target]
}

/// Focal loss of a logit that should be sure or not, and its slope.
fn focal(logit: f32, object: bool) -> [f32; 2] {
    // By symmetry, of the probability of what is true.
    let (sign, alpha) = if object { (1.0, ALPHA) } else { (-1.0, 1.0 - ALPHA) };
    let [minus_log, _] = entropy(sign * logit, 1.0);
    let right = sigmoid(sign * logit);
    let weight = alpha * (1.0 - right).powi(GAMMA);
    [weight * minus_log, sign * weight * (-(GAMMA as f32) * right * minus_log - (1.0 - right))]
}

fn smooth_l1(difference: f32) -> [f32; 2] {
    if difference.abs() < BETA {
        [0.5 * difference * difference / BETA, difference / BETA]
    } else {
        [difference.abs() - 0.5 * BETA, difference.signum()]
    }
}

fn l1(difference: f32) -> [f32; 2] {
    [difference.abs(), if difference == 0.0 { 0.0 } else { difference.signum() }]
}

/// One level's maps: `channels x pixels`, where the channels of an anchor come together.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    pub pixels: usize,
    /// Anchors of a pixel.
    pub per_pixel: usize,
}

impl Layout {
    /// Place of one of `per_anchor` numbers of an anchor in the map.
    fn place(&self, anchor: usize, number: usize, per_anchor: usize) -> usize {
        let (pixel, of_pixel) = (anchor / self.per_pixel, anchor % self.per_pixel);
        (of_pixel * per_anchor + number) * self.pixels + pixel
    }

    /// Anchors of the level.
    pub(super) fn anchors(&self) -> usize {
        self.pixels * self.per_pixel
    }
}

/// The maps of one level with its anchors and what they stand for.
pub(super) struct LevelTargets<'a> {
    pub layout: Layout,
    pub logits: &'a [f32],
    pub codes: &'a [f32],
    pub anchors: &'a [Corners],
    pub matches: &'a [Match],
}

impl LevelTargets<'_> {
    /// RetinaNet's losses of labels and boxes; both are divided by `objects`, the number of anchors that stand for objects on
    /// all levels. `of_object` are the label and the box of each object.
    pub(super) fn focal(&self, labels: usize, of_object: &[(usize, Corners)], objects: usize) -> [Term; 2] {
        let factor = 1.0 / objects.max(1) as f32;
        let (mut of_labels, mut of_boxes) = (Term::zeros(self.logits.len()), Term::zeros(self.codes.len()));
        for (anchor, found) in self.matches.iter().enumerate() {
            let object = match found {
                Match::Object(number) => Some(&of_object[*number]),
                Match::Background => None,
                Match::Between => continue,
            };
            for label in 0..labels {
                let at = self.layout.place(anchor, label, labels);
                let right = object.is_some_and(|(of, _)| *of == label);
                of_labels.add(at, focal(self.logits[at], right), factor);
            }
            if let Some((_, corners)) = object {
                self.boxes(&mut of_boxes, anchor, corners, l1, factor);
            }
        }
        [of_labels, of_boxes]
    }

    /// The proposal network's losses of objects and boxes on the anchors `chosen` of this level; both are divided by `count`, the
    /// number of chosen anchors of all levels.
    pub(super) fn proposals(&self, chosen: &[usize], boxes: &[Corners], count: usize) -> [Term; 2] {
        let factor = 1.0 / count.max(1) as f32;
        let (mut of_objects, mut of_boxes) = (Term::zeros(self.logits.len()), Term::zeros(self.codes.len()));
        for anchor in chosen {
            let at = self.layout.place(*anchor, 0, 1);
            let object = match self.matches[*anchor] {
                Match::Object(number) => Some(number),
                _ => None,
            };
            of_objects.add(at, entropy(self.logits[at], f32::from(u8::from(object.is_some()))), factor);
            if let Some(number) = object {
                self.boxes(&mut of_boxes, *anchor, &boxes[number], smooth_l1, factor);
            }
        }
        [of_objects, of_boxes]
    }

    fn boxes(
        &self,
        term: &mut Term,
        anchor: usize,
        corners: &Corners,
        loss: fn(f32) -> [f32; 2],
        factor: f32,
    ) {
        let target = encode(corners, &self.anchors[anchor], [1.0; 4]);
        for (number, target) in target.iter().enumerate() {
            let at = self.layout.place(anchor, number, 4);
            term.add(at, loss(self.codes[at] - target), factor);
        }
    }
}

/// Losses of labels (cross entropy) and boxes of the box head: `logits` are `proposals x labels`, `codes` `proposals x (4 labels)`;
/// of each proposal its label, 0 for the background, and its object's box.
pub(super) fn classified(
    logits: &[f32],
    codes: &[f32],
    proposals: &[Corners],
    targets: &[(usize, Corners)],
    labels: usize,
) -> [Term; 2] {
    let factor = 1.0 / proposals.len().max(1) as f32;
    let (mut of_labels, mut of_boxes) = (Term::zeros(logits.len()), Term::zeros(codes.len()));
    for (i, (proposal, (label, corners))) in proposals.iter().zip(targets).enumerate() {
        let row = &logits[i * labels..][..labels];
        let largest = row.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let log_sum = largest + row.iter().map(|v| (v - largest).exp()).sum::<f32>().ln();
        of_labels.value += f64::from((log_sum - row[*label]) * factor);
        for (other, logit) in row.iter().enumerate() {
            let target = f32::from(u8::from(other == *label));
            of_labels.gradient[i * labels + other] = ((logit - log_sum).exp() - target) * factor;
        }
        if *label > 0 {
            let target = encode(corners, proposal, CODE_WEIGHTS);
            for (number, target) in target.iter().enumerate() {
                let at = (i * labels + label) * 4 + number;
                of_boxes.add(at, smooth_l1(codes[at] - target), factor);
            }
        }
    }
    [of_labels, of_boxes]
}

/// Loss of masks: `logits` are `boxes x labels x pixels`, of each box its label and the mask that it should have.
pub(super) fn masked(logits: &[f32], targets: &[(usize, Vec<f32>)], labels: usize) -> Term {
    let mut term = Term::zeros(logits.len());
    for (i, (label, mask)) in targets.iter().enumerate() {
        let factor = 1.0 / (targets.len() * mask.len()) as f32;
        let first = (i * labels + label) * mask.len();
        for (pixel, target) in mask.iter().enumerate() {
            term.add(first + pixel, entropy(logits[first + pixel], *target), factor);
        }
    }
    term
}

#[cfg(test)]
mod tests {
    use super::*;

    /// That the gradient is the slope of the value.
    fn is_gradient(numbers: &[f32], of: &dyn Fn(&[f32]) -> Term) {
        let term = of(numbers);
        assert_eq!(term.gradient.len(), numbers.len());
        assert!(term.gradient.iter().any(|g| *g != 0.0));
        for i in 0..numbers.len() {
            let at = |by: f32| {
                let mut moved = numbers.to_vec();
                moved[i] += by;
                of(&moved).value
            };
            let slope = (at(2e-3) - at(-2e-3)) / 4e-3;
            let found = f64::from(term.gradient[i]);
            assert!((slope - found).abs() < 1e-3, "{i}: slope {slope}, gradient {found}");
        }
    }

    fn numbers(count: usize) -> Vec<f32> {
        (0..count).map(|i| 2.0 * (i as f32 * 0.7 + 0.3).sin()).collect()
    }

    #[test]
    fn gradients_are_those_of_finite_differences() {
        let layout = Layout { pixels: 2, per_pixel: 2 };
        let anchors =
            [[0.0, 0.0, 9.0, 9.0], [4.0, 0.0, 19.0, 9.0], [0.0, 5.0, 9.0, 9.0], [2.0, 2.0, 5.0, 9.0]];
        let matches = [Match::Object(1), Match::Background, Match::Between, Match::Object(0)];
        let objects = [(2, [1.0, 1.0, 6.0, 9.0]), (0, [0.0, 1.0, 12.0, 8.0])];
        let boxes = objects.map(|o| o.1);
        let level = |logits: &[f32], codes: &[f32], which: &dyn Fn(&LevelTargets<'_>) -> [Term; 2]| {
            which(&LevelTargets { layout, logits, codes, anchors: &anchors, matches: &matches })
        };
        let (logits, codes) = (numbers(12), numbers(16));
        let focal = |t: &LevelTargets<'_>| t.focal(3, &objects, 2);
        is_gradient(&logits, &|n| level(n, &codes, &focal)[0].clone());
        is_gradient(&codes, &|n| level(&logits, n, &focal)[1].clone());
        let proposals = |t: &LevelTargets<'_>| t.proposals(&[0, 1, 3], &boxes, 3);
        is_gradient(&logits[..4], &|n| level(n, &codes, &proposals)[0].clone());
        is_gradient(&codes, &|n| level(&logits[..4], n, &proposals)[1].clone());

        let targets = [(1, [1.0, 1.0, 6.0, 9.0]), (0, [0.0; 4])];
        is_gradient(&numbers(6), &|n| classified(n, &numbers(24), &anchors[..2], &targets, 3)[0].clone());
        is_gradient(&numbers(24), &|n| classified(&numbers(6), n, &anchors[..2], &targets, 3)[1].clone());
        let masks = [(1, vec![0.0, 1.0]), (0, vec![0.3, 0.9])];
        is_gradient(&numbers(8), &|n| masked(n, &masks, 2));
    }

    #[test]
    fn the_focal_loss_is_torchvisions() {
        // torchvision.ops.sigmoid_focal_loss(torch.tensor([0.7, 0.7, -9.]), torch.tensor([1., 0., 1.]))
        let found = [focal(0.7, true)[0], focal(0.7, false)[0], focal(-9.0, true)[0]];
        for (found, expected) in found.iter().zip([0.011_097_63, 0.369_408_6, 2.249_475_5]) {
            assert!((found - expected).abs() < 1e-5, "{found}, torchvision {expected}");
        }
    }

    #[test]
    fn the_losses_of_the_box_head_are_torchvisions() {
        // torchvision.models.detection.roi_heads.fastrcnn_loss on the same numbers.
        let proposals = [[0.0, 0.0, 9.0, 9.0], [4.0, 0.0, 19.0, 9.0]];
        let targets = [(1, [1.0, 1.0, 6.0, 9.0]), (0, [0.0; 4])];
        let [labels, boxes] = classified(&numbers(6), &numbers(24), &proposals, &targets, 3);
        assert!((labels.value - 0.646_893_442).abs() < 1e-6, "{}", labels.value);
        assert!((boxes.value - 2.456_594_467).abs() < 1e-5, "{}", boxes.value);
    }

    #[test]
    fn codes_of_boxes_are_at_the_indices_of_the_network() {
        // Anchor 3 of two pixels with two anchors each: second of the second pixel.
        let layout = Layout { pixels: 2, per_pixel: 2 };
        assert_eq!([0, 1, 2, 3].map(|i| layout.place(3, i, 4)), [9, 11, 13, 15]);
        assert_eq!(layout.anchors(), 4);
    }
}
