//! `sixfold.metrics`: pose errors and scores. Symmetries and points come from a `Mesh` or from arrays.

use std::path::PathBuf;
use std::sync::Arc;

use numpy::PyArray1;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use sixfold::bop::{
    Estimate, EvalOptions, ModelPoints, Models, Taus, VsdError, VsdOptions, evaluate, evaluate_detection,
    write_recall_curves,
};
use sixfold::geometry::Pose;
use sixfold::mesh::ModelInfo;

use crate::arrays::{self, bad};
use crate::bop::{PyDataset, PyEstimate, json_to_python};
use crate::camera::PyCamera;
use crate::guard::{dataset_error, eval_error, free, image_error, interruptible, results_error};
use crate::mesh::PyMesh;

#[derive(FromPyObject)]
enum Model<'py> {
    Mesh(Bound<'py, PyMesh>),
    Points(Bound<'py, PyAny>),
}

impl Model<'_> {
    fn points(&self) -> PyResult<Arc<ModelPoints>> {
        match self {
            Model::Mesh(mesh) => mesh.get().model_points(),
            Model::Points(object) => {
                let points = arrays::points3("model", object)?;
                let points = ModelPoints::new(&points);
                points.map(Arc::new).ok_or_else(|| bad("model", "at least one point, all finite", "none"))
            }
        }
    }

    fn symmetries(&self, given: Option<&Bound<'_, PyAny>>) -> PyResult<Vec<Pose>> {
        match (given, self) {
            (None, Model::Mesh(mesh)) => Ok(mesh.get().symmetry_poses(ModelInfo::BOP_MAX_STEP)),
            (given, _) => symmetries(given),
        }
    }
}

fn symmetries(given: Option<&Bound<'_, PyAny>>) -> PyResult<Vec<Pose>> {
    let Some(object) = given else { return Ok(vec![Pose::identity()]) };
    let poses = arrays::poses("symmetries", object)?;
    if poses.is_empty() {
        return Err(bad("symmetries", "at least the identity", "no pose"));
    }
    Ok(poses)
}

/// Average distance between corresponding model points (ADD; Hinterstoisser et al. 2012), metres. model: a Mesh or points (N, 3) in
/// metres; estimate and ground_truth (4, 4), used as given: their rotations are not orthonormalised.
///
/// >>> import numpy as np
/// >>> moved = np.eye(4); moved[0, 3] = 0.01
/// >>> add([[0, 0, 0], [0.1, 0, 0]], moved, np.eye(4))
/// 0.01
#[pyfunction]
fn add(
    py: Python<'_>,
    model: Model<'_>,
    estimate: &Bound<'_, PyAny>,
    ground_truth: &Bound<'_, PyAny>,
) -> PyResult<f64> {
    let points = model.points()?;
    let (e, g) = (arrays::placement("estimate", estimate)?, arrays::placement("ground_truth", ground_truth)?);
    free(py, || sixfold::bop::add(&points, e, g))
}

/// As add, with the nearest point at the estimate instead of the corresponding one: ADD-S or ADI, for symmetric objects
/// (Hinterstoisser et al. 2012), metres.
///
/// >>> import numpy as np
/// >>> half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
/// >>> adi([[-0.1, 0, 0], [0.1, 0, 0]], half_turn, np.eye(4))
/// 0.0
#[pyfunction]
fn adi(
    py: Python<'_>,
    model: Model<'_>,
    estimate: &Bound<'_, PyAny>,
    ground_truth: &Bound<'_, PyAny>,
) -> PyResult<f64> {
    let points = model.points()?;
    let (e, g) = (arrays::placement("estimate", estimate)?, arrays::placement("ground_truth", ground_truth)?);
    free(py, || sixfold::bop::adi(&points, e, g))
}

/// Maximum symmetry-aware surface distance (MSSD; Hodan et al. 2020, section 2.2), metres. symmetries (S, 4, 4), including the
/// identity; by default those of the mesh, or only the identity for points.
///
/// >>> import numpy as np
/// >>> moved = np.eye(4); moved[0, 3] = 0.01
/// >>> mssd([[0, 0, 0], [0.1, 0, 0]], moved, np.eye(4))
/// 0.01
#[pyfunction]
#[pyo3(signature = (model, estimate, ground_truth, symmetries=None))]
fn mssd(
    py: Python<'_>,
    model: Model<'_>,
    estimate: &Bound<'_, PyAny>,
    ground_truth: &Bound<'_, PyAny>,
    symmetries: Option<&Bound<'_, PyAny>>,
) -> PyResult<f64> {
    let (points, turns) = (model.points()?, model.symmetries(symmetries)?);
    let (e, g) = (arrays::placement("estimate", estimate)?, arrays::placement("ground_truth", ground_truth)?);
    free(py, || sixfold::bop::mssd(&points, e, g, &turns))
}

