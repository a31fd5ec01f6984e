//! The record of a result file's options and inputs, stored beside it so that a later run can be resumed with the same ones.
//!
//! The record `FILE.run.json` holds version, method and options, for every object a hash of its model and of its entry in
//! `models_info.json`, and for every finished image hashes of its inputs: camera, targets, the images that the method reads, and
//! the ground truth if it provides the boxes. Contents are compared, not paths. If any of them has changed, the whole run is
//! refused and the message names the input, because one file must not mix poses from old and new contents.
//!
//! Rows are written first and the record after them, at most once a second. Images that are missing in the record, or have another
//! number of rows, come from an interrupted run; they are computed again.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use sixfold_io::{fnv1a_of_file, write_atomically};

use crate::dataset::check;
use crate::error::{OtherInput, OtherOptions, RunError};
use crate::inputs::{Inputs, hex};

/// The options on which a run's results depend, by name. For an option that names a file, the file's contents count too.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct RunOptions(pub BTreeMap<String, String>);

impl RunOptions {
    /// Adds an option.
    pub fn add(&mut self, name: &str, value: &str) {
        self.0.insert(name.to_owned(), value.to_owned());
        let path = Path::new(value);
        if path.is_file()
            && let Ok(hash) = fnv1a_of_file(path)
        {
            self.0.insert(format!("{name} (contents)"), hex(hash));
        }
    }

    /// The first option that differs, with both values.
    fn difference(&self, before: &RunOptions) -> Option<(String, String, String)> {
        let names: BTreeSet<&String> = self.0.keys().chain(before.0.keys()).collect();
        let value = |options: &RunOptions, name: &String| options.0.get(name).cloned().unwrap_or_default();
        let name = names.into_iter().find(|name| self.0.get(*name) != before.0.get(*name))?;
        Some((name.clone(), value(before, name), value(self, name)))
    }
}

#[derive(Debug, Default, Serialize, Deserialize)]
struct Record {
    version: String,
    method: String,
    options: RunOptions,
    /// Hashes of each object, by its id.
    objects: BTreeMap<u32, BTreeMap<String, String>>,
    done: Vec<DoneImage>,
}

/// An image whose rows are all in the result file.
#[derive(Debug, Serialize, Deserialize)]
struct DoneImage {
    scene_id: u32,
    im_id: u32,
    rows: usize,
    inputs: BTreeMap<String, String>,
}

/// The record of a result file on disk.
pub(crate) struct RunRecord {
    results: PathBuf,
    path: PathBuf,
    record: Record,
    done: BTreeSet<(u32, u32)>,
    saved: Instant,
}

/// Minimum time between two saves of the record: otherwise a run of a thousand images a minute would mostly save.
const SAVED_EVERY: Duration = Duration::from_secs(1);

impl RunRecord {
    /// The record of `results`: a new one, or the existing one if it has the same options.
    pub(crate) fn open(results: &Path, method: &str, options: &RunOptions) -> Result<RunRecord, RunError> {
        let mut path = results.as_os_str().to_owned();
        path.push(".run.json");
        let path = PathBuf::from(path);
        let record = Record {
            version: env!("CARGO_PKG_VERSION").into(),
            method: method.into(),
            options: options.clone(),
            ..Record::default()
        };
        let opened = |record: Record, path| {
            let done = record.done.iter().map(|d| (d.scene_id, d.im_id)).collect();
            RunRecord { results: results.into(), path, record, done, saved: Instant::now() }
        };
        if !results.exists() {
            let mut new = opened(record, path);
            new.save()?;
            return Ok(new);
        }
        let text = std::fs::read_to_string(&path).ok();
        let Some(before) = text.and_then(|t| serde_json::from_str::<Record>(&t).ok()) else {
            return Err(RunError::NoRecord { results: results.into(), record: path });
        };
        let pairs =
            [("version", &before.version, &record.version), ("method", &before.method, &record.method)];
        let differs = pairs.into_iter().find(|(_, a, b)| a != b);
        let differs = differs.map(|(name, a, b)| (name.to_owned(), a.clone(), b.clone()));
        if let Some((option, before, now)) = differs.or_else(|| options.difference(&before.options)) {
            let results = results.into();
            let other = OtherOptions { results, record: path, option, before, now };
            return Err(RunError::OtherOptions(Box::new(other)));
        }
        Ok(opened(before, path))
    }

