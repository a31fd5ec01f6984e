//! The nearest experiences to a feature, exactly, over a copy of all features in memory.
//!
//! In 256 dimensions a tree finds nothing faster than looking at everything. Everything is looked at twice: first in 8-bit
//! numbers, a quarter of the memory to read, which gives each distance within known bounds; then the few that may be among
//! the nearest in full. The result is the same as of a plain search.

use rayon::prelude::*;

use super::{ExperienceStore, Position, StoreError};
use crate::networks::FEATURE;

/// Steps of the 8-bit numbers for values from -1 to 1.
const STEPS: f32 = 127.0;
/// No 8-bit feature is further than this from its own: half a step in every dimension.
const ROUNDING: f32 = 0.5 / STEPS * 16.0;
/// Features that one task looks at.
const BLOCK: usize = 2048;

/// A retrieved experience.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Number of the experience.
    pub experience: i64,
    /// The copy's turn about the optical axis, radians.
    pub angle: f64,
    /// Euclidean distance of the features.
    pub distance: f64,
}

/// All features of a store that one network made.
#[derive(Debug, Clone)]
pub struct FeatureIndex {
    network: String,
    /// Experience and angle of every feature.
    owners: Vec<(i64, f64)>,
    exact: Vec<f32>,
    coarse: Vec<i8>,
    position: Position,
}

impl FeatureIndex {
    /// An empty index for the features of one network ([`crate::model::DgcmModel::fingerprint`]).
    pub fn new(network: &str) -> FeatureIndex {
        FeatureIndex {
            network: network.to_owned(),
            owners: vec![],
            exact: vec![],
            coarse: vec![],
            position: Position::default(),
        }
    }

    /// Features in the index, in-plane copies included.
    pub fn len(&self) -> usize {
        self.owners.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.owners.is_empty()
    }

    /// Takes over what has changed in the store.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn refresh(&mut self, store: &dyn ExperienceStore) -> Result<(), StoreError> {
        let changes = store.changes(self.position)?;
        for f in changes.features {
            if f.network == self.network && f.feature.len() == FEATURE {
                self.insert(f.experience, f.angle, &f.feature);
            }
        }
        if !changes.forgotten.is_empty() {
            let forgotten: std::collections::HashSet<i64> = changes.forgotten.into_iter().collect();
            let keep: Vec<usize> =
                (0..self.len()).filter(|&i| !forgotten.contains(&self.owners[i].0)).collect();
            if keep.len() < self.len() {
                self.exact =
                    keep.iter().flat_map(|&i| self.exact[i * FEATURE..(i + 1) * FEATURE].to_vec()).collect();
                self.coarse =
                    keep.iter().flat_map(|&i| self.coarse[i * FEATURE..(i + 1) * FEATURE].to_vec()).collect();
                self.owners = keep.iter().map(|&i| self.owners[i]).collect();
            }
        }
        self.position = changes.position;
        Ok(())
    }

    /// Adds one feature.
    ///
    /// # Panics
    /// If it has not 256 numbers.
    pub fn insert(&mut self, experience: i64, angle: f64, feature: &[f32]) {
        assert_eq!(feature.len(), FEATURE);
        self.owners.push((experience, angle));
        self.exact.extend(feature);
        self.coarse.extend(feature.iter().map(|v| quantise(*v)));
    }

    /// The `count` nearest features, nearest first; equal ones in the order in which they were stored. `wanted` says which
    /// experiences count.
    pub fn nearest(&self, feature: &[f32], count: usize, wanted: impl Fn(i64) -> bool + Sync) -> Vec<Match> {
        if count == 0 || self.is_empty() || feature.len() != FEATURE {
            return vec![];
        }
        let query: Vec<i8> = feature.iter().map(|v| quantise(*v)).collect();
        let coarse: Vec<f32> = self
            .coarse
            .par_chunks(BLOCK * FEATURE)
            .flat_map_iter(|block| block.chunks_exact(FEATURE).map(|row| coarse_distance(row, &query)))
            .collect();
        // The count-th smallest upper bound: whatever has a larger lower bound is not among the nearest.
        let mut bounds: Vec<f32> =
            coarse.iter().zip(&self.owners).filter(|(_, o)| wanted(o.0)).map(|(d, _)| *d).collect();
        if bounds.is_empty() {
            return vec![];
        }
        let last = count.min(bounds.len()) - 1;
        let (_, kth, _) = bounds.select_nth_unstable_by(last, f32::total_cmp);
        let limit = *kth + 4.0 * ROUNDING + 1e-3;
        let mut found: Vec<(usize, f64)> = coarse
            .iter()
            .enumerate()
            .filter(|(i, d)| **d <= limit && wanted(self.owners[*i].0))
            .map(|(i, _)| {
                let row = &self.exact[i * FEATURE..(i + 1) * FEATURE];
                let sum: f64 = row.iter().zip(feature).map(|(a, b)| f64::from(a - b).powi(2)).sum();
                (i, sum.sqrt())
            })
            .collect();
        found.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        found
            .into_iter()
            .take(count)
            .map(|(i, distance)| Match { experience: self.owners[i].0, angle: self.owners[i].1, distance })
            .collect()
    }
}

fn quantise(v: f32) -> i8 {
    (v * STEPS).round().clamp(-127.0, 127.0) as i8
}

/// Distance of two 8-bit features in the units of the full ones.
fn coarse_distance(a: &[i8], b: &[i8]) -> f32 {
    let sum: i32 = a
        .iter()
        .zip(b)
        .map(|(a, b)| {
            let d = i16::from(*a) - i16::from(*b);
            i32::from(d) * i32::from(d)
        })
        .sum();
    (sum as f32).sqrt() / STEPS
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn it_finds_what_a_plain_search_finds() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut draw = || -> Vec<f32> { (0..FEATURE).map(|_| random.random_range(-1.0f32..1.0)).collect() };
        let mut index = FeatureIndex::new("n");
        let base = draw();
        let features: Vec<Vec<f32>> = (0..3000)
            .map(|k| {
                // Many near each other, so that rounding would change the order.
                let noise = draw();
                base.iter()
                    .zip(noise)
                    .map(|(b, n)| (b + 0.02 * (1.0 + (k % 7) as f32) * n).clamp(-1.0, 1.0))
                    .collect()
            })
            .collect();
        for (k, f) in features.iter().enumerate() {
            index.insert(k as i64, 0.0, f);
        }
        let all: [&(dyn Fn(i64) -> bool + Sync); 2] = [&|_| true, &|k| k % 3 == 0];
        for wanted in all {
            let query = &features[17];
            let mut plain: Vec<(f64, i64)> = features
                .iter()
                .enumerate()
                .filter(|(k, _)| wanted(*k as i64))
                .map(|(k, f)| {
                    let sum: f64 = f.iter().zip(query).map(|(a, b)| f64::from(a - b).powi(2)).sum();
                    (sum.sqrt(), k as i64)
                })
                .collect();
            plain.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            let found = index.nearest(query, 10, wanted);
            assert_eq!(
                found.iter().map(|m| m.experience).collect::<Vec<_>>(),
                plain[..10].iter().map(|p| p.1).collect::<Vec<_>>()
            );
            assert!((found[9].distance - plain[9].0).abs() < 1e-9);
        }
        assert!(index.nearest(&features[0], 0, |_| true).is_empty());
        assert!(index.nearest(&features[0], 5, |_| false).is_empty());
        assert!(FeatureIndex::new("n").nearest(&features[0], 3, |_| true).is_empty());
    }
}
