//! RetinaNet (Lin et al. 2017, "Focal loss", section 4): labels and a box for every anchor, in one stage.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use sixfold_geometry::random::{Random, stream};
use sixfold_geometry::stats::sigmoid;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig};

use super::anchors::{Scales, anchors};
use super::boxes::{Candidates, Corners, Found, clipped, decode, largest};
use super::config::{AnchoredConfig, Thresholds};
use super::fpn::{Backbone, rectified};
use super::rpn::LevelOutput;
use super::transform::Input;

/// 3x3 convolutions of a head before its last (Lin et al. 2017, section 4).
const LAYERS: usize = 4;
/// Score of every label everywhere before training (Lin et al. 2017, section 3.3).
const PRIOR: f32 = 0.01;
/// Best boxes of a level that are decoded (Lin et al. 2017, section 4.1, "Inference").
const MAX_CANDIDATES: usize = 1000;

/// The network, with torchvision's names.
#[derive(Module, Debug)]
#[module(custom_display)]
pub(super) struct RetinaNet {
    pub backbone: Backbone,
    head: Heads,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct Heads {
    classification_head: ClassificationHead,
    regression_head: RegressionHead,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct ClassificationHead {
    conv: Vec<Conv>,
    cls_logits: Conv,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct RegressionHead {
    conv: Vec<Conv>,
    bbox_reg: Conv,
}

sixfold_nn::displayed_by_name!(RetinaNet, Heads, ClassificationHead, RegressionHead);

/// The layer of the labels, which begin with the prior score.
fn label_logits(config: &AnchoredConfig, random: &mut Random, device: &Device) -> Conv {
    let outputs = Scales::Three.anchors() * config.labels;
    let mut layer =
        ConvConfig::new([config.pyramid, outputs], 3, Activation::Linear).init(0.01, random, device);
    let bias = -((1.0 - PRIOR) / PRIOR).ln();
    layer.bias = burn::module::Param::from_tensor(Tensor::full([outputs], bias, device));
    layer
}

impl RetinaNet {
    pub(super) fn init(config: &AnchoredConfig, seed: u64, device: &Device) -> RetinaNet {
        let random = &mut stream(seed, 1);
        let (width, anchors) = (config.pyramid, Scales::Three.anchors());
        let backbone = Backbone::init(config, seed, random, device);
        let tower = |random: &mut Random| (0..LAYERS).map(|_| rectified(width, random, device)).collect();
        let last = |outputs: usize, random: &mut Random| {
            ConvConfig::new([width, outputs], 3, Activation::Linear).init(0.01, random, device)
        };
        let conv = tower(random);
        let cls_logits = label_logits(config, random, device);
        let classification_head = ClassificationHead { conv, cls_logits };
        let regression_head = RegressionHead { conv: tower(random), bbox_reg: last(4 * anchors, random) };
        RetinaNet { backbone, head: Heads { classification_head, regression_head } }
    }

    /// The same with a new layer for other labels.
    pub(super) fn relabelled(
        mut self,
        config: &AnchoredConfig,
        random: &mut Random,
        device: &Device,
    ) -> RetinaNet {
        self.head.classification_head.cls_logits = label_logits(config, random, device);
        self
    }

    /// Of every level `1 x (anchors * labels) x rows x columns` logits and `1 x (anchors * 4) x rows x columns` codes.
    pub(super) fn forward(&self, x: Tensor<4>) -> Vec<[Tensor<4>; 2]> {
        let Heads { classification_head, regression_head } = &self.head;
        let through = |convs: &[Conv], x: Tensor<4>| convs.iter().fold(x, |x, conv| conv.forward(x));
        let heads = |level: Tensor<4>| {
            let logits =
                classification_head.cls_logits.forward(through(&classification_head.conv, level.clone()));
            [logits, regression_head.bbox_reg.forward(through(&regression_head.conv, level))]
        };
        self.backbone.forward(x).into_iter().map(heads).collect()
    }

    /// The detections in the resized image, best first, of labels that are `wanted`.
    pub(super) fn detect(
        &self,
        x: Tensor<4>,
        input: &Input,
        wanted: &[bool],
        thresholds: &Thresholds,
    ) -> Vec<Found> {
        let raw = self.forward(x);
        let grids: Vec<[usize; 2]> =
            raw.iter().map(|[logits, _]| [logits.dims()[2], logits.dims()[3]]).collect();
        let anchors = anchors(Scales::Three, &grids, input.padded);
        let levels: Vec<LevelOutput> = raw
            .iter()
            .map(|[logits, codes]| LevelOutput::new(logits, codes, Scales::Three.anchors()))
            .collect();
        detections(&levels, &anchors, wanted, input.filled, thresholds)
    }
}

fn detections(
    levels: &[LevelOutput],
    anchors: &[Vec<Corners>],
    wanted: &[bool],
    image: [usize; 2],
    thresholds: &Thresholds,
) -> Vec<Found> {
    let labels = wanted.len();
    let mut candidates = Candidates::default();
    for (level, anchors) in levels.iter().zip(anchors) {
        let (mut numbers, mut scores) = (vec![], vec![]);
        for (number, logit) in level.logits.iter().enumerate() {
            let score = sigmoid(*logit);
            if score > thresholds.score && wanted[number % labels] {
                numbers.push(number);
                scores.push(score);
            }
        }
        for i in largest(&scores, MAX_CANDIDATES) {
            let (anchor, label) = (numbers[i] / labels, numbers[i] % labels);
            let corners = clipped(decode(level.codes[anchor], &anchors[anchor], [1.0; 4]), image);
            candidates.push(Found { label, score: scores[i], corners });
        }
    }
    candidates.suppressed(thresholds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_labels_of_every_level_are_decoded() {
        let anchors =
            vec![vec![[0.0, 0.0, 10.0, 10.0], [20.0, 20.0, 60.0, 60.0]], vec![[0.0, 0.0, 30.0, 30.0]]];
        let level = |logits: Vec<f32>, codes: Vec<[f32; 4]>| LevelOutput { logits, codes };
        let levels = [
            // Second anchor, label 1.
            level(vec![-9.0, -9.0, -9.0, 2.0], vec![[0.0; 4], [0.25, 0.0, 0.0, 0.0]]),
            level(vec![0.0, -9.0], vec![[0.0; 4]]),
        ];
        let thresholds = Thresholds { score: 0.05, overlap: 0.5, most: 9, per_label: 9 };
        let found = detections(&levels, &anchors, &[true; 2], [50, 100], &thresholds);
        assert_eq!(found[0], Found { label: 1, score: sigmoid(2.0), corners: [30.0, 20.0, 70.0, 50.0] });
        assert_eq!(found[1], Found { label: 0, score: 0.5, corners: [0.0, 0.0, 30.0, 30.0] });
        assert_eq!(found.len(), 2);
        assert_eq!(detections(&levels, &anchors, &[true, false], [50, 100], &thresholds), found[1..]);
    }
}
