//! The store of experiences: every successful grasp with its crop of the depth image (dissertation, section 6.2.1).
//!
//! An experience contains a crop of the depth image ([`Crop`]), the grasp, and a feature by which it is retrieved. The store does
//! not depend on how features are computed ([`FeatureExtractor`]).
//!
//! [`ExperienceStore`] is the interface of all stores. `SqliteStore` is a store in a single file, `PostgresStore` (feature
//! `postgres`) one on a server for several robots, `OutboxStore` a robot's own copy of the latter, which also works while the
//! server is unreachable. [`StorePlace`] opens any of them from a file name or an address. Searching is not the store's task:
//! [`FeatureIndex`] keeps all features in memory, reads only changes from the store, and finds the nearest exactly.

#![warn(unreachable_pub, unnameable_types)]
// `!(x > 0.0)` refuses NaN and `x <= 0.0` does not: the checks here rely on this.
#![allow(clippy::neg_cmp_op_on_partial_ord)]

mod attempt;
mod crop;
mod crop_turn;
mod describe;
#[cfg(any(feature = "sqlite", feature = "postgres"))]
mod encode;
mod experience;
mod index;
#[cfg(feature = "sqlite")]
mod outbox;
#[cfg(feature = "postgres")]
mod password_guard;
mod place;
#[cfg(feature = "postgres")]
mod postgres;
#[cfg(any(feature = "sqlite", feature = "postgres"))]
mod row;
#[cfg(feature = "sqlite")]
mod sqlite;
mod vd_noc;

use std::path::PathBuf;

use thiserror::Error;

#[cfg(feature = "postgres")]
pub use self::postgres::PostgresStore;
pub use attempt::Attempt;
pub use crop::{Crop, CropError, CropOptions};
pub use crop_turn::turn;
pub use describe::{Description, picture_with_nearest};
pub use experience::{COPIES, Copy, Experience, FeatureExtractor, Stored, region};
pub use index::{FeatureIndex, Match};
#[cfg(feature = "sqlite")]
pub use outbox::{Notice, NoticeListener, OutboxOptions, OutboxStore};
pub use place::StorePlace;
#[cfg(feature = "sqlite")]
pub use sqlite::SqliteStore;
pub use vd_noc::Extent;

/// Length of a feature.
pub const FEATURE: usize = 256;

/// Errors of stores.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StoreError {
    /// The file cannot be opened.
    #[error("{}: the experience store cannot be opened: {reason}", file.display())]
    Open {
        /// The file.
        file: PathBuf,
        /// The cause.
        reason: String,
    },
    /// The file is not a store.
    #[error(
        "{}: found {found}, expected an experience store; give one that `sixfold grasp learn` or `sixfold grasp store add` wrote", file.display()
    )]
    NotAStore {
        /// The file.
        file: PathBuf,
        /// Kind of file found.
        found: String,
    },
    /// The store was written by another version.
    #[error(
        "{}: the experience store has version {found}, expected {expected}: use the version of Sixfold that wrote it, and export and add its experiences", file.display()
    )]
    Version {
        /// The file.
        file: PathBuf,
        /// Its version.
        found: i64,
        /// The version that this program reads.
        expected: i64,
    },
    /// The file is damaged.
    #[error(
        "{}: the experience store is damaged ({reason}); recover its readable part with `sixfold grasp \
         store merge NEW.db {}`, or restore it from a backup", file.display(), file.display()
    )]
    Broken {
        /// The file.
        file: PathBuf,
        /// SQLite's message.
        reason: String,
    },
    /// The disk is full.
    #[error(
        "{}: the disk is full: the last experience was not stored, all earlier ones are safe; make room and continue", file.display()
    )]
    Full {
        /// The file.
        file: PathBuf,
    },
    /// Another process holds the write lock for too long.
    #[error("{}: another process has been writing for 20 s; try again when it is done", file.display())]
    Busy {
        /// The file.
        file: PathBuf,
    },
    /// The store may not be written.
    #[error("{}: the experience store is read-only; check the permissions of the file and its folder, or, for PostgreSQL, that the server is not a standby", file.display())]
    ReadOnly {
        /// The file.
        file: PathBuf,
    },
    /// The server does not answer. No request was sent, so nothing was stored.
    #[error(
        "{server}: the server of the experience store cannot be reached ({reason}); check that it runs, its name and port, and the network"
    )]
    Unreachable {
        /// The server, without the password.
        server: String,
        /// The cause.
        reason: String,
    },
    /// The connection was lost before the server confirmed.
    #[error(
        "{server}: the connection to the experience store was lost ({reason}); the last data may not have \
         been stored: run the same again, nothing is stored twice"
    )]
    Lost {
        /// The server, without the password.
        server: String,
        /// The cause.
        reason: String,
    },
    /// The server denies access with this address, or does not permit the operation.
    #[error(
        "{server}: the server refuses ({reason}); check user, database and password (PGPASSWORD, or in the \
         address) and the privileges of the user"
    )]
    Refused {
        /// The server, without the password.
        server: String,
        /// The server's message.
        reason: String,
    },
    /// The server's database lacks pgvector.
    #[error(
        "{server}: the database has no extension `vector` ({reason}); install pgvector on the server \
         (Debian: postgresql-VERSION-pgvector) and let an administrator run CREATE EXTENSION vector in \
         this database"
    )]
    Extension {
        /// The server, without the password.
        server: String,
        /// What is missing.
        reason: String,
    },
    /// The address of a server is invalid.
    #[error(
        "{server}: {reason}; expected postgres://user@host:port/database, a password in PGPASSWORD or behind the user's name"
    )]
    Address {
        /// The address, without anything that may be a password.
        server: String,
        /// What is wrong.
        reason: String,
    },
    /// The program was built without this kind of store.
    #[error(
        "{place}: this program was built without the feature `{feature}`; build it with: cargo install --locked --path crates/sixfold-cli --features {feature}"
    )]
    Feature {
        /// The file, or the server without the password.
        place: String,
        /// The feature that it needs.
        feature: &'static str,
    },
    /// A field of an experience cannot be used.
    #[error("experience {id}: field {field}: expected {expected}, found {found}")]
    Field {
        /// Number of the experience, 0 for a new one.
        id: i64,
        /// The field.
        field: &'static str,
        /// The values allowed.
        expected: &'static str,
        /// The value found.
        found: String,
    },
    /// An attempt cannot be used.
    #[error("attempt {id}: expected an attempt as this program writes it, found {reason}")]
    Attempt {
        /// Number of the attempt.
        id: i64,
        /// What is wrong with it.
        reason: String,
    },
    /// Anything else.
    #[error("{}: {reason}", file.display())]
    Other {
        /// The file.
        file: PathBuf,
        /// SQLite's message.
        reason: String,
    },
}

