//! The network and the store that grasps from experience need.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use sixfold_dgcm::model::DgcmModel;
use sixfold_dgcm::transfer::Memory;
use sixfold_experience::StorePlace;

/// Which network encodes objects.
#[derive(Debug, Args)]
pub struct NetworkArguments {
    /// Trained network for experience: a file that `sixfold train dgcm` wrote
    #[arg(long, value_name = "FILE", env = "SIXFOLD_DGCM", default_value = "weights/dgcm.safetensors")]
    pub weights: PathBuf,
}

/// Where experiences wait for a server.
#[derive(Debug, Default, Args)]
pub struct OutboxArguments {
    /// With a server as --experiences: file of this robot's copy of its store, in which new experiences wait while it is away
    /// (default: outbox.db in --out)
    #[arg(long, value_name = "FILE")]
    pub outbox: Option<PathBuf>,
}

/// Reads the network.
pub fn model(a: &NetworkArguments) -> Result<DgcmModel> {
    if !a.weights.exists() {
        bail!(
            "--weights: {} is not there; give a file that `sixfold train dgcm` wrote (the one that comes with Sixfold is weights/dgcm.safetensors in its folder)",
            a.weights.display()
        );
    }
    DgcmModel::load(&a.weights).context("--weights")
}

/// The experiences of a store that is there, for a network.
pub fn memory(place: &StorePlace, model: &DgcmModel) -> Result<Memory> {
    let memory = Memory::new(place.open()?, model)?;
    if memory.index().is_empty() && !memory.is_empty() {
        eprintln!(
            "note: the {} experiences in {place} were encoded by another network; `sixfold grasp store refresh` encodes them again",
            memory.len()
        );
    }
    Ok(memory)
}

/// The experiences of a store, made where there is none. When it lies on a server, a file in `out` is between, so that the
/// server may go away.
pub fn new_memory(
    place: &StorePlace,
    outbox: &OutboxArguments,
    out: &Path,
    model: &DgcmModel,
) -> Result<Memory> {
    let file = match (&outbox.outbox, place) {
        (Some(file), StorePlace::File(_)) => {
            bail!(
                "--outbox: {} is for --experiences on a server, postgres://user@host/database",
                file.display()
            )
        }
        (Some(file), _) => file.clone(),
        (None, _) => out.join("outbox.db"),
    };
    let store = place.create_with_outbox(&file, |notice| eprintln!("note: {notice}"))?;
    Ok(Memory::new(store, model)?)
}

/// Seconds since 1970.
pub fn now() -> i64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |d| d.as_secs() as i64)
}
