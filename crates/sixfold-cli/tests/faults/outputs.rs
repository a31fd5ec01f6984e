//! The files that a command wrote, in a form that is equal for two runs of the same command: without measured times, and with
//! a store of experiences represented by its content.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::support::sixfold;

/// All files below a folder, by their path in it.
pub type Tree = BTreeMap<PathBuf, Vec<u8>>;

/// All paths below a folder, including folders.
fn paths(folder: &Path) -> Vec<PathBuf> {
    let mut all = vec![];
    let mut open = vec![folder.to_path_buf()];
    while let Some(dir) = open.pop() {
        for entry in fs::read_dir(&dir).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                open.push(path.clone());
            }
            all.push(path);
        }
    }
    all
}

/// A name of a file that only a running command may have.
fn is_temporary(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    // A folder of images keeps a list of its own files.
    (name.starts_with('.') && name != ".sixfold-files")
        || [".tmp", ".lock", "-journal", "-wal", "-shm"].iter().any(|end| name.ends_with(end))
}

/// Temporary files, lock files and database journals below a folder.
pub fn leftovers(folder: &Path) -> Vec<PathBuf> {
    paths(folder).into_iter().filter(|p| is_temporary(p)).collect()
}

/// Gives a command on every store that has a write-ahead log. If two processes close a store at the same moment, SQLite deletes its log in
/// neither, because that needs the file alone. What is in the log is stored, and the next command moves it into the store.
pub fn take_over_logs(folder: &Path) {
    for log in paths(folder).into_iter().filter(|p| p.extension().is_some_and(|end| end == "db-wal")) {
        let store = log.with_extension("db");
        let store = store.strip_prefix(folder).unwrap().display();
        let list = sixfold(folder, &format!("grasp store list {store}"));
        assert!(list.code < 2, "{}", list.stderr);
    }
}

/// Name and length of all files below a folder, which change when something is written.
pub fn fingerprint(folder: &Path) -> Vec<(PathBuf, u64)> {
    let length = |path: &Path| fs::metadata(path).map_or(0, |m| if m.is_file() { m.len() } else { 0 });
    let mut all: Vec<_> = paths(folder).into_iter().map(|p| (p.clone(), length(&p))).collect();
    all.sort();
    all
}

/// The total size of the files below a folder.
pub fn size(folder: &Path) -> u64 {
    fingerprint(folder).iter().map(|(_, length)| length).sum()
}

/// The files below a folder in comparable form.
pub fn tree(folder: &Path) -> Tree {
    let mut tree = Tree::new();
    for path in paths(folder).into_iter().filter(|p| p.is_file()) {
        let name = path.strip_prefix(folder).unwrap().to_path_buf();
        let bytes = fs::read(&path).unwrap();
        let end = name.extension().unwrap_or_default().to_string_lossy().into_owned();
        match end.as_str() {
            "db" => tree.extend(store(&path).into_iter().map(|(inside, bytes)| (name.join(inside), bytes))),
            "json" | "jsonl" | "csv" | "md" => {
                tree.insert(name, without_times(&end, bytes));
            }
            // Holds parameters under random names and the time; the resulting model is compared.
            "checkpoint" => {
                tree.insert(name, vec![]);
            }
            // Shows the number of samples per second.
            _ if name.ends_with("training/curves.png") => {
                let size =
                    image::image_dimensions(&path).map_or_else(|e| e.to_string(), |s| format!("{s:?}"));
                tree.insert(name, size.into_bytes());
            }
            _ => {
                tree.insert(name, bytes);
            }
        }
    }
    tree
}

/// The content of a store of experiences, as exported by its own command.
fn store(file: &Path) -> Tree {
    let folder = tempfile::tempdir().unwrap();
    let copy = folder.path().join("copy.db");
    // Reading may create files beside a store.
    fs::copy(file, &copy).unwrap();
    let run = sixfold(folder.path(), "grasp store export copy.db --out files --json report.json");
    if run.code > 1 {
        return Tree::from([("bytes".into(), fs::read(file).unwrap())]);
    }
    let mut held = tree(&folder.path().join("files"));
    let listed = sixfold(folder.path(), "grasp store list copy.db --json");
    held.insert("code".into(), format!("{} {}", run.code, listed.code).into_bytes());
    held.insert("list".into(), without_times("json", listed.stdout.into_bytes()));
    held
}