impl StoreError {
    /// Whether the same call may succeed later without changes here: the server or the network is unreachable, or the server is
    /// busy, full or a standby.
    pub fn is_passing(&self) -> bool {
        matches!(
            self,
            StoreError::Unreachable { .. }
                | StoreError::Lost { .. }
                | StoreError::Busy { .. }
                | StoreError::Full { .. }
                | StoreError::ReadOnly { .. }
        )
    }

    /// Whether only one row is affected, which can be left out or removed, and not the whole store.
    pub fn is_of_one_row(&self) -> bool {
        matches!(self, StoreError::Field { .. } | StoreError::Attempt { .. })
    }
}

/// Position up to which a reader has read the changes of a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Position {
    /// The last feature read.
    pub feature: i64,
    /// The last removal read.
    pub removal: i64,
}

/// A feature of a stored experience or of one of its in-plane copies.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredFeature {
    /// Number of the experience.
    pub experience: i64,
    /// The copy's rotation about the optical axis, radians; 0 for the experience itself.
    pub angle: f64,
    /// The network that computed it: features of different networks cannot be compared.
    pub network: String,
    /// 256 numbers.
    pub feature: Vec<f32>,
}

/// Changes of a store since a position.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Changes {
    /// New features, in the order in which they were stored.
    pub features: Vec<StoredFeature>,
    /// Experiences that were forgotten.
    pub forgotten: Vec<i64>,
    /// The store's current position.
    pub position: Position,
}

/// A line of a list of experiences.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Summary {
    /// Number of the experience.
    pub id: i64,
    /// Seconds since 1970.
    pub time: i64,
    /// The object's name.
    pub object: String,
    /// The part that was grasped, if known.
    pub part: Option<String>,
    /// The gripper's name.
    pub gripper: String,
    /// Distance of the contacts, metres.
    pub width: f64,
    /// The network that computed its features.
    pub network: String,
    /// Origin of the experience.
    pub provenance: String,
}

/// All results of one grasping task. They are stored completely or not at all, so that an interrupted task can be repeated.
#[derive(Clone, Copy, Default)]
pub struct TaskRecord<'a> {
    /// The attempts, in order.
    pub attempts: &'a [Attempt],
    /// The grasp that held.
    pub experience: Option<&'a Experience>,
    /// The task's row in a journal.
    pub journal: Option<JournalEntry<'a>>,
}

/// A row of a journal outside the store. The store keeps the row too, together with the results: after an interruption the journal
/// can be completed from the store, and a journal that belongs to another store is detected.
#[derive(Clone, Copy)]
pub struct JournalEntry<'a> {
    /// The journal's unique name.
    pub journal: &'a str,
    /// Makes the row from the number of the stored experience.
    pub row: &'a dyn Fn(Option<i64>) -> String,
}

