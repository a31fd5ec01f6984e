//! Replaces `colour_poses.rs` when the feature `networks` is off.

use std::collections::BTreeMap;

use crate::pictures::Pictures;
use anyhow::{Result, bail};
use sixfold_bop::{BopDataset, Target};

use super::DemoFiles;
use super::colour::Colour;
use super::samples::Known;
use crate::WITHOUT_NETWORKS;

/// No poses and the reason; an error if weights were given.
pub(super) fn run(
    files: &DemoFiles<'_>,
    _out: &mut Pictures,
    _dataset: &BopDataset,
    _targets: &[Target],
    _known: &BTreeMap<u32, Known>,
) -> Result<Colour> {
    if files.weights.is_some() || files.detector.is_some() {
        bail!("--weights and --detector: {WITHOUT_NETWORKS}");
    }
    Ok(Colour::none(None, WITHOUT_NETWORKS.into()))
}
