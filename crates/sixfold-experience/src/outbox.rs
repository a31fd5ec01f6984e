//! A robot's own copy of a fleet's store, which continues to work while the server is unreachable.
//!
//! The copy is an ordinary store file. All reads use it, and additions are written to it, on disk, before anything else happens;
//! its numbers never change. Every contact with the server has three steps, each of which may be interrupted and repeated:
//! experiences for which the file has no server number are delivered, in order; experiences removed here are removed there; and
//! additions and removals by others are copied. Attempts are exchanged as well. The server's unique key makes a repeated delivery
//! harmless.

use std::cell::{Cell, RefCell};
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rusqlite::{OptionalExtension, params};

use crate::Attempt;

use super::{
    AttemptRow, Changes, Experience, ExperienceStore, Position, SqliteStore, StoreError, Stored, Summary,
    TaskRecord,
};

/// `delivered`: the server's number of an experience, or why the server refused it. `followed`: the server's identity and the
/// position up to which its changes were read. `followed_attempts`: the last attempt of the copy that the server has, and the last
/// one of the server that the copy has.
const TABLES: &str = "
    CREATE TABLE IF NOT EXISTS delivered (experience INTEGER PRIMARY KEY, number INTEGER, reason TEXT);
    CREATE INDEX IF NOT EXISTS delivered_number ON delivered(number);
    CREATE TABLE IF NOT EXISTS followed (
        one INTEGER PRIMARY KEY CHECK (one = 1), identity TEXT, feature INTEGER NOT NULL, removal INTEGER NOT NULL);
    INSERT OR IGNORE INTO followed (one, identity, feature, removal) VALUES (1, NULL, 0, 0);
    CREATE TABLE IF NOT EXISTS followed_attempts (
        one INTEGER PRIMARY KEY CHECK (one = 1), sent INTEGER NOT NULL, taken INTEGER NOT NULL);
    INSERT OR IGNORE INTO followed_attempts (one, sent, taken) VALUES (1, 0, 0);
";

/// Messages for the user.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Notice {
    /// The server is unreachable.
    Away {
        /// The cause.
        reason: String,
        /// Experiences not yet delivered.
        waiting: usize,
        /// The file that contains them.
        file: PathBuf,
    },
    /// The store was closed while experiences were not yet delivered.
    Waiting {
        /// Experiences not yet delivered.
        waiting: usize,
        /// The file that contains them.
        file: PathBuf,
    },
    /// Waiting experiences were delivered.
    Delivered {
        /// Experiences delivered.
        delivered: usize,
        /// Experiences not yet delivered.
        waiting: usize,
    },
    /// Many experiences are being copied from the server, which takes a while.
    TakingOver {
        /// Number of experiences.
        experiences: usize,
    },
    /// The server refuses an experience permanently.
    Refused {
        /// Its number in the file.
        id: i64,
        /// The cause.
        reason: String,
        /// The file, in which it stays.
        file: PathBuf,
    },
    /// An attempt is left out: it cannot be read.
    Attempt {
        /// Number of the attempt, and the cause.
        reason: String,
    },
    /// An experience of the server is left out.
    Unreadable {
        /// Its number on the server.
        number: i64,
        /// The cause.
        reason: String,
    },
}

impl fmt::Display for Notice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Notice::Away { reason, waiting, file } => write!(
                f,
                "{reason}. Going on without: experiences are kept in {} and delivered later ({waiting} wait)",
                file.display()
            ),
            Notice::Waiting { waiting, file } => write!(
                f,
                "{waiting} experiences wait in {0} for the server; the same command delivers them at its next start, `sixfold grasp store merge ADDRESS {0}` at once",
                file.display()
            ),
            Notice::Delivered { delivered, waiting: 0 } => {
                write!(f, "{delivered} experiences that waited were delivered to the server")
            }
            Notice::Delivered { delivered, waiting } => {
                write!(
                    f,
                    "{delivered} experiences that waited were delivered to the server, {waiting} still wait"
                )
            }
            Notice::TakingOver { experiences } => {
                write!(f, "taking over {experiences} experiences from the server")
            }
            Notice::Refused { id, reason, file } => write!(
                f,
                "experience {id} is not delivered to the server ({reason}); it stays in {} and is not offered again",
                file.display()
            ),
            Notice::Attempt { reason } => write!(f, "{reason}; it is left out"),
            Notice::Unreadable { number, reason } => {
                write!(f, "experience {number} of the server is left out: {reason}")
            }
        }
    }
}

/// Options of an [`OutboxStore`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OutboxOptions {
    /// Minimum time between two attempts to reach an unreachable server.
    pub retry: Duration,
}

impl Default for OutboxOptions {
    fn default() -> Self {
        OutboxOptions { retry: Duration::from_secs(10) }
    }
}

