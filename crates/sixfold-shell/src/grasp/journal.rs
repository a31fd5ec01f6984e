//! Rows of a long measurement, each written to disk as soon as it is known, so that an interrupted measurement can be resumed.
//! One process at a time writes a journal.
//!
//! A journal of data that goes into a store of experiences has a name. Under this name the store keeps the same rows, each
//! written in the same transaction as its data. Rows that the file lacks after an interruption are taken from the store. A
//! store that lacks rows of the file is a different store and is refused.

use std::fs::{File, OpenOptions};
use std::hash::{BuildHasher, Hasher, RandomState};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sixfold_experience::ExperienceStore;
use sixfold_io::WriteLock;

/// A file with one row of JSON a line; the first line holds the options.
pub struct Journal {
    file: File,
    path: PathBuf,
    /// Rows that were there when it was opened.
    rows: Vec<String>,
    _lock: WriteLock,
}

impl Journal {
    /// Opens a journal, with the rows that are there already.
    ///
    /// # Errors
    /// When the file belongs to a measurement with other options, or another process writes it.
    pub fn open<T: DeserializeOwned>(path: &Path, options: &impl Serialize) -> Result<(Journal, Vec<T>)> {
        Self::open_groups(path, options, 1)
    }

    /// As [`Journal::open`], for rows that belong together in groups of `group`: an incomplete last group is dropped.
    ///
    /// # Errors
    /// As [`Journal::open`].
    pub fn open_groups<T: DeserializeOwned>(
        path: &Path,
        options: &impl Serialize,
        group: usize,
    ) -> Result<(Journal, Vec<T>)> {
        let options = serde_json::to_string(options)?;
        let journal = Self::with_header(path, group, |found| match found {
            None => Ok(options.clone()),
            Some(found) if found == options => Ok(options.clone()),
            Some(_) => bail!(other_options(path)),
        })?;
        let rows = journal.parsed(&journal.rows)?;
        Ok((journal, rows))
    }

    /// `header` makes the first line, or checks an existing one; rows come in groups of `group`.
    fn with_header(
        path: &Path,
        group: usize,
        header: impl FnOnce(Option<&str>) -> Result<String>,
    ) -> Result<Journal> {
        let name = path.display();
        if let Some(parent) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
            std::fs::create_dir_all(parent).with_context(|| format!("folder {}", parent.display()))?;
        }
        let lock = WriteLock::take(path)?;
        let text = match std::fs::read_to_string(path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => String::new(),
            Err(e) => return Err(e).with_context(|| name.to_string()),
        };
        // A line without a line end was being written when the program was stopped.
        let whole = text.rfind('\n').map_or("", |end| &text[..=end]);
        let mut lines = whole.split_inclusive('\n');
        let first = lines.next();
        let header = header(first.map(str::trim_end))?;
        let mut rows: Vec<&str> = lines.collect();
        rows.truncate(rows.len() / group * group);
        let length = first.map_or(0, str::len) + rows.iter().map(|row| row.len()).sum::<usize>();
        let rows = rows.into_iter().map(|row| row.trim_end().to_owned()).collect();
        let mut file = OpenOptions::new()
            .create(true)
            .truncate(false)
            .write(true)
            .open(path)
            .with_context(|| name.to_string())?;
        file.set_len(length as u64)?;
        std::io::Seek::seek(&mut file, std::io::SeekFrom::End(0))?;
        let mut journal = Journal { file, path: path.to_path_buf(), rows, _lock: lock };
        if whole.is_empty() {
            journal.line(&header)?;
        }
        Ok(journal)
    }

    fn parsed<T: DeserializeOwned>(&self, rows: &[String]) -> Result<Vec<T>> {
        let parse = |(number, line): (usize, &String)| {
            serde_json::from_str(line).with_context(|| {
                format!("{}, line {}: not a row of this measurement", self.path.display(), number + 2)
            })
        };
        rows.iter().enumerate().map(parse).collect()
    }

    /// Writes a row.
    pub fn row(&mut self, row: &impl Serialize) -> Result<()> {
        self.line(&serde_json::to_string(row)?)
    }

    /// Writes rows that belong together.
    pub fn group(&mut self, rows: &[impl Serialize]) -> Result<()> {
        let lines: Vec<String> = rows.iter().map(serde_json::to_string).collect::<Result<_, _>>()?;
        self.line(&lines.join("\n"))
    }

    /// Writes a row that is text already.
    pub fn line(&mut self, line: &str) -> Result<()> {
        // A single write, so that the file almost always ends with a whole line or group.
        self.file
            .write_all(format!("{line}\n").as_bytes())
            .and_then(|()| self.file.flush())
            .with_context(|| format!("cannot write {}", self.path.display()))
    }
}

fn other_options(path: &Path) -> String {
    format!(
        "{}: holds a measurement with other options; continue with the same ones, or start again in another folder",
        path.display()
    )
}

/// A journal whose rows a store keeps as well.
pub struct StoreJournal {
    journal: Journal,
    /// Its name in the store.
    pub name: String,
}

impl StoreJournal {
    /// Opens a journal.
    ///
    /// # Errors
    /// As [`Journal::open`].
    pub fn open(path: &Path, options: &impl Serialize) -> Result<StoreJournal> {
        let end = format!("\",\"options\":{}}}", serde_json::to_string(options)?);
        let mut name = random_name();
        let journal = Journal::with_header(path, 1, |found| {
            if let Some(line) = found {
                let named = line.strip_prefix(HEADER).and_then(|rest| rest.strip_suffix(&end));
                name = named.with_context(|| other_options(path))?.to_owned();
            }
            Ok(format!("{HEADER}{name}{end}"))
        })?;
        Ok(StoreJournal { journal, name })
    }

