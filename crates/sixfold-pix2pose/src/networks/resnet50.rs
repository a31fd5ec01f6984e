//! The generator with a ResNet-50 encoder that the authors used for the BOP Challenge 2020.

use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use sixfold_geometry::random::stream;
use sixfold_nn::pretrained::PretrainedError;
use sixfold_nn::resnet::{ResNet50, ResNet50Config};

use super::paper::{ConvStage, Decoder, GeneratorOutput};

/// Channels of the encoder's maps at 64, 32 and 16 pixels in the skip connections: the first ones of 64, 256 and 512.
const SKIPS: [usize; 3] = [32, 128, 128];

/// The generator with a ResNet-50 encoder. Its only option is the seed.
#[derive(Debug, Clone, Copy, Default)]
pub struct ResNet50GeneratorConfig {
    /// Seed of the random weights.
    pub seed: u64,
}

impl ResNet50GeneratorConfig {
    /// The network with random weights throughout.
    pub fn init(&self, device: &Device) -> ResNet50Generator {
        self.with_encoder(ResNet50Config::features(2).init(self.seed, device), device)
    }

    /// The network with torchvision's ImageNet weights in its encoder, from a `.pth` or `.safetensors` file.
    ///
    /// # Errors
    /// [`PretrainedError`].
    pub fn from_pytorch(&self, path: &Path, device: &Device) -> Result<ResNet50Generator, PretrainedError> {
        Ok(self.with_encoder(ResNet50Config::features(2).from_pytorch(path, device)?, device))
    }

    fn with_encoder(&self, encoder: ResNet50, device: &Device) -> ResNet50Generator {
        let mut rng = stream(self.seed, 1);
        let last = ConvStage::init([512, 512], 2, &mut rng, device);
        ResNet50Generator { encoder, last, decoder: Decoder::init(SKIPS, &mut rng, device) }
    }
}

/// The generator with a ResNet-50 encoder, created by [`ResNet50GeneratorConfig`]. Input: RGB, for torchvision's weights in 0..1
/// minus mean (0.485, 0.456, 0.406) over deviation (0.229, 0.224, 0.225).
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct ResNet50Generator {
    encoder: ResNet50,
    last: ConvStage,
    decoder: Decoder,
}

sixfold_nn::displayed_by_name!(ResNet50Generator);

impl ResNet50Generator {
    /// From images, `batch x 3 x 128 x 128`, to coordinates and error.
    pub fn forward(&self, x: Tensor<4>) -> GeneratorOutput {
        let maps = self.encoder.features(x);
        let [first, second, third] = [0, 1, 2].map(|i| maps[i].clone().narrow(1, 0, SKIPS[i]));
        self.decoder.forward(self.last.forward(maps[2].clone()), [first, second, third])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::networks::paper::SIDE;

    #[test]
    fn it_gives_coordinates_and_error() {
        let device = Device::default();
        let network = ResNet50GeneratorConfig::default().init(&device);
        let output = network.forward(Tensor::ones([1, 3, SIDE, SIDE], &device));
        assert_eq!(
            (output.coordinates.dims(), output.error.dims()),
            ([1, 3, SIDE, SIDE], [1, 1, SIDE, SIDE])
        );
    }
}
