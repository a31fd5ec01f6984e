//! What a result file was made with, kept beside it so that a later run resumes with the same.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sixfold_io::{fnv1a, write_atomically};

use crate::error::{OtherOptions, RunError};

/// The options that decide about a run's results, by name. An option that names a file counts by the file's contents too.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct RunOptions(pub BTreeMap<String, String>);

impl RunOptions {
    /// Adds an option.
    pub fn add(&mut self, name: &str, value: &str) {
        self.0.insert(name.to_owned(), value.to_owned());
        let path = Path::new(value);
        if path.is_file()
            && let Ok(bytes) = std::fs::read(path)
        {
            self.0.insert(format!("{name} (contents)"), format!("{:016x}", fnv1a(&bytes)));
        }
    }

    /// The first option that differs, with both values.
    fn difference(&self, before: &RunOptions) -> Option<(String, String, String)> {
        let names: BTreeSet<&String> = self.0.keys().chain(before.0.keys()).collect();
        let value = |options: &RunOptions, name: &String| options.0.get(name).cloned().unwrap_or_default();
        let name = names.into_iter().find(|name| self.0.get(*name) != before.0.get(*name))?;
        Some((name.clone(), value(before, name), value(self, name)))
    }
}

#[derive(Debug, Default, Serialize, Deserialize)]
struct Record {
    version: String,
    method: String,
    options: RunOptions,
    /// Images that are done, `scene/image`.
    done: BTreeSet<String>,
}

/// The record of a result file on disk.
pub(crate) struct RunRecord {
    path: PathBuf,
    record: Record,
}

impl RunRecord {
    /// The record of `results`: a new one, or the one that is there if it was made with the same options.
    pub fn open(results: &Path, method: &str, options: &RunOptions) -> Result<RunRecord, RunError> {
        let path = results.with_extension("csv.run.json");
        let record = Record {
            version: env!("CARGO_PKG_VERSION").into(),
            method: method.into(),
            options: options.clone(),
            done: BTreeSet::new(),
        };
        if !results.exists() {
            let new = RunRecord { path, record };
            new.save()?;
            return Ok(new);
        }
        let text = std::fs::read_to_string(&path).ok();
        let Some(before) = text.and_then(|t| serde_json::from_str::<Record>(&t).ok()) else {
            return Err(RunError::NoRecord { results: results.into(), record: path });
        };
        let pairs =
            [("version", &before.version, &record.version), ("method", &before.method, &record.method)];
        let differs = pairs.into_iter().find(|(_, a, b)| a != b);
        let differs = differs.map(|(name, a, b)| (name.to_owned(), a.clone(), b.clone()));
        if let Some((option, before, now)) = differs.or_else(|| options.difference(&before.options)) {
            let results = results.into();
            let other = OtherOptions { results, record: path, option, before, now };
            return Err(RunError::OtherOptions(Box::new(other)));
        }
        Ok(RunRecord { path, record: Record { done: before.done, ..record } })
    }

    pub fn is_done(&self, image: &str) -> bool {
        self.record.done.contains(image)
    }

    pub fn done(&mut self, image: String) {
        self.record.done.insert(image);
    }

    pub fn save(&self) -> Result<(), RunError> {
        let io = |source| RunError::Io { path: self.path.clone(), source };
        let text = serde_json::to_string_pretty(&self.record).map_err(|e| io(std::io::Error::other(e)))?;
        write_atomically(&self.path, text.as_bytes()).map_err(io)
    }
}
