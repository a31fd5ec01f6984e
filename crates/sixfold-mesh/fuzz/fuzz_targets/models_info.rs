//! A `models_info.json` from any bytes: an error or its content, never a panic.
//! Run in `crates/sixfold-mesh`: `cargo +nightly fuzz run models_info`.
#![no_main]

use libfuzzer_sys::fuzz_target;
use sixfold_mesh::ModelsInfo;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(infos) = ModelsInfo::parse(bytes, "fuzz.json") {
        for info in infos.0.values() {
            assert!(!info.symmetry_poses(1.0).is_empty());
        }
    }
});
