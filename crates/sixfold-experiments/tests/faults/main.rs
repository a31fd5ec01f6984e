//! Faults put into the program as users run it, with the drivers of the program `sixfold` (crates/sixfold-cli/tests/faults): killed
//! and run again, two at once, a full disk, a folder and a standard output that cannot be written. `docs/faults.md` states the
//! expected behaviour.
#![cfg(unix)]

#[macro_use]
#[path = "../../../sixfold-cli/tests/faults/rows.rs"]
mod rows;

mod commands;
#[allow(dead_code)]
#[path = "../../../sixfold-cli/tests/faults/driver.rs"]
mod driver;
#[path = "../../../sixfold-cli/tests/faults/kill.rs"]
mod kill;
#[path = "../support/made.rs"]
mod made;
#[path = "../../../sixfold-cli/tests/faults/outputs.rs"]
mod outputs;
#[path = "../../../sixfold-cli/tests/faults/space.rs"]
mod space;
#[allow(dead_code)]
#[path = "../../../sixfold-cli/tests/cli/support.rs"]
mod support;
#[path = "../../../sixfold-cli/tests/faults/two.rs"]
mod two;
#[path = "../../../sixfold-cli/tests/faults/unwritable.rs"]
mod unwritable;

/// The program under test.
const PROGRAM: &str = env!("CARGO_BIN_EXE_sixfold-experiments");
