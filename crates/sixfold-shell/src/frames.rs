//! The frames of a dataset that a command leaves out.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::{Context, Result};
use sixfold_bop::BopDataset;

/// The frames of the file of `--except`, as scene and image: none without one.
pub fn excepted(dataset: &BopDataset, file: Option<&Path>) -> Result<BTreeSet<(u32, u32)>> {
    let Some(file) = file else { return Ok(BTreeSet::new()) };
    let frames = dataset.targets(Some(file)).context("--except")?;
    Ok(frames.iter().map(|t| (t.scene_id, t.im_id)).collect())
}
