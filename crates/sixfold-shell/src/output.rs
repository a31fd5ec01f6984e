//! What a command prints: a table for people, JSON for scripts.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Args;
use serde::Serialize;

/// `--json`: to the screen, or to a file.
#[derive(Debug, Default, Args, Clone)]
pub struct JsonArguments {
    /// Print the result as JSON, or write it to FILE and keep the table
    #[arg(long, global = true, value_name = "FILE", num_args = 0..=1)]
    json: Option<Option<PathBuf>>,
}

impl JsonArguments {
    /// Whether JSON replaces the table on the screen.
    pub(crate) fn on_screen(&self) -> bool {
        matches!(self.json, Some(None))
    }

    /// The file JSON goes to.
    pub fn file(&self) -> Option<&PathBuf> {
        self.json.as_ref().and_then(Option::as_ref)
    }
}

/// Prints JSON or calls `table`, and writes the JSON file if one was requested.
pub fn report(json: &JsonArguments, value: &impl Serialize, table: impl FnOnce()) -> Result<()> {
    let text = serde_json::to_string_pretty(value).context("cannot write the result as JSON")?;
    if let Some(path) = json.file() {
        write_atomically(path, text.as_bytes())?;
    }
    if json.on_screen() {
        println!("{text}");
    } else {
        table();
    }
    Ok(())
}

/// Writes a file so that no process reads half of it ([`sixfold_io::write_atomically`]), with the file's name in the
/// error.
///
/// # Errors
/// The system's error.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<()> {
    sixfold_io::write_atomically(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}