/// Called with every [`Notice`].
pub type NoticeListener = Box<dyn Fn(&Notice) + Send>;

/// A copy of a remote store in a file, and an outbox for additions.
pub struct OutboxStore {
    copy: RefCell<SqliteStore>,
    remote: RefCell<Box<dyn ExperienceStore + Send>>,
    listener: NoticeListener,
    retry: Duration,
    /// If the remote store is unreachable, the time of the next attempt.
    away: Cell<Option<Instant>>,
    /// Whether the remote store was confirmed to be the one of which this is a copy.
    known: Cell<bool>,
}

/// Which store an error comes from.
enum Trouble {
    /// The copy: returned to the caller.
    Here(StoreError),
    /// The remote store: retried later.
    There(StoreError),
}

impl OutboxStore {
    /// Opens or creates the copy and contacts the remote store. Experiences that are already in the file, from an earlier run or
    /// from a store without a server, are delivered.
    ///
    /// # Errors
    /// [`StoreError`] for a file that is not a store or belongs to another server, and for a server that answers but cannot be
    /// used. An unreachable server ([`StoreError::is_passing`]) is not an error: `listener` is notified.
    pub fn create(
        file: &Path,
        remote: Box<dyn ExperienceStore + Send>,
        options: &OutboxOptions,
        listener: NoticeListener,
    ) -> Result<OutboxStore, StoreError> {
        let copy = SqliteStore::create(file)?;
        copy.run(TABLES)?;
        let store = OutboxStore {
            copy: RefCell::new(copy),
            remote: RefCell::new(remote),
            listener,
            retry: options.retry,
            away: Cell::new(None),
            known: Cell::new(false),
        };
        let began = Instant::now();
        match store.contact(None) {
            Ok(()) => {}
            Err(Trouble::There(error)) if error.is_passing() => store.leave_alone(&error, began)?,
            Err(Trouble::Here(error) | Trouble::There(error)) => return Err(error),
        }
        Ok(store)
    }

