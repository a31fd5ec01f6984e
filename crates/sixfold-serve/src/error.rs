//! Errors: of a request, as JSON with the field, the values found and expected, and advice; and of the server itself.

use std::net::SocketAddr;
use std::path::PathBuf;

use axum::Json;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use sixfold_estimator::StoreError;
use sixfold_io::{CameraFileError, ImageFileError, LockError};
use thiserror::Error;
use utoipa::ToSchema;

/// Why the server cannot start, or ends.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ServeError {
    /// Listening on an address that other machines can reach requires a token.
    #[error(
        "--host {host}: any machine of the network could use this server, and no token is set; give --token TOKEN (16 characters or \
         more: `openssl rand -hex 16` prints one) or set SIXFOLD_TOKEN, or leave --host at 127.0.0.1"
    )]
    NoToken {
        /// The address.
        host: std::net::IpAddr,
    },
    /// An option is out of its range.
    #[error("--{option}: found {found}, expected {expected}")]
    Option {
        /// Its name.
        option: &'static str,
        /// The given value.
        found: String,
        /// The expected value.
        expected: String,
    },
    /// The server cannot listen on the address.
    #[error(
        "cannot listen on {address}: {source}; another program may use this port: give another one with --port"
    )]
    Bind {
        /// The address.
        address: SocketAddr,
        /// The system's error.
        source: std::io::Error,
    },
    /// Two servers with the same folder.
    #[error("--data: another server keeps its jobs there")]
    Data(#[from] LockError),
    /// The system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A method's files cannot be read.
    #[error(transparent)]
    Method(anyhow::Error),
}

/// An error as clients receive it: `error` is the whole sentence, the other fields are its parts if they are known.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub(crate) struct Problem {
    /// The whole message.
    pub error: String,
    /// The field of the request that it is about.
    pub field: Option<String>,
    /// What the field may be.
    pub expected: Option<String>,
    /// The found value.
    pub found: Option<String>,
    /// Advice.
    pub advice: Option<String>,
}

/// A problem with its status.
#[derive(Debug, Clone)]
pub(crate) struct ApiError {
    pub status: StatusCode,
    pub problem: Box<Problem>,
}

/// The return type of handlers.
pub(crate) type Answer<T> = Result<T, ApiError>;

impl ApiError {
    /// An invalid field; status 422 unless [`ApiError::with_status`] sets another.
    pub fn field(
        field: impl Into<String>,
        found: impl Into<String>,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) -> ApiError {
        let (field, found) = (field.into(), shortened(&found.into()));
        let (expected, advice) = (expected.into(), advice.into());
        let error = format!("{field}: found {found}, expected {expected}; {advice}");
        let problem = Problem {
            error,
            field: Some(field),
            expected: Some(expected),
            found: Some(found),
            advice: Some(advice),
        };
        ApiError { status: StatusCode::UNPROCESSABLE_ENTITY, problem: Box::new(problem) }
    }

    /// A message of a library about a field; `expected` and `advice` describe a valid field.
    pub fn about(
        field: &str,
        message: impl ToString,
        expected: impl Into<String>,
        advice: impl Into<String>,
    ) -> ApiError {
        let message = message.to_string();
        // Messages begin with the name given for the file, here the field's name.
        let found = message.strip_prefix(&format!("{field}: ")).unwrap_or(&message).to_owned();
        let problem = Problem {
            error: format!("{field}: {found}"),
            field: Some(field.to_owned()),
            expected: Some(expected.into()),
            found: Some(found),
            advice: Some(advice.into()),
        };
        ApiError { status: StatusCode::UNPROCESSABLE_ENTITY, problem: Box::new(problem) }
    }

    /// A message that is not about a field.
    pub fn plain(status: StatusCode, error: impl Into<String>, advice: impl Into<String>) -> ApiError {
        let problem = Problem {
            error: error.into(),
            field: None,
            expected: None,
            found: None,
            advice: Some(advice.into()),
        };
        ApiError { status, problem: Box::new(problem) }
    }