    /// Whether it had no rows when it was opened.
    pub fn is_empty(&self) -> bool {
        self.journal.rows.is_empty()
    }

    /// Why it cannot be continued with a store that keeps only `kept` of its rows.
    pub(crate) fn of_another_store(&self, kept: usize, place: &str) -> String {
        format!(
            "{}: holds {} scenes, of which the store {place} has {kept}: it is another store than the one that they went into, or \
             an earlier state of it; give that one, or start again with another --out",
            self.journal.path.display(),
            self.journal.rows.len(),
        )
    }

    /// Takes over the rows that only the store has; returns all rows.
    ///
    /// # Errors
    /// When the store lacks rows of the file.
    pub fn complete<T: DeserializeOwned>(
        &mut self,
        store: &dyn ExperienceStore,
        place: &str,
    ) -> Result<Vec<T>> {
        let kept = store.journal(&self.name)?;
        let rows = &self.journal.rows;
        let same = rows.iter().zip(&kept).take_while(|(row, kept)| row == kept).count();
        if same < rows.len() {
            bail!(self.of_another_store(same, place));
        }
        for row in &kept[same..] {
            self.journal.line(row)?;
        }
        self.journal.parsed(&kept)
    }

    /// Writes a row that the store has.
    pub fn line(&mut self, line: &str) -> Result<()> {
        self.journal.line(line)
    }
}

/// The beginning of the first line of a store's journal; its name and the options follow.
const HEADER: &str = "{\"journal\":\"";

/// 128 random bits: the standard library seeds its hash tables from the system.
fn random_name() -> String {
    let bits = || RandomState::new().build_hasher().finish();
    format!("{:016x}{:016x}", bits(), bits())
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_experience::{JournalEntry, SqliteStore, TaskRecord};

    #[test]
    fn two_processes_do_not_write_one_journal() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("out/rows.jsonl");
        let (mut first, _) = Journal::open::<u32>(&file, &"options").unwrap();
        first.row(&1).unwrap();
        let second = Journal::open::<u32>(&file, &"options").err().unwrap().to_string();
        assert!(second.contains("rows.jsonl") && second.contains("another process"), "{second}");
        drop(first);
        assert_eq!(Journal::open::<u32>(&file, &"options").unwrap().1, [1]);
    }

    #[test]
    fn a_group_of_rows_is_whole_or_not_there() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("rows.jsonl");
        let open = || Journal::open_groups::<u32>(&file, &"options", 3).unwrap();
        let (mut journal, rows) = open();
        assert!(rows.is_empty());
        journal.group(&[1, 2, 3]).unwrap();
        drop(journal);
        let whole = std::fs::read_to_string(&file).unwrap();
        assert_eq!(whole, "\"options\"\n1\n2\n3\n");
        // Interrupted in the next group, within a row or between two rows.
        for more in ["4", "4\n", "4\n5\n", "4\n5\n6"] {
            std::fs::write(&file, format!("{whole}{more}")).unwrap();
            let (mut journal, rows) = open();
            assert_eq!(rows, [1, 2, 3]);
            journal.group(&[7, 8, 9]).unwrap();
            drop(journal);
            assert_eq!(open().1, [1, 2, 3, 7, 8, 9]);
        }
    }

    #[test]
    fn a_journal_goes_with_one_store() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let store = |name: &str| SqliteStore::create(&path(name)).unwrap();
        let open = || StoreJournal::open(&path("rows.jsonl"), &"options").unwrap();
        let keep = |store: &mut SqliteStore, journal: &str, row: u32| {
            let row = move |_| row.to_string();
            let journal = Some(JournalEntry { journal, row: &row });
            store.add_record(&TaskRecord { journal, ..TaskRecord::default() }).unwrap();
        };
        let mut mine = store("mine.db");
        let mut journal = open();
        assert!(journal.complete::<u32>(&mine, "mine.db").unwrap().is_empty() && journal.is_empty());
        for row in 0..3 {
            keep(&mut mine, &journal.name, row);
            // Stopped between the store and the journal.
            if row < 2 {
                journal.line(&row.to_string()).unwrap();
            }
        }
        keep(&mut mine, "another journal", 7);
        let name = journal.name.clone();
        drop(journal);
        let text = || std::fs::read_to_string(path("rows.jsonl")).unwrap();
        for cut in [0, 1] {
            // Also stopped within a line.
            std::fs::write(path("rows.jsonl"), &text()[..text().len() - cut]).unwrap();
            let mut journal = open();
            assert_eq!(journal.complete::<u32>(&mine, "mine.db").unwrap(), [0, 1, 2]);
            assert_eq!(journal.name, name);
            assert_eq!(text().lines().skip(1).collect::<Vec<_>>(), ["0", "1", "2"]);
        }
        // A new store, and one that has lost a row.
        for (file, rows) in [("new.db", 0), ("older.db", 2)] {
            let mut other = store(file);
            (0..rows).for_each(|row| keep(&mut other, &name, row));
            let error = open().complete::<u32>(&other, file).unwrap_err().to_string();
            for word in ["rows.jsonl", "holds 3 scenes", file, &format!("has {rows}"), "--out"] {
                assert!(error.contains(word), "{error}");
            }
        }
        let error = StoreJournal::open(&path("rows.jsonl"), &"others").err().unwrap().to_string();
        assert!(error.contains("other options"), "{error}");
    }
}
