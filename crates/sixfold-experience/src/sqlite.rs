//! The experience store in one SQLite file.
//!
//! It uses a write-ahead log with full synchronisation: when `add` returns, the data is on disk, and other processes can read while
//! one writes. An experience, its features and its copies are written in one transaction. Removals are recorded by number, so that
//! readers are notified of them.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rusqlite::types::ValueRef;
use rusqlite::{Connection, ErrorCode, OpenFlags, OptionalExtension, Row, Transaction, params};

use super::encode::{self, Images};
use super::experience::{Copy, Experience, Stored};
use super::row::{self, Raw};
use super::{AttemptRow, Changes, ExperienceStore, Position, StoreError, StoredFeature, Summary, TaskRecord};
use crate::Attempt;

/// Application id that marks a SQLite file as a store: "6fEx".
const APPLICATION: i64 = 0x3666_4578;
/// Version of the tables. A store of version 1 has no attempts and no planes on which objects stand; it is upgraded on the first
/// write.
const VERSION: i64 = 2;
const TABLES: &str = "
    CREATE TABLE experience (
        id INTEGER PRIMARY KEY AUTOINCREMENT, key BLOB NOT NULL UNIQUE, time INTEGER NOT NULL,
        object TEXT NOT NULL, part TEXT, gripper TEXT NOT NULL, opening REAL NOT NULL, width REAL NOT NULL,
        camera_from_gripper BLOB NOT NULL, camera BLOB NOT NULL, side INTEGER NOT NULL, extent BLOB NOT NULL,
        depth BLOB NOT NULL, normals BLOB NOT NULL, vd_noc BLOB NOT NULL, region BLOB NOT NULL,
        network TEXT NOT NULL, provenance TEXT NOT NULL, table_plane BLOB);
    CREATE TABLE feature (
        id INTEGER PRIMARY KEY AUTOINCREMENT, experience INTEGER NOT NULL REFERENCES experience(id) ON DELETE CASCADE,
        angle REAL NOT NULL, feature BLOB NOT NULL);
    CREATE INDEX feature_of_experience ON feature(experience);
    CREATE TABLE removal (id INTEGER PRIMARY KEY AUTOINCREMENT, experience INTEGER NOT NULL);
";
const ATTEMPTS: &str = "
    CREATE TABLE attempt (id INTEGER PRIMARY KEY AUTOINCREMENT, key BLOB NOT NULL UNIQUE, attempt TEXT NOT NULL);
";
/// Rows of external journals. The table is created only by writers that keep a journal, so that other programs need not know it.
const JOURNAL: &str = "
    CREATE TABLE IF NOT EXISTS journal (id INTEGER PRIMARY KEY AUTOINCREMENT, name TEXT NOT NULL, row TEXT NOT NULL);
";
/// SQLite refuses a file that is shorter than stated in its header, unless this mode for repairs is on.
const REPAIRS: &str = "PRAGMA writable_schema=ON";
/// The columns from which an experience is read.
const COLUMNS: [&str; 17] = [
    "time",
    "object",
    "part",
    "gripper",
    "opening",
    "width",
    "camera_from_gripper",
    "camera",
    "side",
    "extent",
    "depth",
    "normals",
    "vd_noc",
    "region",
    "network",
    "provenance",
    "table_plane",
];

/// How long to wait for another process that writes.
const PATIENCE: Duration = Duration::from_secs(20);
/// Smallest size of the index of a write-ahead log, bytes.
const LOG_INDEX: usize = 32 << 10;

/// Whether the folder of `file` has no room for the index of a write-ahead log, tested by writing a file of that size.
fn is_full_beside(file: &Path) -> bool {
    let probe = file.with_file_name(format!(".sixfold-{}.tmp", std::process::id()));
    let written = std::fs::write(&probe, [0; LOG_INDEX]);
    let _ = std::fs::remove_file(&probe);
    written.is_err_and(|error| error.kind() == std::io::ErrorKind::StorageFull)
}

