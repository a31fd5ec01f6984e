//! Faster R-CNN and Mask R-CNN: proposals, then a look at each.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use sixfold_geometry::random::stream;

use super::anchors::{Scales, anchors};
use super::boxes::{Corners, Found};
use super::config::{AnchoredConfig, Thresholds};
use super::fpn::Backbone;
use super::heads::{Levels, RoiHeads, detections};
use super::masks::MaskProbabilities;
use super::network::vector;
use super::rpn::{LevelOutput, Most, ProposalNetwork, proposals};
use super::transform::Input;

/// The network, with torchvision's names.
#[derive(Module, Debug)]
#[module(custom_display)]
pub(super) struct FasterRcnn {
    pub backbone: Backbone,
    pub rpn: ProposalNetwork,
    pub roi_heads: RoiHeads,
}

sixfold_nn::displayed_by_name!(FasterRcnn);

impl FasterRcnn {
    pub(super) fn init(config: &AnchoredConfig, seed: u64, device: &Device) -> FasterRcnn {
        let random = &mut stream(seed, 1);
        FasterRcnn {
            backbone: Backbone::init(config, seed, random, device),
            rpn: ProposalNetwork::init(config.pyramid, random, device),
            roi_heads: RoiHeads::init(config, random, device),
        }
    }

    /// The detections in the resized image, best first, of labels that are `wanted`, with masks if the network has them and they
    /// are asked for.
    pub(super) fn detect(
        &self,
        x: Tensor<4>,
        input: &Input,
        wanted: &[bool],
        thresholds: &Thresholds,
        masks: bool,
    ) -> Vec<(Found, Option<MaskProbabilities>)> {
        let maps = self.backbone.forward(x);
        let raw = self.rpn.forward(&maps);
        let grids: Vec<[usize; 2]> = maps.iter().map(|map| [map.dims()[2], map.dims()[3]]).collect();
        let anchors = anchors(Scales::One, &grids, input.padded);
        let per_pixel = Scales::One.anchors();
        let output: Vec<LevelOutput> =
            raw.logits.iter().zip(&raw.codes).map(|(l, c)| LevelOutput::new(l, c, per_pixel)).collect();
        let proposals = proposals(&output, &anchors, input.filled, Most::DETECTION);
        if proposals.is_empty() {
            return vec![];
        }
        let levels = Levels::new(&maps, input.filled);
        let (logits, codes) = self.roi_heads.classify(&levels, &proposals);
        let found = detections(vector(logits), &vector(codes), &proposals, wanted, input.filled, thresholds);
        if !masks || found.is_empty() {
            return found.into_iter().map(|f| (f, None)).collect();
        }
        let boxes: Vec<Corners> = found.iter().map(|f| f.corners).collect();
        let Some(logits) = self.roi_heads.masks(&levels, &boxes) else {
            return found.into_iter().map(|f| (f, None)).collect();
        };
        let logits = vector(logits);
        let of = |(number, f): (usize, Found)| {
            (f, Some(MaskProbabilities::new(&logits, number * wanted.len() + f.label)))
        };
        found.into_iter().enumerate().map(of).collect()
    }
}