/// Maximum symmetry-aware projection distance (MSPD; Hodan et al. 2020, section 2.2), pixels of a pinhole camera; infinite when a
/// vertex lies at or behind the camera. symmetries as for mssd.
///
/// >>> import numpy as np
/// >>> from sixfold import Camera
/// >>> a, b = np.eye(4), np.eye(4)
/// >>> a[:3, 3], b[:3, 3] = (0.01, 0, 1), (0, 0, 1)
/// >>> mspd([[0, 0, 0]], a, b, Camera(500, 500, 320, 240, 640, 480))
/// 5.0
#[pyfunction]
#[pyo3(signature = (model, estimate, ground_truth, camera, symmetries=None))]
fn mspd(
    py: Python<'_>,
    model: Model<'_>,
    estimate: &Bound<'_, PyAny>,
    ground_truth: &Bound<'_, PyAny>,
    camera: PyCamera,
    symmetries: Option<&Bound<'_, PyAny>>,
) -> PyResult<f64> {
    let (points, turns) = (model.points()?, model.symmetries(symmetries)?);
    let (e, g) = (arrays::placement("estimate", estimate)?, arrays::placement("ground_truth", ground_truth)?);
    free(py, || sixfold::bop::mspd(&points, e, g, &camera.0, &turns))
}

/// Mean distance in pixels between the projections of corresponding points (Brachmann et al. 2016); infinite when a point lies at
/// or behind the camera.
///
/// Raises ValueError for a matrix that is not a pose and for points that are not finite.
///
/// >>> import numpy as np
/// >>> truth = np.eye(4); truth[2, 3] = 1.0
/// >>> estimate = truth.copy(); estimate[0, 3] = 0.01
/// >>> round(projection_error(np.eye(3) * 0, estimate, truth, Camera(500, 500, 320, 240, 640, 480)), 6)
/// 5.0
#[pyfunction]
fn projection_error(
    py: Python<'_>,
    model: Model<'_>,
    estimate: &Bound<'_, PyAny>,
    ground_truth: &Bound<'_, PyAny>,
    camera: PyCamera,
) -> PyResult<f64> {
    let points = model.points()?;
    let (e, g) = (arrays::placement("estimate", estimate)?, arrays::placement("ground_truth", ground_truth)?);
    free(py, || sixfold::bop::projection_error(&points, e, g, &camera.0))
}

/// Angle in radians between two rotations, under the symmetry (S, 4, 4) for which it is smallest; by default the identity only.
///
/// >>> import numpy as np
/// >>> rotation_error(np.diag([-1.0, -1.0, 1.0, 1.0]), np.eye(4))
/// 3.141592653589793
#[pyfunction]
#[pyo3(signature = (estimate, ground_truth, symmetries=None))]
fn rotation_error(
    estimate: &Bound<'_, PyAny>,
    ground_truth: &Bound<'_, PyAny>,
    symmetries: Option<&Bound<'_, PyAny>>,
) -> PyResult<f64> {
    let (e, g) = (arrays::pose("estimate", estimate)?, arrays::pose("ground_truth", ground_truth)?);
    Ok(sixfold::bop::rotation_error(&e, &g, &self::symmetries(symmetries)?))
}

/// Distance in metres between two origins, under the symmetry (S, 4, 4) for which it is smallest; by default the identity only.
///
/// >>> import numpy as np
/// >>> moved = np.eye(4); moved[2, 3] = 0.5
/// >>> translation_error(moved, np.eye(4))
/// 0.5
#[pyfunction]
#[pyo3(signature = (estimate, ground_truth, symmetries=None))]
fn translation_error(
    estimate: &Bound<'_, PyAny>,
    ground_truth: &Bound<'_, PyAny>,
    symmetries: Option<&Bound<'_, PyAny>>,
) -> PyResult<f64> {
    let (e, g) = (arrays::pose("estimate", estimate)?, arrays::pose("ground_truth", ground_truth)?);
    Ok(sixfold::bop::translation_error(&e, &g, &self::symmetries(symmetries)?))
}

