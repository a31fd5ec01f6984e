//! The common part of all trainings: their data, their reports, and how they are interrupted.

use std::collections::BTreeMap;
use std::error::Error;
use std::path::PathBuf;

use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sixfold::data::{FrameId, FrameSelection, TrainingSet, TrainingSetError};
use sixfold::mesh::ModelInfo;
use sixfold::nn::choice::Choice;
use sixfold::nn::recipe::{Recipe, Session, Trained, TrainingEvent, train};
use sixfold::nn::training::Outcome;
use sixfold::nn::training_log::TrainingRecord;

use crate::arrays::{self, bad, whole};
use crate::bop::PyDataset;
use crate::guard::{Leave, Tell, dataset_error, interruptible, os_error, reporting};
use crate::mesh::PyMesh;

/// An `OSError` if the error was caused by one of a file, otherwise a `ValueError`.
pub(crate) fn file_or_value(error: &(dyn Error + 'static)) -> PyErr {
    let mut below = Some(error);
    while let Some(at) = below {
        if let Some(io) = at.downcast_ref::<std::io::Error>() {
            return os_error(io.kind(), error.to_string());
        }
        below = at.source();
    }
    PyValueError::new_err(error.to_string())
}

/// An event of a training, as sent from its thread.
enum Event {
    Warning(String),
    Preparing(usize, usize),
    Steps(TrainingRecord, u64),
    Measuring(usize, usize),
}

impl Event {
    /// The event for the callback. Notes are left out: the stage already tells the callback what begins.
    fn of(event: TrainingEvent<'_>) -> Option<Event> {
        Some(match event {
            TrainingEvent::Note(_) => return None,
            TrainingEvent::Warning(text) => Event::Warning(text.to_owned()),
            TrainingEvent::Preparing(done, all) => Event::Preparing(done, all),
            TrainingEvent::Steps(record, steps) => Event::Steps(record.clone(), steps),
            TrainingEvent::Measuring(done, all) => Event::Measuring(done, all),
        })
    }

    /// Passes warnings to Python's `warnings` and other events to the user's callback.
    fn report(self, py: Python<'_>, progress: Option<&Py<PyAny>>) -> PyResult<()> {
        if let Event::Warning(text) = &self {
            py.import("warnings")?.call_method1("warn", (text,))?;
            return Ok(());
        }
        let Some(progress) = progress else { return Ok(()) };
        let event = PyDict::new(py);
        let stage = |stage: &str, done: usize, all: usize| -> PyResult<()> {
            event.set_item("stage", stage)?;
            event.set_item("done", done)?;
            event.set_item("total", all)
        };
        match self {
            Event::Warning(_) => return Ok(()),
            Event::Preparing(done, all) => stage("preparing", done, all)?,
            Event::Measuring(done, all) => stage("measuring", done, all)?,
            Event::Steps(record, steps) => {
                stage("training", record.step as usize, steps as usize)?;
                event.set_item("seconds", record.seconds)?;
                event.set_item("learning_rate", record.learning_rate)?;
                event.set_item("samples_per_second", record.samples_per_second)?;
                event.set_item("losses", record.losses)?;
            }
        }
        progress.call1(py, (event,)).map(drop)
    }
}

/// Trains in `out`. Ctrl-C, or an error of the callback, ends the training after the current step, which is saved.
pub(crate) fn run<R: Recipe + Send + 'static>(
    py: Python<'_>,
    progress: Option<Py<PyAny>>,
    recipe: R,
    data: R::Data,
    out: PathBuf,
) -> PyResult<Trained<R::Report>>
where
    R::Data: Send + 'static,
    R::Report: Send + 'static,
{
    let outcome = reporting(
        py,
        Leave::WhenDone,
        move |stop, tell: &Tell<Event>| {
            let mut events = |event: TrainingEvent<'_>| {
                if let Some(event) = Event::of(event) {
                    tell.tell(event);
                }
            };
            train(&recipe, data, &mut Session::new(&out, stop.flag(), &mut events))
        },
        |event| event.report(py, progress.as_ref()),
    )?;
    match outcome {
        Ok(Outcome::Finished(trained)) => Ok(trained),
        Ok(Outcome::Interrupted { step }) => Err(PyRuntimeError::new_err(format!(
            "the training ended after step {step}; call it again to continue"
        ))),
        Err(error) => Err(file_or_value(&error)),
    }
}

