//! Hostile input for every reader of files: for any bytes, each returns an error or content that satisfies the invariants
//! of its type. It never panics, and memory and time stay in proportion to the input's size.
//!
//! [`readers`] lists them, with their seeds and checks. The program of this crate mutates the seeds with a seeded
//! generator; the target in `fuzz/` hands the same checks to cargo-fuzz, which needs a nightly compiler.

mod checks;
mod mutate;
mod readers;
mod seeds;

pub use mutate::{mutated, with_checksum};
pub use readers::{Reader, readers};
