//! In the place of `by_network`, `learned` and `regions` when the feature `network` is off: no object is known to a network, so
//! none of this is ever called.

use sixfold_match::Scene;

use crate::estimate::{EstimateOptions, KnownObject, Placed, Stages};

/// There is none.
#[derive(Debug, Clone)]
pub(crate) enum Learned {}

/// Keeps nothing.
#[derive(Debug, Default)]
pub(crate) struct RegionCache;

pub(crate) fn first_matching(
    _scene: &Scene,
    _object: &KnownObject,
    learned: &Learned,
    _cache: &RegionCache,
    _options: &EstimateOptions,
    _stages: &mut Stages,
) -> Vec<Placed> {
    match *learned {}
}

pub(crate) fn second_matching(
    _scene: &Scene,
    _object: &KnownObject,
    learned: &Learned,
    _options: &EstimateOptions,
    _found: &mut [Vec<Placed>],
) {
    match *learned {}
}