/// The result of a training as a dict.
pub(crate) fn summary<'py, R>(py: Python<'py>, trained: Trained<R>) -> PyResult<Bound<'py, PyDict>> {
    let Trained { model, steps, seconds, losses, .. } = trained;
    let dict = PyDict::new(py);
    dict.set_item("model", model)?;
    dict.set_item("steps", steps)?;
    dict.set_item("seconds", seconds)?;
    dict.set_item("losses", losses)?;
    Ok(dict)
}

/// The recipe if its options are in their ranges. Checked before its data are read.
pub(crate) fn checked<R: Recipe>(recipe: R) -> PyResult<R> {
    recipe.check().map_err(|error| bad(error.field, error.expected, error.found))?;
    Ok(recipe)
}

/// The choice of this name, or the default.
pub(crate) fn choice<C: Choice>(argument: &str, name: Option<&str>, default: C) -> PyResult<C> {
    let Some(name) = name else { return Ok(default) };
    let names = || C::ALL.iter().map(|choice| choice.name()).collect::<Vec<_>>().join(" or ");
    C::named(name).ok_or_else(|| bad(argument, names(), format!("{name:?}")))
}

/// A whole number, or the default.
pub(crate) fn count(argument: &str, value: Option<i64>, default: usize) -> PyResult<usize> {
    value.map_or(Ok(default), |value| whole(argument, value, 0))
}

/// The number of steps, if given.
pub(crate) fn steps(value: Option<i64>) -> PyResult<Option<u64>> {
    value.map(|n| whole("steps", n, 0).map(|n| n as u64)).transpose()
}

/// The number in single precision, or the default.
pub(crate) fn single(value: Option<f64>, default: f32) -> f32 {
    value.map_or(default, |value| value as f32)
}

/// The training data: a BOP dataset, or meshes by their ids.
pub(crate) enum Source {
    Dataset { root: PathBuf, split: String, ids: Vec<u32>, frames: FrameSelection },
    Meshes(Vec<(u32, sixfold::mesh::Mesh, ModelInfo)>),
}

impl Source {
    pub(crate) fn new(
        material: &Bound<'_, PyAny>,
        ids: Option<&Bound<'_, PyAny>>,
        frames: Option<&Bound<'_, PyAny>>,
        split: Option<String>,
        renders_only: bool,
    ) -> PyResult<Source> {
        if let Ok(meshes) = material.extract::<BTreeMap<u32, Py<PyMesh>>>() {
            if ids.is_some() || frames.is_some() || split.is_some() {
                return Err(bad("ids, frames, split", "none with meshes", "some"));
            }
            if meshes.is_empty() {
                return Err(bad("material", "at least one mesh", "none"));
            }
            let known =
                |(id, mesh): (u32, Py<PyMesh>)| (id, mesh.get().mesh.as_ref().clone(), mesh.get().info());
            return Ok(Source::Meshes(meshes.into_iter().map(known).collect()));
        }
        let (root, own) = if let Ok(dataset) = material.cast::<PyDataset>() {
            let dataset = dataset.get();
            (dataset.0.root().to_owned(), Some(dataset.1.clone()))
        } else {
            let expected = "the folder of a BOP dataset, a bop.Dataset, or a dict of a Mesh for each id";
            let found = || bad("material", expected, material.get_type().to_string());
            (material.extract().map_err(|_| found())?, None)
        };
        let frames = match frames {
            Some(_) if renders_only => return Err(bad("frames", "None with renders_only", "some")),
            Some(list) => {
                let pairs = arrays::pairs("frames", list)?;
                FrameSelection::Listed(pairs.into_iter().map(FrameId::from).collect())
            }
            None if renders_only => FrameSelection::RendersOnly,
            None => FrameSelection::All,
        };
        let ids = ids.map_or(Ok(vec![]), |ids| arrays::ids("ids", ids))?;
        let split = split.or(own).unwrap_or_else(|| "test".to_owned());
        Ok(Source::Dataset { root, split, ids, frames })
    }

    pub(crate) fn read(self, py: Python<'_>, min_visibility: f64) -> PyResult<TrainingSet> {
        let read = interruptible(py, move |_| match self {
            Source::Dataset { root, split, ids, frames } => {
                TrainingSet::of_dataset(&root, &split, &ids, &frames, min_visibility)
            }
            Source::Meshes(meshes) => Ok(TrainingSet::of_meshes(meshes, "meshes")),
        })?;
        read.map_err(|error| match error {
            TrainingSetError::Dataset(error) => dataset_error(*error),
            other => file_or_value(&other),
        })
    }
}