fn vsd_error(error: VsdError) -> PyErr {
    let argument = match &error {
        VsdError::Diameter { .. } => "diameter",
        VsdError::Size { image: "estimate", .. } => "depth_estimate",
        VsdError::Size { image: "ground-truth", .. } => "depth_ground_truth",
        _ => "depth",
    };
    PyValueError::new_err(format!("{argument}: {error}"))
}

fn vsd_options(taus: Option<&Bound<'_, PyAny>>, delta: f64) -> PyResult<VsdOptions> {
    let mut options = VsdOptions { delta, ..VsdOptions::default() };
    if let Some(taus) = taus {
        options.taus = Taus::Diameters(arrays::numbers("taus", taus)?);
    }
    if !(delta.is_finite() && delta >= 0.0) {
        return Err(bad("delta", "metres, zero or more", delta.to_string()));
    }
    Ok(options)
}

/// Visible surface discrepancy (VSD; Hodan et al. 2018, equation 1; step cost, visibility "bop19"), 0 to 1, one number per tau.
///
/// mesh is rendered at estimate and ground_truth (4, 4); depth (H, W) in metres is the sensor's depth image, 0 where nothing was
/// measured. taus: misalignment tolerances as fractions of the diameter (default .05 to .5 in steps of .05); delta: tolerance of
/// the visibility test, metres; diameter: metres, by default that of the mesh.
///
/// Raises ValueError when depth and camera differ in size, the mesh has no faces or the diameter is not above 0.
///
/// >>> vsd(mesh, pose, ground_truth, depth, camera).mean()  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (mesh, estimate, ground_truth, depth, camera, *, taus=None, delta=0.015, diameter=None))]
#[allow(clippy::too_many_arguments)]
fn vsd<'py>(
    py: Python<'py>,
    mesh: &Bound<'py, PyMesh>,
    estimate: &Bound<'py, PyAny>,
    ground_truth: &Bound<'py, PyAny>,
    depth: &Bound<'py, PyAny>,
    camera: PyCamera,
    taus: Option<&Bound<'py, PyAny>>,
    delta: f64,
    diameter: Option<f64>,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let (e, g) = (arrays::pose("estimate", estimate)?, arrays::pose("ground_truth", ground_truth)?);
    let test = arrays::depth("depth", depth)?;
    let camera = camera.of_image("depth", test.size())?;
    let mesh = mesh.get();
    if mesh.mesh.faces().is_empty() {
        return Err(bad("mesh", "a mesh with faces to render", "a list of points"));
    }
    let diameter = diameter.unwrap_or_else(|| mesh.known_diameter());
    let options = vsd_options(taus, delta)?;
    let errors = free(py, || {
        let draw = |pose: &Pose| sixfold::render::render_depth(&mesh.mesh, pose, &camera);
        sixfold::bop::vsd(&draw(&e), &draw(&g), &test, &camera, diameter, &options)
    })?;
    Ok(PyArray1::from_vec(py, errors.map_err(vsd_error)?))
}

/// As vsd, from depth images (H, W) in metres: the model rendered at the estimate and at the ground truth, and the sensor's.
///
/// Raises ValueError for images of different sizes and a diameter that is not above 0.
///
/// >>> import numpy as np
/// >>> wall = np.ones((480, 640), np.float32)
/// >>> vsd_of_depth(wall, wall, wall, Camera(500, 500, 320, 240, 640, 480), diameter=0.1, taus=[0.2])
/// array([0.])
#[pyfunction]
#[pyo3(signature = (depth_estimate, depth_ground_truth, depth, camera, diameter, *, taus=None, delta=0.015))]
#[allow(clippy::too_many_arguments)]
fn vsd_of_depth<'py>(
    py: Python<'py>,
    depth_estimate: &Bound<'py, PyAny>,
    depth_ground_truth: &Bound<'py, PyAny>,
    depth: &Bound<'py, PyAny>,
    camera: PyCamera,
    diameter: f64,
    taus: Option<&Bound<'py, PyAny>>,
    delta: f64,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let e = arrays::depth("depth_estimate", depth_estimate)?;
    let g = arrays::depth("depth_ground_truth", depth_ground_truth)?;
    let t = arrays::depth("depth", depth)?;
    let options = vsd_options(taus, delta)?;
    let errors = free(py, || sixfold::bop::vsd(&e, &g, &t, &camera.0, diameter, &options))?;
    Ok(PyArray1::from_vec(py, errors.map_err(vsd_error)?))
}