    /// Records the inputs of an object; an error if existing rows were made with others.
    pub(crate) fn object(&mut self, id: u32, inputs: &Inputs) -> Result<(), RunError> {
        if let Some(before) = self.record.objects.get(&id) {
            return self.same(before, inputs, &format!("object {id}"));
        }
        self.record.objects.insert(id, inputs.hashes());
        Ok(())
    }

    /// An error if the inputs of a finished image differ from those in `now`.
    pub(crate) fn check_images(
        &self,
        stop: &AtomicBool,
        mut now: impl FnMut(u32, u32) -> Inputs,
    ) -> Result<(), RunError> {
        let same = |done: &DoneImage| {
            check(stop)?;
            let image = format!("image {}/{}", done.scene_id, done.im_id);
            self.same(&done.inputs, &now(done.scene_id, done.im_id), &image)
        };
        self.record.done.iter().try_for_each(same)
    }

    fn same(&self, before: &BTreeMap<String, String>, now: &Inputs, of: &str) -> Result<(), RunError> {
        let Some((name, file)) = now.difference(before) else { return Ok(()) };
        Err(RunError::OtherInput(Box::new(OtherInput {
            results: self.results.clone(),
            record: self.path.clone(),
            input: format!("{name} of {of}"),
            file,
        })))
    }

    /// Whether an image is done.
    pub(crate) fn is_done(&self, scene_id: u32, im_id: u32) -> bool {
        self.done.contains(&(scene_id, im_id))
    }

    /// Removes the images whose number of rows in the result file differs from the recorded number. `rows`: scene and image of each
    /// row.
    pub(crate) fn forget_unless_whole(&mut self, rows: impl Iterator<Item = (u32, u32)>) {
        let mut counts: BTreeMap<(u32, u32), usize> = BTreeMap::new();
        for image in rows {
            *counts.entry(image).or_default() += 1;
        }
        self.record.done.retain(|d| counts.get(&(d.scene_id, d.im_id)).copied().unwrap_or(0) == d.rows);
        self.done = self.record.done.iter().map(|d| (d.scene_id, d.im_id)).collect();
    }

    /// Records an image with this many rows, which are on the disk.
    pub(crate) fn finished(
        &mut self,
        image: (u32, u32),
        rows: usize,
        inputs: &Inputs,
    ) -> Result<(), RunError> {
        self.add(image, rows, inputs);
        if self.is_due() { self.save() } else { Ok(()) }
    }

    /// Records an image with this many rows, which will be on the disk before the record is saved.
    pub(crate) fn add(&mut self, (scene_id, im_id): (u32, u32), rows: usize, inputs: &Inputs) {
        self.done.insert((scene_id, im_id));
        self.record.done.push(DoneImage { scene_id, im_id, rows, inputs: inputs.hashes() });
    }

    /// Whether it is time to save the record.
    pub(crate) fn is_due(&self) -> bool {
        self.saved.elapsed() >= SAVED_EVERY
    }

    /// Removes the record after the results were moved to another file.
    pub(crate) fn remove(self) -> Result<(), RunError> {
        std::fs::remove_file(&self.path).map_err(|source| RunError::Io { path: self.path, source })
    }

    pub(crate) fn save(&mut self) -> Result<(), RunError> {
        let io = |source| RunError::Io { path: self.path.clone(), source };
        let text = serde_json::to_string_pretty(&self.record).map_err(|e| io(std::io::Error::other(e)))?;
        write_atomically(&self.path, text.as_bytes()).map_err(io)?;
        self.saved = Instant::now();
        Ok(())
    }
}
