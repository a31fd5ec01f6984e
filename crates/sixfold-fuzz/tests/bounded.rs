//! Runs the driver with a bounded number of hostile files for every reader.

use std::process::Command;

/// Mutated files of each reader.
const INPUTS: &str = "1000";
/// Kilobytes of memory: a reader that asks for more for a file of a few kilobytes fails.
const MEMORY: &str = "8388608";

#[test]
fn every_reader_holds_for_a_bounded_number_of_inputs() {
    let driver = env!("CARGO_BIN_EXE_sixfold-fuzz");
    let folder = concat!(env!("CARGO_TARGET_TMPDIR"), "/fuzz");
    let limited = format!("ulimit -v {MEMORY}; exec \"$0\" --inputs {INPUTS} --seed 1 --out \"$1\"");
    let run = Command::new("sh").args(["-c", &limited, driver, folder]).output().unwrap();
    let said = String::from_utf8_lossy(&run.stderr);
    assert!(run.status.success(), "inputs are kept in {folder}\n{said}");
}