/// A store in a file.
#[derive(Debug)]
pub struct SqliteStore {
    pub(super) connection: Connection,
    pub(super) file: PathBuf,
    /// Whether it was opened read-only because the disk is full.
    no_room: bool,
}

impl SqliteStore {
    /// Opens a store, or creates an empty one if there is none.
    ///
    /// # Errors
    /// [`StoreError`] for a file that is not a store, has another version, or cannot be written.
    pub fn create(path: &Path) -> Result<SqliteStore, StoreError> {
        if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder)
                .map_err(|e| StoreError::Open { file: path.to_path_buf(), reason: e.to_string() })?;
        }
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_CREATE;
        let store = Self::connect(path, flags)?;
        // Two processes may both find the file empty: the lock decides which one creates the tables.
        store.run("BEGIN IMMEDIATE")?;
        let made = store.make_tables();
        store.run(if made.is_ok() { "COMMIT" } else { "ROLLBACK" })?;
        made?;
        let mode = store.use_log()?;
        if mode != "wal" {
            return Err(StoreError::Other {
                file: path.to_path_buf(),
                reason: format!(
                    "the file system allows no write-ahead log (mode {mode}); put the store on a local disk"
                ),
            });
        }
        Ok(store)
    }

    /// Enables the write-ahead log and returns the resulting mode. SQLite itself does not wait here for other processes, which may
    /// be doing the same.
    fn use_log(&self) -> Result<String, StoreError> {
        let start = Instant::now();
        loop {
            let mode = self.connection.query_row("PRAGMA journal_mode=WAL", [], |r| r.get(0));
            match self.checked(mode) {
                Err(StoreError::Busy { .. }) if start.elapsed() < PATIENCE => {
                    std::thread::sleep(Duration::from_millis(5));
                }
                done => return done,
            }
        }
    }

    /// Opens an existing store.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn open(path: &Path) -> Result<SqliteStore, StoreError> {
        if !path.is_file() {
            return Err(StoreError::Open {
                file: path.to_path_buf(),
                reason: "there is no such file; `sixfold grasp learn` makes one".to_owned(),
            });
        }
        // Readers of a write-ahead log also write to its index, so the file is opened for writing if that is permitted.
        let checked = |store: SqliteStore| store.check_version().map(|()| store);
        match Self::connect(path, OpenFlags::SQLITE_OPEN_READ_WRITE).and_then(checked) {
            Err(StoreError::Full { .. }) => {
                let store = checked(Self::connect_to_unchanging(path, "")?)?;
                Ok(SqliteStore { no_room: true, ..store })
            }
            Err(StoreError::ReadOnly { .. } | StoreError::Open { .. }) => {
                checked(Self::connect_to_unchanging(path, "")?)
            }
            opened => opened,
        }
    }

    /// Opens a damaged store, to save what can still be read: every call may fail for some rows only. The file is not changed.
    ///
    /// # Errors
    /// [`StoreError`] if nothing can be read.
    pub(crate) fn open_damaged(path: &Path) -> Result<SqliteStore, StoreError> {
        let checked = |store: SqliteStore| store.check_version().map(|()| store);
        Self::connect_as(path, path, OpenFlags::SQLITE_OPEN_READ_ONLY, REPAIRS)
            .and_then(checked)
            .or_else(|_| checked(Self::connect_to_unchanging(path, REPAIRS)?))
    }

    /// Opens a file in a folder where the files of a write-ahead log cannot be created.
    fn connect_to_unchanging(path: &Path, first: &str) -> Result<SqliteStore, StoreError> {
        let mut log = path.as_os_str().to_owned();
        log.push("-wal");
        if std::fs::metadata(&log).is_ok_and(|log| log.len() > 0) {
            return Err(StoreError::Open {
                file: path.to_path_buf(),
                reason: format!(
                    "it may only be read, and what was stored last is in {} beside it: copy both files into a folder that may be written",
                    Path::new(&log).display()
                ),
            });
        }
        let mut uri = "file:".to_owned();
        for byte in path.to_string_lossy().bytes() {
            match byte {
                b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'/' | b'.' | b'-' | b'_' => uri.push(byte.into()),
                _ => uri.push_str(&format!("%{byte:02X}")),
            }
        }
        uri.push_str("?immutable=1");
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_URI;
        Self::connect_as(Path::new(&uri), path, flags, first)
    }

    fn connect(path: &Path, flags: OpenFlags) -> Result<SqliteStore, StoreError> {
        Self::connect_as(path, path, flags, "")
    }

    /// `file` is used in errors; the statements `first` run before anything is read.
    fn connect_as(
        place: &Path,
        file: &Path,
        flags: OpenFlags,
        first: &str,
    ) -> Result<SqliteStore, StoreError> {
        let file = file.to_path_buf();
        let connection = Connection::open_with_flags(place, flags | OpenFlags::SQLITE_OPEN_NO_MUTEX)
            .map_err(|e| StoreError::Open { file: file.clone(), reason: e.to_string() })?;
        let store = SqliteStore { connection, file, no_room: false };
        store.checked(store.connection.busy_timeout(PATIENCE))?;
        store.run(first)?;
        store.run("PRAGMA foreign_keys=ON; PRAGMA synchronous=FULL")?;
        Ok(store)
    }

    fn make_tables(&self) -> Result<(), StoreError> {
        let empty = self.number("SELECT count(*) FROM sqlite_master")? == 0;
        if empty && self.number("PRAGMA application_id")? == 0 {
            self.run(TABLES)?;
            self.run(ATTEMPTS)?;
            self.run(&format!("PRAGMA application_id={APPLICATION}; PRAGMA user_version={VERSION}"))?;
        }
        self.bring_up()?;
        self.check_version()
    }

    /// Upgrades a store of an earlier version.
    fn bring_up(&self) -> Result<(), StoreError> {
        let version = self.number("PRAGMA user_version")?;
        if self.number("PRAGMA application_id")? == APPLICATION && (1..VERSION).contains(&version) {
            self.run(ATTEMPTS)?;
            self.run("ALTER TABLE experience ADD COLUMN table_plane BLOB")?;
            self.run(&format!("PRAGMA user_version={VERSION}"))?;
        }
        Ok(())
    }

    /// As [`SqliteStore::bring_up`], before something is written.
    fn bring_up_to_write(&self) -> Result<(), StoreError> {
        if self.number("PRAGMA user_version")? < VERSION {
            // Another process may upgrade it at the same time: the lock serialises them.
            self.run("BEGIN IMMEDIATE")?;
            let done = self.bring_up();
            self.run(if done.is_ok() { "COMMIT" } else { "ROLLBACK" })?;
            done?;
        }
        Ok(())
    }

    fn check_version(&self) -> Result<(), StoreError> {
        if self.number("PRAGMA application_id")? != APPLICATION {
            let found = "another kind of SQLite file".to_owned();
            return Err(StoreError::NotAStore { file: self.file.clone(), found });
        }
        let found = self.number("PRAGMA user_version")?;
        if !(1..=VERSION).contains(&found) {
            return Err(StoreError::Version { file: self.file.clone(), found, expected: VERSION });
        }
        Ok(())
    }

    /// Reads every page and every index.
    ///
    /// # Errors
    /// [`StoreError::Broken`].
    pub fn check_integrity(&self) -> Result<(), StoreError> {
        let answer: String =
            self.checked(self.connection.query_row("PRAGMA integrity_check(1)", [], |r| r.get(0)))?;
        if answer == "ok" {
            return Ok(());
        }
        Err(StoreError::Broken { file: self.file.clone(), reason: answer })
    }

    /// Limits the size of the file to this many bytes, to simulate a full disk.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn limit_size(&self, bytes: i64) -> Result<(), StoreError> {
        let page = self.number("PRAGMA page_size")?.max(512);
        self.number(&format!("PRAGMA max_page_count={}", (bytes / page).max(1))).map(|_| ())
    }

    fn number(&self, question: &str) -> Result<i64, StoreError> {
        self.checked(self.connection.query_row(question, [], |row| row.get(0)))
    }

    pub(super) fn run(&self, statements: &str) -> Result<(), StoreError> {
        self.checked(self.connection.execute_batch(statements))
    }

    /// Converts SQLite's errors.
    pub(super) fn checked<T>(&self, result: rusqlite::Result<T>) -> Result<T, StoreError> {
        result.map_err(|error| {
            let (file, reason) = (self.file.clone(), error.to_string());
            match error.sqlite_error_code() {
                Some(ErrorCode::NotADatabase) => {
                    StoreError::NotAStore { file, found: "no SQLite file".to_owned() }
                }
                Some(ErrorCode::DatabaseCorrupt) => StoreError::Broken { file, reason },
                Some(ErrorCode::DiskFull) => StoreError::Full { file },
                // SQLite reports this error when the disk is too full to create the index of the log.
                Some(ErrorCode::SystemIoFailure) if is_full_beside(&file) => StoreError::Full { file },
                Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked) => StoreError::Busy { file },
                Some(ErrorCode::ReadOnly) if self.no_room => StoreError::Full { file },
                Some(ErrorCode::ReadOnly) => StoreError::ReadOnly { file },
                Some(ErrorCode::CannotOpen) => StoreError::Open { file, reason },
                _ => StoreError::Other { file, reason },
            }
        })
    }

    /// Numbers of the rows to read one at a time when reading all at once fails: up to the last number ever assigned or, if that
    /// cannot be read either, as many as fit into the file.
    fn candidates(&self, table: &str) -> std::ops::RangeInclusive<i64> {
        let last: Result<Option<i64>, _> = self
            .connection
            .query_row("SELECT seq FROM sqlite_sequence WHERE name=?1", [table], |r| r.get(0))
            .optional();
        // No row is smaller than this.
        let room = std::fs::metadata(&self.file).map_or(0, |file| file.len() / 256) as i64;
        1..=last.map_or(room, |last| last.unwrap_or(0).min(room))
    }

    /// Reports a column that cannot be decoded as an error of this row only.
    fn of_row<T>(&self, id: i64, result: rusqlite::Result<T>) -> Result<T, StoreError> {
        match result {
            Err(error) if error.sqlite_error_code().is_none() => {
                let column = match &error {
                    rusqlite::Error::InvalidColumnType(column, ..)
                    | rusqlite::Error::FromSqlConversionFailure(column, ..)
                    | rusqlite::Error::IntegralValueOutOfRange(column, _) => COLUMNS.get(*column).copied(),
                    _ => None,
                };
                Err(StoreError::Field {
                    id,
                    field: column.unwrap_or("feature"),
                    expected: "a value of its column's kind",
                    found: error.to_string(),
                })
            }
            result => self.checked(result),
        }
    }

    /// The attempts of a damaged file.
    fn attempts_one_by_one(&self, after: i64) -> Vec<AttemptRow> {
        let read = |id: i64| {
            let row =
                self.connection.query_row("SELECT attempt FROM attempt WHERE id=?1", [id], |r| text(r, 0));
            match self.checked(row.optional()) {
                Ok(text) => Some((id, encode::from_attempt(id, &text?))),
                Err(error) => Some((id, Err(error))),
            }
        };
        self.candidates("attempt").filter(|id| *id > after).filter_map(read).collect()
    }

    fn read_attempts(&self, after: i64) -> rusqlite::Result<Vec<(i64, String)>> {
        let mut query =
            self.connection.prepare("SELECT id, attempt FROM attempt WHERE id > ?1 ORDER BY id")?;
        query.query_map([after], |row| Ok((row.get(0)?, text(row, 1)?)))?.collect()
    }
}

