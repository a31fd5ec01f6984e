//! Images that illustrate results. They are written after the results, and an image that cannot be written
//! does not affect them.

use std::path::{Path, PathBuf};

use sixfold_geometry::{Mask, RgbImage};
use sixfold_io::{write_mask, write_rgb};

use crate::Outcome;
use crate::folder::OutputFolder;

/// Images that are written after the results into a folder, if there is one, with what went wrong.
#[derive(Default)]
pub struct Pictures {
    folder: Option<OutputFolder>,
    failed: Vec<String>,
}

impl Pictures {
    /// Images of this folder.
    pub fn of(folder: Option<OutputFolder>) -> Pictures {
        Pictures { folder, failed: vec![] }
    }

    /// Writes a colour image; returns its path if it was written.
    pub fn write(&mut self, name: &str, image: &RgbImage) -> Option<PathBuf> {
        self.with(name, |path| write_rgb(path, image))
    }

    /// Writes a mask; returns its path if it was written.
    pub fn write_mask(&mut self, name: &str, mask: &Mask) -> Option<PathBuf> {
        self.with(name, |path| write_mask(path, mask))
    }

    /// Lets a closure write a file of the folder; returns its path if it was written.
    pub fn with<E: Into<anyhow::Error>>(
        &mut self,
        name: &str,
        write: impl FnOnce(&Path) -> Result<(), E>,
    ) -> Option<PathBuf> {
        let path = self.folder.as_mut()?.file(name);
        let path = path.and_then(|path| write(&path).map(|()| path).map_err(Into::into));
        path.map_err(|error| self.failed.push(crate::describe(&error))).ok()
    }

    /// Records the result of writing an image elsewhere; returns whether it was written.
    pub fn did<E: Into<anyhow::Error>>(&mut self, written: Result<(), E>) -> bool {
        let is_there = written.is_ok();
        self.failed.extend(written.err().map(|error| crate::describe(&error.into())));
        is_there
    }

    /// Takes the messages about images that could not be written, one sentence each.
    pub fn take_failed(&mut self) -> Vec<String> {
        std::mem::take(&mut self.failed)
    }

    /// Reports images that could not be written; the outcome is then incomplete.
    pub fn outcome(mut self, outcome: Outcome) -> Outcome {
        let failed = self.take_failed();
        failed.iter().for_each(|text| eprintln!("skipped {text}"));
        if failed.is_empty() { outcome } else { Outcome::Incomplete }
    }
}
