//! Selection of HAF's height features: of many random ones, those are kept that individually best separate good grasps from bad
//! ones.
//!
//! As in the original (Fischinger, Weiss and Vincze 2015), features have one rectangle, or two to four with weights that sum to
//! zero; a quarter of them are symmetric about the centre of the closing direction. The selection is by F-score (Chen and Lin
//! 2006).

use rand::RngExt;
use sixfold_geometry::random::{Random, stream};
use sixfold_grasp::learned::{CELLS, HeightFeature, HeightGrid, Region};

use crate::samples::Sample;

/// Number of random features, of which the best are kept. The original has about 70,000; chosen by hand, not swept.
const CANDIDATES: u64 = 6000;
/// Number of features that are kept, as in the original.
pub(crate) const KEPT: usize = 300;

/// The features for the training, the one with the highest F-score first.
pub(crate) fn chosen(samples: &[Sample<HeightGrid>], seed: u64) -> Vec<HeightFeature> {
    use rayon::prelude::*;
    let mut rated: Vec<(f64, HeightFeature)> = (0..CANDIDATES)
        .into_par_iter()
        .map(|number| {
            let feature = feature(&mut stream(seed, number));
            (f_score(&feature, samples), feature)
        })
        .collect();
    // A stable sort: ties keep the order of their numbers.
    rated.sort_by(|a, b| b.0.total_cmp(&a.0));
    rated.into_iter().take(KEPT).map(|(_, feature)| feature).collect()
}

fn feature(random: &mut Random) -> HeightFeature {
    let weights: &[f32] = match random.random_range(0..4u32) {
        0 => &[1.0],
        1 => &[1.0, -1.0],
        2 => &[2.0, -1.0, -1.0],
        _ => &[1.0, 1.0, -1.0, -1.0],
    };
    let symmetric =
        weights.len() == 3 && random.random_range(0..2u32) == 0 || random.random_range(0..3u32) == 0;
    let mut regions: Vec<Region> = weights.iter().map(|&weight| region(weight, random)).collect();
    if symmetric && regions.len() >= 3 {
        // The last two are each other's mirror image.
        let last = regions.len() - 1;
        let of = regions[last - 1];
        regions[last].low = [CELLS - of.high[0], of.low[1]];
        regions[last].high = [CELLS - of.low[0], of.high[1]];
    }
    HeightFeature { regions }
}

fn region(weight: f32, random: &mut Random) -> Region {
    let mut side = || {
        let low = random.random_range(0..CELLS);
        (low, random.random_range(low + 1..=CELLS))
    };
    let ((x0, x1), (y0, y1)) = (side(), side());
    Region { low: [x0, y0], high: [x1, y1], weight }
}

/// Squared distances of the two means from the mean of all, over the two variances.
fn f_score(feature: &HeightFeature, samples: &[Sample<HeightGrid>]) -> f64 {
    let mut sums = [[0.0f64; 3]; 2];
    for sample in samples {
        let value = f64::from(feature.value(&sample.seen));
        let sum = &mut sums[usize::from(sample.held)];
        *sum = [sum[0] + 1.0, sum[1] + value, sum[2] + value * value];
    }
    let mean = |s: &[f64; 3]| s[1] / s[0].max(1.0);
    let variance = |s: &[f64; 3]| (s[2] - s[1] * mean(s)).max(0.0) / (s[0] - 1.0).max(1.0);
    let all = (sums[0][1] + sums[1][1]) / (sums[0][0] + sums[1][0]).max(1.0);
    let between: f64 = sums.iter().map(|s| (mean(s) - all).powi(2)).sum();
    between / (variance(&sums[0]) + variance(&sums[1])).max(1e-12)
}