    /// An internal error of the server, with the system's message.
    pub fn system(what: &str, error: impl std::fmt::Display) -> ApiError {
        ApiError::plain(
            StatusCode::INTERNAL_SERVER_ERROR,
            format!("{what}: {error}"),
            "check the server's disk and its messages",
        )
    }

    pub fn with_status(self, status: StatusCode) -> ApiError {
        ApiError { status, ..self }
    }

    /// An error of the store; the name is a field of the request.
    pub fn of_store(field: &str, error: &StoreError) -> ApiError {
        match error {
            StoreError::Name(name) => ApiError::field(
                field,
                format!("{name:?}"),
                "up to 100 letters, digits, - and _",
                "give another name",
            )
            .with_status(StatusCode::BAD_REQUEST),
            StoreError::Unknown { name, there, .. } => ApiError::field(
                field,
                format!("{name:?}, which is not a stored object"),
                format!("one of the stored objects ({there})"),
                "add the object; /v1/objects lists those that exist",
            )
            .with_status(StatusCode::NOT_FOUND),
            StoreError::Exists { name, .. } => ApiError::field(
                field,
                format!("{name:?}, which exists already"),
                "a new name",
                "give replace=true or another name",
            )
            .with_status(StatusCode::CONFLICT),
            StoreError::Locked(_) => ApiError::plain(
                StatusCode::CONFLICT,
                format!("{field}: another process is changing this object"),
                "try again in a moment",
            ),
            StoreError::NotAnObject { .. } | StoreError::Record { .. } | StoreError::StoredMesh { .. } => {
                ApiError::field(
                    field,
                    "an object whose files are damaged",
                    "a whole one",
                    "add the object again with replace=true",
                )
                .with_status(StatusCode::CONFLICT)
            }
            StoreError::Derive { source, .. } => {
                ApiError::about(field, source, "a mesh that methods can describe", "repair the mesh")
            }
            other => ApiError::system("the store of objects", other),
        }
    }

    /// An error of an image; `field` is its name in messages.
    pub fn of_image(field: &str, error: &ImageFileError) -> ApiError {
        match error {
            ImageFileError::Size { expected, found, .. } => ApiError::field(
                field,
                format!("an image of {}x{}", found.0, found.1),
                format!("{}x{}", expected.0, expected.1),
                "give the images of one camera, and its camera file",
            ),
            ImageFileError::Mask { .. } => ApiError::about(
                field,
                error,
                "a PNG that is above zero on the object",
                "write the mask as PNG with one colour besides black",
            ),
            _ => ApiError::about(
                field,
                error,
                "a PNG or JPEG image; depth: PNG, one channel of 16 bits",
                "get the file again or convert it",
            ),
        }
    }

    /// An error of a camera file.
    pub fn of_camera(error: &CameraFileError) -> ApiError {
        ApiError::about(
            "camera",
            error,
            "a camera file of BOP, OpenCV or ROS for images of this size",
            "give the camera file of these images, or fx, fy, cx, cy",
        )
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        (self.status, Json(self.problem)).into_response()
    }
}

/// A client's text, shortened for a message.
fn shortened(text: &str) -> String {
    const LONGEST: usize = 300;
    if text.chars().count() <= LONGEST {
        return text.to_owned();
    }
    let start: String = text.chars().take(LONGEST).collect();
    format!("{start}...")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_names_its_field_once() {
        let error = ApiError::about("depth", "depth: not a readable image", "a PNG", "convert it");
        assert_eq!(error.problem.error, "depth: not a readable image");
        assert_eq!(error.problem.found.as_deref(), Some("not a readable image"));
        let error = ApiError::field("port", "x".repeat(1000), "a number", "give one");
        assert!(error.problem.error.len() < 400, "{}", error.problem.error.len());
        assert_eq!(error.status, StatusCode::UNPROCESSABLE_ENTITY);
    }
}
