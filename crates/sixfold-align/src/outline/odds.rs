//! Probability from colour that a pixel shows the object: histograms of the pixels inside and around it in this one image.

use sixfold_synth::augment::Patch;

/// Bins of the colour histograms along each channel; chosen by hand, not swept.
const BINS: usize = 16;
/// Largest absolute value of log odds: neither source is ever certain. Chosen by hand; not swept.
const MAX_ODDS: f32 = 3.0;
/// Probabilities are kept away from 0 and 1 by this, so that their log odds are finite.
const CERTAIN: f32 = 0.01;
/// Pixels whose prior is above the first count as object, those below the second ([`BACKGROUND`]) as background; chosen by hand,
/// not swept.
const OBJECT: f32 = 0.75;
/// See [`OBJECT`].
const BACKGROUND: f32 = 0.25;
/// Initial count of every bin, in pixels; chosen by hand, not swept.
const EMPTY_BIN: f32 = 0.5;
/// Fraction of a bin that stays in it, and that goes to each of its neighbours, along each channel: a binomial filter.
const SMOOTHING: (f32, f32) = (0.5, 0.25);

/// Log odds of object against background at every pixel: from the prior's probability, and, times `color`, from
/// [`color_odds`].
pub fn log_odds(patch: &Patch, prior: &[f32], color: f32) -> Vec<f32> {
    let logit = |p: f32| (p / (1.0 - p)).ln().clamp(-MAX_ODDS, MAX_ODDS);
    let colors = color_odds(patch, prior);
    prior
        .iter()
        .zip(colors)
        .map(|(p, colors)| logit(p.clamp(CERTAIN, 1.0 - CERTAIN)) + color * colors)
        .collect()
}

/// Log odds of object against background at every pixel from its colour alone: histograms of the pixels whose prior (a probability
/// per pixel, row by row) is above 3/4 (object) and below 1/4 (background).
pub fn color_odds(patch: &Patch, prior: &[f32]) -> Vec<f32> {
    let area = prior.len();
    let bins = BINS * BINS * BINS;
    let mut counts = [vec![EMPTY_BIN; bins], vec![EMPTY_BIN; bins]];
    let bin = |i: usize| {
        (0..3)
            .fold(0, |bin, c| bin * BINS + ((patch.data[c * area + i] * BINS as f32) as usize).min(BINS - 1))
    };
    for (i, p) in prior.iter().enumerate() {
        // Uncertain pixels are not counted.
        if *p > OBJECT {
            counts[0][bin(i)] += *p;
        } else if *p < BACKGROUND {
            counts[1][bin(i)] += 1.0 - *p;
        }
    }
    // A fraction of each bin goes to its neighbours.
    for count in &mut counts {
        for stride in [1, BINS, BINS * BINS] {
            let before = count.clone();
            for (b, value) in count.iter_mut().enumerate() {
                let place = b / stride % BINS;
                let below = if place > 0 { before[b - stride] } else { before[b] };
                let above = if place + 1 < BINS { before[b + stride] } else { before[b] };
                *value = SMOOTHING.0 * before[b] + SMOOTHING.1 * (below + above);
            }
        }
        let sum: f32 = count.iter().sum();
        count.iter_mut().for_each(|v| *v /= sum);
    }
    (0..area)
        .map(|i| {
            let b = bin(i);
            (counts[0][b] / counts[1][b]).ln().clamp(-MAX_ODDS, MAX_ODDS)
        })
        .collect()
}
