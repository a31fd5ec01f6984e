//! Maintenance of stores of experiences: remove experiences and attempts, merge stores, encode again, export to files. A row
//! that cannot be read is reported and left out; the others are still processed.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde::Serialize;
use sixfold_dgcm::model::DgcmModel;
use sixfold_experience::{Description, Experience, ExperienceStore, StoreError, StorePlace, Stored};

use crate::Outcome;
use crate::folder::OutputFolder;
use crate::progress::{Progress, check_interrupt};

/// Result of storing an experience.
#[derive(Serialize)]
pub struct Added {
    /// Id of the experience.
    pub id: i64,
    /// False if the experience was there already.
    pub new: bool,
    /// Pixels of its region of interest.
    pub region_pixels: usize,
}

/// Stores an experience whose grasp was read from the file `grasp`.
///
/// # Errors
/// When grasp and depth image do not belong together; [`StoreError`].
pub fn add(place: &StorePlace, experience: &Experience, grasp: &Path) -> Result<Added> {
    let region_pixels = experience.region.iter().filter(|r| **r).count();
    if region_pixels == 0 {
        bail!(
            "{}: the gripper is nowhere near the object; do grasp and depth image belong together, and is the grasp in metres in the camera's frame?",
            grasp.display()
        );
    }
    let (id, new) = place.create()?.add(experience)?;
    Ok(Added { id, new, region_pixels })
}

/// Result of removing experiences and attempts.
#[derive(Default, Serialize)]
pub struct Forgotten {
    /// Experiences.
    pub forgotten: Vec<i64>,
    /// Ids of no experience.
    pub unknown: Vec<i64>,
    /// Attempts.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub attempts: Vec<i64>,
    /// Ids of no attempt.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub unknown_attempts: Vec<i64>,
}

/// Removes experiences and attempts by their numbers.
///
/// # Errors
/// [`StoreError`].
pub fn forget(place: &StorePlace, ids: &[i64], attempts: &[i64]) -> Result<Forgotten> {
    let mut store = place.open()?;
    let mut done = Forgotten::default();
    for &id in ids {
        if store.forget(id)? { done.forgotten.push(id) } else { done.unknown.push(id) }
    }
    for &id in attempts {
        if store.forget_attempt(id)? { done.attempts.push(id) } else { done.unknown_attempts.push(id) }
    }
    Ok(done)
}

/// Result of copying experiences into another store.
#[derive(Serialize)]
pub struct Moved {
    /// Experiences that were new to it.
    pub added: usize,
    /// All experiences that it has now.
    pub experiences: usize,
    /// Rows that could not be read.
    #[serde(skip_serializing_if = "is_zero")]
    pub unreadable: usize,
}

fn is_zero(number: &usize) -> bool {
    *number == 0
}

/// Rows that could not be read.
#[derive(Default)]
struct LeftOut {
    rows: usize,
    /// Those of them on damaged pages.
    damaged: usize,
}

impl LeftOut {
    /// Reports a row that is left out; any other error ends the work.
    fn row(&mut self, error: StoreError) -> Result<()> {
        match error {
            error if error.is_of_one_row() => eprintln!("left out: {error}"),
            StoreError::Broken { .. } => self.damaged += 1,
            error => return Err(error.into()),
        }
        self.rows += 1;
        Ok(())
    }

    /// Returns how many there were.
    fn count(self, place: &StorePlace) -> usize {
        if self.damaged > 0 {
            eprintln!("left out: {} rows of {place} on damaged pages", self.damaged);
        }
        self.rows
    }
}

