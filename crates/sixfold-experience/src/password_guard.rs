//! A connection that is closed when the server requests the password in clear text, before anything is sent in answer.
//!
//! The client library would answer. Its interface for encryption is a wrapper around the connection, which can be started without
//! asking the server first. This wrapper encrypts nothing; it inspects the server's answer until the authentication method is known
//! (PostgreSQL's documentation, chapter "Frontend/Backend Protocol", message `AuthenticationCleartextPassword`).

use std::future::{Ready, ready};
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready as ready_or_wait};

use postgres::Socket;
use postgres::tls::{ChannelBinding, MakeTlsConnect, TlsConnect, TlsStream};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

/// The error message when a server requests the password in clear text (the server gets no answer).
pub(super) const ASKED: &str = "it asks for the password in clear text, which this program never sends; let the server \
                                ask for it by scram-sha-256 (in pg_hba.conf)";

/// Wraps connections.
#[derive(Clone, Copy)]
pub(super) struct PasswordGuard;

impl MakeTlsConnect<Socket> for PasswordGuard {
    type Stream = Guarded;
    type TlsConnect = PasswordGuard;
    type Error = io::Error;

    fn make_tls_connect(&mut self, _: &str) -> Result<PasswordGuard, io::Error> {
        Ok(PasswordGuard)
    }
}

impl TlsConnect<Socket> for PasswordGuard {
    type Stream = Guarded;
    type Error = io::Error;
    type Future = Ready<Result<Guarded, io::Error>>;

    fn connect(self, socket: Socket) -> Self::Future {
        ready(Ok(Guarded { socket, heard: Some(vec![]) }))
    }
}

/// An unencrypted connection whose first message is inspected.
pub(super) struct Guarded {
    socket: Socket,
    /// The beginning of the server's first message, until the authentication method is known.
    heard: Option<Vec<u8>>,
}

/// Whether the first bytes of a server's answer ask for the password in clear text; `None` while this is unknown.
fn asks_for_clear_text(heard: &[u8]) -> Option<bool> {
    match heard {
        // A letter, four bytes of length, four bytes of the authentication method.
        [b'R', _, _, _, _, kind @ ..] => kind.first_chunk().map(|kind| u32::from_be_bytes(*kind) == 3),
        [b'R', ..] | [] => None,
        // The client library accepts no other first message than this one or an error.
        _ => Some(false),
    }
}

impl AsyncRead for Guarded {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buf.filled().len();
        ready_or_wait!(Pin::new(&mut self.socket).poll_read(cx, buf))?;
        let Some(heard) = &mut self.heard else { return Poll::Ready(Ok(())) };
        heard.extend_from_slice(&buf.filled()[before..]);
        match asks_for_clear_text(heard) {
            Some(true) => {
                buf.set_filled(before);
                return Poll::Ready(Err(io::Error::new(io::ErrorKind::PermissionDenied, ASKED)));
            }
            Some(false) => self.heard = None,
            None => {}
        }
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Guarded {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.socket).poll_write(cx, buf)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_shutdown(cx)
    }
}

impl TlsStream for Guarded {
    fn channel_binding(&self) -> ChannelBinding {
        ChannelBinding::none()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_for_clear_text_is_known_however_it_arrives() {
        let clear = [b'R', 0, 0, 0, 8, 0, 0, 0, 3];
        for end in 0..clear.len() {
            assert_eq!(asks_for_clear_text(&clear[..end]), None);
        }
        assert_eq!(asks_for_clear_text(&clear), Some(true));
        let scram = [b'R', 0, 0, 0, 23, 0, 0, 0, 10, b'S'];
        assert_eq!(asks_for_clear_text(&scram), Some(false));
        assert_eq!(asks_for_clear_text(b"E"), Some(false));
    }
}
