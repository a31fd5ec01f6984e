//! The location of a store as written by a user: a file, or the address of a server.
//!
//! This is the only parser of such locations. A text that looks like an address but is not valid is refused rather than used as a
//! file name. Passwords are never shown, whether the address is valid or not.

use std::ffi::OsString;
use std::fmt;
use std::path::PathBuf;

use serde::{Serialize, Serializer};

use super::{ExperienceStore, StoreError};

/// A store's location. Its display, debug and serialised forms never contain a password.
#[derive(Clone, PartialEq, Eq)]
pub enum StorePlace {
    /// A SQLite file.
    File(PathBuf),
    /// A PostgreSQL server: `postgres://user@host:port/database`.
    Server(String),
    /// A text that looks like the address of a server but is invalid: it cannot be opened.
    Unusable {
        /// The part of it that can be shown.
        shown: String,
        /// What is wrong.
        reason: String,
    },
}

impl From<OsString> for StorePlace {
    fn from(text: OsString) -> StorePlace {
        let readable = text.to_string_lossy();
        if !looks_like_an_address(&readable) {
            return StorePlace::File(text.into());
        }
        match address(&readable) {
            Ok(url) => StorePlace::Server(url),
            Err(reason) => StorePlace::Unusable { shown: shown(&readable), reason },
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
            StorePlace::Unusable { shown, .. } => f.write_str(shown),
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
            StorePlace::Unusable { shown, .. } => shown.serialize(serializer),
        }
    }
}

impl StorePlace {
    /// For messages, like `Path::display`; without the password.
    pub fn display(&self) -> &dyn fmt::Display {
        self
    }

    /// Opens an existing store.
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

    /// Opens a store to save its contents; of a damaged file, whatever can still be read.
    ///
    /// # Errors
    /// As [`StorePlace::open`].
    pub fn open_to_save(&self) -> Result<Box<dyn ExperienceStore + Send>, StoreError> {
        match (self.open(), self) {
            #[cfg(feature = "sqlite")]
            (Err(StoreError::Broken { .. }), StorePlace::File(path)) => {
                Ok(Box::new(super::SqliteStore::open_damaged(path)?))
            }
            (opened, _) => opened,
        }
    }

    /// Opens a store, or creates an empty one if there is none.
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

    /// A store that remains usable while a server is unreachable: a file is opened directly, a server through an `OutboxStore` with
    /// the file `outbox`. `notice` receives messages for the user.
    ///
    /// # Errors
    /// [`StoreError`], but not for an unreachable server.
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

    /// Why it cannot be opened: it is invalid, or this program was built without its kind of store.
    fn not_built(&self) -> StoreError {
        let feature = match self {
            StorePlace::File(_) => "sqlite",
            StorePlace::Server(_) => "postgres",
            StorePlace::Unusable { shown, reason } => {
                return StoreError::Address { server: shown.clone(), reason: reason.clone() };
            }
        };
        StoreError::Feature { place: self.to_string(), feature }
    }
}

/// Keywords before an equals sign in connection strings such as `host=server user=robot password=..`.
const KEYWORDS: [&str; 15] = [
    "host", "hostaddr", "port", "user", "password", "dbname", "database", "service", "passfile", "sslmode",
    "server", "username", "uid", "pwd", "passwd",
];

/// Whether a text is meant to be the address of a server. A path that begins like one (`/`, `./`, `../`) never is.
fn looks_like_an_address(text: &str) -> bool {
    let text = text.trim_start_matches(|c: char| c.is_whitespace() || c.is_control()).to_ascii_lowercase();
    let absolute = text.starts_with('/') && !text.starts_with("//");
    if absolute || text.starts_with("./") || text.starts_with("../") || text.starts_with("~/") {
        return false;
    }
    // A drive letter is not a scheme.
    let text = match text.as_bytes() {
        [drive, b':', b'\\' | b'/', ..] if drive.is_ascii_alphabetic() => &text[2..],
        _ => &text[..],
    };
    let of_postgres = text.split_once(':').is_some_and(|(scheme, _)| scheme.starts_with("postgres"));
    let credentials =
        text.split_once('@').is_some_and(|(before, _)| before.contains(':') || before.contains("%3a"));
    let word_before = |text: &str| {
        let word = text.trim_end().rsplit(|c: char| !c.is_ascii_alphanumeric()).next();
        word.is_some_and(|word| KEYWORDS.contains(&word))
    };
    let keywords = text.rsplit('=').skip(1).any(word_before);
    text.contains("://") || of_postgres || credentials || keywords
}

/// The address in a text, with its scheme in lower case and without surrounding white space.
///
/// # Errors
/// The reason why it is invalid, without any part of the text.
pub(super) fn address(text: &str) -> Result<String, String> {
    let text = text.trim_matches(|c: char| c.is_whitespace() || c.is_control());
    const FILE: &str = "if it is the name of a file, write ./ before it";
    let Some((scheme, rest)) = text.split_once("://") else {
        return Err(format!(
            "it looks like the address of a server, but does not begin with postgres://; {FILE}"
        ));
    };
    let scheme = scheme.to_ascii_lowercase();
    if scheme != "postgres" && scheme != "postgresql" {
        return Err(format!("this kind of address is not known, only postgres:// is; {FILE}"));
    }
    if let Some((credentials, _)) = rest.split_once('@') {
        let user = credentials.split(':').next().unwrap_or_default().to_ascii_lowercase();
        if user.contains("%3a") {
            return Err("the colon between user and password is written : and not %3A".to_owned());
        }
    }
    Ok(format!("{scheme}://{rest}"))
}

