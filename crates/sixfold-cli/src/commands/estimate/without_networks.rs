//! Replaces `networks.rs` when the feature `networks` is off: options that need a network are refused.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use sixfold_estimator::Region;
use sixfold_geometry::RgbImage;
use sixfold_mttm::{MaskSource, MatchedBy, MttmEstimator};
use sixfold_runner::RegionSource;
use sixfold_shell::WITHOUT_NETWORKS;

/// The default of `--matcher` for `--method mttm`.
pub(super) const DEFAULT_MATCHER: &str = "points";

pub(super) fn objects_file(_weights: &Path) -> Option<PathBuf> {
    None
}

pub(super) fn detected(_weights: &Path, _image: &RgbImage, _id: u32) -> Result<Option<Region>> {
    bail!("--detector: {WITHOUT_NETWORKS}")
}

pub(super) fn regions(_weights: &Path, _ids: BTreeSet<u32>) -> Result<RegionSource> {
    bail!("--detector: {WITHOUT_NETWORKS}")
}

/// The same estimator, if it matches by points only.
pub(super) fn with_network(estimator: MttmEstimator, weights: Option<&Path>) -> Result<MttmEstimator> {
    if estimator.options.masks == MaskSource::Network {
        bail!("--masks network: {WITHOUT_NETWORKS}");
    }
    match (estimator.options.matched_by, weights) {
        (_, Some(_)) => bail!("--weights: {WITHOUT_NETWORKS}"),
        (MatchedBy::Network, None) => bail!("--matcher network: {WITHOUT_NETWORKS}"),
        (MatchedBy::Both, None) => bail!("--matcher both: {WITHOUT_NETWORKS}"),
        (MatchedBy::Points, None) => Ok(estimator),
    }
}
