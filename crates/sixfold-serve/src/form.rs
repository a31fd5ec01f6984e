//! Uploads: the fields of a multipart form, with known names and limited sizes.
//!
//! A client's file names are only used in messages and to find the format of meshes; the server never names its
//! files after them.

use std::collections::BTreeMap;
use std::str::FromStr;

use axum::body::Bytes;
use axum::extract::multipart::{Field, MultipartError, MultipartRejection};
use axum::extract::{FromRequest, Multipart, Request};
use axum::http::StatusCode;

use crate::app::App;
use crate::error::{Answer, ApiError};

/// Maximum bytes of a field that is not a file.
const MAX_TEXT: usize = 64 << 10;
/// Maximum number of fields of a form.
const MAX_FIELDS: usize = 200;
/// Longest name that a client may give a file, bytes: the limit of file systems.
const MAX_NAME: usize = 255;

/// The fields that a form may have.
pub(crate) struct FormRule {
    /// Files, each at most once.
    pub files: &'static [&'static str],
    /// Files that may be sent several times.
    pub many_files: &'static [&'static str],
    /// Texts, which may be sent several times.
    pub texts: &'static [&'static str],
}

/// An uploaded file.
#[derive(Debug, Clone)]
pub(crate) struct UploadedFile {
    /// The client's name for it; empty if there is none.
    pub name: String,
    pub bytes: Bytes,
}

/// A form that was read.
#[derive(Debug, Default)]
pub(crate) struct Form {
    files: BTreeMap<String, Vec<UploadedFile>>,
    texts: BTreeMap<String, Vec<String>>,
}

impl Form {
    /// Reads the form of a request. A few forms are read at once; the others wait.
    pub async fn read(app: &App, request: Request, rule: &FormRule) -> Answer<Form> {
        let _permit = app.uploads.acquire().await.map_err(|e| ApiError::system("uploads", e))?;
        let mut multipart = Multipart::from_request(request, &()).await.map_err(no_form)?;
        let mut form = Form::default();
        let mut fields = 0;
        let limit = app.options.max_upload;
        while let Some(field) = multipart.next_field().await.map_err(|e| broken(&e, limit))? {
            fields += 1;
            if fields > MAX_FIELDS {
                return Err(ApiError::field(
                    "form",
                    format!("more than {MAX_FIELDS} fields"),
                    "fewer",
                    "send several requests",
                ));
            }
            form.take(field, rule, limit).await?;
        }
        Ok(form)
    }

    async fn take(&mut self, field: Field<'_>, rule: &FormRule, limit: usize) -> Answer<()> {
        let name = field.name().unwrap_or_default().to_owned();
        let known = |names: &[&str]| names.contains(&name.as_str());
        if known(rule.files) || known(rule.many_files) {
            let file_name = field.file_name().unwrap_or_default().to_owned();
            check_name(&name, &file_name)?;
            let bytes = field.bytes().await.map_err(|e| broken(&e, limit))?;
            let files = self.files.entry(name.clone()).or_default();
            if !files.is_empty() && !known(rule.many_files) {
                return Err(ApiError::field(
                    name.as_str(),
                    "several files",
                    "one",
                    "send one request for each",
                ));
            }
            files.push(UploadedFile { name: file_name, bytes });
            return Ok(());
        }
        if known(rule.texts) {
            let bytes = field.bytes().await.map_err(|e| broken(&e, limit))?;
            if bytes.len() > MAX_TEXT {
                return Err(ApiError::field(
                    name.as_str(),
                    format!("{} bytes", bytes.len()),
                    format!("at most {MAX_TEXT}"),
                    "send files in the fields for files",
                ));
            }
            let text = String::from_utf8(bytes.to_vec()).map_err(|_| {
                ApiError::field(name.as_str(), "bytes that are no UTF-8", "text", "send text in UTF-8")
            })?;
            self.texts.entry(name).or_default().push(text);
            return Ok(());
        }
        let all: Vec<&str> = [rule.files, rule.many_files, rule.texts].concat();
        Err(ApiError::field(
            "form",
            format!("a field {name:?}, which is not known"),
            all.join(", "),
            "see /v1/openapi.json",
        ))
    }

