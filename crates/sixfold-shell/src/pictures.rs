//! Images for people beside results: written after them, and one that cannot be written costs none of them.

use std::path::Path;

use sixfold_geometry::{Mask, RgbImage};
use sixfold_io::{write_mask, write_rgb};

use crate::Outcome;

/// Images that are written after the results, with what went wrong.
#[derive(Debug, Default)]
pub struct Pictures {
    failed: Vec<String>,
}

impl Pictures {
    /// Writes a colour image; whether it is there.
    pub fn write(&mut self, path: &Path, image: &RgbImage) -> bool {
        self.did(write_rgb(path, image))
    }

    /// Writes a mask; whether it is there.
    pub fn write_mask(&mut self, path: &Path, mask: &Mask) -> bool {
        self.did(write_mask(path, mask))
    }

    /// Takes note of an image that somebody else wrote, or could not; whether it is there.
    pub fn did<E: Into<anyhow::Error>>(&mut self, written: Result<(), E>) -> bool {
        let is_there = written.is_ok();
        self.failed.extend(written.err().map(|error| crate::describe(&error.into())));
        is_there
    }

    /// What could not be written, a sentence each; nothing is left of it here.
    pub fn take_failed(&mut self) -> Vec<String> {
        std::mem::take(&mut self.failed)
    }

    /// Reports what could not be written; the outcome is then incomplete.
    pub fn outcome(mut self, outcome: Outcome) -> Outcome {
        let failed = self.take_failed();
        failed.iter().for_each(|text| eprintln!("skipped {text}"));
        if failed.is_empty() { outcome } else { Outcome::Incomplete }
    }
}
