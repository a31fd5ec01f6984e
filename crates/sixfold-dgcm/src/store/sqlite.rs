//! The experience store in one SQLite file.
//!
//! A write-ahead log with full synchronisation: what `add` has returned for is on the disk, and readers in other processes go
//! on reading while one writes. An experience, its features and its copies go in one transaction. Removals are kept as
//! numbers, so that readers hear of them.

use std::path::{Path, PathBuf};
use std::time::Duration;

use rusqlite::{Connection, ErrorCode, OpenFlags, OptionalExtension, Row, params};
use sixfold_geometry::{Camera, Vec3};
use sixfold_grasp::parse_gripper;

use super::encode::{self, Images};
use super::experience::{Copy, Experience, Stored};
use super::{Changes, ExperienceStore, Position, StoreError, StoredFeature, Summary};
use crate::outcome::Attempt;
use crate::vd_noc::Extent;

/// Says that a SQLite file is one of ours: "6fEx".
const APPLICATION: i64 = 0x3666_4578;
/// Version of the tables. A store of version 1 has no attempts; it is brought up to date when it is written to.
const VERSION: i64 = 2;
const TABLES: &str = "
    CREATE TABLE experience (
        id INTEGER PRIMARY KEY AUTOINCREMENT, key BLOB NOT NULL UNIQUE, time INTEGER NOT NULL,
        object TEXT NOT NULL, part TEXT, gripper TEXT NOT NULL, opening REAL NOT NULL, width REAL NOT NULL,
        camera_from_gripper BLOB NOT NULL, camera BLOB NOT NULL, side INTEGER NOT NULL, extent BLOB NOT NULL,
        depth BLOB NOT NULL, normals BLOB NOT NULL, vd_noc BLOB NOT NULL, region BLOB NOT NULL,
        network TEXT NOT NULL, provenance TEXT NOT NULL);
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
    connection: Connection,
    file: PathBuf,
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

    /// Adds what a store of version 1 lacks.
    fn bring_up(&self) -> Result<(), StoreError> {
        if self.number("PRAGMA application_id")? == APPLICATION && self.number("PRAGMA user_version")? == 1 {
            self.run(ATTEMPTS)?;
            self.run(&format!("PRAGMA user_version={VERSION}"))?;
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

    fn run(&self, statements: &str) -> Result<(), StoreError> {
        self.checked(self.connection.execute_batch(statements))
    }

    /// SQLite's errors in our words.
    fn checked<T>(&self, result: rusqlite::Result<T>) -> Result<T, StoreError> {
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
        // As a gripper file, which says what kind it is.
        let mut gripper = serde_json::to_value(&e.gripper).unwrap_or_default();
        gripper["kind"] = "parallel-jaws".into();
        let gripper = gripper.to_string();
        let camera = &e.crop.camera;
        let numbers = [camera.fx, camera.fy, camera.cx, camera.cy];
        let numbers: Vec<u8> = numbers.iter().flat_map(|v| v.to_le_bytes()).collect();
        transaction.execute(
            "INSERT INTO experience (key, time, object, part, gripper, opening, width, camera_from_gripper, camera, side,
             extent, depth, normals, vd_noc, region, network, provenance)
             VALUES (?1,?2,?3,?4,?5,?6,?7,?8,?9,?10,?11,?12,?13,?14,?15,?16,?17)",
            params![
                key,
                e.time,
                e.object,
                e.part,
                gripper,
                e.opening,
                e.width,
                encode::pose(&e.camera_from_gripper),
                numbers,
                e.crop.side as i64,
                encode::vectors(&[e.crop.extent.centre, e.crop.extent.half]),
                images.depth,
                images.normals,
                images.vd_noc,
                encode::bits(&e.region),
                e.network,
                e.provenance
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

/// The columns of an experience before they are understood.
struct Raw {
    time: i64,
    object: String,
    part: Option<String>,
    gripper: String,
    opening: f64,
    width: f64,
    pose: Vec<u8>,
    camera: Vec<u8>,
    side: i64,
    extent: Vec<u8>,
    images: Images,
    region: Vec<u8>,
    network: String,
    provenance: String,
}

impl Raw {
    fn read(row: &Row<'_>) -> rusqlite::Result<Raw> {
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
        })
    }

    fn understand(self, id: i64, copies: Vec<Copy>) -> Result<Experience, StoreError> {
        let wrong = |field, expected, found: String| StoreError::Field { id, field, expected, found };
        let side = usize::try_from(self.side)
            .ok()
            .filter(|s| (8..=1024).contains(s))
            .ok_or_else(|| wrong("side", "8 to 1024 pixels", self.side.to_string()))?;
        let numbers = encode::doubles(&self.camera);
        let &[fx, fy, cx, cy] = numbers.as_slice() else {
            return Err(wrong("camera", "four numbers", numbers.len().to_string()));
        };
        let camera = Camera::new(fx, fy, cx, cy, side, side)
            .map_err(|e| wrong("camera", "a camera", e.to_string()))?;
        let extent = encode::doubles(&self.extent);
        if extent.len() != 6 || !extent.iter().all(|v| v.is_finite()) {
            return Err(wrong("extent", "six finite numbers", format!("{extent:?}")));
        }
        let extent = Extent {
            centre: Vec3::from_column_slice(&extent[..3]),
            half: Vec3::from_column_slice(&extent[3..]),
        };
        let crop = encode::crop(&self.images, &camera, extent)
            .map_err(|(field, found)| wrong(field, "a PNG image of the crop's size", found))?;
        let pose = encode::from_pose(&self.pose).ok_or_else(|| {
            wrong("camera_from_gripper", "a pose of 16 numbers", self.pose.len().to_string())
        })?;
        let region = encode::from_bits(&self.region, side * side)
            .ok_or_else(|| wrong("region", "one bit a pixel", self.region.len().to_string()))?;
        let gripper = parse_gripper(&self.gripper, "gripper")
            .map_err(|e| wrong("gripper", "a gripper", e.to_string()))?;
        Ok(Experience {
            crop,
            camera_from_gripper: pose,
            opening: self.opening,
            width: self.width,
            region,
            copies,
            network: self.network,
            gripper,
            object: self.object,
            part: self.part,
            time: self.time,
            provenance: self.provenance,
        })
    }
}

impl ExperienceStore for SqliteStore {
    fn add(&mut self, experience: &Experience) -> Result<(i64, bool), StoreError> {
        experience.check()?;
        let images = encode::images(&experience.crop).ok_or_else(|| StoreError::Field {
            id: 0,
            field: "crop",
            expected: "images that can be written as PNG",
            found: format!("{} pixels a side", experience.crop.side),
        })?;
        let e = experience;
        // Without the time: what is stored twice after an interruption is the same experience.
        let key = encode::key(&[
            &images.depth,
            &images.vd_noc,
            &encode::rounded(&e.camera_from_gripper),
            &e.opening.to_le_bytes(),
            e.object.as_bytes(),
            e.part.as_deref().unwrap_or_default().as_bytes(),
            e.gripper.name.as_bytes(),
            e.network.as_bytes(),
            e.provenance.as_bytes(),
        ]);
        let inserted = self.insert(experience, &key, &images);
        self.checked(inserted)
    }

    fn get(&self, id: i64) -> Result<Option<Stored>, StoreError> {
        let raw = self.checked(
            self.connection
                .query_row(
                    "SELECT time, object, part, gripper, opening, width, camera_from_gripper, camera, side, extent, depth,
                     normals, vd_noc, region, network, provenance FROM experience WHERE id=?1",
                    [id],
                    Raw::read,
                )
                .optional(),
        )?;
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
                    let gripper = serde_json::from_str::<serde_json::Value>(&gripper).unwrap_or_default();
                    Ok(Summary {
                        id: row.get(0)?,
                        time: row.get(1)?,
                        object: row.get(2)?,
                        part: row.get(3)?,
                        gripper: gripper["name"].as_str().unwrap_or_default().to_owned(),
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
        if self.number("PRAGMA user_version")? < VERSION {
            // Another process may do so at the same time: the lock decides.
            self.run("BEGIN IMMEDIATE")?;
            let done = self.bring_up();
            self.run(if done.is_ok() { "COMMIT" } else { "ROLLBACK" })?;
            done?;
        }
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
