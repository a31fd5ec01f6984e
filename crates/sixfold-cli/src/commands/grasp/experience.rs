//! The network and the store that grasps from experience need.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use sixfold_dgcm::model::DgcmModel;
use sixfold_dgcm::store::{SqliteStore, StoreError};
use sixfold_dgcm::transfer::Memory;

/// Which network encodes objects.
#[derive(Debug, Args)]
pub(crate) struct NetworkArguments {
    /// Trained network for experience: a file that `sixfold train dgcm` wrote
    #[arg(long, value_name = "FILE", env = "SIXFOLD_DGCM", default_value = "weights/dgcm.safetensors")]
    pub weights: PathBuf,
}

/// Reads the network.
pub(super) fn model(a: &NetworkArguments) -> Result<DgcmModel> {
    if !a.weights.exists() {
        bail!(
            "--weights: {} is not there; give a file that `sixfold train dgcm` wrote (the one that comes with Sixfold is weights/dgcm.safetensors in its folder)",
            a.weights.display()
        );
    }
    DgcmModel::load(&a.weights).context("--weights")
}

/// The experiences of a store that is there, for a network.
pub(super) fn memory(file: &Path, model: &DgcmModel) -> Result<Memory> {
    let memory = Memory::new(Box::new(SqliteStore::open(file)?), model)?;
    if memory.index().is_empty() && !memory.is_empty() {
        eprintln!(
            "note: the {} experiences in {} were encoded by another network; `sixfold grasp store refresh` encodes them anew",
            memory.len(),
            file.display()
        );
    }
    Ok(memory)
}

/// The experiences of a store, made where there is none.
pub(super) fn new_memory(file: &Path, model: &DgcmModel) -> Result<Memory, StoreError> {
    Memory::new(Box::new(SqliteStore::create(file)?), model)
}

/// Seconds since 1970.
pub(super) fn now() -> i64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |d| d.as_secs() as i64)
}
