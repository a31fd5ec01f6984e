//! The losses of the training (dissertation, equations 4.1 and 4.2; the perceptual part: Johnson et al. 2016).
//!
//! Choices that the dissertation leaves open: colours are from -1 to 1 and their differences are summed over the channels;
//! differences of features are averaged over channels and divided by the true image's mean feature, so that one weight fits any
//! backbone; second differences are averaged over the channels.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use sixfold_nn::densenet::DenseNet121;
use sixfold_nn::lite0::{Lite0, imagenet_encoder};
use sixfold_nn::weights::WeightsError;

use crate::network::{COLOURS, Network, imagenet};

/// Weights of colours, features and smoothness: section 4.3.3.
pub const WEIGHTS: [f64; 3] = [5.0, 10.0, 1.0];

/// The frozen backbone whose first two maps the perceptual loss compares.
#[derive(Debug)]
pub enum Perceptual {
    /// For the compact network.
    Lite0(Box<Lite0>),
    /// For the dissertation's network.
    DenseNet(Box<DenseNet121>),
}

impl Perceptual {
    /// The backbone for a network, with its current weights.
    ///
    /// # Errors
    /// [`WeightsError`] if the shipped encoder has another version than the program.
    pub fn of(network: &Network, device: &Device) -> Result<Self, WeightsError> {
        Ok(match network {
            Network::Compact(_) => Perceptual::Lite0(Box::new(imagenet_encoder(device)?.no_grad())),
            Network::Paper(paper) => Perceptual::DenseNet(Box::new(paper.frozen_encoder())),
        })
    }

    /// The first two maps of images (`B x 3 x height x width`, -1 to 1).
    fn features(&self, images: Tensor<4>) -> Vec<Tensor<4>> {
        match self {
            Perceptual::Lite0(network) => network.forward_stages(images, 2),
            Perceptual::DenseNet(network) => network.features(imagenet(images)).into_iter().take(2).collect(),
        }
    }
}

/// Equation 4.1 without its weights: colours and features, each a mean over the pixels of `mask` (`B x 1 x height x width`,
/// M^D: 1 where any source is valid).
pub(crate) fn image_loss(
    image: Tensor<4>,
    truth: Tensor<4>,
    mask: Tensor<4>,
    perceptual: &Perceptual,
) -> (Tensor<1>, Tensor<1>) {
    let count = mask.clone().sum() + 1e-3;
    let colours = ((image.clone() - truth.clone()).abs() * mask.clone()).sum() / count.clone();
    // Outside the mask both images are equal, so that features differ only because of pixels in it.
    let inside = image * mask.clone() + truth.clone() * (mask.clone() * -1.0 + 1.0);
    let [_, _, height, width] = truth.dims();
    let mut features = Tensor::zeros([1], &mask.device());
    let maps = perceptual.features(inside);
    let true_maps = perceptual.features(truth);
    let taps = maps.len().max(1);
    for (map, true_map) in maps.into_iter().zip(true_maps) {
        let [_, channels, rows, columns] = map.dims();
        let true_map = true_map.detach();
        let unit = true_map.clone().abs().mean() + 1e-3;
        let fraction = (height * width) as f64 / (rows * columns * channels) as f64;
        features =
            features + (map - true_map).abs().sum() / (count.clone() * unit) * (fraction / taps as f64);
    }
    (colours, features)
}

/// Equation 4.2 without its weight: the absolute second differences of X^S (`B x 17 x height x width`) along rows, along columns
/// and mixed, where all pixels involved are in the mask.
pub(crate) fn smooth_loss(sum: Tensor<4>, mask: Tensor<4>) -> Tensor<1> {
    let [_, channels, height, width] = sum.dims();
    let part = |x: &Tensor<4>, y: usize, left: usize, rows: usize, columns: usize| {
        x.clone().narrow(2, y, rows).narrow(3, left, columns)
    };
    let count = mask.clone().sum() * channels as f64 + 1e-3;
    let (rows, columns) = (height - 2, width - 2);
    let across = |x: &Tensor<4>, k: usize| part(x, 0, k, height, columns);
    let down = |x: &Tensor<4>, k: usize| part(x, k, 0, rows, width);
    let second = |a: Tensor<4>, b: Tensor<4>, c: Tensor<4>| (a + c - b * 2.0).abs();
    let x = second(across(&sum, 0), across(&sum, 1), across(&sum, 2))
        * (across(&mask, 0) * across(&mask, 1) * across(&mask, 2));
    let y = second(down(&sum, 0), down(&sum, 1), down(&sum, 2))
        * (down(&mask, 0) * down(&mask, 1) * down(&mask, 2));
    let corner = |x: &Tensor<4>, j: usize, i: usize| part(x, j, i, height - 1, width - 1);
    let mixed = (corner(&sum, 0, 0) + corner(&sum, 1, 1) - corner(&sum, 0, 1) - corner(&sum, 1, 0)).abs()
        * (corner(&mask, 0, 0) * corner(&mask, 1, 1) * corner(&mask, 0, 1) * corner(&mask, 1, 0));
    (x.sum() + y.sum() + mixed.sum() * 2.0) / count
}

