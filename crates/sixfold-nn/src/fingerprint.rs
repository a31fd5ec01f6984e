//! Everything on which the result of a training depends: its options, and hashes of its inputs. It is stored in every checkpoint; a
//! training is resumed, exported or considered finished only for the same options and inputs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::Value;
use sixfold_io::{Fnv1a, fnv1a_of_file};

use crate::train_error::TrainError;

/// Maximum number of differences that a message lists.
const LISTED: usize = 3;

/// Names with values: an option by its value, an input by a hash of its contents, independent of its location.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Fingerprint(BTreeMap<String, Value>);

impl Fingerprint {
    /// The fingerprint of options: every field by its name, those of nested structures joined with dots (`pool.crop.side`).
    ///
    /// # Errors
    /// [`TrainError::Method`] for options that cannot be written as JSON.
    pub fn of(options: &impl Serialize) -> Result<Self, TrainError> {
        let mut entries = BTreeMap::new();
        flatten(String::new(), serde_json::to_value(options).map_err(TrainError::method)?, &mut entries);
        Ok(Fingerprint(entries))
    }

    /// The same with one more value.
    pub fn with(mut self, name: &str, value: impl Into<Value>) -> Self {
        self.0.insert(name.to_owned(), value.into());
        self
    }

    /// The same with contents described by the caller.
    pub fn with_contents(mut self, contents: impl IntoIterator<Item = (String, String)>) -> Self {
        self.0.extend(contents.into_iter().map(|(name, text)| (name, Value::from(text))));
        self
    }

    /// The same with the contents of a file, if there is one.
    ///
    /// # Errors
    /// [`TrainError::Input`].
    pub fn with_file(self, name: &str, file: Option<&Path>) -> Result<Self, TrainError> {
        let hash = file.map(|file| hash_of(name, file).map(|hash| format!("{hash:016x}"))).transpose()?;
        Ok(self.with(name, hash))
    }

    /// The same with the contents of files in this order; an empty list is recorded as such.
    ///
    /// # Errors
    /// [`TrainError::Input`].
    pub fn with_files(self, name: &str, files: &[PathBuf]) -> Result<Self, TrainError> {
        let mut all = Fnv1a::default();
        for file in files {
            all.write(&hash_of(name, file)?.to_le_bytes());
        }
        let text = match files.len() {
            0 => "none".to_owned(),
            count => format!("{count} files, hash {:016x}", all.value()),
        };
        Ok(self.with(name, text))
    }

    /// The same with all values of another.
    pub fn merged(mut self, other: &Fingerprint) -> Self {
        self.0.extend(other.0.iter().map(|(name, value)| (name.clone(), value.clone())));
        self
    }

    /// Description of the differences between the fingerprint of a checkpoint and the requested one, `asked`; `None` if they are
    /// equal.
    pub fn difference(&self, asked: &Fingerprint) -> Option<String> {
        self.difference_in(asked, self.0.keys().chain(asked.0.keys()))
    }

    /// The same, but only for the names in `asked`, before the other values are known.
    pub(crate) fn difference_from_part(&self, asked: &Fingerprint) -> Option<String> {
        self.difference_in(asked, asked.0.keys())
    }

    fn difference_in<'a>(
        &self,
        asked: &Fingerprint,
        names: impl Iterator<Item = &'a String>,
    ) -> Option<String> {
        let names: std::collections::BTreeSet<&String> = names.collect();
        let show = |value: Option<&Value>| value.map_or("not there".to_owned(), ToString::to_string);
        let all: Vec<String> = names
            .into_iter()
            .map(|name| (name, self.0.get(name), asked.0.get(name).map(as_read)))
            .filter(|(_, was, is)| *was != is.as_ref())
            .map(|(name, was, is)| format!("{name} was {}, is {}", show(was), show(is.as_ref())))
            .collect();
        let listed = all.iter().take(LISTED).cloned().collect::<Vec<_>>().join("; ");
        match all.len() {
            0 => None,
            n if n > LISTED => Some(format!("{listed}; and {} more", n - LISTED)),
            _ => Some(listed),
        }
    }
}

/// A value after writing to a file and reading: the last digit of a number may change.
fn as_read(value: &Value) -> Value {
    serde_json::from_str(&value.to_string()).unwrap_or_else(|_| value.clone())
}

fn flatten(name: String, value: Value, entries: &mut BTreeMap<String, Value>) {
    match value {
        Value::Object(fields) => {
            for (field, value) in fields {
                let name = if name.is_empty() { field } else { format!("{name}.{field}") };
                flatten(name, value, entries);
            }
        }
        value => {
            entries.insert(name, value);
        }
    }
}

fn hash_of(name: &str, file: &Path) -> Result<u64, TrainError> {
    fnv1a_of_file(file).map_err(|source| TrainError::Input {
        name: name.to_owned(),
        file: file.to_owned(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn differences_are_named_with_both_values() {
        let was =
            Fingerprint::of(&json!({"steps": 3, "pool": {"crop": {"side": 96}, "sides": [1, 2]}})).unwrap();
        let text = serde_json::to_string(&was).unwrap();
        assert_eq!(text, r#"{"pool.crop.side":96,"pool.sides":[1,2],"steps":3}"#);
        assert_eq!(was.difference(&serde_json::from_str(&text).unwrap()), None);
        let is = was.clone().with("steps", 6).with("pool.crop.side", 128);
        assert_eq!(was.difference(&is).unwrap(), "pool.crop.side was 96, is 128; steps was 3, is 6");
        let few = Fingerprint::default().with("steps", 3);
        assert_eq!(was.difference_from_part(&few), None);
        assert_eq!(
            was.difference(&few).unwrap(),
            "pool.crop.side was 96, is not there; pool.sides was [1,2], is not there"
        );
        let more = was.clone().with("a", 1).with("b", 1).with("c", 1).with("d", 1);
        assert!(was.difference(&more).unwrap().ends_with("c was not there, is 1; and 1 more"));
    }

    #[test]
    fn numbers_survive_a_file_and_contents_count_not_paths() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let write = |name: &str, bytes: &[u8]| std::fs::write(path(name), bytes).unwrap();
        write("a", b"one");
        write("b", b"one");
        write("c", b"two");
        let of = |name: &str| Fingerprint::default().with_file("init", Some(&path(name))).unwrap();
        assert_eq!(of("a"), of("b"));
        assert!(of("a").difference(&of("c")).unwrap().starts_with("init was \""));
        let files =
            |names: [&str; 2]| Fingerprint::default().with_files("backgrounds", &names.map(path)).unwrap();
        assert_eq!(files(["a", "c"]), files(["b", "c"]));
        assert_ne!(files(["a", "c"]), files(["c", "a"]));
        let error = Fingerprint::default().with_file("init", Some(&path("d"))).unwrap_err().to_string();
        assert!(error.contains("init: ") && error.contains("check the path"), "{error}");
        for number in [0.1 + 0.2, f64::from(0.7f32), 1.0 / 3.0, 5e-324, 1.797e308] {
            let one = Fingerprint::default().with("x", number);
            let read: Fingerprint = serde_json::from_str(&serde_json::to_string(&one).unwrap()).unwrap();
            assert_eq!(read.difference(&one), None, "{number}");
        }
    }
}