    /// Experiences that were not delivered yet.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn waiting(&self) -> Result<usize, StoreError> {
        self.undelivered().map(|w| w.len())
    }

    /// Contacts the remote store unless it was unreachable a short time ago; failures there do not affect the local copy.
    fn synchronise(&self, fresh: Option<i64>) -> Result<(), StoreError> {
        if self.away.get().is_some_and(|until| Instant::now() < until) {
            return Ok(());
        }
        let began = Instant::now();
        match self.contact(fresh) {
            Ok(()) => {
                self.away.set(None);
                Ok(())
            }
            Err(Trouble::Here(error)) => Err(error),
            Err(Trouble::There(error)) => self.leave_alone(&error, began),
        }
    }

    fn leave_alone(&self, error: &StoreError, began: Instant) -> Result<(), StoreError> {
        // At most a tenth of the time is spent on attempts, however long one of them hangs.
        let pause = self.retry.max(10 * began.elapsed());
        if self.away.replace(Some(Instant::now() + pause)).is_none() {
            let waiting = self.waiting()?;
            (self.listener)(&Notice::Away { reason: error.to_string(), waiting, file: self.file() });
        }
        Ok(())
    }

    fn file(&self) -> PathBuf {
        self.copy.borrow().file.clone()
    }

    /// All steps of a contact with the remote store. `fresh` is an experience that was just added.
    fn contact(&self, fresh: Option<i64>) -> Result<(), Trouble> {
        self.recognise()?;
        self.deliver(fresh)?;
        self.deliver_removals()?;
        self.take_over()?;
        self.exchange_attempts()
    }

    /// Delivers attempts and copies those of others. An attempt keeps its key, so that no store gets it twice.
    fn exchange_attempts(&self) -> Result<(), Trouble> {
        let (sent, taken) = self
            .numbers("SELECT sent, taken FROM followed_attempts")
            .map_err(Trouble::Here)?
            .first()
            .copied()
            .unwrap_or_default();
        let mine = self.copy.borrow().attempt_rows(sent).map_err(Trouble::Here)?;
        for (id, attempt) in mine {
            if let Some(attempt) = self.readable(attempt) {
                let answer = self.remote.borrow_mut().add_attempt(&attempt);
                answer.map_err(Trouble::There)?;
            }
            self.follow_attempts("sent", id)?;
        }
        let theirs = self.remote.borrow().attempt_rows(taken).map_err(Trouble::There)?;
        for (number, attempt) in theirs {
            if let Some(attempt) = self.readable(attempt) {
                self.copy.borrow_mut().add_attempt(&attempt).map_err(Trouble::Here)?;
            }
            self.follow_attempts("taken", number)?;
        }
        Ok(())
    }

    fn readable(&self, attempt: Result<Attempt, StoreError>) -> Option<Attempt> {
        attempt.map_err(|error| (self.listener)(&Notice::Attempt { reason: error.to_string() })).ok()
    }

    fn follow_attempts(&self, which: &str, number: i64) -> Result<(), Trouble> {
        let copy = self.copy.borrow();
        let done = copy.connection.execute(&format!("UPDATE followed_attempts SET {which} = ?1"), [number]);
        copy.checked(done).map(|_| ()).map_err(Trouble::Here)
    }

    /// Tests that the remote store is the one of which the file is a copy.
    fn recognise(&self) -> Result<(), Trouble> {
        if self.known.get() {
            return Ok(());
        }
        let identity = self.remote.borrow().identity().map_err(Trouble::There)?;
        let copy = self.copy.borrow();
        let found: Option<String> = copy
            .checked(copy.connection.query_row("SELECT identity FROM followed", [], |r| r.get(0)))
            .map_err(Trouble::Here)?;
        if found.is_some() && found != identity {
            return Err(Trouble::There(StoreError::Other {
                file: copy.file.clone(),
                reason: "this file goes with another store than the one that answers at the address; give the other address, or another file with --outbox (`sixfold grasp store merge` takes experiences over)".to_owned(),
            }));
        }
        copy.checked(copy.connection.execute("UPDATE followed SET identity = ?1", [identity]))
            .map_err(Trouble::Here)?;
        self.known.set(true);
        Ok(())
    }

    /// Experiences that are not recorded as delivered, in the order in which they were added.
    fn undelivered(&self) -> Result<Vec<i64>, StoreError> {
        self.numbers(
            "SELECT e.id FROM experience e LEFT JOIN delivered d ON d.experience = e.id
             WHERE d.experience IS NULL ORDER BY e.id",
        )
        .map(|rows| rows.into_iter().map(|r| r.0).collect())
    }

    /// Runs a query with one or two numbers per row.
    fn numbers(&self, question: &str) -> Result<Vec<(i64, i64)>, StoreError> {
        let copy = self.copy.borrow();
        copy.checked((|| {
            let mut query = copy.connection.prepare(question)?;
            let second = query.column_count() - 1;
            query.query_map([], |row| Ok((row.get(0)?, row.get(second)?)))?.collect()
        })())
    }

    fn deliver(&self, fresh: Option<i64>) -> Result<(), Trouble> {
        let waiting = self.undelivered().map_err(Trouble::Here)?;
        let mut done = 0;
        let mut trouble = Ok(());
        for id in waiting {
            let stored = self.copy.borrow().get(id);
            let answer = match stored {
                Ok(Some(stored)) => self.remote.borrow_mut().add(&stored.experience),
                // Another process removed it.
                Ok(None) => continue,
                // One that cannot be read does not block the others.
                Err(error @ StoreError::Field { .. }) => Err(error),
                Err(error) => return Err(Trouble::Here(error)),
            };
            match answer {
                Ok((number, _)) => {
                    self.note(id, Some(number), None)?;
                    done += usize::from(Some(id) != fresh);
                }
                Err(error @ StoreError::Field { .. }) => {
                    let reason = error.to_string();
                    self.note(id, None, Some(&reason))?;
                    (self.listener)(&Notice::Refused { id, reason, file: self.file() });
                }
                Err(error) => {
                    trouble = Err(Trouble::There(error));
                    break;
                }
            }
        }
        if done > 0 {
            let waiting = self.waiting().map_err(Trouble::Here)?;
            (self.listener)(&Notice::Delivered { delivered: done, waiting });
        }
        trouble
    }

    /// Records the result of delivering an experience.
    fn note(&self, id: i64, number: Option<i64>, reason: Option<&str>) -> Result<(), Trouble> {
        let copy = self.copy.borrow();
        let done = copy.connection.execute(
            "INSERT OR REPLACE INTO delivered (experience, number, reason) VALUES (?1, ?2, ?3)",
            params![id, number, reason],
        );
        copy.checked(done).map(|_| ()).map_err(Trouble::Here)
    }

    fn strike(&self, id: i64) -> Result<(), Trouble> {
        let copy = self.copy.borrow();
        let done = copy.connection.execute("DELETE FROM delivered WHERE experience = ?1", [id]);
        copy.checked(done).map(|_| ()).map_err(Trouble::Here)
    }

    fn deliver_removals(&self) -> Result<(), Trouble> {
        // Numbers in the file are never reused: an experience that is recorded but missing was removed.
        let removed = self
            .numbers(
                "SELECT d.experience, coalesce(d.number, 0) FROM delivered d
                 LEFT JOIN experience e ON e.id = d.experience WHERE e.id IS NULL ORDER BY d.experience",
            )
            .map_err(Trouble::Here)?;
        for (id, number) in removed {
            if number > 0 {
                self.remote.borrow_mut().forget(number).map_err(Trouble::There)?;
            }
            self.strike(id)?;
        }
        Ok(())
    }

    fn take_over(&self) -> Result<(), Trouble> {
        let since = {
            let copy = self.copy.borrow();
            let read = copy.connection.query_row("SELECT feature, removal FROM followed", [], |row| {
                Ok(Position { feature: row.get(0)?, removal: row.get(1)? })
            });
            copy.checked(read).map_err(Trouble::Here)?
        };
        let changes = self.remote.borrow().changes(since).map_err(Trouble::There)?;
        if changes.position == since {
            return Ok(());
        }
        let mut new: Vec<i64> = changes.features.iter().map(|f| f.experience).collect();
        new.dedup();
        let mut unknown = vec![];
        for number in new {
            if self.local(number)?.is_none() {
                unknown.push(number);
            }
        }
        if unknown.len() >= 100 {
            (self.listener)(&Notice::TakingOver { experiences: unknown.len() });
        }
        for number in unknown {
            let answer = self.remote.borrow().get(number);
            match answer {
                Ok(Some(stored)) => {
                    let added = self.copy.borrow_mut().add(&stored.experience);
                    self.note(added.map_err(Trouble::Here)?.0, Some(number), None)?;
                }
                Ok(None) => {}
                Err(error @ StoreError::Field { .. }) => {
                    (self.listener)(&Notice::Unreadable { number, reason: error.to_string() });
                }
                Err(error) => return Err(Trouble::There(error)),
            }
        }
        for number in changes.forgotten {
            if let Some(id) = self.local(number)? {
                self.copy.borrow_mut().forget(id).map_err(Trouble::Here)?;
                self.strike(id)?;
            }
        }
        let copy = self.copy.borrow();
        let done = copy.connection.execute(
            "UPDATE followed SET feature = ?1, removal = ?2",
            params![changes.position.feature, changes.position.removal],
        );
        copy.checked(done).map(|_| ()).map_err(Trouble::Here)
    }

    /// The local number of an experience of the server.
    fn local(&self, number: i64) -> Result<Option<i64>, Trouble> {
        let copy = self.copy.borrow();
        let found = copy
            .connection
            .query_row("SELECT experience FROM delivered WHERE number = ?1", [number], |row| row.get(0))
            .optional();
        copy.checked(found).map_err(Trouble::Here)
    }
}

