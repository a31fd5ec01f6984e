//! torchvision's weights: state dicts of `fasterrcnn_resnet50_fpn`, `maskrcnn_resnet50_fpn` and `retinanet_resnet50_fpn`, with the names
//! of tensors of any version since 0.8.

use std::path::Path;

use burn::module::Module;
use burn::tensor::Device;
use sixfold_nn::device;
use sixfold_nn::pretrained::{Naming, PretrainedError, PretrainedFile, fill};
use sixfold_nn::resnet::Bottlenecks;

use super::config::{AnchoredConfig, AnchoredKind};
use super::network::{AnchoredNetwork, Layers};

impl AnchoredKind {
    /// The function of torchvision that builds this network.
    pub fn torchvision(self) -> &'static str {
        match self {
            AnchoredKind::FasterRcnn => "fasterrcnn_resnet50_fpn",
            AnchoredKind::MaskRcnn => "maskrcnn_resnet50_fpn",
            AnchoredKind::RetinaNet => "retinanet_resnet50_fpn",
        }
    }
}

/// What a file must hold to be one of the three networks: end of a tensor's name, the network, and the tensor's rows a label (of
/// RetinaNet one for each anchor of a pixel).
const SIGNS: [(&str, AnchoredKind, usize); 3] = [
    ("roi_heads.mask_predictor.mask_fcn_logits.weight", AnchoredKind::MaskRcnn, 1),
    ("roi_heads.box_predictor.cls_score.weight", AnchoredKind::FasterRcnn, 1),
    ("head.classification_head.cls_logits.weight", AnchoredKind::RetinaNet, 9),
];

/// Largest sizes that are made: a wrong number in a file would ask for all memory. ResNet-152 has 36 blocks in a layer.
const MAX_LABELS: usize = 10_000;
const MAX_BLOCKS: usize = 64;
const MAX_WIDTH: usize = 256;
const MAX_PYRAMID: usize = 1024;
const MAX_HIDDEN: usize = 8192;

/// A file's tensors by the ends of their names.
pub(super) struct Shapes<'a>(pub(super) &'a PretrainedFile);

impl Shapes<'_> {
    /// Rows of the tensor whose name ends so, within 1 and a limit.
    fn rows(&self, end: &str, most: usize) -> Option<usize> {
        let (_, shape) = self.0.tensors().find(|(name, _)| name.ends_with(end))?;
        shape.first().copied().filter(|rows| (1..=most).contains(rows))
    }

    /// Numbers in all tensors.
    fn numbers(&self) -> usize {
        let product = |shape: &[usize]| shape.iter().fold(1usize, |n, side| n.saturating_mul(*side));
        self.0.tensors().fold(0, |n, (_, shape)| n.saturating_add(product(shape)))
    }

    /// Sizes of the network that the file holds; `None` where it is none of the three. More than the tensors' numbers are never made.
    pub(super) fn config(&self) -> Option<AnchoredConfig> {
        let (kind, per_label, rows) = SIGNS.iter().find_map(|(sign, kind, per_label)| {
            Some((*kind, per_label, self.rows(sign, MAX_LABELS * per_label)?))
        })?;
        let width = self.rows("backbone.body.conv1.weight", MAX_WIDTH)?;
        let layer = |layer: usize| {
            let has = |block: &usize| {
                self.rows(&format!("body.layer{}.{block}.conv2.weight", layer + 1), usize::MAX).is_some()
            };
            (0..MAX_BLOCKS).take_while(has).count()
        };
        let old = "fpn.inner_blocks.0.bias";
        let pyramid =
            self.rows("fpn.inner_blocks.0.0.bias", MAX_PYRAMID).or_else(|| self.rows(old, MAX_PYRAMID))?;
        let hidden = match kind {
            AnchoredKind::RetinaNet => 0,
            _ => self.rows("roi_heads.box_head.fc6.bias", MAX_HIDDEN)?,
        };
        let blocks = [0, 1, 2, 3].map(layer);
        let config =
            AnchoredConfig { blocks, width, pyramid, hidden, ..AnchoredConfig::new(kind, rows / per_label) };
        let epsilon = epsilon_of(self.0);
        let config = AnchoredConfig { norm_epsilon: epsilon, ..config };
        (config.numbers() <= self.numbers()).then_some(config)
    }
}

/// PyTorch's names of a tensor, that of the newest version first.
fn names(name: &str) -> Vec<String> {
    let parts: Vec<&str> = name.split('.').collect();
    let number = |i: usize| parts.get(i).and_then(|part| part.parse::<usize>().ok());
    match parts.as_slice() {
        ["backbone", "fpn", kind @ ("inner_blocks" | "layer_blocks"), level, last] => {
            let stem = format!("backbone.fpn.{kind}.{level}");
            vec![format!("{stem}.0.{last}"), format!("{stem}.{last}")]
        }
        ["rpn", "head", "conv", last] => {
            vec![format!("rpn.head.conv.0.0.{last}"), format!("rpn.head.conv.{last}")]
        }
        ["roi_heads", "mask_head", "layers", _, last] => {
            let layer = number(3).unwrap_or(0);
            let old = format!("roi_heads.mask_head.mask_fcn{}.{last}", layer + 1);
            vec![format!("roi_heads.mask_head.{layer}.0.{last}"), old]
        }
        ["head", head, "conv", _, last] => {
            let layer = number(3).unwrap_or(0);
            vec![
                format!("head.{head}.conv.{layer}.0.{last}"),
                format!("head.{head}.conv.{}.{last}", 2 * layer),
            ]
        }
        _ => vec![name.to_owned()],
    }
}

fn filled<M: Module>(module: M, file: &PretrainedFile, kind: AnchoredKind) -> Result<M, PretrainedError> {
    let network = format!("torchvision's {}", kind.torchvision());
    fill(module, file, &Naming { network: &network, names: &names, unused: &|_| false })
}

impl AnchoredNetwork {
    /// The network with torchvision's weights from an open `.pth`, `.pt` or `.safetensors` file, of the sizes that `config` states.
    ///
    /// # Errors
    /// [`PretrainedError`] with the first tensor that is missing, of another shape, unknown or not finite.
    pub fn from_pytorch(
        file: &PretrainedFile,
        config: &AnchoredConfig,
        device: &Device,
    ) -> Result<AnchoredNetwork, PretrainedError> {
        let network = config.init(0, device);
        let layers = match network.layers {
            Layers::TwoStages(layers) => Layers::TwoStages(filled(layers, file, config.kind)?),
            Layers::OneStage(layers) => Layers::OneStage(filled(layers, file, config.kind)?),
        };
        Ok(AnchoredNetwork { layers, ..network })
    }

    /// The same with the sizes that the file's tensors have: `None` where they are none of the three networks. What no weight file states
    /// is as torchvision has it by default; `change` may change it before the network is made.
    ///
    /// # Errors
    /// [`PretrainedError`].
    pub fn recognised(
        path: &Path,
        change: impl FnOnce(&mut AnchoredConfig),
    ) -> Result<Option<AnchoredNetwork>, PretrainedError> {
        let file = PretrainedFile::open(path)?;
        let Some(mut config) = Shapes(&file).config() else { return Ok(None) };
        change(&mut config);
        AnchoredNetwork::from_pytorch(&file, &config, &device::chosen()).map(Some)
    }
}

/// PyTorch's epsilon for normalisations that were in training and so counted their batches, 0 for frozen ones.
fn epsilon_of(file: &PretrainedFile) -> f64 {
    let trained = file.tensors().any(|(name, _)| name.ends_with(".num_batches_tracked"));
    if trained { Bottlenecks::default().epsilon } else { 0.0 }
}