/// The bytes of a file without measured times; those of an invalid file are unchanged.
fn without_times(end: &str, bytes: Vec<u8>) -> Vec<u8> {
    let Ok(text) = std::str::from_utf8(&bytes) else { return bytes };
    match end {
        "csv" if text.starts_with("scene_id,im_id,obj_id,score,R,t,time") => {
            let mut cut: String = text
                .split_inclusive('\n')
                .map(|line| line.rsplit_once(',').map_or(line.to_owned(), |(row, _)| format!("{row}\n")))
                .collect();
            // Text without a line end is not a line.
            if !text.ends_with('\n') {
                cut.push_str("(cut off)");
            }
            cut.into_bytes()
        }
        "jsonl" => {
            let lines = text.lines().map(|line| match serde_json::from_str::<Value>(line) {
                Ok(value) => timeless(value).to_string(),
                Err(_) => line.to_owned(),
            });
            lines.collect::<Vec<_>>().join("\n").into_bytes()
        }
        "json" => match serde_json::from_str::<Value>(text) {
            Ok(value) => timeless(value).to_string().into_bytes(),
            Err(_) => bytes,
        },
        "md" => {
            // The cells of a table that hold seconds: one number of two digits, or a sum of two.
            let of_a_clock = |cell: &str| {
                cell.contains('.')
                    && cell.chars().all(|c| c.is_ascii_digit() || matches!(c, '.' | '+' | ' '))
                    && cell.contains(" + ")
            };
            // The columns with milliseconds in the header.
            let mut columns: Vec<bool> = vec![];
            let lines = text.lines().map(|line| {
                let cells: Vec<&str> = line.split('|').collect();
                if cells.len() == 1 {
                    columns.clear();
                } else if columns.is_empty() {
                    columns = cells.iter().map(|cell| cell.trim().starts_with("ms ")).collect();
                }
                let timeless = cells.iter().enumerate().map(|(at, cell)| {
                    let in_column = columns.get(at).is_some_and(|of_time| *of_time);
                    if in_column || of_a_clock(cell) { " time " } else { cell }
                });
                timeless.collect::<Vec<_>>().join("|")
            });
            lines.collect::<Vec<_>>().join("\n").into_bytes()
        }
        _ => bytes,
    }
}

/// A value without measured times and without the random name of a journal.
fn timeless(value: Value) -> Value {
    match value {
        Value::Object(fields) => {
            let of_a_clock = |name: &str| {
                name.contains("second") || name.contains("time") || name == "created" || name == "journal"
            };
            let kept = fields.into_iter().filter(|(name, _)| !of_a_clock(name));
            Value::Object(kept.map(|(name, value)| (name, timeless(value))).collect())
        }
        Value::Array(values) => Value::Array(values.into_iter().map(timeless).collect()),
        other => other,
    }
}

/// The differences of two trees, in a few lines.
pub fn differences(expected: &Tree, found: &Tree) -> Vec<String> {
    let mut lines: Vec<String> = vec![];
    for (path, bytes) in expected {
        match found.get(path) {
            None => lines.push(format!("{}: missing", path.display())),
            Some(other) if other != bytes => {
                lines.push(format!("{}: {}", path.display(), first(bytes, other)))
            }
            Some(_) => {}
        }
    }
    let new = found.keys().filter(|path| !expected.contains_key(*path));
    lines.extend(new.map(|path| format!("{}: not there after an undisturbed run", path.display())));
    lines.truncate(8);
    lines
}

/// The first difference of two files.
fn first(expected: &[u8], found: &[u8]) -> String {
    let at = expected.iter().zip(found).take_while(|(a, b)| a == b).count();
    let part = |bytes: &[u8]| {
        let from = at.saturating_sub(20);
        String::from_utf8_lossy(&bytes[from..bytes.len().min(at + 40)]).into_owned()
    };
    let (lengths, parts) = ((expected.len(), found.len()), (part(expected), part(found)));
    format!("{} and {} bytes, differ from byte {at}: {:?} and {:?}", lengths.0, lengths.1, parts.0, parts.1)
}