impl Drop for OutboxStore {
    fn drop(&mut self) {
        if let Ok(waiting @ 1..) = self.waiting() {
            (self.listener)(&Notice::Waiting { waiting, file: self.file() });
        }
    }
}

impl ExperienceStore for OutboxStore {
    fn add(&mut self, experience: &Experience) -> Result<(i64, bool), StoreError> {
        let (id, new) = self.copy.borrow_mut().add(experience)?;
        self.synchronise(new.then_some(id))?;
        Ok((id, new))
    }

    fn get(&self, id: i64) -> Result<Option<Stored>, StoreError> {
        self.copy.borrow().get(id)
    }

    fn list(&self) -> Result<Vec<Summary>, StoreError> {
        self.copy.borrow().list()
    }

    fn forget(&mut self, id: i64) -> Result<bool, StoreError> {
        let forgotten = self.copy.borrow_mut().forget(id)?;
        self.synchronise(None)?;
        Ok(forgotten)
    }

    /// The attempt is delivered at the next contact.
    fn add_attempt(&mut self, attempt: &Attempt) -> Result<bool, StoreError> {
        self.copy.borrow_mut().add_attempt(attempt)
    }

    /// Delivered at the next contact; immediately if there is an experience.
    fn add_record(&mut self, record: &TaskRecord<'_>) -> Result<Option<i64>, StoreError> {
        let id = self.copy.borrow_mut().add_record(record)?;
        if id.is_some() {
            self.synchronise(id)?;
        }
        Ok(id)
    }

    fn journal(&self, name: &str) -> Result<Vec<String>, StoreError> {
        self.copy.borrow().journal(name)
    }

    fn attempts(&self, after: i64) -> Result<Vec<(i64, Attempt)>, StoreError> {
        self.copy.borrow().attempts(after)
    }

    fn attempt_rows(&self, after: i64) -> Result<Vec<AttemptRow>, StoreError> {
        self.copy.borrow().attempt_rows(after)
    }

    /// Removes it from the copy only.
    fn forget_attempt(&mut self, id: i64) -> Result<bool, StoreError> {
        self.copy.borrow_mut().forget_attempt(id)
    }

    fn changes(&self, since: Position) -> Result<Changes, StoreError> {
        self.synchronise(None)?;
        self.copy.borrow().changes(since)
    }
}
