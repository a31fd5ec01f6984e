//! `sixfold.coco`: detections and their scores, in COCO's JSON format.

use std::path::{Path, PathBuf};

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sixfold::bop::{
    CocoGroundTruth, Detection, IouType, ReadDetections, VisibleTruth, evaluate_coco, parse_detections,
};

use crate::arrays::{bad, id, pairs};
use crate::bop::{PyDataset, decode_mask, encode_mask, json_to_python};
use crate::guard::{dataset_error, free, interruptible, os_error};

/// The text of a JSON file, or of an object with the contents of one; and the path for messages.
fn document(argument: &'static str, source: &Bound<'_, PyAny>) -> PyResult<(Vec<u8>, PathBuf)> {
    if let Ok(path) = source.extract::<PathBuf>() {
        let bytes = std::fs::read(&path).map_err(|error| {
            os_error(error.kind(), format!("{}: cannot be read: {error}", path.display()))
        })?;
        return Ok((bytes, path));
    }
    let text = source.py().import("json")?.call_method1("dumps", (source,));
    let text = text.map_err(|error| {
        bad(
            argument,
            "a JSON file or what one holds (dicts, lists, numbers)",
            error.value(source.py()).to_string(),
        )
    })?;
    Ok((text.extract::<String>()?.into_bytes(), PathBuf::from(argument)))
}

fn detections_of(argument: &'static str, source: &Bound<'_, PyAny>) -> PyResult<Vec<Detection>> {
    let (text, path) = document(argument, source)?;
    Ok(parse_detections(&text, &path, &ReadDetections::default()).map_err(dataset_error)?.detections)
}

/// Computes COCO's average precision and recall of boxes or masks (Lin et al. 2014), with the same numbers as pycocotools 2.0.11.
///
/// ground_truth: a COCO JSON file (BOP: scene_gt_coco.json) or a dict of that form; {scene_id: file or dict} for several scenes;
/// or a bop.Dataset, whose ground-truth poses give boxes and masks of the visible parts. detections: a JSON file or a list of dicts
/// with image_id, category_id, score, bbox [x, y, w, h] (pixels) and/or segmentation (run lengths), in BOP also scene_id.
/// iou_type: "bbox" or "segm". images: the images of a bop.Dataset to evaluate, [(scene_id, im_id), ...]; all if None. Ctrl-C
/// interrupts it.
///
/// Returns a dict with ap, ap50, ap75, ap_small, ap_medium, ap_large, ar1, ar10, ar100, ar_small, ar_medium and ar_large. Each is
/// from 0 to 1, or None if there is no ground truth of that size (-1 in pycocotools).
///
/// Raises OSError for files that cannot be read; ValueError with entry and field for invalid ones.
///
/// >>> truth = {"images": [{"id": 1}],
/// ...          "annotations": [{"id": 1, "image_id": 1, "category_id": 5, "bbox": [10, 10, 50, 50]}]}
/// >>> found = [{"image_id": 1, "category_id": 5, "score": 0.9, "bbox": [10, 10, 50, 50]}]
/// >>> round(evaluate(truth, found)["ap"], 6)
/// 1.0
#[pyfunction]
#[pyo3(signature = (ground_truth, detections, iou_type="bbox", *, images=None))]
fn evaluate<'py>(
    py: Python<'py>,
    ground_truth: &Bound<'py, PyAny>,
    detections: &Bound<'py, PyAny>,
    iou_type: &str,
    images: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyAny>> {
    let iou_type = match iou_type {
        "bbox" => IouType::Box,
        "segm" => IouType::Mask,
        other => return Err(bad("iou_type", "\"bbox\" or \"segm\"", format!("{other:?}"))),
    };
    if let Ok(dataset) = ground_truth.cast::<PyDataset>() {
        let truth = truth_of(py, dataset.get(), images)?;
        let detections = detections_of("detections", detections)?;
        let scores = interruptible(py, move |_| evaluate_coco(&truth, &detections, iou_type))?;
        return json_to_python(py, &scores);
    }
    if images.is_some() {
        return Err(bad("images", "None, as ground_truth is not a Dataset", "some"));
    }
    let mut truth = CocoGroundTruth::default();
    let mut add = |scene_id: u32, source: &Bound<'py, PyAny>| -> PyResult<()> {
        let (text, path) = document("ground_truth", source)?;
        truth.add_scene(scene_id, &text, &path).map_err(dataset_error)
    };
    match ground_truth.cast::<PyDict>() {
        Ok(dict) if !dict.contains("images")? && !dict.contains("annotations")? => {
            for (scene_id, source) in dict {
                let scene_id: i64 = scene_id.extract().map_err(|_| {
                    bad("ground_truth", "scene ids as keys, or images and annotations", "other keys")
                })?;
                add(id("ground_truth", scene_id)?, &source)?;
            }
        }
        _ => add(0, ground_truth)?,
    }
    let detections = detections_of("detections", detections)?;
    let scores = interruptible(py, move |_| evaluate_coco(&truth, &detections, iou_type))?;
    json_to_python(py, &scores)
}

