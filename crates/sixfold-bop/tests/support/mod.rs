//! Where the real data is, for tests that need it.

use std::path::PathBuf;

/// A folder of the shared data; prints a message and returns `None` if it does not exist.
pub fn data(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("SIXFOLD_DATA").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"),
        PathBuf::from,
    );
    let path = root.join(name);
    if path.exists() {
        return Some(path);
    }
    eprintln!("skipped: {} is not there (set SIXFOLD_DATA)", path.display());
    None
}
