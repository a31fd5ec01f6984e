//! Result files: no text may make the parser panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|text: &str| {
    let _ = sixfold_bop::parse_results(text);
});
