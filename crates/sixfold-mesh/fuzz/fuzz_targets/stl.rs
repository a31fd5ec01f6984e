//! An STL mesh from any bytes: an error or a mesh, never a panic, never much memory.
//! Run in `crates/sixfold-mesh`: `cargo +nightly fuzz run stl -- -rss_limit_mb=2048`.
#![no_main]

use libfuzzer_sys::fuzz_target;
use sixfold_mesh::{Unit, no_resources, parse_stl};

fuzz_target!(|bytes: &[u8]| {
    if let Ok(mesh) = parse_stl(bytes, "fuzz.stl", Unit::Millimetre, &no_resources) {
        assert!(mesh.diameter() >= 0.0);
        assert_eq!(mesh.vertex_normals().len(), mesh.vertices().len());
        assert!(mesh.sample_surface(3, 0).points.len() <= 3);
    }
});
