//! Compares templates with a crop, feature by feature.

use std::ops::Range;

use sixfold_nn::xfeat::CHANNELS;

use crate::colour::{Chroma, alike};
use crate::features::FeatureMap;
use crate::templates::Template;

/// See [`quick_similarity`].
const QUICK_STEP: usize = 4;

/// The product of two features.
#[inline(always)]
pub(crate) fn dot(a: &[f32], b: &[f32]) -> f32 {
    // Sums of 16, and pairs of sums added as a tree, take twice as long.
    let (a, _) = a.as_chunks::<8>();
    let (b, _) = b.as_chunks::<8>();
    let mut sums = [0.0f32; 8];
    for (a, b) in a.iter().zip(b) {
        for i in 0..8 {
            sums[i] += a[i] * b[i];
        }
    }
    sums.iter().sum()
}

sixfold_nn::vectorised! {
    /// Mean over every `step`-th of some features, at `cells`, of the best product with a feature within `reach` cells in a map of `n` x `n`
    /// cells; 0 without features.
    pub(crate) fn mean_best(cells: &[u16], features: &[f32], map: &[f32], n: usize, reach: usize, step: usize) -> f32 {
        let channels = features.len() / cells.len().max(1);
        let (mut sum, mut count) = (0.0, 0.0);
        for (cell, feature) in cells.iter().zip(features.chunks_exact(channels.max(1))).step_by(step) {
            sum += best_of(feature, map, n, usize::from(*cell), reach).1;
            count += 1.0;
        }
        if count > 0.0 { sum / count } else { 0.0 }
    }
}

/// Similarity of a template and a crop: the mean over the template's features of the best product with a feature of the crop within
/// `reach` cells.
pub(crate) fn similarity(template: &Template, map: &FeatureMap, reach: usize) -> f32 {
    mean_best(&template.cells, &template.features, &map.features, map.cells, reach, 1)
}

/// Similarity of a template's colours to those of the crop's cells at the same positions, 0 to 1, on every [`QUICK_STEP`]th cell;
/// 0 if the object has no colours.
pub(crate) fn colour_similarity(template: &Template, crop: &[Chroma]) -> f32 {
    let cells = template.cells.iter().zip(&template.chromas).step_by(QUICK_STEP);
    let (mut sum, mut count) = (0.0, 0.0);
    for (cell, chroma) in cells {
        sum += alike(*chroma, crop[usize::from(*cell)]);
        count += 1.0;
    }
    if count > 0.0 { sum / count } else { 0.0 }
}

/// [`similarity`] with every [`QUICK_STEP`]th feature, searched only in the neighbouring cells: about twelve times as fast.
pub(crate) fn quick_similarity(template: &Template, map: &FeatureMap) -> f32 {
    mean_best(&template.cells, &template.features, &map.features, map.cells, 1, QUICK_STEP)
}

/// The cell within `reach` of `cell` whose feature is most similar, and the product.
pub(crate) fn best_near(feature: &[f32], map: &FeatureMap, cell: usize, reach: usize) -> (usize, f32) {
    best_of(feature, &map.features, map.cells, cell, reach)
}

/// As [`best_near`], in a map of `n` x `n` cells, row by row.
#[inline(always)]
fn best_of(feature: &[f32], map: &[f32], n: usize, cell: usize, reach: usize) -> (usize, f32) {
    let mut best = (0, f32::NEG_INFINITY);
    let [columns, rows] = near(n, cell, reach);
    for v in rows {
        for at in v * n + columns.start..v * n + columns.end {
            let product = dot(feature, &map[at * feature.len()..][..feature.len()]);
            if product > best.1 {
                best = (at, product);
            }
        }
    }
    best
}

/// The columns and the rows within `reach` of a cell of a map of `n` x `n`.
#[inline(always)]
fn near(n: usize, cell: usize, reach: usize) -> [Range<usize>; 2] {
    [cell % n, cell / n].map(|at| at.saturating_sub(reach)..(at + reach + 1).min(n))
}

/// A feature of the template and one of the crop that are mutual nearest neighbours.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Match {
    /// Index of the template's feature.
    pub index: usize,
    /// The cell of the crop.
    pub cell: usize,
    /// Their product.
    pub similarity: f32,
}

