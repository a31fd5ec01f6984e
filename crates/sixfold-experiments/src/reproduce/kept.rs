//! The files of long measurements: rows as they are made, and the inputs they were made from.

use std::path::Path;

use anyhow::{Context, Result, bail};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sixfold_shell::output::{JsonArguments, report, write_atomically};

/// The stored row of an earlier run, or a new one, which is stored.
pub(super) fn kept_or_made<T: Serialize + DeserializeOwned>(
    folder: &Path,
    key: &str,
    make: impl FnOnce() -> Result<T>,
) -> Result<T> {
    let path = folder.join("rows").join(format!("{key}.json"));
    if let Ok(text) = std::fs::read_to_string(&path) {
        return serde_json::from_str(&text).with_context(|| {
            format!("{}: not a row of this version; remove it to have it made again", path.display())
        });
    }
    eprintln!("row {key}");
    let text = serde_json::to_string_pretty(&make()?)?;
    write_atomically(&path, text.as_bytes())?;
    // Read it back as a later run will: numbers as text may lose their last digit.
    serde_json::from_str(&text).with_context(|| format!("row {key}"))
}

/// Writes `table.md` and `reproduce.json` into the folder and reports them; `files` names everything that is then in it.
pub(super) fn write_table(
    folder: &Path,
    text: &str,
    result: &impl Serialize,
    files: &str,
    json: &JsonArguments,
) -> Result<()> {
    write_atomically(&folder.join("table.md"), text.as_bytes())?;
    write_result(folder, "reproduce.json", text, result, files, json)
}

/// The same with the result in a file of another name, and without a table.
pub(super) fn write_result(
    folder: &Path,
    file: &str,
    text: &str,
    result: &impl Serialize,
    files: &str,
    json: &JsonArguments,
) -> Result<()> {
    write_atomically(&folder.join(file), serde_json::to_string_pretty(result)?.as_bytes())?;
    report(json, result, || {
        println!("{text}");
        println!("{files} in {}", folder.display());
    })
}

/// An error if the folder contains rows from other inputs.
pub(super) fn same_inputs(folder: &Path, inputs: &impl Serialize) -> Result<()> {
    let path = folder.join("inputs.json");
    let now = serde_json::to_value(inputs)?;
    if let Ok(text) = std::fs::read_to_string(&path) {
        let before: serde_json::Value = serde_json::from_str(&text)
            .with_context(|| format!("{}: not JSON; remove the folder", path.display()))?;
        if let (Some(before), Some(now)) = (before.as_object(), now.as_object())
            && let Some((field, was)) = before.iter().find(|(field, was)| now.get(*field) != Some(*was))
        {
            bail!(
                "{}: holds rows with other inputs ({field} was {was}, is {}); choose another --out, or remove it",
                folder.display(),
                now.get(field).cloned().unwrap_or_default()
            );
        }
        return Ok(());
    }
    write_atomically(&path, serde_json::to_string_pretty(&now)?.as_bytes())
}
