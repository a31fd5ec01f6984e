//! Options of the server: address, access, folders and limits.

use std::net::{IpAddr, Ipv4Addr};
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::time::Duration;

use crate::error::ServeError;

/// Shortest token, characters: 64 bits in hexadecimal.
const SHORTEST_TOKEN: usize = 16;

/// Options of the server.
#[derive(Debug, Clone)]
pub struct ServerOptions {
    /// The address to listen on.
    pub host: IpAddr,
    /// The port; 0 is any free one.
    pub port: u16,
    /// The secret that every client needs; required on any address except loopback.
    pub token: Option<String>,
    /// The folder of stored objects.
    pub objects: PathBuf,
    /// The folder of jobs and their uploads.
    pub data: PathBuf,
    /// Number of jobs that are processed at once.
    pub workers: NonZeroUsize,
    /// A trained model that `sixfold train pix2pose` wrote: the method pix2pose, and a member of auto.
    pub pix2pose: Option<PathBuf>,
    /// Maximum bytes of one request.
    pub max_upload: usize,
    /// Maximum number of waiting jobs; further ones are refused until some are done.
    pub max_waiting: usize,
    /// Number of finished jobs that are kept; the oldest are removed first.
    pub keep: usize,
    /// Maximum number of connections at once.
    pub max_connections: usize,
    /// Longest time for one request to arrive and be answered; events of a job are sent as long as it runs.
    pub request_timeout: Duration,
    /// Longest time for a job; a longer one is stopped between two objects. Trainings have no limit.
    pub job_timeout: Duration,
}

impl ServerOptions {
    /// The defaults of `sixfold serve` with these two folders: on this machine alone, one worker.
    pub fn new(objects: impl Into<PathBuf>, data: impl Into<PathBuf>) -> ServerOptions {
        ServerOptions {
            host: IpAddr::V4(Ipv4Addr::LOCALHOST),
            port: 8640,
            token: None,
            objects: objects.into(),
            data: data.into(),
            workers: NonZeroUsize::MIN,
            pix2pose: None,
            max_upload: 100 << 20,
            max_waiting: 100,
            keep: 500,
            max_connections: 256,
            request_timeout: Duration::from_secs(120),
            job_timeout: Duration::from_secs(1800),
        }
    }

    /// Checks the options.
    ///
    /// # Errors
    /// [`ServeError::NoToken`] and [`ServeError::Option`].
    pub fn check(&self) -> Result<(), ServeError> {
        check_address(self.host, self.token.as_deref())?;
        let limits = [
            ("max-upload", self.max_upload),
            ("max-waiting", self.max_waiting),
            ("keep", self.keep),
            ("max-connections", self.max_connections),
        ];
        match limits.into_iter().find(|(_, value)| *value == 0) {
            Some((option, _)) => {
                Err(ServeError::Option { option, found: "0".to_owned(), expected: "1 or more".to_owned() })
            }
            None => Ok(()),
        }
    }
}

/// Checks that a server may listen on this address with this token: only loopback addresses need none.
///
/// # Errors
/// [`ServeError::NoToken`], and [`ServeError::Option`] for a token that is too short or cannot be sent in a header.
pub fn check_address(host: IpAddr, token: Option<&str>) -> Result<(), ServeError> {
    let Some(token) = token else {
        return if host.is_loopback() { Ok(()) } else { Err(ServeError::NoToken { host }) };
    };
    let good = token.len() >= SHORTEST_TOKEN && token.chars().all(|c| c.is_ascii_graphic());
    if good {
        return Ok(());
    }
    Err(ServeError::Option {
        option: "token",
        // The token itself is never printed.
        found: format!("{} characters", token.chars().count()),
        expected: format!(
            "{SHORTEST_TOKEN} or more letters, digits and signs without blanks; `openssl rand -hex 16` prints one"
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_address_than_loopback_needs_a_token() {
        let all = IpAddr::V4(Ipv4Addr::UNSPECIFIED);
        let message = check_address(all, None).unwrap_err().to_string();
        assert!(message.contains("0.0.0.0") && message.contains("--token"), "{message}");
        check_address(all, Some("0123456789abcdef")).unwrap();
        for token in ["", "short", "0123456789 abcdef"] {
            let message = check_address(all, Some(token)).unwrap_err().to_string();
            assert!(
                message.contains("--token") && (token.is_empty() || !message.contains(token)),
                "{message}"
            );
        }
        for host in ["127.0.0.1", "127.1.2.3", "::1"] {
            check_address(host.parse().unwrap(), None).unwrap();
        }
        assert!(check_address("192.168.0.7".parse().unwrap(), None).is_err());
    }

    #[test]
    fn limits_of_nothing_are_refused_by_name() {
        ServerOptions::new("objects", "data").check().unwrap();
        let options = ServerOptions { keep: 0, ..ServerOptions::new("objects", "data") };
        assert_eq!(options.check().unwrap_err().to_string(), "--keep: found 0, expected 1 or more");
    }
}