    /// A file, if it was sent.
    pub fn file(&self, name: &str) -> Option<&UploadedFile> {
        self.files.get(name).and_then(|files| files.first())
    }

    /// All files of a field.
    pub fn files(&self, name: &str) -> &[UploadedFile] {
        self.files.get(name).map_or(&[], Vec::as_slice)
    }

    /// A required file.
    pub fn needed_file(&self, name: &str, what: &str) -> Answer<&UploadedFile> {
        self.file(name).ok_or_else(|| {
            ApiError::field(name, "nothing", what, format!("send it as the file field {name} of the form"))
        })
    }

    /// The single value of a text field, without blanks at its ends; an empty value counts as none.
    pub fn text(&self, name: &str) -> Answer<Option<&str>> {
        let values = self.texts.get(name).map_or(&[][..], Vec::as_slice);
        match values {
            [] => Ok(None),
            [one] => Ok(Some(one.trim()).filter(|t| !t.is_empty())),
            more => Err(ApiError::field(name, format!("{} values", more.len()), "one", "send it once")),
        }
    }

    /// All values of a text field, also separated by commas.
    pub fn list(&self, name: &str) -> Vec<String> {
        let values = self.texts.get(name).map_or(&[][..], Vec::as_slice);
        let parts = values.iter().flat_map(|v| v.split(',')).map(str::trim);
        parts.filter(|part| !part.is_empty()).map(str::to_owned).collect()
    }

    /// A value of a type, if it was sent; `expected` is for the message.
    pub fn parsed<T: FromStr>(&self, name: &str, expected: &str) -> Answer<Option<T>> {
        let Some(text) = self.text(name)? else { return Ok(None) };
        let wrong = |_| ApiError::field(name, format!("{text:?}"), expected, "correct the value");
        text.parse().map(Some).map_err(wrong)
    }

    /// A number within limits, if it was sent.
    pub fn number(&self, name: &str, expected: &str, good: impl Fn(f64) -> bool) -> Answer<Option<f64>> {
        let value: Option<f64> = self.parsed(name, expected)?;
        match value {
            Some(value) if !good(value) => {
                Err(ApiError::field(name, value.to_string(), expected, "correct the value"))
            }
            other => Ok(other),
        }
    }
}

/// A client's file name is never used as a path; a name that looks like a path is refused as a mistake or an
/// attack.
fn check_name(field: &str, name: &str) -> Answer<()> {
    let bad = name.len() > MAX_NAME
        || name.contains(['/', '\\', '\0'])
        || name.chars().any(char::is_control)
        || matches!(name, "." | "..");
    if !bad {
        return Ok(());
    }
    Err(ApiError::field(
        field,
        format!("a file named {name:?}"),
        format!("a file name of at most {MAX_NAME} bytes without / and \\"),
        "send the file's name alone, not its path",
    )
    .with_status(StatusCode::BAD_REQUEST))
}

fn no_form(rejection: MultipartRejection) -> ApiError {
    ApiError::field(
        "Content-Type",
        rejection.to_string(),
        "multipart/form-data with a boundary",
        "send a form: curl -F depth=@depth.png ...",
    )
    .with_status(StatusCode::UNSUPPORTED_MEDIA_TYPE)
}

fn broken(error: &MultipartError, limit: usize) -> ApiError {
    if error.status() == StatusCode::PAYLOAD_TOO_LARGE {
        return ApiError::field(
            "form",
            format!("more than {} MB", limit >> 20),
            format!("at most {} MB in one request", limit >> 20),
            "send smaller files, or start the server with a larger --max-upload",
        )
        .with_status(StatusCode::PAYLOAD_TOO_LARGE);
    }
    ApiError::field(
        "form",
        format!("a form that ends early or is damaged ({})", error.body_text()),
        "a whole multipart/form-data body",
        "send it again",
    )
    .with_status(StatusCode::BAD_REQUEST)
}