fn insert_experience(
    transaction: &Transaction<'_>,
    e: &Experience,
    key: &[u8],
    images: &Images,
) -> rusqlite::Result<(i64, bool)> {
    let known: Option<i64> = transaction
        .query_row("SELECT id FROM experience WHERE key=?1", [key], |row| row.get(0))
        .optional()?;
    if let Some(id) = known {
        return Ok((id, false));
    }
    transaction.execute(
        "INSERT INTO experience (key, time, object, part, gripper, opening, width, camera_from_gripper, camera, side,
         extent, depth, normals, vd_noc, region, network, provenance, table_plane)
         VALUES (?1,?2,?3,?4,?5,?6,?7,?8,?9,?10,?11,?12,?13,?14,?15,?16,?17,?18)",
        params![
            key,
            e.time,
            e.object,
            e.part,
            row::gripper_text(&e.gripper),
            e.opening,
            e.width,
            encode::pose(&e.camera_from_gripper),
            encode::camera(&e.crop.camera),
            e.crop.side as i64,
            encode::vectors(&[e.crop.extent.centre, e.crop.extent.half]),
            images.depth,
            images.normals,
            images.vd_noc,
            encode::bits(&e.region),
            e.network,
            e.provenance,
            e.crop.table.as_ref().map(encode::plane)
        ],
    )?;
    let id = transaction.last_insert_rowid();
    for copy in &e.copies {
        transaction.execute(
            "INSERT INTO feature (experience, angle, feature) VALUES (?1,?2,?3)",
            params![id, copy.angle, encode::floats(&copy.feature)],
        )?;
    }
    Ok((id, true))
}

