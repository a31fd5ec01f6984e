//! Samples as tensor data: sources sampled at the surface points of the target, the one that shows most of it last.

use std::sync::Arc;

use rand::RngExt;
use serde::{Deserialize, Serialize};
use sixfold_geometry::random::stream;
use sixfold_nn::kernels::{Places, SampledPixel, neighbours};
use sixfold_synth::augment::{Backgrounds, Patch};

use super::view::{Sample, ViewSampleOptions, make_sample};
use crate::network::COLOURS;
use crate::projection::TargetSurface;
use crate::source::SourceView;

/// Below this visibility a source's pixel counts as hidden.
const VISIBLE: f32 = 0.5;

/// The pixels of a source that show points of a target.
#[derive(Debug, Clone, Default)]
pub struct Lookup {
    /// Numbers of the target's points that the source shows.
    pub points: Vec<u32>,
    /// Pixels of the source.
    pub pixels: Vec<[f32; 2]>,
    /// Cosines of the angles between normal and line of sight.
    pub cosines: Vec<f32>,
}

impl Lookup {
    /// How much of the target the source shows: the sum of the cosines.
    pub fn worth(&self) -> f32 {
        self.cosines.iter().sum()
    }
}

/// Projects a target into a source; pixels outside the source's mask are not visible.
pub(crate) fn look_up(source: &SourceView, target: &TargetSurface) -> Lookup {
    let mut lookup = Lookup::default();
    for (i, (point, normal)) in target.points.iter().zip(&target.normals).enumerate() {
        let Some((pixel, cosine)) = source.see(point, normal) else { continue };
        if source.visible.sample(pixel[0], pixel[1]) >= VISIBLE {
            lookup.points.push(i as u32);
            lookup.pixels.push(pixel);
            lookup.cosines.push(cosine);
        }
    }
    lookup
}

/// Order in which sources are integrated: an LSTM remembers the last one best, so the one that shows most is last.
pub(crate) fn order(lookup: &[Lookup]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..lookup.len()).collect();
    order.sort_by(|a, b| lookup[*a].worth().total_cmp(&lookup[*b].worth()));
    order
}

/// A pixel of a crop as a fraction of its side, as in [`SampledPixel`].
pub(crate) fn relative(pixel: f32, side: usize) -> f32 {
    (pixel + 0.5) / side as f32
}

/// Colour of a patch (0 to 1) at a pixel, from -1 to 1.
fn colour(patch: &Patch, [x, y]: [f32; 2]) -> [f32; COLOURS] {
    let pixels = patch.width * patch.height;
    let (at, weights) =
        neighbours(relative(x, patch.width), relative(y, patch.height), [patch.height, patch.width]);
    std::array::from_fn(|c| {
        let sum: f32 = at.iter().zip(&weights).map(|(i, w)| patch.data[c * pixels + i] * w).sum();
        2.0 * sum - 1.0
    })
}

/// Number and size of the samples in a step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewBatchOptions {
    /// Possible sides of the crops, pixels; each step uses one.
    pub sides: Vec<usize>,
    /// Fewest sources of a sample.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub min_sources: usize,
    /// Maximum number of sources of a sample; a step has from `min_sources` to this many, uniformly distributed.
    pub max_sources: usize,
    /// Sources in a step at the smallest side; fewer at a larger one.
    pub sources: usize,
    /// Maximum number of samples in a step.
    pub max_samples: usize,
}

fn one() -> usize {
    1
}

fn is_one(number: &usize) -> bool {
    *number == 1
}

/// Samples as tensor data; `K` sources, `B` samples, ordered source by source.
#[derive(Debug, Clone)]
pub struct Batch {
    /// Number of its step; 0 if it does not belong to one.
    pub step: u64,
    /// Side of all crops, pixels.
    pub side: usize,
    /// `K`.
    pub sources: usize,
    /// `B`.
    pub samples: usize,
    /// The sources, `K B x 3 x side x side`, -1 to 1.
    pub images: Vec<f32>,
    /// Positions at which features are sampled.
    pub places: Arc<Places>,
    /// Sampled colours, `K B x 3 x side x side`.
    pub colours: Vec<f32>,
    /// Cosines, `K B x 1 x side x side`; 0 where a source does not show the point.
    pub cosines: Vec<f32>,
    /// X^GT, `B x 3 x side x side`, -1 to 1.
    pub target: Vec<f32>,
}

