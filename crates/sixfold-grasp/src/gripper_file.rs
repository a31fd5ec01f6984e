//! Gripper files: a small JSON object in which every field is required and checked.

use std::path::Path;

use serde_json::{Map, Value};
use thiserror::Error;

use crate::Gripper;

/// Errors of gripper files.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum GripperError {
    /// The file cannot be read.
    #[error("gripper file {file}: {source}")]
    Io {
        /// The file.
        file: String,
        /// The cause.
        source: std::io::Error,
    },
    /// The file is not JSON.
    #[error("gripper file {file}: not JSON: {source}")]
    Json {
        /// The file.
        file: String,
        /// Position and cause.
        source: serde_json::Error,
    },
    /// A field is missing, unknown or impossible.
    #[error("gripper file {file}: field {field}: found {found}, expected {expected}")]
    Field {
        /// The file.
        file: String,
        /// The field.
        field: &'static str,
        /// Its value.
        found: String,
        /// The values allowed.
        expected: String,
    },
    /// An unknown field, most likely a typing error.
    #[error("gripper file {file}: field {field} is unknown, expected only {known}")]
    Unknown {
        /// The file.
        file: String,
        /// The field.
        field: String,
        /// The known fields.
        known: String,
    },
}

/// Names of all fields.
const FIELDS: [&str; 11] = [
    "kind",
    "name",
    "max_opening",
    "finger_length",
    "finger_width",
    "finger_thickness",
    "palm_width",
    "palm_depth",
    "palm_height",
    "force",
    "friction",
];

/// Reads a gripper file; see [`parse_gripper`] for its contents.
///
/// # Errors
/// [`GripperError`].
pub fn read_gripper(path: impl AsRef<Path>) -> Result<Gripper, GripperError> {
    let path = path.as_ref();
    let file = path.display().to_string();
    let text =
        std::fs::read_to_string(path).map_err(|source| GripperError::Io { file: file.clone(), source })?;
    parse_gripper(&text, &file)
}

/// The gripper in a text: a JSON object with `"kind": "parallel-jaws"`, `name`, and the fields of [`Gripper`] in metres and
/// newtons. `file` is used in errors.
///
/// # Errors
/// [`GripperError::Json`], and [`GripperError::Field`] or [`GripperError::Unknown`] for the first field that is wrong.
pub fn parse_gripper(text: &str, file: &str) -> Result<Gripper, GripperError> {
    let value: Value =
        serde_json::from_str(text).map_err(|source| GripperError::Json { file: file.to_owned(), source })?;
    let wrong = |field: &'static str, found: String, expected: &str| GripperError::Field {
        file: file.to_owned(),
        field,
        found,
        expected: expected.to_owned(),
    };
    let Value::Object(object) = &value else {
        return Err(wrong("(the whole file)", short(&value), "a JSON object"));
    };
    if let Some(field) = object.keys().find(|key| !FIELDS.contains(&key.as_str())) {
        return Err(GripperError::Unknown {
            file: file.to_owned(),
            field: field.clone(),
            known: FIELDS.join(", "),
        });
    }
    let text = |field: &'static str, expected: &str| match object.get(field) {
        Some(Value::String(word)) if !word.trim().is_empty() => Ok(word.clone()),
        other => Err(wrong(field, found(other), expected)),
    };
    let kind = text("kind", "\"parallel-jaws\"")?;
    if kind != "parallel-jaws" {
        return Err(wrong("kind", format!("\"{kind}\""), "\"parallel-jaws\""));
    }
    let number = |field: &'static str, object: &Map<String, Value>| match object.get(field) {
        Some(Value::Number(n)) => n.as_f64().ok_or_else(|| wrong(field, n.to_string(), "a number")),
        other => Err(wrong(field, found(other), "a number")),
    };
    let gripper = Gripper {
        name: text("name", "a name")?,
        max_opening: number("max_opening", object)?,
        finger_length: number("finger_length", object)?,
        finger_width: number("finger_width", object)?,
        finger_thickness: number("finger_thickness", object)?,
        palm_width: number("palm_width", object)?,
        palm_depth: number("palm_depth", object)?,
        palm_height: number("palm_height", object)?,
        force: number("force", object)?,
        friction: number("friction", object)?,
    };
    gripper.check(file)?;
    Ok(gripper)
}

fn found(value: Option<&Value>) -> String {
    value.map_or_else(|| "nothing".to_owned(), short)
}

/// A value shortened for a message.
fn short(value: &Value) -> String {
    let text = value.to_string();
    if text.chars().count() > 40 { format!("{}...", text.chars().take(37).collect::<String>()) } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = include_str!("../grippers/jaws-85.json");

    #[test]
    fn what_is_wrong_is_named() {
        let with = |from: &str, to: &str| {
            assert!(GOOD.contains(from));
            parse_gripper(&GOOD.replace(from, to), "hand.json").unwrap_err().to_string()
        };
        for (from, to, parts) in [
            ("\"max_opening\": 0.085", "\"max_opening\": 85", vec!["max_opening", "found 85", "write 0.085"]),
            (
                "\"finger_width\": 0.022",
                "\"finger_width\": -0.022",
                vec!["finger_width", "found -0.022", "0.001 to 0.2 m"],
            ),
            ("\"finger_length\": 0.045,", "", vec!["finger_length", "found nothing", "a number"]),
            ("\"force\": 30.0", "\"force\": \"30\"", vec!["force", "found \"30\"", "a number"]),
            ("\"friction\": 0.5", "\"friction\": 0", vec!["friction", "found 0", "0.01 to 2"]),
            ("\"friction\": 0.5", "\"frictoin\": 0.5", vec!["frictoin is unknown", "friction"]),
            ("parallel-jaws", "suction", vec!["kind", "\"suction\"", "\"parallel-jaws\""]),
            ("\"name\": \"jaws-85\"", "\"name\": \" \"", vec!["name", "expected a name"]),
        ] {
            let message = with(from, to);
            for part in parts.iter().chain(&["hand.json"]) {
                assert!(message.contains(part), "{message}");
            }
        }
        assert!(parse_gripper("{", "a").unwrap_err().to_string().contains("not JSON"));
        assert!(parse_gripper("[1]", "a").unwrap_err().to_string().contains("a JSON object"));
        assert!(matches!(read_gripper("no/such/file"), Err(GripperError::Io { .. })));
    }

    #[test]
    fn a_file_gives_the_gripper_that_it_describes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("g.json");
        std::fs::write(&path, GOOD).unwrap();
        assert_eq!(read_gripper(&path).unwrap(), Gripper::built_in("jaws-85").unwrap());
    }
}
