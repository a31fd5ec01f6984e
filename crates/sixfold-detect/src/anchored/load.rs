//! torchvision's weights: state dicts of `fasterrcnn_resnet50_fpn`, `maskrcnn_resnet50_fpn` and `retinanet_resnet50_fpn`, with the names
//! of tensors of any version since 0.8.

use std::path::Path;

use burn::module::Module;
use burn::tensor::Device;
use sixfold_nn::pretrained::{Naming, PretrainedError, PretrainedFile, fill};

use super::anchors::Scales;
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

/// What a file must hold to be one of the three networks: end of a tensor's name, the network, and the tensor's rows a label.
const SIGNS: [(&str, AnchoredKind, usize); 3] = [
    ("roi_heads.mask_predictor.mask_fcn_logits.weight", AnchoredKind::MaskRcnn, 1),
    ("roi_heads.box_predictor.cls_score.weight", AnchoredKind::FasterRcnn, 1),
    ("head.classification_head.cls_logits.weight", AnchoredKind::RetinaNet, 9),
];

/// Which network a file's tensors belong to, and how many labels it has; `None` where it is none of the three.
pub(crate) fn recognise(file: &PretrainedFile) -> Option<(AnchoredKind, usize)> {
    debug_assert_eq!(SIGNS[2].2, Scales::Three.anchors());
    SIGNS.iter().find_map(|(sign, kind, per_label)| {
        let (_, shape) = file.tensors().find(|(name, _)| name.ends_with(sign))?;
        Some((*kind, shape.first()? / per_label))
    })
}

/// PyTorch's names of a tensor, that of the newest version first.
fn names(name: &str) -> Vec<String> {
    let parts: Vec<&str> = name.split('.').collect();
    let number = |i: usize| parts.get(i).and_then(|part| part.parse::<usize>().ok());
    // Burn's name of an enum's variant is no part of PyTorch's.
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
            vec![format!("head.{head}.conv.{layer}.0.{last}"), format!("head.{head}.conv.{}.{last}", 2 * layer)]
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

    /// The same with torchvision's own sizes, which the file's tensors decide: `None` where it holds none of the three networks.
    /// For `norm_epsilon` see [`AnchoredConfig`].
    ///
    /// # Errors
    /// [`PretrainedError`].
    pub fn recognised(path: &Path, norm_epsilon: f64) -> Result<Option<AnchoredNetwork>, PretrainedError> {
        let file = PretrainedFile::open(path)?;
        let Some((kind, labels)) = recognise(&file) else { return Ok(None) };
        let config = AnchoredConfig { norm_epsilon, ..AnchoredConfig::new(kind, labels) };
        AnchoredNetwork::from_pytorch(&file, &config, &Device::flex()).map(Some)
    }
}
