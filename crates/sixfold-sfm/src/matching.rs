//! Matches of features in two photographs: mutual nearest neighbours of descriptors. For descriptors that are not invariant to
//! rotation, the second photograph can also be rotated.

use rayon::prelude::*;
use sixfold_geometry::nalgebra::DMatrix;
use sixfold_geometry::{Progress, Vec2};

/// Features of a photograph.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Features {
    /// Their positions, pixels.
    pub points: Vec<Vec2>,
    /// Their descriptors one after the other, each of length 1.
    pub descriptors: Vec<f32>,
    /// Descriptors of the same points in the rotated photograph, for several rotations; may be empty.
    pub rotated: Vec<Vec<f32>>,
}

/// Number of features that choose the rotation of a pair: the first ones of each photograph. Chosen by hand; not swept.
const SCREENED: usize = 512;

impl Features {
    /// Descriptors as columns: of the unrotated photograph, then of the rotated ones.
    fn matrices(&self) -> Vec<DMatrix<f32>> {
        let count = self.points.len().max(1);
        let of = |descriptors: &Vec<f32>| {
            let channels = descriptors.len() / count;
            DMatrix::from_column_slice(channels, descriptors.len() / channels.max(1), descriptors)
        };
        std::iter::once(&self.descriptors).chain(&self.rotated).map(of).collect()
    }
}

/// The matches of two photographs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PairMatches {
    /// Numbers of the photographs, the smaller first.
    pub pair: (usize, usize),
    /// Numbers of the features in both.
    pub matches: Vec<(u32, u32)>,
}

/// Mutual nearest neighbours in every pair of photographs whose descriptors' product is at least `minimum`, with the rotation of
/// the second photograph that gives most matches; `None` when `progress` asked to stop. All descriptors have the same length, and
/// features are sorted best first.
pub fn matched(features: &[Features], minimum: f32, progress: &dyn Progress) -> Option<Vec<PairMatches>> {
    let matrices: Vec<Vec<DMatrix<f32>>> = features.iter().map(Features::matrices).collect();
    let pairs: Vec<(usize, usize)> =
        (0..features.len()).flat_map(|a| (a + 1..features.len()).map(move |b| (a, b))).collect();
    let done = std::sync::atomic::AtomicUsize::new(0);
    let go = std::sync::atomic::AtomicBool::new(true);
    let found: Vec<PairMatches> = pairs
        .par_iter()
        .map(|(a, b)| {
            use std::sync::atomic::Ordering::Relaxed;
            let mut matches = vec![];
            if go.load(Relaxed) {
                matches = best_matches(&matrices[*a][0], &matrices[*b], minimum);
                let count = done.fetch_add(1, Relaxed) + 1;
                if !progress.report(count, pairs.len()) {
                    go.store(false, Relaxed);
                }
            }
            PairMatches { pair: (*a, *b), matches }
        })
        .collect();
    go.into_inner().then_some(found)
}

/// The matches with one of several sets of descriptors of the same points, the one with most among the first features.
fn best_matches(a: &DMatrix<f32>, b: &[DMatrix<f32>], minimum: f32) -> Vec<(u32, u32)> {
    let first = |m: &DMatrix<f32>| m.columns(0, m.ncols().min(SCREENED)).into_owned();
    let best = if b.len() > 1 {
        let few = first(a);
        let counts: Vec<usize> = b.iter().map(|b| mutual(&few, &first(b), minimum).len()).collect();
        // The first one of several with equal counts.
        (0..b.len()).max_by_key(|k| (counts[*k], std::cmp::Reverse(*k))).unwrap_or(0)
    } else {
        0
    };
    mutual(a, &b[best], minimum)
}

fn mutual(a: &DMatrix<f32>, b: &DMatrix<f32>, minimum: f32) -> Vec<(u32, u32)> {
    if a.ncols() == 0 || b.ncols() == 0 || a.nrows() != b.nrows() {
        return vec![];
    }
    // Column j holds the products of b's feature j with all of a's.
    let products = a.transpose() * b;
    let mut best_of_a = vec![(f32::NEG_INFINITY, 0u32); a.ncols()];
    let mut best_of_b = Vec::with_capacity(b.ncols());
    for (j, column) in products.column_iter().enumerate() {
        let mut best = (f32::NEG_INFINITY, 0u32);
        for (i, product) in column.iter().enumerate() {
            if *product > best.0 {
                best = (*product, i as u32);
            }
            if *product > best_of_a[i].0 {
                best_of_a[i] = (*product, j as u32);
            }
        }
        best_of_b.push(best);
    }
    let chosen = |(i, (product, j)): (usize, &(f32, u32))| {
        let mutual = best_of_b[*j as usize].1 == i as u32 && *product >= minimum;
        mutual.then_some((i as u32, *j))
    };
    best_of_a.iter().enumerate().filter_map(chosen).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn features(descriptors: &[[f32; 3]]) -> Features {
        let points = vec![Vec2::zeros(); descriptors.len()];
        Features { points, descriptors: descriptors.concat(), rotated: vec![] }
    }

    #[test]
    fn only_features_that_choose_each_other_match() {
        let a = features(&[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.6, 0.8, 0.0]]);
        let b = features(&[[0.0, 0.0, 1.0], [0.9, 0.436, 0.0], [0.0, 1.0, 0.0]]);
        let found = matched(&[a.clone(), b, Features::default()], 0.5, &()).unwrap();
        assert_eq!(found.len(), 3);
        assert_eq!((found[0].pair, &found[0].matches), ((0, 1), &vec![(0, 1), (1, 2)]));
        assert!(found[1].matches.is_empty() && found[2].matches.is_empty());
        assert!(matched(&[a.clone(), a], 0.5, &|_: usize, _: usize| false).is_none());
    }

    #[test]
    fn the_rotation_with_most_matches_is_used() {
        let a = features(&[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
        let mut b = features(&[[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]);
        assert_eq!(matched(&[a.clone(), b.clone()], 0.5, &()).unwrap()[0].matches, [(1, 1)]);
        b.rotated =
            vec![[[0.0f32; 3]; 3].concat(), [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]].concat()];
        assert_eq!(matched(&[a, b], 0.5, &()).unwrap()[0].matches, [(0, 1), (2, 0)]);
    }
}