/// The ground truth of a dataset's images, computed from its poses.
fn truth_of(
    py: Python<'_>,
    dataset: &PyDataset,
    images: Option<&Bound<'_, PyAny>>,
) -> PyResult<CocoGroundTruth> {
    let images = match images {
        Some(list) => pairs("images", list)?,
        None => dataset.images()?,
    };
    let dataset = dataset.0.clone();
    let truth = interruptible(py, move |_| VisibleTruth::of_poses(&dataset, &images))?;
    Ok(truth.map_err(dataset_error)?.truth)
}

/// Reads a file of detections in COCO's JSON format, or in BOP's form of it with scene_id.
///
/// image_size: (width, height) of the images, pixels; if given, boxes are clipped to it, and detections with boxes outside are left
/// out. Detections with an empty box are always left out. lenient=True also leaves invalid entries out. A warning reports what was
/// changed or left out.
///
/// Returns a list of dicts with scene_id, image_id, category_id, score, bbox, segmentation and time.
///
/// Raises OSError when the file cannot be read; ValueError with entry and field when it is invalid.
///
/// >>> found = read_detections("detections.json", image_size=(640, 480))  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (path, *, image_size=None, lenient=false))]
fn read_detections<'py>(
    py: Python<'py>,
    path: PathBuf,
    image_size: Option<(usize, usize)>,
    lenient: bool,
) -> PyResult<Bound<'py, PyAny>> {
    let options = ReadDetections { lenient, image_size };
    let read = free(py, || sixfold::bop::read_detections(&path, &options))?.map_err(dataset_error)?;
    if let Some(first) = read.adjusted.first() {
        let text = format!(
            "{} detections were changed or left out, the first: {}",
            read.adjusted.len(),
            first.message
        );
        py.import("warnings")?.call_method1("warn", (text,))?;
    }
    let list: Vec<serde_json::Value> = read.detections.iter().map(as_json).collect();
    json_to_python(py, &list)
}

fn as_json(d: &Detection) -> serde_json::Value {
    serde_json::json!({
        "scene_id": d.scene_id,
        "image_id": d.image_id,
        "category_id": d.category_id,
        "score": d.score,
        "bbox": d.bbox.map(|b| [b.x, b.y, b.width, b.height]),
        "segmentation": d.segmentation.as_ref().map(|r| {
            serde_json::json!({ "size": [r.height(), r.width()], "counts": r.to_compressed() })
        }),
        "time": d.time,
    })
}

/// Writes detections in BOP's form of COCO's JSON format, completely or not at all.
///
/// detections: a list of dicts, as returned by read_detections.
///
/// Raises OSError when the file cannot be written; ValueError with entry and field for an invalid detection.
///
/// >>> write_detections("out/detections.json", found)  # doctest: +SKIP
#[pyfunction]
fn write_detections(py: Python<'_>, path: PathBuf, detections: &Bound<'_, PyAny>) -> PyResult<()> {
    if detections.extract::<PathBuf>().is_ok() {
        return Err(PyValueError::new_err("detections: expected a list of dicts, found a path"));
    }
    let list = detections_of("detections", detections)?;
    free(py, || sixfold::bop::write_detections(Path::new(&path), &list))?.map_err(dataset_error)
}

/// Adds the contents of `sixfold.coco`.
pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(evaluate, module)?)?;
    module.add_function(wrap_pyfunction!(read_detections, module)?)?;
    module.add_function(wrap_pyfunction!(write_detections, module)?)?;
    module.add_function(wrap_pyfunction!(encode_mask, module)?)?;
    module.add_function(wrap_pyfunction!(decode_mask, module)?)?;
    Ok(())
}
