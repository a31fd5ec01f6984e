//! Processes a teaching: tags, masks, mesh, as `sixfold teach` does; stores the object once a person has accepted it.

use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sixfold_auto::prepare_all;
use sixfold_teach::{
    FEWEST_PHOTOGRAPHS, FEWEST_WITH_DEPTH, ShapeOptions, TeachError, TeachOptions, Teaching, World,
};

use super::views::MeshFacts;
use super::{Entry, locked, of_teach};
use crate::app::App;
use crate::jobs::{Stopped, Work};
use crate::objects::SymmetryView;

/// What a job does with a teaching.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct TeachRequest {
    teaching: String,
    accept: Option<AcceptedAs>,
}

/// The name under which the object is stored, and whether it replaces another.
#[derive(Debug, Serialize, Deserialize)]
struct AcceptedAs {
    name: String,
    replace: bool,
}

impl TeachRequest {
    pub fn run(teaching: &str) -> TeachRequest {
        TeachRequest { teaching: teaching.to_owned(), accept: None }
    }

    pub fn accept(teaching: &str, name: String, replace: bool) -> TeachRequest {
        TeachRequest { teaching: teaching.to_owned(), accept: Some(AcceptedAs { name, replace }) }
    }
}

/// Processes a request. An error is kept with the teaching, also after the job was removed.
pub(crate) fn run(app: &App, request: &TeachRequest, work: &mut Work<'_>) -> Result<Value, Stopped> {
    let entry = app.teachings.get(&request.teaching)?;
    let _held = locked(&entry.changing);
    let id = work.id().to_owned();
    entry.note(|record| (record.job, record.problem) = (Some(id), None))?;
    let result = match &request.accept {
        None => teach(app, &entry, work),
        Some(accepted) => accept(app, &entry, accepted, work),
    };
    if let Err(Stopped::Failed(error)) = &result {
        entry.note(|record| record.problem = Some((*error.problem).clone()))?;
    }
    result
}

/// Runs a step that reports progress; it ends if the job was cancelled or the server ends.
fn step(
    work: &Work<'_>,
    name: &str,
    step: impl FnOnce(&dyn sixfold_geometry::Progress) -> Result<(), TeachError>,
) -> Result<(), Stopped> {
    let stopped = Mutex::new(None);
    let report = |done: usize, total: usize| match work.step(done, total, name) {
        Ok(()) => true,
        Err(reason) => {
            *stopped.lock().unwrap_or_else(PoisonError::into_inner) = Some(reason);
            false
        }
    };
    match step(&report) {
        Ok(()) => work.check(),
        Err(TeachError::Stopped) => {
            let reason = stopped.into_inner().unwrap_or_else(PoisonError::into_inner);
            Err(reason.unwrap_or(Stopped::Cancelled))
        }
        Err(error) => Err(of_teach(&error).into()),
    }
}

/// Reports too few photographs on the board before anything is searched in them. Without a board the first step reports them.
fn check_number(teaching: &Teaching) -> Result<(), TeachError> {
    if teaching.options().world == World::Features {
        return Ok(());
    }
    let used = || teaching.photographs().iter().filter(|p| !p.left_out_by_person);
    let minimum = if used().any(|p| p.depth.is_some()) { FEWEST_WITH_DEPTH } else { FEWEST_PHOTOGRAPHS };
    let found = used().count();
    if found < minimum {
        return Err(TeachError::TooFewPhotographs { found, minimum, reasons: String::new() });
    }
    Ok(())
}

fn teach(app: &App, entry: &Entry, work: &mut Work<'_>) -> Result<Value, Stopped> {
    let fault = |e: TeachError| Stopped::from(of_teach(&e));
    let mut teaching = Teaching::open(&entry.folder, &TeachOptions::default()).map_err(fault)?;
    check_number(&teaching).map_err(fault)?;
    let options = ShapeOptions { stereo: !entry.record().hull_only, ..ShapeOptions::default() };
    let segmenter = app.teachings.segmenter()?;
    let poses = if teaching.options().world == World::Features { "finding poses" } else { "finding tags" };
    step(work, poses, |progress| teaching.locate(progress))?;
    step(work, "finding the object", |progress| teaching.find_masks(segmenter.as_ref(), &options, progress))?;
    step(work, "making the mesh", |progress| teaching.reconstruct(&options, progress))?;
    work.step(0, 2, "finding symmetries")?;
    let mesh = teaching.mesh().map_err(fault)?;
    let symmetries = teaching.symmetries().map_err(fault)?;
    let symmetries: Vec<SymmetryView> = symmetries.iter().map(|s| SymmetryView::of(s, true)).collect();
    let facts = MeshFacts::of(&mesh);
    entry.note(|record| (record.mesh, record.symmetries) = (Some(facts.clone()), symmetries.clone()))?;
    work.step(1, 2, "drawing")?;
    work.overlay(&teaching.picture().map_err(fault)?)?;
    let left_out: Vec<Value> = teaching
        .photographs()
        .iter()
        .filter(|p| p.left_out_by_person || p.left_out.is_some())
        .map(|p| json!({ "photograph": p.name, "reason": p.left_out.as_deref().unwrap_or("by request") }))
        .collect();
    let shape = teaching.shape();
    Ok(json!({
        "teaching": format!("/v1/teachings/{}", entry.id),
        "photographs": teaching.photographs().len() - left_out.len(),
        "left_out": left_out,
        "mesh": facts,
        "unseen": shape.map(|s| s.unseen),
        "with_depth": shape.map(|s| s.with_depth),
        "symmetries": symmetries,
    }))
}

fn accept(app: &App, entry: &Entry, accepted: &AcceptedAs, work: &mut Work<'_>) -> Result<Value, Stopped> {
    let known = entry.snapshot()?;
    work.step(0, 1, "storing the object")?;
    // It was stored by this job before the server ended and the job was started again.
    let own = entry.record().object.as_ref() == Some(&accepted.name);
    let replace = accepted.replace || own;
    let name = &accepted.name;
    let before = entry.record().object;
    entry.note(|record| record.object = Some(name.clone()))?;
    let stored = match known.store(&app.store, name, replace, prepare_all) {
        Ok(stored) => stored,
        Err(error) => {
            entry.note(|record| record.object = before)?;
            return Err(of_teach(&error).into());
        }
    };
    entry.note(|record| record.accepted = true)?;
    Ok(json!({
        "name": name,
        "object": format!("/v1/objects/{name}"),
        "record": stored.record,
        "photographs": stored.photographs,
    }))
}
