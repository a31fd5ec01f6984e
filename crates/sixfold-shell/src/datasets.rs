//! How commands open a BOP dataset and choose its targets.

use std::path::Path;

use anyhow::{Context, Result, bail};
use sixfold_bop::{BopDataset, Target};

use crate::ranges::without_duplicates;

/// The value of `--targets` that selects every annotated pose instead of a file.
const ALL: &str = "all";

/// Opens a dataset with one of its splits, and with the models of the folder `models` if given.
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

/// The targets of `--targets`: from a file; with `all`, every annotated pose that is at least 10 % visible; without the option, the
/// dataset's own targets.
///
/// # Errors
/// When the file or a scene is missing or broken.
pub fn targets(dataset: &BopDataset, file: Option<&Path>) -> Result<Vec<Target>> {
    let all = file.is_some_and(|file| file == Path::new(ALL));
    Ok(if all { dataset.all_targets()? } else { dataset.targets(file)? })
}

/// The targets of the objects `ids` only, those of whole images expanded to objects; all targets where `ids` is empty.
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
