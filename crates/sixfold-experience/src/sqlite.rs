//! The experience store in one SQLite file.
//!
//! A write-ahead log with full synchronisation: what `add` has returned for is on the disk, and readers in other processes go
//! on reading while one writes. An experience, its features and its copies go in one transaction. Removals are kept as
//! numbers, so that readers hear of them.

use std::path::{Path, PathBuf};
use std::time::Duration;

use rusqlite::{Connection, ErrorCode, OpenFlags, OptionalExtension, Row, params};

use super::encode::{self, Images};
use super::experience::{Copy, Experience, Stored};
use super::row::{self, Raw};
use super::{Changes, ExperienceStore, Position, StoreError, StoredFeature, Summary};
use crate::Attempt;

/// Says that a SQLite file is one of ours: "6fEx".
const APPLICATION: i64 = 0x3666_4578;
/// Version of the tables. A store of version 1 has no attempts, and knows no tables that objects stand on; it is brought up to
/// date when it is written to.
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

/// A store in a file.
#[derive(Debug)]
pub struct SqliteStore {
    pub(super) connection: Connection,
    pub(super) file: PathBuf,
}

impl SqliteStore {
    /// Opens a store, or makes an empty one where there is none.
    ///
    /// # Errors
    /// [`StoreError`] for what is no store, one of another version, or one that cannot be written.
    pub fn create(path: &Path) -> Result<SqliteStore, StoreError> {
        if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder)
                .map_err(|e| StoreError::Open { file: path.to_path_buf(), reason: e.to_string() })?;
        }
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_CREATE;
        let store = Self::connect(path, flags)?;
        // Two processes may both find the file empty: the lock decides who makes the tables.
        store.run("BEGIN IMMEDIATE")?;
        let made = store.make_tables();
        store.run(if made.is_ok() { "COMMIT" } else { "ROLLBACK" })?;
        made?;
        let mode: String =
            store.checked(store.connection.query_row("PRAGMA journal_mode=WAL", [], |r| r.get(0)))?;
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

    /// Opens a store that is there.
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
        // A reader of a write-ahead log takes part in it, so it opens for writing where it may.
        let store = Self::connect(path, OpenFlags::SQLITE_OPEN_READ_WRITE)?;
        store.check_version()?;
        Ok(store)
    }

    fn connect(path: &Path, flags: OpenFlags) -> Result<SqliteStore, StoreError> {
        let file = path.to_path_buf();
        let connection = Connection::open_with_flags(path, flags | OpenFlags::SQLITE_OPEN_NO_MUTEX)
            .map_err(|e| StoreError::Open { file: file.clone(), reason: e.to_string() })?;
        let store = SqliteStore { connection, file };
        store.checked(store.connection.busy_timeout(Duration::from_secs(20)))?;
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

    /// Adds what a store of an earlier version lacks.
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
            // Another process may do so at the same time: the lock decides.
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

    /// Lets the file grow to this many bytes only, as a small disk would.
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

    /// SQLite's errors in our words.
    pub(super) fn checked<T>(&self, result: rusqlite::Result<T>) -> Result<T, StoreError> {
        result.map_err(|error| {
            let (file, reason) = (self.file.clone(), error.to_string());
            match error.sqlite_error_code() {
                Some(ErrorCode::NotADatabase) => {
                    StoreError::NotAStore { file, found: "no SQLite file".to_owned() }
                }
                Some(ErrorCode::DatabaseCorrupt) => StoreError::Broken { file, reason },
                Some(ErrorCode::DiskFull) => StoreError::Full { file },
                Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked) => StoreError::Busy { file },
                Some(ErrorCode::ReadOnly) => StoreError::ReadOnly { file },
                Some(ErrorCode::CannotOpen) => StoreError::Open { file, reason },
                _ => StoreError::Other { file, reason },
            }
        })
    }

    fn insert(&mut self, e: &Experience, key: &[u8], images: &Images) -> rusqlite::Result<(i64, bool)> {
        let transaction =
            self.connection.transaction_with_behavior(rusqlite::TransactionBehavior::Immediate)?;
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
        transaction.commit()?;
        Ok((id, true))
    }
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
        let inserted = self.insert(experience, &key, &images);
        self.checked(inserted)
    }

    fn get(&self, id: i64) -> Result<Option<Stored>, StoreError> {
        let plane = if self.number("PRAGMA user_version")? < VERSION { "NULL" } else { "table_plane" };
        let question = format!(
            "SELECT time, object, part, gripper, opening, width, camera_from_gripper, camera, side, extent, depth,
             normals, vd_noc, region, network, provenance, {plane} FROM experience WHERE id=?1"
        );
        let raw = self.checked(self.connection.query_row(&question, [id], raw).optional())?;
        let Some(raw) = raw else { return Ok(None) };
        let copies = self.checked((|| {
            let mut query = self
                .connection
                .prepare("SELECT angle, feature FROM feature WHERE experience=?1 ORDER BY id")?;
            query
                .query_map([id], |row| {
                    Ok(Copy { angle: row.get(0)?, feature: encode::from_floats(&row.get::<_, Vec<u8>>(1)?) })
                })?
                .collect::<rusqlite::Result<Vec<Copy>>>()
        })())?;
        Ok(Some(Stored { id, experience: raw.understand(id, copies)? }))
    }

    fn list(&self) -> Result<Vec<Summary>, StoreError> {
        self.checked((|| {
            let mut query = self.connection.prepare(
                "SELECT id, time, object, part, gripper, width, network, provenance FROM experience ORDER BY id",
            )?;
            query
                .query_map([], |row| {
                    let gripper: String = row.get(4)?;
                    Ok(Summary {
                        id: row.get(0)?,
                        time: row.get(1)?,
                        object: row.get(2)?,
                        part: row.get(3)?,
                        gripper: row::gripper_name(&gripper),
                        width: row.get(5)?,
                        network: row.get(6)?,
                        provenance: row.get(7)?,
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
        self.checked(self.connection.execute(
            "INSERT INTO attempt (key, attempt) VALUES (?1,?2) ON CONFLICT(key) DO NOTHING",
            params![key, text],
        ))
        .map(|rows| rows > 0)
    }

    fn attempts(&self, after: i64) -> Result<Vec<(i64, Attempt)>, StoreError> {
        if self.number("PRAGMA user_version")? < VERSION {
            return Ok(vec![]);
        }
        let rows: Vec<(i64, String)> = self.checked((|| {
            let mut query =
                self.connection.prepare("SELECT id, attempt FROM attempt WHERE id > ?1 ORDER BY id")?;
            query.query_map([after], |row| Ok((row.get(0)?, row.get(1)?)))?.collect()
        })())?;
        rows.into_iter().map(|(id, text)| Ok((id, encode::from_attempt(id, &text)?))).collect()
    }

    fn changes(&self, since: Position) -> Result<Changes, StoreError> {
        // One transaction: what it reads belongs together.
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
                changes.features.push(StoredFeature {
                    experience: row.get(1)?,
                    angle: row.get(2)?,
                    feature: encode::from_floats(&row.get::<_, Vec<u8>>(3)?),
                    network: row.get(4)?,
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
            share: 0.0,
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
