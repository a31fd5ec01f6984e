//! One of the three networks with its sizes: images in, detections out.

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use sixfold_geometry::RgbImage;

use super::config::{AnchoredConfig, AnchoredKind, Thresholds};
use super::faster::FasterRcnn;
use super::fpn::Backbone;
use super::masks::MaskProbabilities;
use super::retina::RetinaNet;
use super::transform::Input;
pub(super) use super::transform::normalise;

/// A detected object.
#[derive(Debug, Clone, PartialEq)]
pub struct AnchoredDetection {
    /// The network's label, as in torchvision.
    pub label: usize,
    /// Confidence, 0 to 1.
    pub score: f32,
    /// Left, top, right and bottom in the image's pixels, borders of pixels at whole numbers.
    pub corners: [f32; 4],
    /// Mask R-CNN's mask within the box, if asked for.
    pub mask: Option<MaskProbabilities>,
}

/// The layers of one of the networks.
#[derive(Module, Debug)]
#[module(custom_display)]
#[allow(clippy::large_enum_variant)]
pub(super) enum Layers {
    /// Faster R-CNN and Mask R-CNN.
    TwoStages(FasterRcnn),
    /// RetinaNet.
    OneStage(RetinaNet),
}

sixfold_nn::displayed_by_name!(Layers);

impl Layers {
    pub(super) fn backbone(&self) -> &Backbone {
        match self {
            Layers::TwoStages(network) => &network.backbone,
            Layers::OneStage(network) => &network.backbone,
        }
    }

    pub(super) fn backbone_mut(&mut self) -> &mut Backbone {
        match self {
            Layers::TwoStages(network) => &mut network.backbone,
            Layers::OneStage(network) => &mut network.backbone,
        }
    }

    /// [`Backbone::freeze_stages`].
    pub(super) fn freeze_stages(mut self, stages: usize) -> Layers {
        let backbone = self.backbone().clone().freeze_stages(stages);
        *self.backbone_mut() = backbone;
        self
    }
}

/// A network with its sizes.
#[derive(Debug, Clone)]
pub struct AnchoredNetwork {
    pub(super) layers: Layers,
    pub(super) config: AnchoredConfig,
    /// Of every label whether it is detected.
    pub(super) wanted: Vec<bool>,
    pub(super) device: Device,
}

/// A tensor's numbers, off the autodiff device.
pub(super) fn vector<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    let tensor = if tensor.device().is_autodiff() { tensor.inner() } else { tensor };
    tensor.into_data().try_to_vec().unwrap_or_else(|error| unreachable!("f32 output: {error:?}"))
}

/// As [`vector`], of a map.
pub(super) fn numbers(tensor: Tensor<4>) -> Vec<f32> {
    vector(tensor)
}

impl AnchoredConfig {
    /// The network with random weights.
    pub fn init(&self, seed: u64, device: &Device) -> AnchoredNetwork {
        let layers = match self.kind {
            AnchoredKind::RetinaNet => Layers::OneStage(RetinaNet::init(self, seed, device)),
            _ => Layers::TwoStages(FasterRcnn::init(self, seed, device)),
        };
        AnchoredNetwork {
            layers,
            config: self.clone(),
            wanted: vec![true; self.labels],
            device: device.clone(),
        }
    }
}

impl AnchoredNetwork {
    pub(super) fn of_layers(layers: Layers, config: AnchoredConfig, device: Device) -> AnchoredNetwork {
        let wanted = vec![true; config.labels];
        AnchoredNetwork { layers, config, wanted, device }
    }

    /// Sizes of the network.
    pub fn config(&self) -> &AnchoredConfig {
        &self.config
    }

    /// Only these of the labels are detected; others do not count as detections of an image.
    pub fn with_labels(mut self, labels: &[usize]) -> AnchoredNetwork {
        self.wanted = (0..self.config.labels).map(|label| labels.contains(&label)).collect();
        self
    }

    /// Detects objects in an image of any size, best first, with masks if the network has them and `masks` asks for them. Nothing in
    /// an image without pixels.
    pub fn detect(&self, image: &RgbImage, thresholds: &Thresholds, masks: bool) -> Vec<AnchoredDetection> {
        let Some(input) = Input::new(image, &self.config) else { return vec![] };
        let [rows, columns] = input.padded;
        let data = TensorData::new(input.values.clone(), [1, 3, rows, columns]);
        let x = Tensor::from_data(data, &self.device);
        let wanted = &self.wanted;
        let found = match &self.layers {
            Layers::TwoStages(network) => network.detect(x, &input, wanted, thresholds, masks),
            Layers::OneStage(network) => {
                network.detect(x, &input, wanted, thresholds).into_iter().map(|f| (f, None)).collect()
            }
        };
        found
            .into_iter()
            .map(|(f, mask)| AnchoredDetection {
                label: f.label,
                score: f.score,
                corners: input.to_image(f.corners),
                mask,
            })
            .collect()
    }
}