/// Adds the experiences of a store, changed by `change`, to another one; returns how many are new.
fn take_over(
    target: &mut dyn ExperienceStore,
    source: &dyn ExperienceStore,
    left_out: &mut LeftOut,
    change: impl Fn(Stored) -> Result<Experience>,
) -> Result<usize> {
    let numbers = source.numbers()?;
    let mut progress = Progress::new("experiences", numbers.len());
    let mut added = 0;
    for id in numbers {
        check_interrupt("what was taken over is kept; the same command resumes")?;
        match source.get(id) {
            Ok(Some(stored)) => {
                progress.step(stored.experience.object.clone());
                added += usize::from(target.add(&change(stored)?)?.1);
            }
            Ok(None) => {}
            Err(error) => left_out.row(error)?,
        }
    }
    progress.finish();
    Ok(added)
}

/// Copies the experiences and attempts of other stores into this one; from damaged stores, the rows that can still be read.
///
/// # Errors
/// [`StoreError`]; what was taken over until then is kept.
pub fn merge(place: &StorePlace, others: &[StorePlace]) -> Result<Moved> {
    let sources: Vec<_> = others.iter().map(StorePlace::open_to_save).collect::<Result<_, _>>()?;
    let mut store = place.create()?;
    let (mut added, mut unreadable) = (0, 0);
    for (source, place) in sources.iter().zip(others) {
        let context = || place.display().to_string();
        let mut left_out = LeftOut::default();
        added += take_over(&mut *store, &**source, &mut left_out, |stored| Ok(stored.experience))
            .with_context(context)?;
        for (_, attempt) in source.attempt_rows(0).with_context(context)? {
            match attempt {
                Ok(attempt) => store.add_attempt(&attempt).map(|_| ())?,
                Err(error) => left_out.row(error)?,
            }
        }
        unreadable += left_out.count(place);
    }
    Ok(Moved { added, experiences: store.list()?.len(), unreadable })
}

/// Encodes all experiences with another network, into another store.
///
/// # Errors
/// [`StoreError`]; what was encoded until then is kept.
pub fn refresh(place: &StorePlace, out: &StorePlace, network: &DgcmModel) -> Result<Moved> {
    if place == out {
        bail!("--out: expected another file than the store itself");
    }
    let source = place.open()?;
    let mut target = out.create()?;
    let encode = |stored: Stored| {
        stored.experience.encoded(network).with_context(|| format!("experience {}", stored.id))
    };
    let mut left_out = LeftOut::default();
    let added = take_over(&mut *target, &*source, &mut left_out, encode)?;
    Ok(Moved { added, experiences: target.list()?.len(), unreadable: left_out.count(place) })
}

/// Result of an export.
#[derive(Serialize)]
pub struct Exported {
    /// Experiences.
    pub experiences: usize,
    /// Those that could not be read.
    pub unreadable: usize,
    folder: PathBuf,
}

impl Exported {
    /// The outcome of the command.
    pub fn outcome(&self) -> Outcome {
        match (self.experiences, self.unreadable) {
            (_, 1..) => Outcome::Incomplete,
            (0, _) => Outcome::NothingFound,
            _ => Outcome::Found,
        }
    }
}

/// Writes all experiences as files; from a damaged store, those that can still be read.
///
/// # Errors
/// For a store or a folder that cannot be used.
pub fn export(place: &StorePlace, out: &Path) -> Result<Exported> {
    let store = place.open_to_save()?;
    let numbers = store.numbers()?;
    let mut folder = OutputFolder::take(out)?;
    let mut progress = Progress::new("experiences", numbers.len());
    let mut done = Exported { experiences: 0, unreadable: 0, folder: out.to_path_buf() };
    let mut left_out = LeftOut::default();
    for id in numbers {
        check_interrupt("what was written is whole")?;
        match store.get(id) {
            Ok(Some(stored)) => {
                let name = format!("{id:06}");
                folder.write_rgb(&format!("{name}.png"), &stored.experience.picture()?)?;
                let text = serde_json::to_string_pretty(&Description::new(&stored, true))?;
                folder.write_text(&format!("{name}.json"), &text)?;
                done.experiences += 1;
                progress.step(stored.experience.object);
            }
            Ok(None) => {}
            Err(error) => left_out.row(error)?,
        }
    }
    progress.finish();
    done.unreadable = left_out.count(place);
    Ok(done)
}
