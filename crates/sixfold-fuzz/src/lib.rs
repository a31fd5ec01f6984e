//! Hostile input for every reader of files: each takes any bytes and gives an error or content that holds what its type
//! promises, never a panic, and never more memory or time than the input's size asks for.
//!
//! [`readers`] names them, with their seeds and what is asserted behind each. The program of this crate mutates the seeds
//! with a seeded generator; the target in `fuzz/` hands the same checks to cargo-fuzz, which needs a nightly compiler.

mod checks;
mod mutate;
mod readers;
mod seeds;

pub use mutate::{mutated, with_checksum};
pub use readers::{Reader, readers};
