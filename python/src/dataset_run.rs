//! `Estimator.run_dataset`: runs a method on all targets of a BOP dataset (`sixfold-runner`) and reports its events to Python.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sixfold::bop::{BopDataset, Target};
use sixfold::detect::detector::TrainedDetector;
use sixfold::estimator::{Cache, PoseEstimator};
use sixfold::runner::{
    DatasetEvent, DatasetRun, DatasetSummary, RegionSource, RunError, RunOptions, describe,
};

use crate::arrays::bad;
use crate::bop::json_to_python;
use crate::guard::{Leave, Stop, Tell, dataset_error, os_error, reporting, results_error};
use crate::training::file_or_value;

/// A method, a dataset, and the result file.
pub(crate) struct Run {
    pub method: Arc<dyn PoseEstimator>,
    pub path: PathBuf,
    pub out: PathBuf,
    pub split: String,
    /// "gt" for ground-truth boxes, or a file of COCO detections.
    pub boxes: Option<PathBuf>,
    pub detector: Option<PathBuf>,
    pub targets: Option<PathBuf>,
    pub min_confidence: Option<f64>,
    pub cache: Option<PathBuf>,
    /// The method's own options.
    pub record: RunOptions,
}

/// An event that a run sends from its thread.
enum Event {
    Image { image: String, done: usize, total: usize },
    Note(String),
}

impl Event {
    /// Passes notes on as Python warnings, and images to the user's callback.
    fn report(self, py: Python<'_>, progress: Option<&Py<PyAny>>) -> PyResult<()> {
        match (self, progress) {
            (Event::Note(text), _) => py.import("warnings")?.call_method1("warn", (text,)).map(drop),
            (Event::Image { .. }, None) => Ok(()),
            (Event::Image { image, done, total }, Some(progress)) => {
                let event = PyDict::new(py);
                event.set_item("stage", "estimating")?;
                event.set_item("done", done)?;
                event.set_item("total", total)?;
                event.set_item("image", image)?;
                progress.call1(py, (event,)).map(drop)
            }
        }
    }
}

/// Runs a method on a dataset and calls the callback after every image. Ctrl-C or an error of the callback ends the run after the
/// current image, when its rows are on disk.
pub(crate) fn run<'py>(
    py: Python<'py>,
    run: Run,
    progress: Option<Py<PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    if run.out.extension().is_none_or(|e| e != "csv") {
        return Err(bad("out", "a file that ends in .csv", run.out.display().to_string()));
    }
    if let (Some(boxes), Some(_)) = (&run.boxes, &run.detector) {
        return Err(bad("boxes", "None with a detector", boxes.display().to_string()));
    }
    let summary = reporting(
        py,
        Leave::WhenDone,
        move |stop, tell: &Tell<Event>| run.run(stop, tell),
        |event| event.report(py, progress.as_ref()),
    )??;
    Ok(json_to_python(py, &summary)?.cast_into::<PyDict>()?)
}

impl Run {
    // The callback has to return the runner's error type, which is large.
    #[allow(clippy::result_large_err)]
    fn run(&self, stop: &Stop, tell: &Tell<Event>) -> PyResult<DatasetSummary> {
        let dataset = BopDataset::open(&self.path, &self.split).map_err(dataset_error)?;
        let targets = dataset.targets(self.targets.as_deref()).map_err(dataset_error)?;
        let targets = dataset.object_targets(&targets).map_err(dataset_error)?;
        let (regions, mut skipped) = self.regions(&dataset, &targets, tell)?;
        let images: BTreeSet<(u32, u32)> = targets.iter().map(|t| (t.scene_id, t.im_id)).collect();
        let (cache, options) = (self.cache(), self.options());
        let run = DatasetRun {
            estimator: self.method.as_ref(),
            dataset: &dataset,
            targets: &targets,
            regions: &regions,
            min_confidence: self.min_confidence,
            cache: &cache,
            options: &options,
        };
        let (mut done, total) = (0, images.len());
        let mut report = |event: DatasetEvent<'_>| match event {
            DatasetEvent::Image { image, .. } => {
                done += 1;
                tell.tell(Event::Image { image, done, total });
            }
            DatasetEvent::Note(text) => tell.tell(Event::Note(text)),
            DatasetEvent::Result(_) => {}
        };
        let summary = run.run(&self.out, stop.flag(), &mut |event| {
            report(event);
            Ok(())
        });
        let mut summary = summary.map_err(run_error)?;
        skipped.append(&mut summary.skipped);
        summary.skipped = skipped;
        Ok(summary)
    }

    /// The regions to search, and which detections of a file were left out.
    fn regions(
        &self,
        dataset: &BopDataset,
        targets: &[Target],
        tell: &Tell<Event>,
    ) -> PyResult<(RegionSource, Vec<String>)> {
        if let Some(weights) = &self.detector {
            let ids: BTreeSet<u32> = targets.iter().filter_map(|t| t.object).map(|o| o.obj_id).collect();
            let detector = TrainedDetector::load(weights).map_err(|error| file_or_value(&error))?;
            let detector = Box::new(detector.for_dataset());
            return Ok((RegionSource::of_detector(detector, ids).map_err(run_error)?, vec![]));
        }
        match self.boxes.as_deref() {
            None => Ok((RegionSource::Anywhere, vec![])),
            Some(gt) if gt == Path::new("gt") => Ok((RegionSource::GroundTruth, vec![])),
            Some(file) => {
                let (source, changed, left_out) = RegionSource::read(dataset, file).map_err(run_error)?;
                changed.into_iter().for_each(|note| tell.tell(Event::Note(note)));
                Ok((source, left_out))
            }
        }
    }

    fn cache(&self) -> Cache {
        self.cache.as_ref().map_or_else(Cache::none, |folder| Cache::new(folder, Cache::LIMIT))
    }

    /// The options that affect the results.
    fn options(&self) -> RunOptions {
        let mut options = self.record.clone();
        options.add("split", &self.split);
        let files = [
            ("path", Some(&self.path)),
            ("boxes", self.boxes.as_ref()),
            ("detector", self.detector.as_ref()),
            ("targets", self.targets.as_ref()),
        ];
        for (name, file) in files {
            if let Some(file) = file {
                options.add(name, &file.display().to_string());
            }
        }
        if let Some(min) = self.min_confidence {
            options.add("min_confidence", &min.to_string());
        }
        options
    }
}

/// The Python exception for a run that cannot continue.
fn run_error(error: RunError) -> PyErr {
    let text = describe(&error);
    match error {
        RunError::Dataset(error) => dataset_error(*error),
        RunError::Results(error) => results_error(error),
        RunError::Io { source, .. } => os_error(source.kind(), text),
        RunError::Cache(error) => file_or_value(&error),
        RunError::NoRegions { method } => bad(
            "boxes",
            format!("\"gt\", a file of COCO detections, or a detector, as {method} needs them"),
            "None",
        ),
        RunError::NoRecord { results, record } => bad(
            "out",
            "a new file, or one that this call started",
            format!("{} without {}", results.display(), record.display()),
        ),
        RunError::OtherOptions(other) => PyValueError::new_err(format!(
            "out: {} was made with other options ({}: {:?}, now {:?}); remove it and {}, or choose another",
            other.results.display(),
            other.option,
            other.before,
            other.now,
            other.record.display()
        )),
        RunError::Interrupted => PyRuntimeError::new_err("the run was interrupted; call it again to resume"),
        _ => PyValueError::new_err(text),
    }
}
