//! What the network predicts for a scene's regions, kept for all objects of about the same size: they are described once.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use sixfold_align::DepthRegion;

use crate::learned::Learned;
use crate::model::{Descriptor, Encoded};
use crate::patch::{Patch, REACH};
use crate::roi::{ProposalOptions, Roi, propose};

/// Distance of sampled centres as a fraction of the diameter. The network was trained with regions that are off by half of it, and
/// says how far they are off. Chosen by hand; not swept.
const STEP: f64 = 0.3;
/// Most regions that are described; chosen by hand for the time that it takes, not swept.
const MOST: usize = 3000;
/// A region is worth describing when so many of its cells show something about as far away as its centre. Chosen by hand;
/// not swept.
const MIN_CELLS: f32 = 0.08;
/// Regions that go through the network at a time; of no influence on the result.
const AT_A_TIME: usize = 64;
/// Objects whose diameters differ by less than this factor share regions; chosen by hand, not swept.
const RATIO: f64 = 1.25;

/// What a patch holds for "measured" lies above this, for "not measured" below.
const KNOWN: f32 = 0.5;
/// A cell shows something as far away as the centre where its depth (in halves of the patch's size) is less than this off it.
/// Chosen by hand; not swept.
const AT_CENTRE: f32 = 0.5;

/// The diameter that stands for all about as large.
pub(crate) fn shared_diameter(diameter: f64) -> f64 {
    RATIO.powf((diameter.ln() / RATIO.ln()).round())
}

/// Regions of a scene as the network describes them.
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
            .filter(|(_, patch)| share_at_centre(patch) >= MIN_CELLS)
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
    /// For no numbers.
    pub(crate) fn encoded(&self, numbers: &[usize]) -> Encoded {
        let one = |&i: &usize| self.encoded[i / AT_A_TIME].select(&[i % AT_A_TIME]);
        Encoded::joined(&numbers.iter().map(one).collect::<Vec<_>>())
    }
}

/// The fraction of a patch's cells that show something within a quarter of its size of the centre.
fn share_at_centre(patch: &Patch) -> f32 {
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
    /// Those for an object's size; described now if they are asked for the first time.
    pub(crate) fn of(&self, scene: &DepthRegion, learned: &Learned) -> Arc<Regions> {
        let key = (learned.model().fingerprint(), learned.size().to_bits());
        let known = || self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(regions) = known().get(&key) {
            return regions.clone();
        }
        // The lock is not held meanwhile: two callers may both describe them, with the same outcome.
        let regions = Arc::new(Regions::new(scene, learned));
        known().insert(key, regions.clone());
        regions
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_that_share_are_near_one_another() {
        for diameter in [0.03, 0.102, 0.145, 0.155, 0.201, 0.261, 0.4] {
            let shared = shared_diameter(diameter);
            assert!((0.89..1.12).contains(&(shared / diameter)), "{diameter} {shared}");
            assert_eq!(shared_diameter(shared * 1.05), shared);
        }
    }

    #[test]
    fn what_is_far_behind_the_centre_does_not_count() {
        let mut patch = Patch::empty(28);
        for i in 0..100 {
            patch.values[4 * 784 + i] = 1.0;
            patch.values[3 * 784 + i] = if i < 60 { 0.2 } else { 1.0 };
        }
        assert!((share_at_centre(&patch) - 60.0 / 784.0).abs() < 1e-6);
    }
}
