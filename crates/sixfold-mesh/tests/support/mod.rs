//! The folder of real data: `SIXFOLD_DATA`, or `../shared/data` beside the workspace.

use std::path::PathBuf;

/// The folder of shared data; prints a message if there is none.
pub fn data() -> Option<PathBuf> {
    let folder = std::env::var_os("SIXFOLD_DATA")
        .map(PathBuf::from)
        .unwrap_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data")));
    if folder.is_dir() {
        return Some(folder);
    }
    eprintln!("skipped: no shared data");
    None
}
