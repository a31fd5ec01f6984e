//! What whole trainings (material in, a model file out) have in common: what they tell on their way, what they come to, and
//! what a card says of where weights come from.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;
use thiserror::Error;

use crate::training_log::TrainingRecord;
use crate::weights::{WeightsError, read_card};

/// What a training tells on its way.
#[derive(Debug, Clone, Copy)]
pub enum News<'a> {
    /// Something that the user should know, such as what begins now.
    Note(&'a str),
    /// Something that is probably wrong.
    Warning(&'a str),
    /// What is made ready before the first step: done, and in all.
    Preparing(usize, usize),
    /// Steps were taken; steps in all.
    Steps(&'a TrainingRecord, u64),
    /// What is measured after the last step: done, and in all.
    Measuring(usize, usize),
}

/// Who hears it; from any thread, one at a time.
pub type Listener<'a> = dyn FnMut(News<'_>) + Send + 'a;

/// What a training came to.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Trained {
    /// The model file.
    pub model: PathBuf,
    /// Steps in all.
    pub steps: u64,
    /// Of training; `None` where a model was only exported.
    pub seconds: Option<f64>,
    /// The last record's losses by name.
    pub losses: BTreeMap<String, f64>,
}

/// Why a training cannot begin, or its model not be exported.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum NotReady {
    /// An option is out of its range.
    #[error("{field}: found {found}, expected {expected}")]
    Option {
        /// Its name.
        field: &'static str,
        /// What it held.
        found: String,
        /// What it should hold.
        expected: &'static str,
    },
    /// There is nothing to export.
    #[error("{}: holds no checkpoint; train first", folder.display())]
    NoCheckpoint {
        /// The training's folder.
        folder: PathBuf,
    },
}

impl NotReady {
    /// An option that is out of its range.
    pub fn option(field: &'static str, found: impl ToString, expected: &'static str) -> NotReady {
        NotReady::Option { field, found: found.to_string(), expected }
    }
}

/// What a card says of the weights that a training began with: how they came about, and theirs in turn.
///
/// # Errors
/// [`WeightsError`] for a file that is no weight file.
pub fn continued_from(init: Option<&Path>) -> Result<serde_json::Value, WeightsError> {
    let Some(file) = init else { return Ok(serde_json::Value::Null) };
    let card = read_card(file)?;
    Ok(serde_json::json!({
        "file": file.display().to_string(),
        "command": card.command,
        "data": card.data,
        "steps": card.steps,
        "seed": card.seed,
        "continued_from": card.extra["continued_from"],
    }))
}
