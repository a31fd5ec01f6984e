//! One reader of files, guided by coverage. SIXFOLD_READER names it (`sixfold-fuzz --reader` lists them).
//! Run in `crates/sixfold-fuzz`: `SIXFOLD_READER=ply cargo +nightly fuzz run reader -- -rss_limit_mb=2048`.
#![no_main]

use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use sixfold_fuzz::{Reader, readers};

static READER: LazyLock<Reader> = LazyLock::new(|| {
    let name = std::env::var("SIXFOLD_READER").unwrap_or_default();
    let found = readers().into_iter().find(|r| r.name == name);
    found.unwrap_or_else(|| panic!("SIXFOLD_READER: found {name:?}, expected a reader's name"))
});

fuzz_target!(|bytes: &[u8]| (READER.check)(bytes));
