//! Access control: the token, if there is one; requests from foreign pages are refused; requests have a time limit.
//!
//! Any page in a browser can send requests to servers on the same machine. Without a token, the `Host` has to be this machine's (a
//! foreign name may resolve to it: DNS rebinding), and pages of another origin cannot change anything. A token arrives in the
//! header `Authorization: Bearer TOKEN` or, for pages, in the cookie that `POST /v1/session` sets, since images and event streams
//! cannot send headers.

use std::net::IpAddr;
use std::sync::Arc;

use axum::Json;
use axum::extract::{Request, State};
use axum::http::header::{AUTHORIZATION, CONTENT_ENCODING, COOKIE, HOST, ORIGIN, SET_COOKIE};
use axum::http::{HeaderMap, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::app::{App, Shared};
use crate::error::{Answer, ApiError, Problem};

const COOKIE_NAME: &str = "sixfold_token";

/// The token of a page.
#[derive(Debug, Deserialize, ToSchema)]
pub(crate) struct Session {
    /// The server's token.
    token: String,
}

/// Whether a token is asked for.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct SessionState {
    /// Always true: a wrong token is refused.
    accepted: bool,
}

/// Gives a page the cookie that stands for the token.
#[utoipa::path(post, path = "/v1/session", tag = "server", request_body = Session, responses(
    (status = 200, description = "The cookie is set", body = SessionState),
    (status = 401, description = "Wrong token", body = Problem),
    (status = 422, description = "No token in the body", body = Problem),
), security(()))]
pub(crate) async fn session(State(app): Shared, body: axum::body::Bytes) -> Answer<Response> {
    let session: Session = serde_json::from_slice(&body).map_err(|e| {
        ApiError::about("token", e, "JSON such as {\"token\": \"...\"}", "send the token of the server")
    })?;
    if let Some(token) = &app.options.token
        && !same(token, &session.token)
    {
        return Err(unknown());
    }
    let mut response = Json(SessionState { accepted: true }).into_response();
    let cookie = format!("{COOKIE_NAME}={}; Path=/; HttpOnly; SameSite=Strict", encoded(&session.token));
    let cookie = cookie.parse().map_err(|_| unknown())?;
    response.headers_mut().insert(SET_COOKIE, cookie);
    Ok(response)
}

fn unknown() -> ApiError {
    ApiError::plain(
        StatusCode::UNAUTHORIZED,
        "this server needs its token",
        "send the header `Authorization: Bearer TOKEN`, the token that the server was started with",
    )
}

/// Passes a request on, or answers it with the reason for refusing it.
pub(crate) async fn guard(State(app): State<Arc<App>>, request: Request, next: Next) -> Response {
    if let Err(error) = check(&app, request.method(), request.uri().path(), request.headers()) {
        return error.into_response();
    }
    let timeout = app.options.request_timeout;
    match tokio::time::timeout(timeout, next.run(request)).await {
        Ok(response) => response,
        Err(_) => ApiError::plain(
            StatusCode::REQUEST_TIMEOUT,
            format!("the request took longer than {} s to arrive and to be answered", timeout.as_secs()),
            "send less at once",
        )
        .into_response(),
    }
}

fn check(app: &App, method: &Method, path: &str, headers: &HeaderMap) -> Answer<()> {
    if headers.get(CONTENT_ENCODING).is_some_and(|v| v != "identity") {
        return Err(ApiError::field(
            "Content-Encoding",
            "a compressed body",
            "none",
            "send the body as it is; images are compressed already",
        )
        .with_status(StatusCode::UNSUPPORTED_MEDIA_TYPE));
    }
    let host = text(headers, HOST.as_str());
    let changes = !matches!(*method, Method::GET | Method::HEAD | Method::OPTIONS);
    let origin = text(headers, ORIGIN.as_str()).and_then(|o| o.split_once("://").map(|(_, host)| host));
    // An origin that is not an address, such as `null`, is foreign too.
    if changes && headers.contains_key(ORIGIN) && (origin.is_none() || origin != host) {
        return Err(ApiError::plain(
            StatusCode::FORBIDDEN,
            "a page of another origin may change nothing here",
            "open the page from this server, or use a program without the header Origin",
        ));
    }
    let Some(token) = &app.options.token else {
        let own = host.is_some_and(|host| is_own(host, app.options.host));
        return if own {
            Ok(())
        } else {
            Err(ApiError::field(
                "Host",
                format!("{:?}", host.unwrap_or_default()),
                "localhost or 127.0.0.1",
                "ask by this machine's own name, or start the server with --token",
            )
            .with_status(StatusCode::FORBIDDEN))
        };
    };
    // Pages contain no user data, and they ask for the token.
    if !path.starts_with("/v1/") || matches!(path, "/v1/session" | "/v1/health") {
        return Ok(());
    }
    let bearer = text(headers, AUTHORIZATION.as_str()).and_then(|v| v.strip_prefix("Bearer "));
    if bearer.is_some_and(|given| same(token, given.trim())) || in_cookie(headers, token) {
        return Ok(());
    }
    Err(unknown())
}

fn text<'h>(headers: &'h HeaderMap, name: &str) -> Option<&'h str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

/// Whether `Host` names this machine, or the address on which the server listens.
fn is_own(host: &str, listening: IpAddr) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|b| b.is_ascii_digit()) => name,
        _ => host,
    };
    let name = name.trim_start_matches('[').trim_end_matches(']');
    name.eq_ignore_ascii_case("localhost")
        || name.parse::<IpAddr>().is_ok_and(|address| address.is_loopback() || address == listening)
}

fn in_cookie(headers: &HeaderMap, token: &str) -> bool {
    let expected = encoded(token);
    let cookies = headers.get_all(COOKIE).iter().filter_map(|value| value.to_str().ok());
    cookies.flat_map(|value| value.split(';')).any(|cookie| {
        let pair = cookie.trim().split_once('=');
        pair.is_some_and(|(name, value)| name == COOKIE_NAME && same(&expected, value))
    })
}

/// A token as a cookie's value, with special characters encoded.
fn encoded(token: &str) -> String {
    token.bytes().map(|b| format!("{b:02x}")).collect()
}

/// Whether two texts are equal, compared in constant time.
fn same(a: &str, b: &str) -> bool {
    let (a, b) = (a.as_bytes(), b.as_bytes());
    let different = a.iter().zip(b).fold(0, |bits, (x, y)| bits | (x ^ y));
    a.len() == b.len() && different == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hosts_of_this_machine() {
        let local: IpAddr = "127.0.0.1".parse().unwrap();
        for host in ["localhost", "LOCALHOST:8640", "127.0.0.1:8640", "127.0.0.1", "[::1]:8640", "[::1]"] {
            assert!(is_own(host, local), "{host}");
        }
        for host in ["example.org", "example.org:8640", "127.0.0.1.example.org", "192.168.0.7:8640", ""] {
            assert!(!is_own(host, local), "{host}");
        }
        assert!(is_own("192.168.0.7:8640", "192.168.0.7".parse().unwrap()));
    }

    #[test]
    fn tokens_are_compared_whole() {
        assert!(same("abc", "abc") && !same("abc", "abd") && !same("abc", "ab") && !same("", "a"));
        let mut headers = HeaderMap::new();
        headers.insert(COOKIE, "a=b; sixfold_token=2b3b".parse().unwrap());
        assert!(in_cookie(&headers, "+;") && !in_cookie(&headers, "+"));
    }
}