fn insert_attempt(connection: &Connection, key: &[u8], text: &str) -> rusqlite::Result<usize> {
    connection.execute(
        "INSERT INTO attempt (key, attempt) VALUES (?1,?2) ON CONFLICT(key) DO NOTHING",
        params![key, text],
    )
}

/// A text column, or a placeholder for another type: lists show broken rows too.
fn text(row: &Row<'_>, column: usize) -> rusqlite::Result<String> {
    Ok(match row.get_ref(column)? {
        ValueRef::Text(bytes) => String::from_utf8_lossy(bytes).into_owned(),
        other => format!("(not a text: {})", other.data_type()),
    })
}

fn raw(row: &Row<'_>) -> rusqlite::Result<Raw> {
    Ok(Raw {
        time: row.get(0)?,
        object: row.get(1)?,
        part: row.get(2)?,
        gripper: row.get(3)?,
        opening: row.get(4)?,
        width: row.get(5)?,
        pose: row.get(6)?,
        camera: row.get(7)?,
        side: row.get(8)?,
        extent: row.get(9)?,
        images: Images { depth: row.get(10)?, normals: row.get(11)?, vd_noc: row.get(12)? },
        region: row.get(13)?,
        network: row.get(14)?,
        provenance: row.get(15)?,
        table_plane: row.get(16)?,
    })
}