/// Average precision with COCO's 101 recall steps, as the BOP Challenge 2024 computes it. right (N,) bool states for each
/// detection, in order of falling score, whether it is matched; positives is the number of ground-truth poses. None without ground
/// truth.
///
/// >>> round(average_precision([True, False], 1), 6)
/// 1.0
#[pyfunction]
fn average_precision(right: Vec<bool>, positives: i64) -> PyResult<Option<f64>> {
    let positives = arrays::whole("positives", positives, 0)?;
    let found = right.iter().filter(|r| **r).count();
    if positives > 0 && found > positives {
        return Err(bad("right", format!("at most {positives} matches"), found.to_string()));
    }
    Ok(sixfold::bop::average_precision(&right, positives))
}

/// Area under the accuracy-threshold curve from 0 to `largest` metres, 0 to 1, as PoseCNN's toolbox computes it (Xiang et al.
/// 2018). errors (N,) in metres, infinite where an estimate is missing. None for an empty list.
///
/// >>> import numpy as np
/// >>> area_under_accuracy([0.0, np.inf])
/// 0.5
#[pyfunction]
#[pyo3(signature = (errors, largest=0.1))]
fn area_under_accuracy(errors: Vec<f64>, largest: f64) -> PyResult<Option<f64>> {
    if errors.iter().any(|e| e.is_nan() || *e < 0.0) {
        return Err(bad("errors", "numbers from 0 (infinite for missing ones)", "NaN or a negative number"));
    }
    Ok(sixfold::bop::area_under_accuracy(&errors, arrays::positive("largest", largest)?))
}

/// Fraction of the errors (N,) that are below a threshold, 0 to 1; None for an empty list.
///
/// >>> recall_below([0.01, 0.2], 0.1)
/// 0.5
#[pyfunction]
fn recall_below(errors: Vec<f64>, threshold: f64) -> Option<f64> {
    sixfold::bop::recall_below(&errors, threshold)
}

#[derive(FromPyObject)]
enum Results {
    List(Vec<PyEstimate>),
    File(PathBuf),
}

impl Results {
    fn read(self) -> PyResult<Vec<Estimate>> {
        match self {
            Results::List(list) => Ok(list.into_iter().map(|e| e.0).collect()),
            Results::File(path) => sixfold::bop::read_results(&path).map_err(results_error),
        }
    }
}

#[derive(FromPyObject)]
enum DatasetOrFolder<'py> {
    Dataset(Bound<'py, PyDataset>),
    Folder(PathBuf),
}

impl DatasetOrFolder<'_> {
    fn open(self, split: &str) -> PyResult<Arc<sixfold::bop::BopDataset>> {
        match self {
            DatasetOrFolder::Dataset(dataset) => Ok(dataset.get().0.clone()),
            DatasetOrFolder::Folder(path) => {
                Ok(Arc::new(sixfold::bop::BopDataset::open(&path, split).map_err(dataset_error)?))
            }
        }
    }
}

fn models_of(word: &str) -> PyResult<Models> {
    match word {
        "eval" => Ok(Models::Evaluation),
        "rendering" => Ok(Models::Rendering),
        other => Err(bad("models", "\"eval\" or \"rendering\"", format!("{other:?}"))),
    }
}

