//! Where colour says that a pixel shows the object: histograms of what lies inside and around it in this one image.

use sixfold_synth::augment::Patch;

/// Bins of the colour histograms along each channel.
const BINS: usize = 16;

/// Log odds of object against background at every pixel: from the prior's probability, and, times `color`, from
/// [`color_odds`].
pub fn log_odds(patch: &Patch, prior: &[f32], color: f32) -> Vec<f32> {
    let logit = |p: f32| (p / (1.0 - p)).ln().clamp(-3.0, 3.0);
    let colors = color_odds(patch, prior);
    prior.iter().zip(colors).map(|(p, colors)| logit(p.clamp(0.01, 0.99)) + color * colors).collect()
}

/// Log odds of object against background at every pixel from its colour alone: histograms of what the prior (a probability per
/// pixel, row by row) takes for the one (above 3/4) and the other (below 1/4).
pub fn color_odds(patch: &Patch, prior: &[f32]) -> Vec<f32> {
    let area = prior.len();
    let bins = BINS * BINS * BINS;
    let mut counts = [vec![0.5f32; bins], vec![0.5f32; bins]];
    let bin = |i: usize| {
        (0..3)
            .fold(0, |bin, c| bin * BINS + ((patch.data[c * area + i] * BINS as f32) as usize).min(BINS - 1))
    };
    for (i, p) in prior.iter().enumerate() {
        // What is uncertain says nothing.
        if *p > 0.75 {
            counts[0][bin(i)] += *p;
        } else if *p < 0.25 {
            counts[1][bin(i)] += 1.0 - *p;
        }
    }
    // A little of each bin goes to its neighbours.
    for count in &mut counts {
        for stride in [1, BINS, BINS * BINS] {
            let before = count.clone();
            for (b, value) in count.iter_mut().enumerate() {
                let place = b / stride % BINS;
                let below = if place > 0 { before[b - stride] } else { before[b] };
                let above = if place + 1 < BINS { before[b + stride] } else { before[b] };
                *value = 0.5 * before[b] + 0.25 * (below + above);
            }
        }
        let sum: f32 = count.iter().sum();
        count.iter_mut().for_each(|v| *v /= sum);
    }
    (0..area)
        .map(|i| {
            let b = bin(i);
            (counts[0][b] / counts[1][b]).ln().clamp(-3.0, 3.0)
        })
        .collect()
}