/// An attempt with its number, or the error in reading it.
pub type AttemptRow = (i64, Result<Attempt, StoreError>);

/// The interface of a store of experiences. Numbers of experiences are never reused.
pub trait ExperienceStore {
    /// Stores an experience with its in-plane copies and returns its number. When it returns, the experience is durable: it
    /// survives a crash of the process or a power failure. An experience that is already stored keeps its number, and the second
    /// value is false.
    ///
    /// # Errors
    /// [`StoreError`]; nothing is stored then.
    fn add(&mut self, experience: &Experience) -> Result<(i64, bool), StoreError>;

    /// An experience by its number; `None` if there is none.
    ///
    /// # Errors
    /// [`StoreError`].
    fn get(&self, id: i64) -> Result<Option<Stored>, StoreError>;

    /// All experiences, in the order of their numbers.
    ///
    /// # Errors
    /// [`StoreError`].
    fn list(&self) -> Result<Vec<Summary>, StoreError>;

    /// Removes an experience; false if there was none.
    ///
    /// # Errors
    /// [`StoreError`].
    fn forget(&mut self, id: i64) -> Result<bool, StoreError>;

    /// The experiences stored and removed since a position ([`Position::default`]: everything).
    ///
    /// # Errors
    /// [`StoreError`].
    fn changes(&self, since: Position) -> Result<Changes, StoreError>;

    /// Stores a grasp that was tried, successful or not; false if it is already stored.
    ///
    /// # Errors
    /// [`StoreError`]; nothing is stored then.
    fn add_attempt(&mut self, attempt: &Attempt) -> Result<bool, StoreError>;

    /// The attempts after a number (0: all), in the order in which they were stored, with their numbers. Those that cannot be read
    /// are left out: [`ExperienceStore::attempt_rows`] includes them.
    ///
    /// # Errors
    /// [`StoreError`].
    fn attempts(&self, after: i64) -> Result<Vec<(i64, Attempt)>, StoreError>;

    /// As [`ExperienceStore::attempts`], with the errors of those that cannot be read.
    ///
    /// # Errors
    /// [`StoreError`].
    fn attempt_rows(&self, after: i64) -> Result<Vec<AttemptRow>, StoreError> {
        Ok(self.attempts(after)?.into_iter().map(|(id, attempt)| (id, Ok(attempt))).collect())
    }

    /// Removes an attempt; false if there was none. A process that has read it keeps it until it restarts.
    ///
    /// # Errors
    /// [`StoreError`].
    fn forget_attempt(&mut self, id: i64) -> Result<bool, StoreError> {
        let reason = format!("attempt {id} cannot be removed from a store of this kind");
        Err(StoreError::Other { file: PathBuf::from("experience store"), reason })
    }

    /// Stores all results of one task at once and returns the number of its experience. A store without journals stores the results
    /// one after another.
    ///
    /// # Errors
    /// [`StoreError`]; nothing is stored then.
    fn add_record(&mut self, record: &TaskRecord<'_>) -> Result<Option<i64>, StoreError> {
        if record.journal.is_some() {
            let reason = "a store of this kind keeps no journal".to_owned();
            return Err(StoreError::Other { file: PathBuf::from("experience store"), reason });
        }
        for attempt in record.attempts {
            self.add_attempt(attempt)?;
        }
        record.experience.map(|experience| Ok(self.add(experience)?.0)).transpose()
    }

    /// The rows that were stored for a journal ([`JournalEntry`]), in that order.
    ///
    /// # Errors
    /// [`StoreError`].
    fn journal(&self, _name: &str) -> Result<Vec<String>, StoreError> {
        Ok(vec![])
    }

    /// The numbers of all experiences, in order, including those that cannot be read.
    ///
    /// # Errors
    /// [`StoreError`].
    fn numbers(&self) -> Result<Vec<i64>, StoreError> {
        Ok(self.list()?.into_iter().map(|summary| summary.id).collect())
    }

    /// A unique name of the store, if it has one: servers do, so that robots detect when another server answers.
    ///
    /// # Errors
    /// [`StoreError`].
    fn identity(&self) -> Result<Option<String>, StoreError> {
        Ok(None)
    }

    /// Copies all experiences and attempts of another store that are missing here; returns the number of new experiences.
    ///
    /// # Errors
    /// [`StoreError`]; whatever was copied before the error is kept.
    fn merge(&mut self, other: &dyn ExperienceStore) -> Result<usize, StoreError> {
        let mut added = 0;
        for summary in other.list()? {
            if let Some(stored) = other.get(summary.id)? {
                added += usize::from(self.add(&stored.experience)?.1);
            }
        }
        for (_, attempt) in other.attempts(0)? {
            self.add_attempt(&attempt)?;
        }
        Ok(added)
    }
}
