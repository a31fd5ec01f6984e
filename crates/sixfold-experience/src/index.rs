//! Exact search for the experiences nearest to a feature, over a copy of all features in memory.
//!
//! In 256 dimensions a tree is not faster than exhaustive search. All features are first compared as 16-bit integers, whose
//! distances have a bounded error; most rows are rejected after a quarter of their numbers. The few that may be among the nearest
//! are then compared in full. The result is the same as that of a plain search.

use rayon::prelude::*;

use super::{ExperienceStore, Position, StoreError};
use crate::FEATURE;

/// Quantisation steps of the integers from 0 to 1. 256 squared differences of twice this fit into 32 bits.
const STEPS: f32 = 1024.0;
/// Largest distance between a feature and its quantised form: half a step in every dimension.
const ROUNDING: f64 = 0.5 / STEPS as f64 * 16.0;
/// Numbers of a row after which it may be rejected.
const FIRST: usize = 64;
/// Features per parallel task.
const BLOCK: usize = 2048;

/// A retrieved experience.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Number of the experience.
    pub experience: i64,
    /// The copy's rotation about the optical axis, radians.
    pub angle: f64,
    /// Euclidean distance of the features.
    pub distance: f64,
}

/// All features of a store that were computed by one network.
#[derive(Debug, Clone)]
pub struct FeatureIndex {
    network: String,
    /// Experience and angle of every feature.
    owners: Vec<(i64, f64)>,
    exact: Vec<f32>,
    coarse: Vec<i16>,
    position: Position,
    /// Experiences with an invalid feature.
    unusable: Vec<i64>,
}

impl FeatureIndex {
    /// An empty index for the features of one network ([`crate::FeatureExtractor::fingerprint`]).
    pub fn new(network: &str) -> FeatureIndex {
        FeatureIndex {
            network: network.to_owned(),
            owners: vec![],
            exact: vec![],
            coarse: vec![],
            position: Position::default(),
            unusable: vec![],
        }
    }

    /// Experiences that have an invalid feature for some or all of their copies and are not found by these; each once.
    pub fn take_unusable(&mut self) -> Vec<i64> {
        std::mem::take(&mut self.unusable)
    }

    /// Features in the index, in-plane copies included.
    pub fn len(&self) -> usize {
        self.owners.len()
    }

    /// Whether the index is empty.
    pub fn is_empty(&self) -> bool {
        self.owners.is_empty()
    }

    /// Applies the changes of the store since the last call.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn refresh(&mut self, store: &dyn ExperienceStore) -> Result<(), StoreError> {
        let changes = store.changes(self.position)?;
        for f in changes.features {
            if f.network != self.network {
                continue;
            }
            let finite = f.angle.is_finite() && f.feature.iter().all(|v| v.is_finite());
            if finite && f.feature.len() == FEATURE {
                self.insert(f.experience, f.angle, &f.feature);
            } else if !self.unusable.contains(&f.experience) {
                self.unusable.push(f.experience);
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
    /// If `feature` does not have 256 numbers. They should be between -1 and 1, as the networks' are.
    pub fn insert(&mut self, experience: i64, angle: f64, feature: &[f32]) {
        assert_eq!(feature.len(), FEATURE);
        self.owners.push((experience, angle));
        self.exact.extend(feature);
        self.coarse.extend(feature.iter().map(|v| quantise(*v)));
    }

    /// The `count` nearest features, nearest first; ties in the order in which they were stored. `wanted` selects the experiences
    /// that count.
    pub fn nearest(&self, feature: &[f32], count: usize, wanted: impl Fn(i64) -> bool + Sync) -> Vec<Match> {
        if count == 0 || self.is_empty() || feature.len() != FEATURE {
            return vec![];
        }
        let query: Vec<i16> = feature.iter().map(|v| quantise(*v)).collect();
        // A feature that is further than the count-th nearest of its block by more than both rounding errors is not among the
        // nearest.
        let mut candidates: Vec<(usize, i32)> = self
            .coarse
            .par_chunks(BLOCK * FEATURE)
            .enumerate()
            .flat_map_iter(|(block, rows)| {
                let mut near = Nearest::new(count);
                for (i, row) in rows.chunks_exact(FEATURE).enumerate() {
                    let first = squared(&row[..FIRST], &query[..FIRST]);
                    if first > near.limit {
                        continue;
                    }
                    let all = first + squared(&row[FIRST..], &query[FIRST..]);
                    let number = block * BLOCK + i;
                    if all <= near.limit && wanted(self.owners[number].0) {
                        near.take(number, all);
                    }
                }
                near.candidates
            })
            .collect();
        let mut distances: Vec<i32> = candidates.iter().map(|c| c.1).collect();
        if distances.is_empty() {
            return vec![];
        }
        let last = count.min(distances.len()) - 1;
        let limit = reach(*distances.select_nth_unstable(last).1);
        candidates.retain(|c| c.1 <= limit);
        let mut found: Vec<(usize, f64)> = candidates
            .into_iter()
            .map(|(i, _)| {
                let row = &self.exact[i * FEATURE..(i + 1) * FEATURE];
                (i, distance(row, feature))
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

/// Euclidean distance of two features.
pub(super) fn distance(a: &[f32], b: &[f32]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    sum.sqrt()
}

/// The candidates of a block.
struct Nearest {
    count: usize,
    /// The smallest squared distances so far, smallest first, `count` at most.
    best: Vec<i32>,
    /// Features further than this cannot be among the nearest.
    limit: i32,
    candidates: Vec<(usize, i32)>,
}

impl Nearest {
    fn new(count: usize) -> Nearest {
        Nearest { count, best: vec![], limit: i32::MAX, candidates: vec![] }
    }

    fn take(&mut self, number: usize, distance: i32) {
        self.candidates.push((number, distance));
        let place = self.best.partition_point(|d| *d <= distance);
        self.best.insert(place, distance);
        self.best.truncate(self.count);
        if self.best.len() == self.count {
            self.limit = reach(self.best[self.count - 1]);
        }
    }
}

/// The largest squared integer distance of a feature that may still be nearer than one at `squared`.
fn reach(squared: i32) -> i32 {
    let distance = f64::from(squared).sqrt() + 4.0 * ROUNDING * f64::from(STEPS) + 1.0;
    (distance * distance).min(f64::from(i32::MAX)) as i32
}

fn quantise(v: f32) -> i16 {
    (v * STEPS).round().clamp(-STEPS, STEPS) as i16
}

/// Squared distance of two rows of integers.
fn squared(a: &[i16], b: &[i16]) -> i32 {
    a.iter()
        .zip(b)
        .map(|(a, b)| {
            let d = a.wrapping_sub(*b);
            i32::from(d) * i32::from(d)
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn it_agrees_with_a_brute_force_search() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut draw = || -> Vec<f32> { (0..FEATURE).map(|_| random.random_range(-1.0f32..1.0)).collect() };
        let mut index = FeatureIndex::new("n");
        let base = draw();
        let features: Vec<Vec<f32>> = (0..3000)
            .map(|k| {
                // Many features near each other, so that rounding would change the order.
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
