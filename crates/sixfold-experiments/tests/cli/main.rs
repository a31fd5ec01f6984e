//! The program as a user runs it: the real binary, in a temporary folder, on inputs made by the tests themselves.

mod auto;
mod dgcm;
mod grasp;
#[path = "../support/made.rs"]
mod made;
mod mttm;
mod nol;
mod pix2pose;
// The same small scenes as for the program `sixfold`.
#[allow(dead_code)]
#[path = "../../../sixfold-cli/tests/cli/support.rs"]
mod support;

/// The program under test.
const PROGRAM: &str = env!("CARGO_BIN_EXE_sixfold-experiments");
