//! What looks at each proposal by itself: label and box (Ren et al. 2015, section 3.2), and the mask (He et al. 2017, section 3), on
//! features pooled from the level that fits its size (Lin et al. 2017, "Feature pyramid networks", section 4.2).

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::{Device, Int, Tensor, TensorData, activation};
use sixfold_geometry::random::Random;
use sixfold_nn::conv_transpose::{ConvTranspose, ConvTransposeConfig};
use sixfold_nn::dense::dense;
use sixfold_nn::kernels::{Activation, Regions};
use sixfold_nn::layers::{Conv, ConvConfig};
use sixfold_nn::roi_align::roi_align;

use super::boxes::{Candidates, Corners, Found, area, clipped, decode, is_large};
use super::config::{AnchoredConfig, AnchoredKind, Thresholds};
use super::fpn::rectified;

/// Levels of the pyramid that are pooled from; the fifth is for proposals alone.
const POOLED_LEVELS: usize = 4;
/// Bins along a side of what the box head sees, and the mask head (He et al. 2017, figure 4).
const BOX_BINS: usize = 7;
const MASK_BINS: usize = 14;
/// Samples along a side of a bin (torchvision).
const SAMPLES: usize = 2;
/// A box of this side, pixels, is pooled from the level of stride 16 (Lin et al. 2017, equation 1).
const CANONICAL_SIDE: f32 = 224.0;
const CANONICAL_LEVEL: f32 = 4.0;
/// Against rounding at the border between two levels (torchvision).
const LEVEL_EPSILON: f32 = 1e-6;
/// What codes of boxes are divided by (Girshick's code; torchvision).
pub(super) const CODE_WEIGHTS: [f32; 4] = [10.0, 10.0, 5.0, 5.0];
/// Shortest side of a detection in pixels (torchvision).
const MIN_SIDE: f32 = 1e-2;
/// 3x3 convolutions of the mask head (He et al. 2017, figure 4).
const MASK_LAYERS: usize = 4;

