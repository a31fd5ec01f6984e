//! An OBJ mesh and its MTL from any bytes: an error or a mesh, never a panic, never much memory.
//! Run in `crates/sixfold-mesh`: `cargo +nightly fuzz run obj -- -rss_limit_mb=2048`.
#![no_main]

use libfuzzer_sys::fuzz_target;
use sixfold_mesh::{Unit, parse_obj};

fuzz_target!(|bytes: &[u8]| {
    // The same bytes serve as the material file and as the texture.
    let resources = |_: &str| Ok(bytes.to_vec());
    if let Ok(mesh) = parse_obj(bytes, "fuzz.obj", Unit::Millimetre, &resources) {
        assert!(mesh.diameter() >= 0.0);
        assert_eq!(mesh.vertex_normals().len(), mesh.vertices().len());
    }
});
