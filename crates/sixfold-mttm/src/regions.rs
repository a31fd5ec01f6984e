//! The network's predictions for a scene's regions, computed once and shared by all objects of about the same size.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use sixfold_align::DepthRegion;

use crate::learned::Learned;
use crate::model::{Descriptor, Encoded};
use crate::patch::{Patch, REACH};
use crate::roi::{ProposalOptions, Roi, propose};

/// Distance of sampled centres as a fraction of the diameter. The network was trained with regions shifted by up to half of it, and
/// predicts the shift. Chosen by hand; not swept.
const STEP: f64 = 0.3;
/// Largest number of regions for which descriptors are computed; chosen by hand for run time, not swept.
const MOST: usize = 3000;
/// Descriptors are computed for a region only when at least this fraction of its cells is about as far away as its centre. Chosen
/// by hand; not swept.
const MIN_CELLS: f32 = 0.08;
/// Regions per forward pass; does not affect the result.
const AT_A_TIME: usize = 64;
/// Objects whose diameters differ by less than this factor share regions; chosen by hand, not swept.
const RATIO: f64 = 1.25;

/// Threshold of a patch's plane of measured pixels: above it a pixel was measured.
const KNOWN: f32 = 0.5;
/// A cell is as far away as the centre if its relative depth (in halves of the patch's size) is smaller than this. Chosen by hand;
/// not swept.
const AT_CENTRE: f32 = 0.5;

/// The diameter that represents all objects of about the same size.
pub(crate) fn shared_diameter(diameter: f64) -> f64 {
    RATIO.powf((diameter.ln() / RATIO.ln()).round())
}

/// Regions of a scene with their descriptors.
#[derive(Debug)]
pub(crate) struct Regions {
    pub rois: Vec<Roi>,
    pub descriptors: Vec<Descriptor>,
    /// Regions sampled, before those that show too little were left out.
    pub sampled: usize,
    encoded: Vec<Encoded>,
}

impl Regions {
    fn new(scene: &DepthRegion, learned: &Learned) -> Regions {
        let options = ProposalOptions { step: STEP, layer: STEP, most: MOST };
        let sampled = propose(scene, learned.size() / REACH, &options);
        let (size, side) = (learned.size(), learned.model().side());
        let seen: Vec<(Roi, Patch)> = sampled
            .par_iter()
            .map(|roi| (*roi, Patch::of_scene(scene, roi, size, side, |_| true)))
            .filter(|(_, patch)| fraction_at_centre(patch) >= MIN_CELLS)
            .collect();
        let encoded: Vec<Encoded> = seen
            .par_chunks(AT_A_TIME)
            .map(|part| learned.model().encode(&part.iter().map(|p| &p.1).collect::<Vec<_>>()))
            .collect();
        let descriptors: Vec<_> = encoded.par_iter().map(|e| learned.model().describe(e)).collect();
        Regions {
            rois: seen.iter().map(|p| p.0).collect(),
            descriptors: descriptors.concat(),
            sampled: sampled.len(),
            encoded,
        }
    }

    /// Maps of some of the regions.
    ///
    /// # Panics
    /// If `numbers` is empty.
    pub(crate) fn encoded(&self, numbers: &[usize]) -> Encoded {
        let one = |&i: &usize| self.encoded[i / AT_A_TIME].select(&[i % AT_A_TIME]);
        Encoded::joined(&numbers.iter().map(one).collect::<Vec<_>>())
    }
}

/// The fraction of a patch's cells whose depth is within a quarter of its size from the centre's.
fn fraction_at_centre(patch: &Patch) -> f32 {
    let pixels = patch.side * patch.side;
    let (depth, known) = (&patch.values[3 * pixels..4 * pixels], &patch.values[4 * pixels..]);
    let near = depth.iter().zip(known).filter(|(d, k)| **k > KNOWN && d.abs() < AT_CENTRE).count();
    near as f32 / pixels as f32
}

/// Regions of one scene by network and size.
#[derive(Debug, Default)]
pub(crate) struct RegionCache {
    kept: Mutex<BTreeMap<(u64, u64), Arc<Regions>>>,
}

impl RegionCache {
    /// The regions for an object's size; computed on the first call.
    pub(crate) fn of(&self, scene: &DepthRegion, learned: &Learned) -> Arc<Regions> {
        let key = (learned.model().fingerprint(), learned.size().to_bits());
        let known = || self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(regions) = known().get(&key) {
            return regions.clone();
        }
        // The lock is not held meanwhile: two callers may both compute them, with the same result.
        let regions = Arc::new(Regions::new(scene, learned));
        known().insert(key, regions.clone());
        regions
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_sizes_are_near_one_another() {
        for diameter in [0.03, 0.102, 0.145, 0.155, 0.201, 0.261, 0.4] {
            let shared = shared_diameter(diameter);
            assert!((0.89..1.12).contains(&(shared / diameter)), "{diameter} {shared}");
            assert_eq!(shared_diameter(shared * 1.05), shared);
        }
    }

    #[test]
    fn points_far_behind_the_centre_do_not_count() {
        let mut patch = Patch::empty(28);
        for i in 0..100 {
            patch.values[4 * 784 + i] = 1.0;
            patch.values[3 * 784 + i] = if i < 60 { 0.2 } else { 1.0 };
        }
        assert!((fraction_at_centre(&patch) - 60.0 / 784.0).abs() < 1e-6);
    }
}