/// torchvision's `roi_heads`.
#[derive(Module, Debug)]
#[module(custom_display)]
pub(super) struct RoiHeads {
    box_head: BoxHead,
    box_predictor: BoxPredictor,
    mask_head: Option<MaskHead>,
    mask_predictor: Option<MaskPredictor>,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct BoxHead {
    fc6: Linear,
    fc7: Linear,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct BoxPredictor {
    cls_score: Linear,
    bbox_pred: Linear,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct MaskHead {
    layers: Vec<Conv>,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct MaskPredictor {
    conv5_mask: ConvTranspose,
    mask_fcn_logits: Conv,
}

sixfold_nn::displayed_by_name!(RoiHeads, BoxHead, BoxPredictor, MaskHead, MaskPredictor);

/// The levels of an image's pyramid for pooling.
pub(super) struct Levels<'a> {
    maps: &'a [Tensor<4>],
    /// Map pixels per image pixel.
    scales: Vec<f32>,
}

impl<'a> Levels<'a> {
    /// `filled` are the rows and columns that show the image, without padding. The scales are powers of two near to the ratio of the
    /// rows, as torchvision finds them.
    pub(super) fn new(maps: &'a [Tensor<4>], filled: [usize; 2]) -> Levels<'a> {
        let maps = &maps[..POOLED_LEVELS.min(maps.len())];
        let scale =
            |map: &Tensor<4>| (map.dims()[2] as f32 / filled[0] as f32).log2().round_ties_even().exp2();
        Levels { maps, scales: maps.iter().map(scale).collect() }
    }

    /// The level of a box.
    fn level_of(&self, corners: &Corners) -> usize {
        let finest = -self.scales[0].log2();
        let coarsest = -self.scales[self.scales.len() - 1].log2();
        let level = CANONICAL_LEVEL + (area(corners).sqrt() / CANONICAL_SIDE).log2() + LEVEL_EPSILON;
        let level = level.floor().max(finest).min(coarsest) - finest;
        (level as usize).min(self.maps.len() - 1)
    }

    /// `boxes x channels x bins x bins` in the order of the boxes, of which there is at least one.
    fn pooled(&self, boxes: &[Corners], bins: usize) -> Tensor<4> {
        let levels: Vec<usize> = boxes.iter().map(|b| self.level_of(b)).collect();
        let (mut parts, mut order) = (vec![], vec![]);
        for (level, map) in self.maps.iter().enumerate() {
            let of_level: Vec<usize> = (0..boxes.len()).filter(|i| levels[*i] == level).collect();
            if of_level.is_empty() {
                continue;
            }
            let its_boxes = of_level.iter().map(|i| boxes[*i]).collect();
            let regions =
                Regions { boxes: its_boxes, scale: self.scales[level], side: bins, samples: Some(SAMPLES) };
            parts.push(roi_align(map.clone(), regions));
            order.extend(of_level);
        }
        let mut places = vec![0i64; order.len()];
        order.iter().enumerate().for_each(|(place, number)| places[*number] = place as i64);
        if parts.len() == 1 {
            return parts.remove(0);
        }
        let all = Tensor::cat(parts, 0);
        let count = places.len();
        let places = Tensor::<1, Int>::from_data(TensorData::new(places, [count]), &all.device());
        all.select(0, places)
    }
}

impl BoxPredictor {
    fn init(config: &AnchoredConfig, random: &mut Random, device: &Device) -> BoxPredictor {
        let AnchoredConfig { labels, hidden, .. } = *config;
        BoxPredictor {
            cls_score: dense([hidden, labels], random, device),
            bbox_pred: dense([hidden, 4 * labels], random, device),
        }
    }
}

/// The layer of the masks. Small, so that training starts without a preference (chosen by hand; not swept).
fn mask_logits(config: &AnchoredConfig, random: &mut Random, device: &Device) -> Conv {
    ConvConfig::new([config.pyramid, config.labels], 1, Activation::Linear).init(0.01, random, device)
}

impl RoiHeads {
    pub(super) fn init(config: &AnchoredConfig, random: &mut Random, device: &Device) -> RoiHeads {
        let AnchoredConfig { pyramid, hidden, .. } = *config;
        let box_head = BoxHead {
            fc6: dense([pyramid * BOX_BINS * BOX_BINS, hidden], random, device),
            fc7: dense([hidden, hidden], random, device),
        };
        let box_predictor = BoxPredictor::init(config, random, device);
        let masks = config.kind == AnchoredKind::MaskRcnn;
        let mask_head = masks.then(|| MaskHead {
            layers: (0..MASK_LAYERS).map(|_| rectified(pyramid, random, device)).collect(),
        });
        let enlarge = ConvTransposeConfig { channels: [pyramid; 2], kernel: 2, stride: 2, bias: true };
        let mask_predictor = masks.then(|| MaskPredictor {
            conv5_mask: enlarge.init(2.0, random, device),
            mask_fcn_logits: mask_logits(config, random, device),
        });
        RoiHeads { box_head, box_predictor, mask_head, mask_predictor }
    }

    /// The same with new layers for other labels.
    pub(super) fn relabelled(
        self,
        config: &AnchoredConfig,
        random: &mut Random,
        device: &Device,
    ) -> RoiHeads {
        let box_predictor = BoxPredictor::init(config, random, device);
        let mask_predictor = self.mask_predictor.map(|predictor| MaskPredictor {
            mask_fcn_logits: mask_logits(config, random, device),
            ..predictor
        });
        RoiHeads { box_predictor, mask_predictor, ..self }
    }

    /// Of `boxes`, of which there is at least one: `boxes x labels` logits and `boxes x (4 labels)` codes.
    pub(super) fn classify(&self, levels: &Levels<'_>, boxes: &[Corners]) -> (Tensor<2>, Tensor<2>) {
        let pooled = levels.pooled(boxes, BOX_BINS);
        let [count, channels, rows, columns] = pooled.dims();
        let x = pooled.reshape([count, channels * rows * columns]);
        let x = activation::relu(self.box_head.fc6.forward(x));
        let x = activation::relu(self.box_head.fc7.forward(x));
        (self.box_predictor.cls_score.forward(x.clone()), self.box_predictor.bbox_pred.forward(x))
    }

    /// `boxes x labels x 28 x 28` logits of masks within the boxes, of which there is at least one; `None` for a network without.
    pub(super) fn masks(&self, levels: &Levels<'_>, boxes: &[Corners]) -> Option<Tensor<4>> {
        let (head, predictor) = (self.mask_head.as_ref()?, self.mask_predictor.as_ref()?);
        let pooled = levels.pooled(boxes, MASK_BINS);
        let x = head.layers.iter().fold(pooled, |x, conv| conv.forward(x));
        let x = activation::relu(predictor.conv5_mask.forward(x));
        Some(predictor.mask_fcn_logits.forward(x))
    }
}

/// Logits of one proposal to probabilities, in place.
fn softmax(logits: &mut [f32]) {
    let largest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let mut sum = 0.0;
    for value in logits.iter_mut() {
        *value = (*value - largest).exp();
        sum += *value;
    }
    logits.iter_mut().for_each(|value| *value /= sum);
}

/// The detections of an image of so many rows and columns, best first, from the `logits` (`proposals x labels`) and `codes`
/// (`proposals x (4 labels)`) of its proposals; only of labels that are `wanted`. Label 0, the background, is none.
pub(super) fn detections(
    mut logits: Vec<f32>,
    codes: &[f32],
    proposals: &[Corners],
    wanted: &[bool],
    image: [usize; 2],
    thresholds: &Thresholds,
) -> Vec<Found> {
    let labels = wanted.len();
    let mut candidates = Candidates::default();
    for ((of, logits), codes) in
        proposals.iter().zip(logits.chunks_exact_mut(labels)).zip(codes.chunks_exact(4 * labels))
    {
        softmax(logits);
        for (label, code) in codes.as_chunks::<4>().0.iter().enumerate().skip(1) {
            if wanted[label] && logits[label] > thresholds.score {
                let corners = clipped(decode(*code, of, CODE_WEIGHTS), image);
                if is_large(&corners, MIN_SIDE) {
                    candidates.push(Found { label, score: logits[label], corners });
                }
            }
        }
    }
    candidates.suppressed(thresholds)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn maps(device: &Device) -> Vec<Tensor<4>> {
        // Every level holds its own number.
        let map = |level: usize| Tensor::full([1, 2, 256 >> level, 256 >> level], level as f32 + 1.0, device);
        (0..5).map(map).collect()
    }

    #[test]
    fn boxes_are_pooled_from_the_level_of_their_size_and_stay_in_order() {
        let maps = maps(&Device::flex());
        let levels = Levels::new(&maps, [1000, 960]);
        assert_eq!(levels.scales, [0.25, 0.125, 0.0625, 0.03125]);
        let square = |side: f32| [0.0, 0.0, side, side];
        let boxes = [square(224.0), square(20.0), square(223.0), square(900.0), square(112.0)];
        let pooled = levels.pooled(&boxes, 2);
        assert_eq!(pooled.dims(), [5, 2, 2, 2]);
        let values: Vec<f32> = pooled.try_into_vec_as().unwrap();
        assert_eq!([0, 8, 16, 24, 32].map(|i| values[i]), [3.0, 1.0, 2.0, 4.0, 2.0]);
    }

    #[test]
    fn labels_have_their_own_boxes_and_the_background_none() {
        let proposals = [[0.0, 0.0, 10.0, 10.0], [20.0, 0.0, 30.0, 10.0]];
        // The first proposal is label 2, the second background.
        let logits = vec![0.0, 0.0, 3.0, 9.0, 0.0, 0.0];
        let mut codes = vec![0.0; 24];
        // Label 2 of the first: half a width to the right.
        codes[8] = 5.0;
        let thresholds = Thresholds { score: 0.1, overlap: 0.5, most: 9, per_label: 9 };
        let found = detections(logits.clone(), &codes, &proposals, &[true; 3], [8, 40], &thresholds);
        let score = 3f32.exp() / (3f32.exp() + 2.0);
        assert_eq!(found.len(), 1);
        assert_eq!((found[0].label, found[0].corners), (2, [5.0, 0.0, 15.0, 8.0]));
        assert!((found[0].score - score).abs() < 1e-6);
        let all = Thresholds { score: 0.0, most: 3, ..thresholds };
        let count =
            |wanted: &[bool]| detections(logits.clone(), &codes, &proposals, wanted, [8, 40], &all).len();
        assert_eq!(count(&[true; 3]), 3);
        assert_eq!(count(&[true, true, false]), 2);
    }
}