impl ExperienceStore for SqliteStore {
    fn add(&mut self, experience: &Experience) -> Result<(i64, bool), StoreError> {
        let (images, key) = row::prepare(experience)?;
        self.bring_up_to_write()?;
        let inserted = (|| {
            let transaction =
                self.connection.transaction_with_behavior(rusqlite::TransactionBehavior::Immediate)?;
            let inserted = insert_experience(&transaction, experience, &key, &images)?;
            transaction.commit()?;
            Ok(inserted)
        })();
        self.checked(inserted)
    }

    fn add_record(&mut self, record: &TaskRecord<'_>) -> Result<Option<i64>, StoreError> {
        let attempts = record.attempts.iter().map(encode::attempt).collect::<Result<Vec<_>, _>>()?;
        let prepared = record.experience.map(row::prepare).transpose()?;
        self.bring_up_to_write()?;
        let stored = (|| {
            let transaction =
                self.connection.transaction_with_behavior(rusqlite::TransactionBehavior::Immediate)?;
            for (key, text) in &attempts {
                insert_attempt(&transaction, key, text)?;
            }
            let mut id = None;
            if let (Some(experience), Some((images, key))) = (record.experience, &prepared) {
                id = Some(insert_experience(&transaction, experience, key, images)?.0);
            }
            if let Some(entry) = &record.journal {
                transaction.execute_batch(JOURNAL)?;
                transaction.execute(
                    "INSERT INTO journal (name, row) VALUES (?1, ?2)",
                    params![entry.journal, (entry.row)(id)],
                )?;
            }
            transaction.commit()?;
            Ok(id)
        })();
        self.checked(stored)
    }

