//! Rows of a long measurement, each on the disk as soon as it is known, so that a stopped one resumes.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// A file with one row of JSON a line; the first line holds the options.
pub struct Journal {
    file: File,
    path: PathBuf,
}

impl Journal {
    /// Opens a journal, with the rows that are there already.
    ///
    /// # Errors
    /// When the file belongs to a measurement with other options.
    pub fn open<T: DeserializeOwned>(path: &Path, options: &impl Serialize) -> Result<(Journal, Vec<T>)> {
        let name = path.display();
        if let Some(parent) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
            std::fs::create_dir_all(parent).with_context(|| format!("folder {}", parent.display()))?;
        }
        let options = serde_json::to_string(options)?;
        let text = match std::fs::read_to_string(path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(e) => return Err(e).with_context(|| name.to_string()),
        };
        // A line without an end was being written when the program was stopped.
        let whole = text.rfind('\n').map_or("", |end| &text[..=end]);
        let mut lines = whole.lines();
        let mut rows = vec![];
        match lines.next() {
            None => {}
            Some(found) if found == options => {
                for (number, line) in lines.enumerate() {
                    rows.push(serde_json::from_str(line).with_context(|| {
                        format!("{name}, line {}: not a row of this measurement", number + 2)
                    })?);
                }
            }
            Some(_) => bail!(
                "{name}: holds a measurement with other options; continue with the same ones, or start again in another folder"
            ),
        }
        let mut file = OpenOptions::new()
            .create(true)
            .truncate(false)
            .write(true)
            .open(path)
            .with_context(|| name.to_string())?;
        file.set_len(whole.len() as u64)?;
        std::io::Seek::seek(&mut file, std::io::SeekFrom::End(0))?;
        if whole.is_empty() {
            writeln!(file, "{options}")?;
        }
        Ok((Journal { file, path: path.to_path_buf() }, rows))
    }

    /// Writes a row.
    pub fn row(&mut self, row: &impl Serialize) -> Result<()> {
        let line = serde_json::to_string(row)?;
        writeln!(self.file, "{line}")
            .and_then(|()| self.file.flush())
            .with_context(|| format!("cannot write {}", self.path.display()))
    }
}