/// Scores a result file as the BOP Challenge 2019 does (Hodan et al. 2020). Returns a dict with ar, ar_vsd, ar_mssd, ar_mspd,
/// add_s_recall (by object id, "mean", "mean_over_objects"), add_auc, add_s_auc, objects, curves, targets, estimates,
/// estimates_left_out, average_time_per_image and reasons. A score that cannot be computed is None, and `reasons` states why.
///
/// dataset: a bop.Dataset, or its folder, of which `split` is scored. results: a CSV file in BOP's format (millimetres) or a list
/// of bop.Estimate. targets: a targets file (by default the dataset's test_targets_bop19.json, or without one every pose of the
/// split that is at least 10 % visible). vsd=False leaves out VSD, which takes longest; its visibility tolerance is 15 mm,
/// or 5 mm for a dataset whose folder is named itodd. visib_gt_min: minimum visible fraction of a target, instead of BOP's rule. models: "eval" or
/// "rendering". curves: a PNG file to write, with the recall curves. Ctrl-C interrupts it.
///
/// Raises OSError for files that cannot be read, ValueError for broken ones.
///
/// >>> bop19("data/demo", "out/results.csv")["ar_mssd"]  # doctest: +SKIP
/// 0.75...
#[pyfunction]
#[pyo3(signature = (dataset, results, *, split="test", targets=None, vsd=true, visib_gt_min=None, models="eval", curves=None))]
#[allow(clippy::too_many_arguments)]
fn bop19<'py>(
    py: Python<'py>,
    dataset: DatasetOrFolder<'py>,
    results: Results,
    split: &str,
    targets: Option<PathBuf>,
    vsd: bool,
    visib_gt_min: Option<f64>,
    models: &str,
    curves: Option<PathBuf>,
) -> PyResult<Bound<'py, PyAny>> {
    let dataset = dataset.open(split)?;
    let estimates = results.read()?;
    let usual = EvalOptions::for_dataset(dataset.root());
    let options = EvalOptions { compute_vsd: vsd, visib_gt_min, models: models_of(models)?, ..usual };
    options.check().map_err(eval_error)?;
    let targets = dataset.targets(targets.as_deref()).map_err(dataset_error)?;
    let scores = interruptible(py, move |stop| {
        let progress = |_, _| {
            stop.check();
            true
        };
        evaluate(&dataset, &estimates, &targets, &options, &progress)
    })?
    .map_err(eval_error)?;
    if let Some(path) = curves {
        free(py, || write_recall_curves(&path, &scores))?.map_err(image_error)?;
    }
    json_to_python(py, &scores)
}

/// Scores estimates as 6D detections (BOP Challenge 2024). Returns a dict with ap, ap_mssd, ap_mspd, ap_mssd_mm (MSSD thresholds 2
/// to 20 mm), objects and reasons. Arguments and exceptions as for bop19.
///
/// >>> bop24("data/demo", "out/results.csv")["ap"]  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (dataset, results, *, split="test", targets=None, visib_gt_min=None, models="eval"))]
fn bop24<'py>(
    py: Python<'py>,
    dataset: DatasetOrFolder<'py>,
    results: Results,
    split: &str,
    targets: Option<PathBuf>,
    visib_gt_min: Option<f64>,
    models: &str,
) -> PyResult<Bound<'py, PyAny>> {
    let dataset = dataset.open(split)?;
    let estimates = results.read()?;
    let usual = EvalOptions::for_dataset(dataset.root());
    let options = EvalOptions { visib_gt_min, models: models_of(models)?, ..usual };
    options.check().map_err(eval_error)?;
    let targets = dataset.targets(targets.as_deref()).map_err(dataset_error)?;
    let scores = interruptible(py, move |_| evaluate_detection(&dataset, &estimates, &targets, &options))?
        .map_err(eval_error)?;
    json_to_python(py, &scores)
}

/// Adds the functions of `sixfold.metrics`.
pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(add, module)?)?;
    module.add_function(wrap_pyfunction!(adi, module)?)?;
    module.add_function(wrap_pyfunction!(mssd, module)?)?;
    module.add_function(wrap_pyfunction!(mspd, module)?)?;
    module.add_function(wrap_pyfunction!(projection_error, module)?)?;
    module.add_function(wrap_pyfunction!(rotation_error, module)?)?;
    module.add_function(wrap_pyfunction!(translation_error, module)?)?;
    module.add_function(wrap_pyfunction!(vsd, module)?)?;
    module.add_function(wrap_pyfunction!(vsd_of_depth, module)?)?;
    module.add_function(wrap_pyfunction!(average_precision, module)?)?;
    module.add_function(wrap_pyfunction!(area_under_accuracy, module)?)?;
    module.add_function(wrap_pyfunction!(recall_below, module)?)?;
    module.add_function(wrap_pyfunction!(bop19, module)?)?;
    module.add_function(wrap_pyfunction!(bop24, module)?)?;
    Ok(())
}