impl Batch {
    /// The batch of a step.
    pub fn of_step(
        textures: &Backgrounds,
        samples: &ViewSampleOptions,
        options: &ViewBatchOptions,
        seed: u64,
        step: u64,
    ) -> Batch {
        // Streams with odd numbers choose the batch, those with even ones make samples.
        let mut random = stream(seed, 2 * step + 1);
        let sources = random
            .random_range(options.min_sources.max(1)..=options.max_sources.max(options.min_sources.max(1)));
        let side = options.sides[random.random_range(0..options.sides.len())];
        let smallest = options.sides.iter().copied().min().unwrap_or(side);
        let budget = options.sources as f64 * (smallest as f64 / side as f64).powi(2);
        let count = ((budget / sources as f64).round() as usize).clamp(1, options.max_samples.max(1));
        let made: Vec<Sample> = (0..count as u64)
            .map(|i| {
                let number = 2 * (step * options.max_samples.max(1) as u64 + i);
                make_sample(textures, samples, side, sources, seed, number)
            })
            .collect();
        Batch { step, ..Batch::of_samples(&made) }
    }

    /// A batch of samples with the same side and number of sources.
    ///
    /// # Panics
    /// If they differ in these, or there are none.
    pub(crate) fn of_samples(samples: &[Sample]) -> Batch {
        let (side, sources) = (samples[0].target.width, samples[0].sources.len());
        let (count, pixels) = (samples.len(), side * side);
        let all = sources * count;
        let mut batch = Batch {
            step: 0,
            side,
            sources,
            samples: count,
            images: Vec::with_capacity(all * COLOURS * pixels),
            places: Arc::default(),
            colours: vec![0.0; all * COLOURS * pixels],
            cosines: vec![0.0; all * pixels],
            target: samples.iter().flat_map(|s| s.target.data.iter().map(|v| 2.0 * v - 1.0)).collect(),
        };
        let lookup: Vec<Vec<Lookup>> = samples
            .iter()
            .map(|s| s.sources.iter().map(|source| look_up(source, &s.surface)).collect())
            .collect();
        let orders: Vec<Vec<usize>> = lookup.iter().map(|l| order(l)).collect();
        let mut images = Vec::with_capacity(all);
        for k in 0..sources {
            for (b, sample) in samples.iter().enumerate() {
                assert_eq!(
                    (sample.target.width, sample.sources.len()),
                    (side, sources),
                    "samples of one kind"
                );
                let (source, lookup) = (&sample.sources[orders[b][k]], &lookup[b][orders[b][k]]);
                batch.images.extend(source.patch.data.iter().map(|v| 2.0 * v - 1.0));
                let n = k * count + b;
                let mut places = Vec::with_capacity(lookup.points.len());
                for ((point, pixel), cosine) in lookup.points.iter().zip(&lookup.pixels).zip(&lookup.cosines)
                {
                    let at = sample.surface.pixels[*point as usize];
                    places.push(SampledPixel {
                        pixel: at,
                        x: relative(pixel[0], side),
                        y: relative(pixel[1], side),
                    });
                    let at = at as usize;
                    for (c, value) in colour(&source.patch, *pixel).into_iter().enumerate() {
                        batch.colours[(n * COLOURS + c) * pixels + at] = value;
                    }
                    batch.cosines[n * pixels + at] = *cosine;
                }
                images.push(places);
            }
        }
        batch.places = Arc::new(Places { size: [side, side], images });
        batch
    }

    /// The average of the sources: images in the format of [`Batch::target`], and its mean squared error over the pixels that any
    /// source shows, for values from 0 to 1.
    pub fn average(&self) -> (Vec<f32>, f64) {
        let pixels = self.side * self.side;
        let mut image = vec![0.0; self.target.len()];
        let (mut error, mut count) = (0.0, 0);
        for b in 0..self.samples {
            for p in 0..pixels {
                let seen = |k: &usize| self.cosines[(k * self.samples + b) * pixels + p] > 0.0;
                let seeing: Vec<usize> = (0..self.sources).filter(seen).collect();
                if seeing.is_empty() {
                    continue;
                }
                for c in 0..COLOURS {
                    let of = |k: usize| self.colours[((k * self.samples + b) * COLOURS + c) * pixels + p];
                    let mean = seeing.iter().map(|k| of(*k)).sum::<f32>() / seeing.len() as f32;
                    let at = (b * COLOURS + c) * pixels + p;
                    image[at] = mean;
                    error += f64::from(0.5 * (mean - self.target[at])).powi(2);
                    count += 1;
                }
            }
        }
        (image, error / f64::from(count.max(1)))
    }
}
