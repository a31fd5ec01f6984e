//! In the place of `colour_poses.rs` when the feature `networks` is off.

use std::collections::BTreeMap;

use anyhow::{Result, bail};
use sixfold_bop::{BopDataset, Target};
use sixfold_shell::pictures::Pictures;

use super::arguments::DemoArguments;
use super::colour::Colour;
use super::samples::Known;
use crate::commands::without_networks::MESSAGE;

/// No poses, and why; an error where weights were given.
pub(super) fn run(
    a: &DemoArguments,
    _out: &mut Pictures,
    _dataset: &BopDataset,
    _targets: &[Target],
    _known: &BTreeMap<u32, Known>,
) -> Result<Colour> {
    if a.weights.is_some() || a.detector.is_some() {
        bail!("--weights and --detector: {MESSAGE}");
    }
    Ok(Colour::none(None, MESSAGE.into()))
}