/// Mean squared error of colours (-1 to 1, `B x 3`) over the mask, converted to values from 0 to 1.
pub(crate) fn squared_error(image: Tensor<4>, truth: Tensor<4>, mask: Tensor<4>) -> Tensor<1> {
    let error = ((image - truth) * 0.5).square() * mask.clone();
    error.sum() / (mask.sum() * COLOURS as f64 + 1e-3)
}

/// Peak signal-to-noise ratio in decibels for a mean squared error.
pub fn psnr(squared_error: f64) -> f64 {
    -10.0 * squared_error.max(1e-10).log10()
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::TensorData;

    fn number(t: Tensor<1>) -> f32 {
        t.into_scalar::<f32>()
    }

    #[test]
    fn equation_4_1_counts_pixels_in_the_mask() {
        let device = Device::flex();
        let perceptual = Perceptual::Lite0(Box::new(imagenet_encoder(&device).unwrap()));
        let truth = Tensor::<4>::zeros([1, 3, 32, 32], &device);
        let mask: Vec<f32> = (0..1024).map(|i| f32::from(u8::from(i % 32 < 16))).collect();
        let mask = Tensor::<4>::from_data(TensorData::new(mask, [1, 1, 32, 32]), &device);
        let beside = (mask.clone() * -1.0 + 1.0).repeat_dim(1, 3);
        let (colours, features) = image_loss(beside, truth.clone(), mask.clone(), &perceptual);
        assert_eq!((number(colours), number(features)), (0.0, 0.0));
        let within = mask.clone().repeat_dim(1, 3) * 0.1;
        let (colours, features) = image_loss(within.clone(), truth.clone(), mask.clone(), &perceptual);
        assert!((number(colours) - 0.3).abs() < 1e-4);
        assert!(number(features) > 0.0);
        let (darker, _) = image_loss(within.clone() * -1.0, truth.clone(), mask.clone(), &perceptual);
        assert!((number(darker) - 0.3).abs() < 1e-4);
        assert!((number(squared_error(within, truth, mask)) - 0.0025).abs() < 1e-5);
        assert!((psnr(0.01) - 20.0).abs() < 1e-9);
    }

    #[test]
    fn equation_4_2_is_zero_for_slopes() {
        let device = Device::flex();
        let plane = |f: &dyn Fn(f32, f32) -> f32| {
            let values: Vec<f32> = (0..64).map(|i| f((i % 8) as f32, (i / 8) as f32)).collect();
            Tensor::<4>::from_data(TensorData::new(values, [1, 1, 8, 8]), &device)
        };
        let all = plane(&|_, _| 1.0);
        assert!(number(smooth_loss(plane(&|x, y| 2.0 * x - 3.0 * y), all.clone())) < 1e-4);
        // Second difference 2 in rows, at 6 of 8 pixels of a row.
        let bent = number(smooth_loss(plane(&|x, _| x * x), all));
        assert!((bent - 2.0 * 48.0 / 64.0).abs() < 1e-3, "{bent}");
        // A zigzag in rows and columns: of 8 rows the four odd ones have six second differences of 2 or -2, columns too, and all 49
        // mixed ones are 1 or -1, counted twice.
        let zigzag = plane(&|x, y| (x % 2.0) * (y % 2.0));
        let bent = number(smooth_loss(zigzag, plane(&|_, _| 1.0)));
        assert!((bent - (48.0 + 48.0 + 98.0) / 64.0).abs() < 1e-3, "{bent}");
        let holes = plane(&|x, _| f32::from(u8::from(!(x as usize).is_multiple_of(3))));
        assert!(number(smooth_loss(plane(&|x, _| x * x), holes)) < 1e-4);
    }
}