/// A server's address without anything that may be a password: user, host, port and database, no parameters. Of an ambiguous
/// address only the scheme.
pub(super) fn shown(text: &str) -> String {
    let text = text.trim_matches(|c: char| c.is_whitespace() || c.is_control());
    let plain = |part: &str, more: &str| {
        part.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c) || more.contains(c))
    };
    let Some((scheme, rest)) = text.split_once("://").filter(|(scheme, _)| plain(scheme, "+")) else {
        return "(an address that is not shown)".to_owned();
    };
    let hidden = format!("{scheme}://(not shown)");
    let (user, rest) = match rest.split_once('@') {
        Some((credentials, rest)) => (credentials.split(':').next(), rest),
        None => (None, rest),
    };
    let place = rest.split(['?', '#']).next().unwrap_or_default();
    let (hosts, database) = place.split_once('/').unwrap_or((place, ""));
    // After a host's colon there is a port, or a password with its @ missing.
    let of_a_host = |host: &str| {
        let behind = host.rsplit(']').next().unwrap_or(host);
        let port = behind.split_once(':').map_or("", |(_, port)| port);
        plain(host, ":[]%") && port.chars().all(|c| c.is_ascii_digit())
    };
    let lower = rest.to_ascii_lowercase();
    // The position of passwords in other kinds of addresses is unknown.
    let of_postgres = ["postgres", "postgresql"].iter().any(|known| scheme.eq_ignore_ascii_case(known));
    let clear = of_postgres
        && !["password", "%3a", "%40", "@"].iter().any(|word| lower.contains(word))
        && hosts.split(',').all(of_a_host)
        && plain(database, "")
        && plain(user.unwrap_or_default(), "");
    match user {
        _ if !clear => hidden,
        Some(user) => format!("{scheme}://{user}@{place}"),
        None => format!("{scheme}://{place}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_form_of_an_address_shows_its_password_or_becomes_a_file() {
        for text in [
            "Postgres://robot:secret@127.0.0.1:1/fleet",
            "POSTGRESQL://robot:secret@127.0.0.1:1/fleet",
            "postgresql+psycopg://robot:secret@host/fleet",
            "postgres+ssl://secret@host/fleet",
            "host=server user=robot password=secret dbname=fleet",
            "user=robot password = 'secret'",
            "Server=host;Database=fleet;Uid=robot;Pwd=secret;",
            " postgres://robot:secret@127.0.0.1:1/fleet",
            "\tpostgres://robot:secret@127.0.0.1:1/fleet\n",
            "postgres://robot%3Asecret@127.0.0.1:1/fleet",
            "postgres://robot%3asecret:x@127.0.0.1:1/fleet",
            "user%3Asecret@host/fleet",
            "robot:secret@host/fleet",
            "//robot:secret@host/fleet",
            "postgres:robot:secret@host/fleet",
            "postgres:/robot:secret@host/fleet",
            "postgres://robot:secret",
            "postgres://robot:se@secret@host/fleet",
            "postgres://robot/secret@host/fleet",
            "postgres://host:1/fleet?password=secret",
            "postgres://host:1/fleet;password=secret",
            "postgres://robot%3Asecret%40host/fleet",
            "postgres://127.0.0.1:1/fleet?passw%6Frd=secret#secret",
            "jdbc:postgresql://host/fleet?user=robot&password=secret",
            "mysql://robot:secret@host/fleet",
            "https://robot:secret@host/fleet",
        ] {
            let place = StorePlace::from(text);
            assert!(!matches!(place, StorePlace::File(_)), "{text:?} is taken for a file");
            let serialised = serde_json::to_string(&place).unwrap();
            let errors = [place.open().err(), place.create().err(), place.open_to_save().err()];
            for shown in [format!("{place} {place:?} {serialised}"), format!("{errors:?}")]
                .into_iter()
                .chain(errors.iter().map(|e| e.as_ref().expect("nobody is there").to_string()))
            {
                assert!(!shown.contains("secret"), "{text:?} is shown as {shown}");
            }
        }
    }

    #[test]
    fn files_are_files_and_servers_are_servers() {
        for text in [
            "a.db",
            "out/experience.db",
            "./host=1.db",
            "/data/robot:1@home.db",
            "robot@home.db",
            "C:\\a@b\\c.db",
        ] {
            assert_eq!(StorePlace::from(text), StorePlace::File(text.into()), "{text}");
        }
        for (text, shown) in [
            ("postgres://robot:secret@server:5432/fleet", "postgres://robot@server:5432/fleet"),
            ("Postgres://robot@server/fleet", "postgres://robot@server/fleet"),
            ("postgresql://robot@[::1]:5432/fleet?connect_timeout=3", "postgresql://robot@[::1]:5432/fleet"),
            ("postgres://a:1,b:2/fleet", "postgres://a:1,b:2/fleet"),
        ] {
            let place = StorePlace::from(text);
            assert!(matches!(place, StorePlace::Server(_)), "{text}");
            assert_eq!(place.to_string(), shown);
        }
    }
}
