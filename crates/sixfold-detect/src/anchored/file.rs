//! These networks in Sixfold's own weight files, and the start of a training from weights of torchvision.

use std::path::Path;

use burn::tensor::Device;
use sixfold_geometry::random::stream;
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::pretrained::{PretrainedError, PretrainedFile};
use sixfold_nn::resnet::ResNet50Config;
use sixfold_nn::weights::{ModelCard, WeightsError, load_weights, save_weights};

use super::config::{AnchoredConfig, AnchoredKind};
use super::load::Shapes;
use super::network::{AnchoredNetwork, Layers};
use crate::network::EncoderKind;

/// A field of a card that cannot be, what it should hold, and what it holds.
pub(crate) type Wrong = (&'static str, &'static str, String);

impl AnchoredKind {
    /// Name of the network in weight files.
    pub(crate) fn architecture(self) -> &'static str {
        match self {
            AnchoredKind::FasterRcnn => "detect-faster-rcnn",
            AnchoredKind::MaskRcnn => "detect-mask-rcnn",
            AnchoredKind::RetinaNet => "detect-retinanet-anchors",
        }
    }
}

impl AnchoredConfig {
    /// Whether these can be the sizes of a network in a file of so many `bytes`. Nothing of their size is made before.
    ///
    /// # Errors
    /// [`Wrong`].
    pub(crate) fn check(&self, bytes: u64) -> Result<(), Wrong> {
        let (width, blocks) = match self.encoder {
            EncoderKind::ResNet50 => ((1..=256, "1 to 256"), (1..=64, "1 to 64 a layer")),
            EncoderKind::Lite0 => ((0..=0, "0 with lite0"), (0..=0, "0 with lite0")),
        };
        let ranges = [
            ("extra.network.labels", self.labels, 1..=10_000, "1 to 10000"),
            ("extra.network.width", self.width, width.0, width.1),
            ("extra.network.pyramid", self.pyramid, 1..=1024, "1 to 1024"),
            ("extra.network.hidden", self.hidden, 0..=8192, "0 to 8192"),
            ("extra.network.min_side", self.min_side, 32..=16_384, "32 to 16384 pixels"),
            ("extra.network.max_side", self.max_side, 32..=16_384, "32 to 16384 pixels"),
        ];
        let blocks = self.blocks.map(|b| ("extra.network.blocks", b, blocks.0.clone(), blocks.1));
        for (field, value, range, expected) in ranges.into_iter().chain(blocks) {
            if !range.contains(&value) {
                return Err((field, expected, value.to_string()));
            }
        }
        if !(0.0..=1.0).contains(&self.norm_epsilon) {
            return Err(("extra.network.norm_epsilon", "0 to 1", self.norm_epsilon.to_string()));
        }
        // Two bytes or more for each number.
        if bytes < 2 * self.numbers() as u64 {
            let found = format!("{bytes} bytes for {} numbers or more", self.numbers());
            return Err(("extra.network", "sizes of a network that the file holds", found));
        }
        Ok(())
    }
}

impl AnchoredNetwork {
    /// Writes a weight file.
    pub(crate) fn save(&self, card: &ModelCard, path: &Path) -> Result<(), WeightsError> {
        save_weights(&self.layers, card, path)
    }

    /// Reads a weight file of a network of these sizes, which [`AnchoredConfig::check`] has seen.
    pub(crate) fn load(
        path: &Path,
        config: &AnchoredConfig,
        device: &Device,
    ) -> Result<(AnchoredNetwork, ModelCard), WeightsError> {
        let AnchoredNetwork { layers, config, device, .. } = config.init(0, device);
        let (layers, card) = load_weights(layers, path, config.kind.architecture())?;
        Ok((AnchoredNetwork::of_layers(layers, config, device), card))
    }

    /// A network to be trained for so many `labels`: all layers but those of the labels from torchvision's weights of the same network
    /// (as trained on COCO), or the ResNet from its ResNet-50. `None` for weights of another of the networks.
    ///
    /// # Errors
    /// [`PretrainedError`].
    pub fn pretrained(
        path: &Path,
        kind: AnchoredKind,
        labels: usize,
        seed: u64,
        device: &Device,
    ) -> Result<Option<AnchoredNetwork>, PretrainedError> {
        let file = PretrainedFile::open(path)?;
        let Some(config) = Shapes(&file).config() else {
            let mut network = AnchoredConfig::new(kind, labels).init(seed, device);
            let resnet = ResNet50Config::features(4).from_pytorch(path, device)?;
            network.layers.backbone_mut().body = Some(resnet);
            return Ok(Some(network));
        };
        if config.kind != kind {
            return Ok(None);
        }
        let AnchoredNetwork { layers, config, .. } = AnchoredNetwork::from_pytorch(&file, &config, device)?;
        let config = AnchoredConfig { labels, ..config };
        let random = &mut stream(seed, 2);
        let layers = match layers {
            Layers::TwoStages(mut network) => {
                network.roi_heads = network.roi_heads.relabelled(&config, random, device);
                Layers::TwoStages(network)
            }
            Layers::OneStage(network) => Layers::OneStage(network.relabelled(&config, random, device)),
        };
        Ok(Some(AnchoredNetwork::of_layers(layers, config, device.clone())))
    }

    /// A network on EfficientNet-Lite0 with its ImageNet weights, to be trained for so many `labels` ([`AnchoredConfig::compact`]).
    ///
    /// # Errors
    /// [`WeightsError`] if the program carries other weights than its own version's.
    pub fn on_lite0(
        kind: AnchoredKind,
        labels: usize,
        seed: u64,
        device: &Device,
    ) -> Result<AnchoredNetwork, WeightsError> {
        let mut network = AnchoredConfig::compact(kind, labels).init(seed, device);
        network.layers.backbone_mut().lite0 = Some(imagenet_encoder(device)?);
        Ok(network)
    }

    /// Images' longer side gets this length, pixels.
    pub(crate) fn with_longest_side(mut self, side: usize) -> AnchoredNetwork {
        (self.config.min_side, self.config.max_side) = (side, side);
        self
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Tensor;

    use super::*;

    #[test]
    fn a_network_on_lite0_is_the_same_after_it_was_saved_and_loaded() {
        let (kind, device) = (AnchoredKind::MaskRcnn, Device::flex());
        let network = AnchoredNetwork::on_lite0(kind, 3, 7, &device).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        network.save(&ModelCard::new(kind.architecture(), ""), &path).unwrap();
        network.config.check(std::fs::metadata(&path).unwrap().len()).unwrap();
        let (loaded, _) = AnchoredNetwork::load(&path, &network.config, &device).unwrap();
        let levels = |network: &AnchoredNetwork| -> Vec<f32> {
            let levels = network.layers.backbone().forward(Tensor::ones([1, 3, 64, 64], &device));
            levels.into_iter().flat_map(super::super::network::numbers).collect()
        };
        let (before, after) = (levels(&network), levels(&loaded));
        let largest = before.iter().fold(0f32, |m, v| m.max(v.abs()));
        let error = before.iter().zip(&after).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
        // Files hold half floats.
        assert!(largest > 0.1 && error < 0.01 * largest, "{error} of {largest}");
        let resnet = AnchoredConfig { pyramid: 64, hidden: 512, ..AnchoredConfig::new(kind, 3) };
        let error = AnchoredNetwork::load(&path, &resnet, &device).unwrap_err().to_string();
        assert!(error.contains("model.safetensors") && error.contains("tensor"), "{error}");
    }
}
