//! What trainings have in common: what they learn from, what they tell, and how they are stopped.

use std::collections::BTreeMap;
use std::error::Error;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sixfold_data::{FrameId, FrameSelection, TrainingSet, TrainingSetError};
use sixfold_mesh::ModelInfo;
use sixfold_nn::recipe::{Listener, News, Trained};
use sixfold_nn::training::Ending;
use sixfold_nn::training_log::TrainingRecord;

use crate::arrays::{self, bad, whole};
use crate::bop::PyDataset;
use crate::guard::{Leave, Tell, dataset_error, interruptible, os_error, reporting};
use crate::mesh::PyMesh;

/// An `OSError` where a file is at the bottom of it, else a `ValueError`.
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

/// What a training tells, as it crosses from its thread.
enum Told {
    Warning(String),
    Preparing(usize, usize),
    Steps(TrainingRecord, u64),
    Measuring(usize, usize),
}

impl Told {
    /// What is worth hearing; that something begins, the callback tells by its stage.
    fn of(news: News<'_>) -> Option<Told> {
        Some(match news {
            News::Note(_) => return None,
            News::Warning(text) => Told::Warning(text.to_owned()),
            News::Preparing(done, all) => Told::Preparing(done, all),
            News::Steps(record, steps) => Told::Steps(record.clone(), steps),
            News::Measuring(done, all) => Told::Measuring(done, all),
        })
    }

    /// Warnings as Python's own; the rest for the user's callback.
    fn hear(self, py: Python<'_>, progress: Option<&Py<PyAny>>) -> PyResult<()> {
        if let Told::Warning(text) = &self {
            py.import("warnings")?.call_method1("warn", (text,))?;
            return Ok(());
        }
        let Some(progress) = progress else { return Ok(()) };
        let news = PyDict::new(py);
        let share = |stage: &str, done: usize, all: usize| -> PyResult<()> {
            news.set_item("stage", stage)?;
            news.set_item("done", done)?;
            news.set_item("total", all)
        };
        match self {
            Told::Warning(_) => return Ok(()),
            Told::Preparing(done, all) => share("preparing", done, all)?,
            Told::Measuring(done, all) => share("measuring", done, all)?,
            Told::Steps(record, steps) => {
                share("training", record.step as usize, steps as usize)?;
                news.set_item("seconds", record.seconds)?;
                news.set_item("learning_rate", record.learning_rate)?;
                news.set_item("samples_per_second", record.samples_per_second)?;
                news.set_item("losses", record.losses)?;
            }
        }
        progress.call1(py, (news,)).map(drop)
    }
}

/// Runs a training. Ctrl-C, or an error of the callback, ends it after the current step, which is kept on the disk.
pub(crate) fn run<T, E>(
    py: Python<'_>,
    progress: Option<Py<PyAny>>,
    train: impl FnOnce(&AtomicBool, &mut Listener<'_>) -> Result<Ending<T>, E> + Send + 'static,
) -> PyResult<T>
where
    T: Send + 'static,
    E: Error + Send + 'static,
{
    let ending = reporting(
        py,
        Leave::WhenDone,
        move |stop, tell: &Tell<Told>| {
            train(stop.flag(), &mut |news| {
                if let Some(told) = Told::of(news) {
                    tell.tell(told);
                }
            })
        },
        |told| told.hear(py, progress.as_ref()),
    )?;
    match ending {
        Ok(Ending::Finished(trained)) => Ok(trained),
        Ok(Ending::Interrupted { step }) => Err(PyRuntimeError::new_err(format!(
            "the training ended after step {step}; call it again to go on"
        ))),
        Err(error) => Err(file_or_value(&error)),
    }
}

/// What a training came to, as a dict.
pub(crate) fn summary<'py>(py: Python<'py>, trained: Trained) -> PyResult<Bound<'py, PyDict>> {
    let Trained { model, steps, seconds, losses } = trained;
    let dict = PyDict::new(py);
    dict.set_item("model", model)?;
    dict.set_item("steps", steps)?;
    dict.set_item("seconds", seconds)?;
    dict.set_item("losses", losses)?;
    Ok(dict)
}

/// One of the names of a kind of network.
pub(crate) fn kind<K: Copy, const N: usize>(
    argument: &str,
    name: &str,
    all: [K; N],
    name_of: impl Fn(K) -> &'static str,
) -> PyResult<K> {
    let expected = || all.map(&name_of).join(" or ");
    all.into_iter()
        .find(|k| name_of(*k) == name)
        .ok_or_else(|| bad(argument, expected(), format!("{name:?}")))
}

/// 0 to 1.
pub(crate) fn share(argument: &str, value: f64) -> PyResult<f32> {
    if (0.0..=1.0).contains(&value) {
        return Ok(value as f32);
    }
    Err(bad(argument, "a number from 0 to 1", value.to_string()))
}

/// Radians from 0 to half a turn, or the default.
pub(crate) fn turn(argument: &str, value: Option<f64>, default: f32) -> PyResult<f32> {
    match value {
        None => Ok(default),
        Some(value) if (0.0..=std::f64::consts::PI).contains(&value) => {
            Ok((value as f32).min(std::f32::consts::PI))
        }
        Some(value) => Err(bad(argument, "radians from 0 to half a turn", value.to_string())),
    }
}

pub(crate) fn steps_of(steps: Option<i64>) -> PyResult<Option<u64>> {
    steps.map(|n| whole("steps", n, 1).map(|n| n as u64)).transpose()
}

/// A BOP dataset by its folder, an opened one, or meshes by their ids.
pub(crate) enum Source {
    Dataset { root: PathBuf, split: String, ids: Vec<u32>, frames: FrameSelection },
    Meshes(Vec<(u32, sixfold_mesh::Mesh, ModelInfo)>),
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
                return Err(bad("ids, frames, split", "none beside meshes", "some"));
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

    pub(crate) fn read(self, py: Python<'_>, least_visible: f64) -> PyResult<TrainingSet> {
        let read = interruptible(py, move |_| match self {
            Source::Dataset { root, split, ids, frames } => {
                TrainingSet::of_dataset(&root, &split, &ids, &frames, least_visible)
            }
            Source::Meshes(meshes) => Ok(TrainingSet::of_meshes(meshes, "meshes")),
        })?;
        read.map_err(|error| match error {
            TrainingSetError::Dataset(error) => dataset_error(*error),
            other => file_or_value(&other),
        })
    }
}
