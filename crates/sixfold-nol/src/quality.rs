//! How well a model renders synthetic objects that it was not trained on, compared with plain averaging of the same sources.

use std::collections::BTreeMap;

use burn::tensor::{Tensor, TensorData};
use serde::Serialize;
use sixfold_nn::device;
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::weights::WeightsError;
use sixfold_synth::augment::Backgrounds;

use crate::loss::{Perceptual, image_loss, psnr, squared_error};
use crate::model::NolModel;
use crate::network::COLOURS;
use crate::samples::{Batch, ViewSampleOptions, make_sample};

/// Options of the measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QualityOptions {
    /// Number of objects.
    pub objects: u64,
    /// Sources per object.
    pub sources: usize,
    /// Side of all crops, pixels.
    pub side: usize,
    /// Seed of the objects; different from the training's.
    pub seed: u64,
}

impl Default for QualityOptions {
    fn default() -> Self {
        QualityOptions { objects: 24, sources: 6, side: 128, seed: 0x4e4f_4c00 }
    }
}

/// Means over the objects, over the pixels that any source shows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct TruthSimilarity {
    /// Peak signal-to-noise ratio, decibels. Insensitive to blur.
    pub psnr: f64,
    /// Difference of features, as in equation 4.1 for the compact network. Sensitive to blur.
    pub features: f64,
}

/// Similarity of X^D and of the average of the same sources to the truth.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Quality {
    /// X^D, with pose errors as in table 4.1.
    pub rough: TruthSimilarity,
    /// The sources' average with these poses.
    pub rough_average: TruthSimilarity,
    /// X^D with exact poses.
    pub exact: TruthSimilarity,
    /// The sources' average with these poses.
    pub exact_average: TruthSimilarity,
}

impl Quality {
    /// Scores for a model card.
    pub fn scores(&self) -> BTreeMap<String, f64> {
        [
            ("rough poses", self.rough),
            ("rough poses, averaging", self.rough_average),
            ("exact poses", self.exact),
            ("exact poses, averaging", self.exact_average),
        ]
        .into_iter()
        .flat_map(|(name, similarity)| {
            [
                (format!("PSNR in dB, {name}"), similarity.psnr),
                (format!("difference of features, {name}"), similarity.features),
            ]
        })
        .collect()
    }
}

/// Measures a model on objects with these textures.
///
/// # Errors
/// [`WeightsError`] if the shipped encoder has another version than the program.
pub fn quality(
    model: &NolModel,
    textures: &Backgrounds,
    samples: &ViewSampleOptions,
    options: &QualityOptions,
) -> Result<Quality, WeightsError> {
    let perceptual = Perceptual::Lite0(Box::new(imagenet_encoder(&device::chosen())?));
    let rough = ViewSampleOptions { good_poses: 0.0, ..*samples };
    let exact = ViewSampleOptions { translation: 0.0, rotation: 0.0, ..*samples };
    let [rough, exact] = [rough, exact].map(|samples| {
        let mut means = [TruthSimilarity::default(); 2];
        for number in 0..options.objects {
            let found = compare(model, textures, &samples, options, number, &perceptual);
            for (mean, one) in means.iter_mut().zip(found) {
                mean.psnr += one.psnr / options.objects.max(1) as f64;
                mean.features += one.features / options.objects.max(1) as f64;
            }
        }
        means
    });
    Ok(Quality { rough: rough[0], rough_average: rough[1], exact: exact[0], exact_average: exact[1] })
}

/// X^D and averaging for one object.
fn compare(
    model: &NolModel,
    textures: &Backgrounds,
    samples: &ViewSampleOptions,
    options: &QualityOptions,
    number: u64,
    perceptual: &Perceptual,
) -> [TruthSimilarity; 2] {
    let sample = make_sample(textures, samples, options.side, options.sources, options.seed, number);
    let features = model.encode(&sample.sources);
    let rendering = model.render(&sample.surface, &sample.sources, &features);
    let batch = Batch::of_samples(std::slice::from_ref(&sample));
    let (side, pixels) = (options.side, options.side * options.side);
    let mut image = vec![0.0; COLOURS * pixels];
    let mut mask = vec![0.0; pixels];
    for (i, at) in sample.surface.pixels.iter().map(|p| *p as usize).enumerate() {
        (0..COLOURS).for_each(|c| image[c * pixels + at] = 2.0 * rendering.colours[i][c] - 1.0);
        mask[at] = f32::from(u8::from(rendering.seen[i]));
    }
    let tensor = |values: Vec<f32>, channels: usize| {
        Tensor::<4>::from_data(TensorData::new(values, [1, channels, side, side]), &device::chosen())
    };
    let (truth, mask) = (tensor(batch.target.clone(), COLOURS), tensor(mask, 1));
    [image, batch.average().0].map(|image| {
        let image = tensor(image, COLOURS);
        let error = squared_error(image.clone(), truth.clone(), mask.clone()).into_scalar::<f32>();
        let (_, features) = image_loss(image, truth.clone(), mask.clone(), perceptual);
        TruthSimilarity { psnr: psnr(f64::from(error)), features: f64::from(features.into_scalar::<f32>()) }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Weights that were exchanged by mistake, or a change of the renderer that they do not fit, fail here.
    #[test]
    fn the_shipped_network_is_nearer_to_the_truth_than_the_average_of_the_sources() {
        let model = NolModel::shipped().unwrap();
        let options = QualityOptions { objects: 8, ..QualityOptions::default() };
        let quality =
            quality(&model, &Backgrounds::procedural(), &ViewSampleOptions::default(), &options).unwrap();
        println!("{quality:?}");
        assert!(quality.rough.features < 0.97 * quality.rough_average.features, "{quality:?}");
        assert!(quality.exact.features < 0.94 * quality.exact_average.features, "{quality:?}");
        assert!(quality.exact.psnr > quality.exact_average.psnr, "{quality:?}");
    }
}
