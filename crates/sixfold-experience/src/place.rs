//! Where a store lies, as a user writes it: a file, or the address of a server.

use std::ffi::OsString;
use std::fmt;
use std::path::PathBuf;

use serde::{Serialize, Serializer};

use super::{ExperienceStore, StoreError};

/// A store's place. Displayed, debugged or serialised it never shows a password.
#[derive(Clone, PartialEq, Eq)]
pub enum StorePlace {
    /// A SQLite file.
    File(PathBuf),
    /// A PostgreSQL server: `postgres://user@host:port/database`.
    Server(String),
}

impl From<OsString> for StorePlace {
    fn from(text: OsString) -> StorePlace {
        match text.to_str() {
            Some(url) if url.starts_with("postgres://") || url.starts_with("postgresql://") => {
                StorePlace::Server(url.to_owned())
            }
            _ => StorePlace::File(text.into()),
        }
    }
}

impl From<&str> for StorePlace {
    fn from(text: &str) -> StorePlace {
        OsString::from(text).into()
    }
}

impl fmt::Display for StorePlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            StorePlace::File(path) => write!(f, "{}", path.display()),
            StorePlace::Server(url) => f.write_str(&shown(url)),
        }
    }
}

impl fmt::Debug for StorePlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "StorePlace({self})")
    }
}

impl Serialize for StorePlace {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            StorePlace::File(path) => path.serialize(serializer),
            StorePlace::Server(url) => shown(url).serialize(serializer),
        }
    }
}

impl StorePlace {
    /// For messages, as of a path; a password is left out.
    pub fn display(&self) -> &dyn fmt::Display {
        self
    }

    /// Opens a store that is there.
    ///
    /// # Errors
    /// [`StoreError`]; [`StoreError::Feature`] when this program was built without this kind of store.
    pub fn open(&self) -> Result<Box<dyn ExperienceStore + Send>, StoreError> {
        match self {
            #[cfg(feature = "sqlite")]
            StorePlace::File(path) => Ok(Box::new(super::SqliteStore::open(path)?)),
            #[cfg(feature = "postgres")]
            StorePlace::Server(url) => Ok(Box::new(super::PostgresStore::open(url)?)),
            #[allow(unreachable_patterns)]
            _ => Err(self.not_built()),
        }
    }

    /// Opens a store, or makes an empty one where there is none.
    ///
    /// # Errors
    /// [`StoreError`]; [`StoreError::Feature`] when this program was built without this kind of store.
    pub fn create(&self) -> Result<Box<dyn ExperienceStore + Send>, StoreError> {
        match self {
            #[cfg(feature = "sqlite")]
            StorePlace::File(path) => Ok(Box::new(super::SqliteStore::create(path)?)),
            #[cfg(feature = "postgres")]
            StorePlace::Server(url) => Ok(Box::new(super::PostgresStore::create(url)?)),
            #[allow(unreachable_patterns)]
            _ => Err(self.not_built()),
        }
    }

    /// A store for somebody who must continue when a server is away: a file as it is, a server through an `OutboxStore` whose
    /// file `outbox` is. `notice` receives what the user should know.
    ///
    /// # Errors
    /// [`StoreError`], but none because a server cannot be reached.
    #[cfg(feature = "sqlite")]
    pub fn create_with_outbox(
        &self,
        outbox: &std::path::Path,
        notice: impl Fn(&super::Notice) + Send + 'static,
    ) -> Result<Box<dyn ExperienceStore + Send>, StoreError> {
        match self {
            #[cfg(feature = "postgres")]
            StorePlace::Server(url) => {
                let remote = Box::new(super::PostgresStore::at(url)?);
                let options = super::OutboxOptions::default();
                Ok(Box::new(super::OutboxStore::create(outbox, remote, &options, Box::new(notice))?))
            }
            _ => {
                let _ = (outbox, notice);
                self.create()
            }
        }
    }

    fn not_built(&self) -> StoreError {
        let feature = match self {
            StorePlace::File(_) => "sqlite",
            StorePlace::Server(_) => "postgres",
        };
        StoreError::Feature { place: self.to_string(), feature }
    }
}

/// A server's address without what may be a password: user, host, port and database, no parameters. Of one that is not clear in
/// that, nothing.
pub(super) fn shown(url: &str) -> String {
    let (scheme, rest) = url.split_once("://").unwrap_or(("postgres", ""));
    let user_and_host = match rest.split_once('@') {
        _ if rest.matches('@').count() > 1 || rest.to_lowercase().contains("password") => None,
        None => Some((None, rest)),
        Some((user, host)) => Some((user.split(':').next(), host)),
    };
    let Some((user, host)) = user_and_host else { return format!("{scheme}://(not shown)") };
    let host = host.split('?').next().unwrap_or_default();
    match user {
        Some(user) => format!("{scheme}://{user}@{host}"),
        None => format!("{scheme}://{host}"),
    }
}
