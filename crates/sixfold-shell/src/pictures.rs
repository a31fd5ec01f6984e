//! Images for people beside results: written after them, and one that cannot be written costs none of them.

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

    /// Writes a colour image; its path, if it is there.
    pub fn write(&mut self, name: &str, image: &RgbImage) -> Option<PathBuf> {
        self.with(name, |path| write_rgb(path, image))
    }

    /// Writes a mask; its path, if it is there.
    pub fn write_mask(&mut self, name: &str, mask: &Mask) -> Option<PathBuf> {
        self.with(name, |path| write_mask(path, mask))
    }

    /// Has a file of the folder written; its path, if it is there.
    pub fn with<E: Into<anyhow::Error>>(
        &mut self,
        name: &str,
        write: impl FnOnce(&Path) -> Result<(), E>,
    ) -> Option<PathBuf> {
        let path = self.folder.as_mut()?.file(name);
        let path = path.and_then(|path| write(&path).map(|()| path).map_err(Into::into));
        path.map_err(|error| self.failed.push(crate::describe(&error))).ok()
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
