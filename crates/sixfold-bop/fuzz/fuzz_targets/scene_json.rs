//! The JSON files of a scene: no text may make a parser panic.
#![no_main]

use std::path::Path;

libfuzzer_sys::fuzz_target!(|text: &[u8]| {
    let path = Path::new("fuzz.json");
    let _ = sixfold_bop::parse_scene_camera(text, path);
    let _ = sixfold_bop::parse_scene_gt(text, path);
    let _ = sixfold_bop::parse_scene_gt_info(text, path);
    let _ = sixfold_bop::parse_targets(text, path);
});