/// Mutual nearest neighbours within `reach` cells.
pub(crate) fn mutual_matches(template: &Template, map: &FeatureMap, reach: usize) -> Vec<Match> {
    mutual(&template.cells, &template.features, &map.features, map.cells, reach)
}

sixfold_nn::vectorised! {
    fn mutual(cells: &[u16], features: &[f32], map: &[f32], n: usize, reach: usize) -> Vec<Match> {
        let mut back: Vec<(f32, u32)> = vec![(f32::NEG_INFINITY, u32::MAX); n * n];
        let mut forward = Vec::with_capacity(cells.len());
        for (i, (cell, feature)) in cells.iter().zip(features.chunks_exact(CHANNELS)).enumerate() {
            let cell = usize::from(*cell);
            let mut best = (cell, f32::NEG_INFINITY);
            let [columns, rows] = near(n, cell, reach);
            for v in rows {
                for at in v * n + columns.start..v * n + columns.end {
                    let product = dot(feature, &map[at * CHANNELS..][..CHANNELS]);
                    if product > best.1 {
                        best = (at, product);
                    }
                    if product > back[at].0 {
                        back[at] = (product, i as u32);
                    }
                }
            }
            forward.push(best);
        }
        let chosen = |(i, (cell, similarity)): (usize, (usize, f32))| {
            (back[cell].1 == i as u32).then_some(Match { index: i, cell, similarity })
        };
        forward.into_iter().enumerate().filter_map(chosen).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::{Camera, Pose};

    /// A map of 4 x 4 cells in which every cell has a different feature.
    fn map() -> FeatureMap {
        let mut features = vec![0.0; 16 * CHANNELS];
        (0..16).for_each(|cell| features[cell * CHANNELS + 3 * cell] = 1.0);
        FeatureMap { cells: 4, features }
    }

    /// A template whose `i`-th feature is that of the map's cell `of[i]` and is at `at[i]`.
    fn template(at: &[u16], of: &[usize]) -> Template {
        Template {
            crop_from_object: Pose::identity(),
            camera: Camera::new(40.0, 40.0, 15.5, 15.5, 32, 32).unwrap(),
            cells: at.to_vec(),
            features: of.iter().flat_map(|c| map().feature(*c).to_vec()).collect(),
            points: vec![[0.0; 3]; at.len()],
            chromas: vec![],
            appearance: Default::default(),
        }
    }

    #[test]
    fn features_are_found_within_reach_and_not_beyond() {
        let map = map();
        let moved = template(&[5, 10], &[6, 11]);
        assert_eq!((similarity(&moved, &map, 1), similarity(&moved, &map, 0)), (1.0, 0.0));
        assert_eq!(best_near(map.feature(15), &map, 0, 3), (15, 1.0));
        assert_eq!(best_near(map.feature(15), &map, 0, 2).1, 0.0);
        assert_eq!(similarity(&template(&[], &[]), &map, 1), 0.0);
    }

    #[test]
    fn quick_similarity_takes_every_fourth_feature() {
        // The first and the fifth of six features are at their cells, the others far away.
        let template = template(&[0, 1, 2, 4, 15, 5], &[0, 15, 15, 15, 15, 15]);
        assert_eq!(quick_similarity(&template, &map()), 1.0);
        assert_eq!(similarity(&template, &map(), 1), 2.0 / 6.0);
    }

    #[test]
    fn colours_are_compared_cell_by_cell() {
        let mut coloured = template(&[5, 10], &[6, 11]);
        let mut crop = vec![[0.0; 2]; 16];
        assert_eq!(colour_similarity(&coloured, &crop), 0.0, "an object without colours");
        coloured.chromas = vec![[0.4, -0.2], [0.0, 0.0]];
        let other = colour_similarity(&coloured, &crop);
        crop[5] = [0.4, -0.2];
        let same = colour_similarity(&coloured, &crop);
        assert!(same == 1.0 && other < 0.8, "{same} {other}");
    }

    #[test]
    fn only_features_that_choose_each_other_match() {
        // Two features of the template match the same cell: ties go to the first.
        let found = mutual_matches(&template(&[5, 9, 10], &[6, 6, 11]), &map(), 2);
        let pairs: Vec<(usize, usize)> = found.iter().map(|m| (m.index, m.cell)).collect();
        assert_eq!(pairs, [(0, 6), (2, 11)]);
    }
}
