//! The region proposal network (Ren et al. 2015, section 3.1): whether there is an object about each anchor, and its box.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use sixfold_geometry::random::Random;
use sixfold_geometry::stats::sigmoid;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig};

use super::anchors::Scales;
use super::boxes::{Corners, clipped, decode, is_large, largest, suppress_in_groups};
use super::fpn::rectified;
use super::network::numbers;

/// Proposals overlap at most by this (Ren et al. 2015, section 3.3).
const MAX_OVERLAP: f64 = 0.7;
/// Shortest side of a proposal in pixels (torchvision).
const MIN_SIDE: f32 = 1e-3;

/// How many proposals are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Most {
    /// Of each level, before suppression.
    pub before: usize,
    /// Of all levels, after suppression.
    pub after: usize,
}

impl Most {
    /// For detection (torchvision).
    pub(super) const DETECTION: Most = Most { before: 1000, after: 1000 };
    /// For training (torchvision).
    pub(super) const TRAINING: Most = Most { before: 2000, after: 2000 };
}

/// torchvision's `rpn`.
#[derive(Module, Debug)]
#[module(custom_display)]
pub(super) struct ProposalNetwork {
    head: ProposalHead,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct ProposalHead {
    conv: Conv,
    cls_logits: Conv,
    bbox_pred: Conv,
}

sixfold_nn::displayed_by_name!(ProposalNetwork, ProposalHead);

/// Raw output for the levels of one image: `1 x anchors x rows x columns` and `1 x (4 anchors) x rows x columns`.
pub(super) struct Proposed {
    pub logits: Vec<Tensor<4>>,
    pub codes: Vec<Tensor<4>>,
}

/// Raw output of one level as numbers in the order of its anchors.
pub(super) struct LevelOutput {
    /// `anchors x labels`.
    pub logits: Vec<f32>,
    pub codes: Vec<[f32; 4]>,
}

impl LevelOutput {
    /// Of tensors of `1 x (anchors per pixel * labels) x rows x columns` and `1 x (anchors per pixel * 4) x rows x columns`.
    pub(super) fn new(logits: &Tensor<4>, codes: &Tensor<4>, per_pixel: usize) -> LevelOutput {
        let [_, channels, rows, columns] = logits.dims();
        let labels = channels / per_pixel;
        let pixels = rows * columns;
        let (raw_logits, raw_codes) = (numbers(logits.clone()), numbers(codes.clone()));
        let anchors = pixels * per_pixel;
        let mut ordered = Vec::with_capacity(anchors * labels);
        let mut of_anchors = Vec::with_capacity(anchors);
        for pixel in 0..pixels {
            for anchor in 0..per_pixel {
                let first = anchor * labels;
                ordered.extend((0..labels).map(|l| raw_logits[(first + l) * pixels + pixel]));
                of_anchors.push([0, 1, 2, 3].map(|i| raw_codes[(4 * anchor + i) * pixels + pixel]));
            }
        }
        LevelOutput { logits: ordered, codes: of_anchors }
    }
}

impl ProposalNetwork {
    pub(super) fn init(channels: usize, random: &mut Random, device: &Device) -> ProposalNetwork {
        let anchors = Scales::One.anchors();
        let conv = rectified(channels, random, device);
        // Small, so that training starts without a preference (torchvision: a deviation of 0.01 at 256 channels).
        let mut out = |outputs: usize| {
            ConvConfig::new([channels, outputs], 1, Activation::Linear).init(0.0256, random, device)
        };
        ProposalNetwork { head: ProposalHead { conv, cls_logits: out(anchors), bbox_pred: out(4 * anchors) } }
    }

    pub(super) fn forward(&self, levels: &[Tensor<4>]) -> Proposed {
        let ProposalHead { conv, cls_logits, bbox_pred } = &self.head;
        let (mut logits, mut codes) = (vec![], vec![]);
        for level in levels {
            let x = conv.forward(level.clone());
            logits.push(cls_logits.forward(x.clone()));
            codes.push(bbox_pred.forward(x));
        }
        Proposed { logits, codes }
    }
}

/// Boxes that may hold an object, best first, in an image of so many rows and columns.
pub(super) fn proposals(
    levels: &[LevelOutput],
    anchors: &[Vec<Corners>],
    image: [usize; 2],
    most: Most,
) -> Vec<Corners> {
    let (mut boxes, mut scores, mut groups) = (vec![], vec![], vec![]);
    for (number, (level, anchors)) in levels.iter().zip(anchors).enumerate() {
        for i in largest(&level.logits, most.before) {
            let corners = clipped(decode(level.codes[i], &anchors[i], [1.0; 4]), image);
            if is_large(&corners, MIN_SIDE) {
                boxes.push(corners);
                scores.push(sigmoid(level.logits[i]));
                groups.push(number);
            }
        }
    }
    let kept = suppress_in_groups(&boxes, &scores, &groups, MAX_OVERLAP);
    kept.into_iter().take(most.after).map(|i| boxes[i]).collect()
}
