//! The network and the store for grasps from experience.

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
    /// Network that matches experiences: a file that `sixfold train dgcm` wrote (default: the one that comes with Sixfold,
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

/// Parses the location of a store on the command line.
pub fn store_place() -> impl TypedValueParser<Value = StorePlace> {
    OsStringValueParser::new().try_map(|text| match text.is_empty() {
        true => Err("found nothing, expected a file or the address of a server"),
        false => Ok(StorePlace::from(text)),
    })
}

/// The experiences of an existing store, for a network.
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

/// Reports the rows that could not be read and were left out, and how to remove them.
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

/// The local file of a writable store: the store itself, or the robot's copy of a store on a server, which is in `out` by
/// default.
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

/// Opens a store, or creates it. For a store on a server, `file` is the local copy, so that work continues while the server
/// is unreachable.
pub(crate) fn writable_store(place: &StorePlace, file: &Path) -> Result<Box<dyn ExperienceStore + Send>> {
    Ok(place.create_with_outbox(file, |notice| eprintln!("note: {notice}"))?)
}

/// Seconds since 1970.
pub fn now() -> i64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |d| d.as_secs() as i64)
}
