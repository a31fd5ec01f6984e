//! Replaces `by_network`, `learned`, `published`, `regions` and `segmentation` when the feature `network` is off: no object has network
//! descriptors, so these functions are never called.

use sixfold_align::DepthRegion;
use sixfold_estimator::Object;

use crate::estimate::{KnownObject, MttmOptions, Placed, Stages};
use crate::estimator::MttmEstimator;

/// Empty: there is no network.
#[derive(Debug, Clone)]
pub(crate) enum Learned {}

impl MttmEstimator {
    /// Returns the object unchanged.
    pub(crate) fn described(
        &self,
        known: KnownObject,
        _object: &Object,
        _notes: &mut Vec<String>,
    ) -> KnownObject {
        known
    }
}

/// An empty cache.
#[derive(Debug, Default)]
pub(crate) struct RegionCache {}

pub(crate) fn first_matching(
    _scene: &DepthRegion,
    _object: &KnownObject,
    learned: &Learned,
    _cache: &RegionCache,
    _options: &MttmOptions,
    _stages: &mut Stages,
) -> Vec<Placed> {
    match *learned {}
}

pub(crate) fn hypotheses(
    _scene: &DepthRegion,
    _object: &KnownObject,
    learned: &Learned,
    _cache: &RegionCache,
    _options: &MttmOptions,
    _stages: &mut Stages,
) -> Vec<Placed> {
    match *learned {}
}

pub(crate) fn second_matching(
    _scene: &DepthRegion,
    _object: &KnownObject,
    learned: &Learned,
    _options: &MttmOptions,
    _found: &mut [Vec<Placed>],
) {
    match *learned {}
}