    fn journal(&self, name: &str) -> Result<Vec<String>, StoreError> {
        if self.number("SELECT count(*) FROM sqlite_master WHERE name='journal'")? == 0 {
            return Ok(vec![]);
        }
        self.checked((|| {
            let mut query = self.connection.prepare("SELECT row FROM journal WHERE name=?1 ORDER BY id")?;
            query.query_map([name], |row| text(row, 0))?.collect()
        })())
    }

    fn numbers(&self) -> Result<Vec<i64>, StoreError> {
        match self.list() {
            Err(StoreError::Broken { .. }) => {
                // Distinguishes a missing experience from a broken one.
                let there = |id: &i64| !matches!(self.get(*id), Ok(None));
                Ok(self.candidates("experience").filter(there).collect())
            }
            listed => Ok(listed?.into_iter().map(|summary| summary.id).collect()),
        }
    }

    fn get(&self, id: i64) -> Result<Option<Stored>, StoreError> {
        let plane = if self.number("PRAGMA user_version")? < VERSION { "NULL" } else { "table_plane" };
        let question = format!(
            "SELECT {}, {plane} FROM experience WHERE id=?1",
            COLUMNS[..COLUMNS.len() - 1].join(", ")
        );
        let raw = self.of_row(id, self.connection.query_row(&question, [id], raw).optional())?;
        let Some(raw) = raw else { return Ok(None) };
        let copies = self.of_row(
            id,
            (|| {
                let mut query = self
                    .connection
                    .prepare("SELECT angle, feature FROM feature WHERE experience=?1 ORDER BY id")?;
                query
                    .query_map([id], |row| {
                        Ok(Copy {
                            angle: row.get(0)?,
                            feature: encode::from_floats(&row.get::<_, Vec<u8>>(1)?),
                        })
                    })?
                    .collect::<rusqlite::Result<Vec<Copy>>>()
            })(),
        )?;
        Ok(Some(Stored { id, experience: raw.understand(id, copies)? }))
    }

    fn list(&self) -> Result<Vec<Summary>, StoreError> {
        self.checked((|| {
            let mut query = self.connection.prepare(
                "SELECT id, time, object, part, gripper, width, network, provenance FROM experience ORDER BY id",
            )?;
            query
                .query_map([], |row| {
                    Ok(Summary {
                        id: row.get(0)?,
                        time: row.get_ref(1)?.as_i64().unwrap_or(0),
                        object: text(row, 2)?,
                        part: match row.get_ref(3)? {
                            ValueRef::Null => None,
                            _ => Some(text(row, 3)?),
                        },
                        gripper: row::gripper_name(&text(row, 4)?),
                        width: row.get_ref(5)?.as_f64().unwrap_or(0.0),
                        network: text(row, 6)?,
                        provenance: text(row, 7)?,
                    })
                })?
                .collect()
        })())
    }

    fn forget(&mut self, id: i64) -> Result<bool, StoreError> {
        let removed = (|| {
            let transaction =
                self.connection.transaction_with_behavior(rusqlite::TransactionBehavior::Immediate)?;
            let removed = transaction.execute("DELETE FROM experience WHERE id=?1", [id])? > 0;
            if removed {
                transaction.execute("INSERT INTO removal (experience) VALUES (?1)", [id])?;
            }
            transaction.commit()?;
            Ok(removed)
        })();
        self.checked(removed)
    }

    fn add_attempt(&mut self, attempt: &Attempt) -> Result<bool, StoreError> {
        let (key, text) = encode::attempt(attempt)?;
        self.bring_up_to_write()?;
        self.checked(insert_attempt(&self.connection, &key, &text)).map(|rows| rows > 0)
    }

