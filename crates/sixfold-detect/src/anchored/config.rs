//! Sizes and constants of Faster R-CNN, Mask R-CNN and RetinaNet.

use serde::{Deserialize, Serialize};
use sixfold_nn::choice::Choice;
use sixfold_nn::resnet::Bottlenecks;

use crate::network::EncoderKind;

/// The three networks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AnchoredKind {
    /// Proposals of a region proposal network, classified (Ren et al. 2015).
    FasterRcnn,
    /// The same with a mask for each box (He et al. 2017).
    MaskRcnn,
    /// Every anchor classified by itself (Lin et al. 2017, "Focal loss").
    RetinaNet,
}

impl Choice for AnchoredKind {
    const ALL: &'static [AnchoredKind] =
        &[AnchoredKind::FasterRcnn, AnchoredKind::MaskRcnn, AnchoredKind::RetinaNet];

    fn name(self) -> &'static str {
        match self {
            AnchoredKind::FasterRcnn => "faster-rcnn",
            AnchoredKind::MaskRcnn => "mask-rcnn",
            AnchoredKind::RetinaNet => "retinanet-anchors",
        }
    }

    fn help(self) -> &'static str {
        match self {
            AnchoredKind::FasterRcnn => "Faster R-CNN with a feature pyramid",
            AnchoredKind::MaskRcnn => "Mask R-CNN with a feature pyramid",
            AnchoredKind::RetinaNet => "RetinaNet with anchors and a feature pyramid",
        }
    }
}

/// Sizes of a network; part of its weight file. The named constructors give torchvision's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AnchoredConfig {
    /// Which network.
    pub kind: AnchoredKind,
    /// Labels that the network tells apart: torchvision's `num_classes`. Label 0 is the background of the R-CNNs, and of
    /// RetinaNet a label as any other (its COCO weights never use it).
    pub labels: usize,
    /// What the pyramid stands on. Files without this field have a ResNet.
    #[serde(default = "resnet", skip_serializing_if = "is_resnet")]
    pub encoder: EncoderKind,
    /// Bottlenecks in the layers of the ResNet; 0 without one.
    pub blocks: [usize; 4],
    /// Channels of the ResNet's first convolution; 0 without one.
    pub width: usize,
    /// Channels of the pyramid and of the heads' convolutions.
    pub pyramid: usize,
    /// Numbers in the two layers of the box head, which RetinaNet does not have.
    pub hidden: usize,
    /// Added to the variances of the ResNet's normalisations. torchvision's is 1e-5, but 0 for frozen normalisations of networks built
    /// with its COCO_V1 weights (`overwrite_eps`). No weight file states it; those of normalisations that are not frozen, which count
    /// their batches, always have 1e-5.
    pub norm_epsilon: f64,
    /// Images are resized to this shorter side, pixels (Ren et al. 2015, section 3.3; torchvision: 800).
    pub min_side: usize,
    /// Unless the longer side would exceed this, pixels (torchvision: 1333).
    pub max_side: usize,
}

fn resnet() -> EncoderKind {
    EncoderKind::ResNet50
}

#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_resnet(encoder: &EncoderKind) -> bool {
    *encoder == EncoderKind::ResNet50
}

/// Which detections are kept.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thresholds {
    /// Detections must have a higher score.
    pub score: f32,
    /// Of two boxes of a label that overlap more (intersection over union) the worse one is left out.
    pub overlap: f64,
    /// Maximum number of detections, the best ones.
    pub most: usize,
    /// Maximum number of detections of a label; torchvision has no such limit.
    pub per_label: usize,
}

impl AnchoredConfig {
    /// ResNet-50 with its pyramid of 256 channels, as the v1 models of torchvision have it, built by its default.
    pub fn new(kind: AnchoredKind, labels: usize) -> Self {
        let Bottlenecks { blocks, width, epsilon } = Bottlenecks::default();
        AnchoredConfig {
            kind,
            labels,
            encoder: EncoderKind::ResNet50,
            blocks,
            width,
            pyramid: 256,
            hidden: 1024,
            norm_epsilon: epsilon,
            min_side: 800,
            max_side: 1333,
        }
    }

    /// EfficientNet-Lite0 with a pyramid of a quarter of the channels and a box head of half as many numbers, to be trained on a CPU.
    pub fn compact(kind: AnchoredKind, labels: usize) -> Self {
        AnchoredConfig {
            encoder: EncoderKind::Lite0,
            blocks: [0; 4],
            width: 0,
            pyramid: 64,
            hidden: if kind == AnchoredKind::RetinaNet { 0 } else { 512 },
            ..AnchoredConfig::new(kind, labels)
        }
    }

    /// torchvision's thresholds: those of COCO's average precision.
    pub fn thresholds(&self) -> Thresholds {
        let most = if self.kind == AnchoredKind::RetinaNet { 300 } else { 100 };
        Thresholds { score: 0.05, overlap: 0.5, most, per_label: usize::MAX }
    }

    /// The first label that stands for an object.
    pub fn first_label(&self) -> usize {
        usize::from(self.kind != AnchoredKind::RetinaNet)
    }

    /// Numbers in the largest layers; the network has more.
    pub(super) fn numbers(&self) -> usize {
        let AnchoredConfig { labels, blocks, width, pyramid, hidden, .. } = *self;
        let inner = |layer: usize| (width << layer) * (width << layer);
        let of_body: usize = blocks.iter().enumerate().map(|(layer, count)| 9 * count * inner(layer)).sum();
        of_body + 9 * pyramid * pyramid + hidden * (49 * pyramid + hidden + 5 * labels)
    }

    pub(crate) fn resnet(&self) -> Bottlenecks {
        Bottlenecks { blocks: self.blocks, width: self.width, epsilon: self.norm_epsilon }
    }
}
