//! Faults put into the program as users run it, one table of commands for all of them: killed and run again, two at once, a full
//! disk, a folder that cannot be written, standard output that cannot be written, and command lines with hostile values.
//!
//! `docs/faults.md` states the expected behaviour. `SIXFOLD_FAULTS=all` runs each driver at many moments instead of a few, and the
//! hostile command lines with all values instead of a sample.
#![cfg(all(unix, feature = "experience", feature = "physics"))]

#[macro_use]
mod rows;

mod commands;
mod driver;
mod hostile;
mod kill;
mod outputs;
mod space;
#[allow(dead_code)]
#[path = "../cli/support.rs"]
mod support;
mod two;
mod unwritable;

/// The program under test.
const PROGRAM: &str = env!("CARGO_BIN_EXE_sixfold");
