//! How commands open a BOP dataset and choose its targets.

use std::path::Path;

use anyhow::{Context, Result, bail};
use sixfold_bop::{BopDataset, Target};

use crate::ranges::without_duplicates;

/// What stands for every annotated pose in place of a file of targets.
const ALL: &str = "all";

/// A dataset with one of its splits, and the models of one of its folders where one is named.
///
/// # Errors
/// When there is no such dataset, split or folder.
pub fn open(root: &Path, split: &str, models: Option<&str>) -> Result<BopDataset> {
    let dataset = BopDataset::open(root, split)?;
    match models {
        Some(folder) => dataset.with_models(folder).context("--models"),
        None => Ok(dataset),
    }
}

/// The targets of `--targets`: those of a file, with `all` every annotated pose that is at least 10 % visible, without one those that
/// the dataset names.
///
/// # Errors
/// When the file or a scene is missing or broken.
pub fn targets(dataset: &BopDataset, file: Option<&Path>) -> Result<Vec<Target>> {
    let all = file.is_some_and(|file| file == Path::new(ALL));
    Ok(if all { dataset.all_targets()? } else { dataset.targets(file)? })
}

/// The targets of some objects alone, those of whole images spelled out; all of them where `ids` is empty.
///
/// # Errors
/// When a scene is missing or broken.
pub fn of_objects(dataset: &BopDataset, targets: Vec<Target>, ids: &[u32]) -> Result<Vec<Target>> {
    if ids.is_empty() {
        return Ok(targets);
    }
    without_duplicates("--ids", ids)?;
    let mut targets = dataset.object_targets(&targets)?;
    targets.retain(|target| target.object.is_some_and(|o| ids.contains(&o.obj_id)));
    if targets.is_empty() {
        bail!("--ids: none of these objects is a target");
    }
    Ok(targets)
}
