//! The network and the store that grasps from experience need.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use clap::builder::{OsStringValueParser, TypedValueParser};
use sixfold_dgcm::model::DgcmModel;
use sixfold_dgcm::transfer::Memory;
use sixfold_experience::{ExperienceStore, StoreError, StorePlace};

use crate::shipped::DGCM;

/// Which network encodes objects.
#[derive(Debug, Args)]
pub struct NetworkArguments {
    /// Trained network for experience: a file that `sixfold train dgcm` wrote (default: the one that comes with Sixfold,
    /// docs/install.md)
    #[arg(long, value_name = "FILE", env = "SIXFOLD_DGCM")]
    pub weights: Option<PathBuf>,
}

/// Where experiences wait for a server.
#[derive(Debug, Default, Args)]
pub struct OutboxArguments {
    /// With a server as --experiences: file of the local copy, which keeps new experiences while the server is unreachable
    /// (default: outbox.db in --out)
    #[arg(long, value_name = "FILE")]
    pub outbox: Option<PathBuf>,
}

/// Reads the network.
pub fn model(a: &NetworkArguments) -> Result<DgcmModel> {
    let Some(weights) = &a.weights else {
        return Ok(DgcmModel::load(&DGCM.find()?)?);
    };
    if !weights.exists() {
        bail!(
            "--weights: {} is not there; give a file that `sixfold train dgcm` wrote, or leave --weights out for the one that comes with Sixfold",
            weights.display()
        );
    }
    DgcmModel::load(weights).context("--weights")
}

/// Parses a store's place on the command line.
pub fn store_place() -> impl TypedValueParser<Value = StorePlace> {
    OsStringValueParser::new().try_map(|text| match text.is_empty() {
        true => Err("found nothing, expected a file or the address of a server"),
        false => Ok(StorePlace::from(text)),
    })
}

/// The experiences of a store that is there, for a network.
pub fn memory(place: &StorePlace, model: &DgcmModel) -> Result<Memory> {
    let mut memory = Memory::new(place.open()?, model)?;
    note_left_out(&memory.take_left_out(), &place.to_string());
    if memory.index().is_empty() && !memory.is_empty() {
        eprintln!(
            "note: the {} experiences in {place} were encoded by another network; `sixfold grasp store refresh` encodes them again",
            memory.len()
        );
    }
    Ok(memory)
}

/// Names what could not be read and was left out, and how it is removed.
pub fn note_left_out(errors: &[StoreError], place: &str) {
    for error in errors {
        match error {
            StoreError::Field { id, .. } => {
                eprintln!(
                    "note: {error}; it is left out, `sixfold grasp store forget {place} {id}` removes it"
                );
            }
            StoreError::Attempt { id, .. } => {
                eprintln!(
                    "note: {error}; it is left out, `sixfold grasp store forget {place} --attempt {id}` removes it"
                );
            }
            _ => eprintln!("note: {error}; it is left out"),
        }
    }
}

/// The file in which a store that can be written is on this machine: its own, or that of the robot's copy, which is in `out`
/// where nothing else is said.
pub(crate) fn local_file(place: &StorePlace, outbox: &OutboxArguments, out: &Path) -> Result<PathBuf> {
    match (&outbox.outbox, place) {
        (Some(file), StorePlace::File(_)) => bail!(
            "--outbox: {} is for --experiences on a server, postgres://user@host/database",
            file.display()
        ),
        (None, StorePlace::File(file)) => Ok(file.clone()),
        (Some(file), _) => Ok(file.clone()),
        (None, _) => Ok(out.join("outbox.db")),
    }
}

/// A store, made where there is none. When it lies on a server, `file` is between, so that the server may go away.
pub(crate) fn writable_store(place: &StorePlace, file: &Path) -> Result<Box<dyn ExperienceStore + Send>> {
    Ok(place.create_with_outbox(file, |notice| eprintln!("note: {notice}"))?)
}

/// Seconds since 1970.
pub fn now() -> i64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |d| d.as_secs() as i64)
}