    fn attempts(&self, after: i64) -> Result<Vec<(i64, Attempt)>, StoreError> {
        let rows = self.attempt_rows(after)?.into_iter();
        Ok(rows.filter_map(|(id, attempt)| Some((id, attempt.ok()?))).collect())
    }

    fn attempt_rows(&self, after: i64) -> Result<Vec<AttemptRow>, StoreError> {
        if self.number("PRAGMA user_version")? < VERSION {
            return Ok(vec![]);
        }
        let rows = match self.checked(self.read_attempts(after)) {
            Err(StoreError::Broken { .. }) => return Ok(self.attempts_one_by_one(after)),
            rows => rows?,
        };
        Ok(rows.into_iter().map(|(id, text)| (id, encode::from_attempt(id, &text))).collect())
    }

    fn forget_attempt(&mut self, id: i64) -> Result<bool, StoreError> {
        if self.number("PRAGMA user_version")? < VERSION {
            return Ok(false);
        }
        let removed = self.connection.execute("DELETE FROM attempt WHERE id=?1", [id]);
        self.checked(removed).map(|rows| rows > 0)
    }

    fn changes(&self, since: Position) -> Result<Changes, StoreError> {
        // One transaction, so that all reads are consistent.
        self.checked((|| {
            let transaction = self.connection.unchecked_transaction()?;
            let mut changes = Changes { position: since, ..Changes::default() };
            let mut query = transaction.prepare(
                "SELECT f.id, f.experience, f.angle, f.feature, e.network FROM feature f
                 JOIN experience e ON e.id = f.experience WHERE f.id > ?1 ORDER BY f.id",
            )?;
            let mut rows = query.query([since.feature])?;
            while let Some(row) = rows.next()? {
                changes.position.feature = row.get(0)?;
                // An invalid feature becomes an empty one, which the index reports.
                let feature = row.get_ref(3)?.as_blob().map(encode::from_floats).unwrap_or_default();
                changes.features.push(StoredFeature {
                    experience: row.get(1)?,
                    angle: row.get_ref(2)?.as_f64().unwrap_or(f64::NAN),
                    feature,
                    network: text(row, 4)?,
                });
            }
            let mut query =
                transaction.prepare("SELECT id, experience FROM removal WHERE id > ?1 ORDER BY id")?;
            let mut rows = query.query([since.removal])?;
            while let Some(row) = rows.next()? {
                changes.position.removal = row.get(0)?;
                changes.forgotten.push(row.get(1)?);
            }
            Ok(changes)
        })())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Attempt;
    use sixfold_grasp::{AntipodalQuality, GraspDescription};

    #[test]
    fn a_store_of_version_1_is_read_and_brought_up_to_date_when_written_to() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("old.db");
        {
            let made = SqliteStore::create(&file).unwrap();
            made.run(
                "DROP TABLE attempt; ALTER TABLE experience DROP COLUMN table_plane; PRAGMA user_version=1",
            )
            .unwrap();
        }
        let quality = AntipodalQuality { alignment: 0.5, support: 0.5, centring: 0.5, observed: 0.5 };
        let description =
            GraspDescription { quality, overlap: 0.0, lever: 0.0, above_middle: 0.0, table_room: None };
        let attempt = Attempt {
            description,
            agreement: 0.0,
            transferred: false,
            held: true,
            gripper: "g".to_owned(),
            object: "o".to_owned(),
            time: 0,
            provenance: "p".to_owned(),
        };
        let mut store = SqliteStore::open(&file).unwrap();
        assert_eq!(store.attempts(0).unwrap(), []);
        assert_eq!(store.number("PRAGMA user_version").unwrap(), 1, "reading changes nothing");
        assert!(store.add_attempt(&attempt).unwrap());
        assert_eq!(store.number("PRAGMA user_version").unwrap(), VERSION);
        assert_eq!(SqliteStore::open(&file).unwrap().attempts(0).unwrap()[0].1, attempt);
        // A later version is refused.
        store.run("PRAGMA user_version=9").unwrap();
        let error = SqliteStore::open(&file).unwrap_err().to_string();
        assert!(error.contains("version 9"), "{error}");
    }
}
