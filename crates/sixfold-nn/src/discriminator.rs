//! The discriminator of the dissertation's adversarial training (section 3.2.5): classifies an image (of object coordinates; of an
//! object, in chapter 4) as rendered or generated. Its input is that image alone, not the generator's input.

use crate::batch_norm::{BatchNorm, BatchNormConfig};
use crate::conv_norm::{BareConv, BareConvConfig};
use crate::dense::dense;
use crate::kernels::ConvSpec;
use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::{Device, Tensor};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const CHANNELS: [usize; 8] = [3, 64, 128, 256, 512, 512, 512, 512];
const KERNEL: usize = 3;
const SLOPE: f32 = 0.2;

/// The discriminator. Its only option is the seed.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct DiscriminatorConfig {
    /// Seed of the random weights.
    pub seed: u64,
}

impl DiscriminatorConfig {
    /// The network with random weights (He et al. 2015).
    pub(crate) fn init(&self, device: &Device) -> Discriminator {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        let padding = ConvSpec::same(2, KERNEL, 2);
        let stages = CHANNELS
            .windows(2)
            .map(|c| {
                let conv = BareConvConfig::new([c[0], c[1]], KERNEL).with_stride(2).with_padding(padding);
                Stage { conv: conv.init(&mut rng, device), norm: BatchNormConfig::new(c[1]).init(device) }
            })
            .collect();
        let judge = dense([CHANNELS[CHANNELS.len() - 1], 1], &mut rng, device);
        Discriminator { stages, judge }
    }
}

/// The discriminator, created by `DiscriminatorConfig`.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Discriminator {
    stages: Vec<Stage>,
    judge: Linear,
}

#[derive(Module, Debug)]
#[module(custom_display)]
struct Stage {
    conv: BareConv,
    norm: BatchNorm,
}

crate::displayed_by_name!(Discriminator, Stage);

impl Discriminator {
    /// From images in -1..1, `batch x 3 x 128 x 128`, to `batch x 1` logits that they are rendered. Smaller images, of at least 16
    /// pixels, are reduced to one pixel before the last stages, which are then skipped; for larger ones the mean is used.
    pub fn forward(&self, images: Tensor<4>) -> Tensor<2> {
        let x = self.stages.iter().fold(images, |x, stage| match x.dims() {
            [_, _, 1, 1] => x,
            _ => stage.conv.forward_norm(x, &stage.norm, None, SLOPE),
        });
        let [batch, channels, height, width] = x.dims();
        self.judge
            .forward(x.reshape([batch, channels, height * width]).mean_dim(2).reshape([batch, channels]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::optim::GradientsParams;

    #[test]
    fn it_gives_a_logit_an_image_and_passes_gradients_on() {
        let device = Device::default().autodiff();
        let network = DiscriminatorConfig::default().init(&device);
        let x = Tensor::<4>::random([3, 3, 128, 128], burn::tensor::Distribution::Default, &device)
            .require_grad();
        let logits = network.forward(x.clone());
        assert_eq!(logits.dims(), [3, 1]);
        let gradients = logits.square().mean().backward();
        assert!(x.grad(&gradients).unwrap().abs().max().into_scalar::<f32>() > 0.0);
        assert_eq!(GradientsParams::from_grads(gradients, &network).len(), 7 * 3 + 2);
        // NOL's images, Pix2Pose's compact network's, and its smallest.
        for (side, stages) in [(256, 7), (64, 6), (16, 4)] {
            let x = Tensor::<4>::random([2, 3, side, side], burn::tensor::Distribution::Default, &device);
            let logits = network.forward(x);
            assert_eq!(logits.dims(), [2, 1]);
            let gradients = GradientsParams::from_grads(logits.square().mean().backward(), &network);
            assert_eq!(gradients.len(), stages * 3 + 2);
        }
    }
}
