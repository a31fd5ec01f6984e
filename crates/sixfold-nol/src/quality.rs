//! How well a model renders made-up objects that it was not trained on, beside plain averaging of the same sources.

use std::collections::BTreeMap;

use serde::Serialize;
use sixfold_augment::Backgrounds;

use crate::loss::psnr;
use crate::model::NolModel;
use crate::samples::{SampleOptions, look_up, make_sample};

/// What to measure on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QualityOptions {
    /// Objects.
    pub objects: u64,
    /// Sources of each.
    pub sources: usize,
    /// Side of all crops, pixels.
    pub side: usize,
    /// Seed of the objects; another than the training's.
    pub seed: u64,
}

impl Default for QualityOptions {
    fn default() -> Self {
        QualityOptions { objects: 24, sources: 6, side: 128, seed: 0x4e4f_4c00 }
    }
}

/// Mean peak signal-to-noise ratios over the objects, decibels, where any source sees something.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Quality {
    /// Of X^D, with poses off as table 4.1 has it.
    pub rough: f64,
    /// Of the sources' average there.
    pub rough_average: f64,
    /// Of X^D with exact poses.
    pub exact: f64,
    /// Of the sources' average there.
    pub exact_average: f64,
}

impl Quality {
    /// For a model card.
    pub fn scores(&self) -> BTreeMap<String, f64> {
        [
            ("PSNR, rough poses", self.rough),
            ("PSNR of averaging, rough poses", self.rough_average),
            ("PSNR, exact poses", self.exact),
            ("PSNR of averaging, exact poses", self.exact_average),
        ]
        .into_iter()
        .map(|(name, value)| (name.to_owned(), value))
        .collect()
    }
}

/// Measures a model.
pub fn quality(
    model: &NolModel,
    textures: &Backgrounds,
    samples: &SampleOptions,
    options: &QualityOptions,
) -> Quality {
    let rough = SampleOptions { good_poses: 0.0, ..*samples };
    let exact = SampleOptions { translation: 0.0, rotation: 0.0, ..*samples };
    let [rough, exact] = [rough, exact].map(|samples| {
        let mut sums = [0.0; 2];
        for number in 0..options.objects {
            let errors = errors(model, textures, &samples, options, number);
            sums.iter_mut().zip(errors).for_each(|(sum, e)| *sum += psnr(e) / options.objects.max(1) as f64);
        }
        sums
    });
    Quality { rough: rough[0], rough_average: rough[1], exact: exact[0], exact_average: exact[1] }
}

/// Mean squared errors of X^D and of averaging for one object.
fn errors(
    model: &NolModel,
    textures: &Backgrounds,
    samples: &SampleOptions,
    options: &QualityOptions,
    number: u64,
) -> [f64; 2] {
    let sample = make_sample(textures, samples, options.side, options.sources, options.seed, number);
    let features = model.encode(&sample.sources);
    let rendering = model.render(&sample.surface, &sample.sources, &features);
    let mut average = vec![([0.0f32; 3], 0.0f32); sample.surface.points.len()];
    for (source, features) in sample.sources.iter().zip(&features) {
        let looked = look_up(source, &sample.surface);
        let mut values = vec![0.0; features.channels()];
        for (point, pixel) in looked.points.iter().zip(&looked.pixels) {
            features.sample(pixel[0], pixel[1], &mut values);
            let (sum, count) = &mut average[*point as usize];
            (0..3).for_each(|c| sum[c] += 0.5 * values[c] + 0.5);
            *count += 1.0;
        }
    }
    let pixels = options.side * options.side;
    let (mut errors, mut count) = ([0.0f64; 2], 0.0f64);
    for (i, (sum, sources)) in average.iter().enumerate().filter(|(_, (_, n))| *n > 0.0) {
        for c in 0..3 {
            let truth = sample.target.data[c * pixels + sample.surface.pixels[i] as usize];
            errors[0] += f64::from(rendering.colours[i][c] - truth).powi(2);
            errors[1] += f64::from(sum[c] / sources - truth).powi(2);
            count += 1.0;
        }
    }
    errors.map(|e| e / count.max(1.0))
}
