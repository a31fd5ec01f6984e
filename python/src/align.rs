//! Poses from correspondences: PnP with outliers, Kabsch, Umeyama and ICP.

use numpy::{PyArray1, PyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyIterator;
use sixfold::geometry::{
    AlignmentError, DepthTarget, IcpError, IcpLevel, IcpOptions, IcpReport, IndexedCloud, NormalOptions,
    PnpError, PnpOptions, PnpReport, PnpSolver, PointCloud, Pose, RefineOptions,
};

use crate::NoSolutionError;
use crate::arrays::{self, bad, positive, seed, whole};
use crate::camera::PyCamera;
use crate::guard::{free, interruptible};

fn pnp_error(error: PnpError) -> PyErr {
    let argument = match &error {
        PnpError::NoModel => return NoSolutionError::new_err(error.to_string()),
        PnpError::Lengths { .. } => "object_points, image_points",
        PnpError::TooFew { .. } => "object_points",
        PnpError::NotFinite { what, .. } | PnpError::Degenerate { what } if what.contains("image") => {
            "image_points"
        }
        PnpError::NotFinite { .. } | PnpError::Degenerate { .. } => "object_points",
        PnpError::Undistortable { .. } => "image_points",
        PnpError::Camera(_) => "camera",
        _ => return PyValueError::new_err(error.to_string()),
    };
    PyValueError::new_err(format!("{argument}: {error}"))
}

/// The result of `pnp_ransac`. Unpacks into camera_from_object (4, 4) and inliers (N,) bool.
#[pyclass(name = "PnpResult", module = "sixfold", frozen)]
pub(crate) struct PnpResult {
    /// The pose, (4, 4) float64, metres.
    #[pyo3(get)]
    camera_from_object: Py<PyArray2<f64>>,
    /// Per correspondence, whether its reprojection error is below the threshold; (N,) bool.
    #[pyo3(get)]
    inliers: Py<PyArray1<bool>>,
    /// Number of inliers.
    #[pyo3(get)]
    inlier_count: usize,
    /// Number of samples drawn.
    #[pyo3(get)]
    iterations: usize,
    /// Mean of 1 - min(error / threshold, 1)^2 over all correspondences: 0 no support, 1 perfect.
    #[pyo3(get)]
    score: f64,
    /// Root mean square reprojection error of the inliers, pixels.
    #[pyo3(get)]
    rms_px: f64,
}

#[pymethods]
impl PnpResult {
    fn __iter__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyIterator>> {
        (&self.camera_from_object, &self.inliers).into_pyobject(py)?.try_iter()
    }

    fn __len__(&self) -> usize {
        2
    }

    fn __repr__(&self) -> String {
        format!("<PnpResult: {} inliers, score {:.3}, {:.2} px>", self.inlier_count, self.score, self.rms_px)
    }
}

/// With more samples than this, the search runs on a thread of its own, so that Ctrl-C can interrupt it.
const MANY_ITERATIONS: usize = 20_000;

/// Estimates a pose from correspondences with outliers. AP3P (Ke and Roumeliotis 2017) or EPnP (Lepetit et al. 2009) computes
/// poses in a locally optimised RANSAC (Chum et al. 2003; Lebeda et al. 2012). With refine=True the best pose is refined over all
/// correspondences.
///
/// object_points: (N, 3), metres. image_points: (N, 2), pixels of the raw image; the camera's distortion is removed.
/// threshold_px: correspondences with a smaller reprojection error are inliers. max_iterations, min_iterations: maximum and
/// minimum number of samples; min_iterations is 200 by default, but not above max_iterations. confidence: the search ends once a
/// sample without outliers was drawn with this probability, 0.9999 by default. solver: "ap3p" or "epnp". Ctrl-C interrupts long
/// searches (max_iterations above 20000, or more than 200000 correspondences).
///
/// Returns a PnpResult, which unpacks into the pose (4, 4) and the inlier mask (N,). The same input and seed give the same bytes.
///
/// Raises ValueError for lists of different lengths, fewer than 4 correspondences, numbers that are not finite, collinear points
/// and options out of range; NoSolutionError (a ValueError) when no pose agrees with enough correspondences.
///
/// >>> import numpy as np
/// >>> camera = Camera(572.4, 573.6, 325.3, 242.0, 640, 480)
/// >>> points = np.random.default_rng(0).uniform(-0.05, 0.05, (50, 3))
/// >>> truth = pose_exp([0.02, -0.1, 0.8, 0.3, -0.2, 0.5])
/// >>> pixels = camera.project(points @ truth[:3, :3].T + truth[:3, 3])
/// >>> pixels[0] += 40
/// >>> pose, inliers = pnp_ransac(points, pixels, camera)
/// >>> bool(np.allclose(pose, truth)), int(inliers.sum())
/// (True, 49)
#[pyfunction]
#[pyo3(signature = (object_points, image_points, camera, threshold_px=3.0, max_iterations=10_000, seed=0, *, min_iterations=None, confidence=None, solver="ap3p", refine=true))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn pnp_ransac(
    py: Python<'_>,
    object_points: &Bound<'_, PyAny>,
    image_points: &Bound<'_, PyAny>,
    camera: PyCamera,
    threshold_px: f64,
    max_iterations: i64,
    seed: i64,
    min_iterations: Option<i64>,
    confidence: Option<f64>,
    solver: &str,
    refine: bool,
) -> PyResult<PnpResult> {
    let object = arrays::points3("object_points", object_points)?;
    let image = arrays::points2("image_points", image_points)?;
    let defaults = PnpOptions::default();
    let max_iterations = whole("max_iterations", max_iterations, 1)?;
    let options = PnpOptions {
        threshold_px,
        max_iterations,
        min_iterations: match min_iterations {
            Some(n) => whole("min_iterations", n, 0)?,
            None => defaults.min_iterations.min(max_iterations),
        },
        confidence: confidence.unwrap_or(defaults.confidence),
        seed: self::seed(seed)?,
        solver: match solver {
            "ap3p" => PnpSolver::Ap3p,
            "epnp" => PnpSolver::Epnp,
            other => return Err(bad("solver", "\"ap3p\" or \"epnp\"", format!("{other:?}"))),
        },
        refine,
        ..defaults
    };
    let camera = camera.0;
    let found = if max_iterations > MANY_ITERATIONS || object.len() > 200_000 {
        interruptible(py, move |_| sixfold::geometry::pnp_ransac(&object, &image, &camera, &options))?
    } else {
        free(py, || sixfold::geometry::pnp_ransac(&object, &image, &camera, &options))?
    };
    let PnpReport { camera_from_object, inliers, inlier_count, iterations, score, rms_px, .. } =
        found.map_err(pnp_error)?;
    Ok(PnpResult {
        camera_from_object: arrays::from_pose(py, &camera_from_object)?.unbind(),
        inliers: PyArray1::from_vec(py, inliers).unbind(),
        inlier_count,
        iterations,
        score,
        rms_px,
    })
}

/// Computes a pose (4, 4) by EPnP (Lepetit et al. 2009) from at least four correspondences without outliers.
///
/// object_points: (N, 3), metres. image_points: (N, 2), pixels of the raw image.
///
/// Raises ValueError as pnp_ransac; NoSolutionError when EPnP finds no pose.
///
/// >>> import numpy as np
/// >>> points = np.array([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1], [0.1, 0.1, 0.1], [0, 0, 0]])
/// >>> camera = Camera(500, 500, 320, 240, 640, 480)
/// >>> epnp(points, camera.project(points + [0, 0, 0.6]), camera)[2, 3].round(6)
/// np.float64(0.6)
#[pyfunction]
pub(crate) fn epnp<'py>(
    py: Python<'py>,
    object_points: &Bound<'py, PyAny>,
    image_points: &Bound<'py, PyAny>,
    camera: PyCamera,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let object = arrays::points3("object_points", object_points)?;
    let image = arrays::points2("image_points", image_points)?;
    let pose = free(py, || sixfold::geometry::epnp(&object, &image, &camera.0))?.map_err(pnp_error)?;
    arrays::from_pose(py, &pose)
}

/// Refines the pose `initial` (4, 4) by truncated least squares (Blake and Zisserman 1987). All correspondences are used, outliers
/// included, but reprojection errors above threshold_px have no influence.
///
/// Returns the pose (4, 4) and the number of inliers.
///
/// Raises ValueError as pnp_ransac; NoSolutionError when fewer than three correspondences are within the threshold.
///
/// >>> import numpy as np
/// >>> points = np.array([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1], [0.1, 0.1, 0.1], [0, 0, 0]])
/// >>> camera = Camera(500, 500, 320, 240, 640, 480)
/// >>> near = np.eye(4); near[2, 3] = 0.62
/// >>> pose, inliers = refine_pose(points, camera.project(points + [0, 0, 0.6]), camera, near, threshold_px=30)
/// >>> inliers, pose[2, 3].round(6)
/// (5, np.float64(0.6))
#[pyfunction]
#[pyo3(signature = (object_points, image_points, camera, initial, threshold_px=3.0, max_iterations=50))]
pub(crate) fn refine_pose<'py>(
    py: Python<'py>,
    object_points: &Bound<'py, PyAny>,
    image_points: &Bound<'py, PyAny>,
    camera: PyCamera,
    initial: &Bound<'py, PyAny>,
    threshold_px: f64,
    max_iterations: i64,
) -> PyResult<(Bound<'py, PyArray2<f64>>, usize)> {
    let object = arrays::points3("object_points", object_points)?;
    let image = arrays::points2("image_points", image_points)?;
    let initial = arrays::pose("initial", initial)?;
    let max_iterations = whole("max_iterations", max_iterations, 0)?;
    let options = RefineOptions { threshold_px, max_iterations, ..RefineOptions::default() };
    let report = free(py, || sixfold::geometry::refine_pose(&object, &image, &camera.0, &initial, &options))?
        .map_err(pnp_error)?;
    Ok((arrays::from_pose(py, &report.camera_from_object)?, report.inlier_count))
}

fn alignment_error(error: AlignmentError) -> PyErr {
    let argument = match &error {
        AlignmentError::Value { what, .. } if what.contains("weight") => "weights",
        AlignmentError::Value { what, .. } if what.contains("target") => "target",
        AlignmentError::Lengths { source_points, target_points, .. } if source_points == target_points => {
            "weights"
        }
        _ => "source, target",
    };
    PyValueError::new_err(format!("{argument}: {error}"))
}

/// Source points, target points and their weights.
type Pairs = (Vec<sixfold::geometry::Vec3>, Vec<sixfold::geometry::Vec3>, Option<Vec<f64>>);

fn pairs(
    source: &Bound<'_, PyAny>,
    target: &Bound<'_, PyAny>,
    weights: Option<&Bound<'_, PyAny>>,
) -> PyResult<Pairs> {
    let source = arrays::points3("source", source)?;
    let target = arrays::points3("target", target)?;
    let weights = weights.map(|w| arrays::numbers("weights", w)).transpose()?;
    Ok((source, target, weights))
}

/// Computes the rigid transformation target_from_source (4, 4) that minimises the weighted squared distances (Kabsch 1976,
/// reflections after Umeyama 1991).
///
/// source, target: (N, 3). weights: (N,), or None for equal weights.
///
/// Raises ValueError for different lengths, negative weights, or points that do not determine a rotation (fewer than three, or
/// collinear).
///
/// >>> import numpy as np
/// >>> points = np.random.default_rng(0).normal(size=(10, 3))
/// >>> bool(np.allclose(kabsch(points, points + [0, 0, 1])[:3, 3], [0, 0, 1]))
/// True
#[pyfunction]
#[pyo3(signature = (source, target, weights=None))]
pub(crate) fn kabsch<'py>(
    py: Python<'py>,
    source: &Bound<'py, PyAny>,
    target: &Bound<'py, PyAny>,
    weights: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (source, target, weights) = pairs(source, target, weights)?;
    let pose = free(py, || sixfold::geometry::kabsch(&source, &target, weights.as_deref()))?
        .map_err(alignment_error)?;
    arrays::from_pose(py, &pose)
}

/// Computes the similarity transformation that minimises the weighted squared distances (Umeyama 1991, equations 40 to 42).
///
/// Returns target_from_source (4, 4) without the scale, and the scale: target = R (scale * source) + t.
///
/// Raises ValueError as kabsch.
///
/// >>> import numpy as np
/// >>> points = np.random.default_rng(0).normal(size=(10, 3))
/// >>> pose, scale = umeyama(points, 2 * points)
/// >>> round(scale, 9)
/// 2.0
#[pyfunction]
#[pyo3(signature = (source, target, weights=None))]
pub(crate) fn umeyama<'py>(
    py: Python<'py>,
    source: &Bound<'py, PyAny>,
    target: &Bound<'py, PyAny>,
    weights: Option<&Bound<'py, PyAny>>,
) -> PyResult<(Bound<'py, PyArray2<f64>>, f64)> {
    let (source, target, weights) = pairs(source, target, weights)?;
    let found = free(py, || sixfold::geometry::umeyama(&source, &target, weights.as_deref()))?
        .map_err(alignment_error)?;
    Ok((arrays::from_pose(py, &found.target_from_source)?, found.scale))
}

/// The result of ICP. Unpacks into target_from_source (4, 4) and rms.
#[pyclass(name = "IcpResult", module = "sixfold", frozen)]
pub(crate) struct IcpResult {
    /// The pose that maps the source onto the target, (4, 4) float64.
    #[pyo3(get)]
    target_from_source: Py<PyArray2<f64>>,
    /// Root mean square of the point-to-plane distances in the last iteration, metres.
    #[pyo3(get)]
    rms: f64,
    /// Number of pairs in the last iteration.
    #[pyo3(get)]
    inliers: usize,
    /// Number of iterations over all levels.
    #[pyo3(get)]
    iterations: usize,
    /// Whether the last level ended because its steps became small.
    #[pyo3(get)]
    converged: bool,
}

#[pymethods]
impl IcpResult {
    fn __iter__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyIterator>> {
        (&self.target_from_source, self.rms).into_pyobject(py)?.try_iter()
    }

    fn __len__(&self) -> usize {
        2
    }

    fn __repr__(&self) -> String {
        format!(
            "<IcpResult: {} pairs, {:.3} mm, {} iterations{}>",
            self.inliers,
            1000.0 * self.rms,
            self.iterations,
            if self.converged { ", converged" } else { "" }
        )
    }
}

fn icp_error(error: IcpError) -> PyErr {
    match &error {
        IcpError::TooFewCorrespondences { .. } | IcpError::Degenerate => {
            NoSolutionError::new_err(error.to_string())
        }
        IcpError::NoNormals { .. } => PyValueError::new_err(format!("target_normals: {error}")),
        _ => PyValueError::new_err(error.to_string()),
    }
}

fn icp_result(py: Python<'_>, report: Result<IcpReport, IcpError>) -> PyResult<IcpResult> {
    let r = report.map_err(icp_error)?;
    Ok(IcpResult {
        target_from_source: arrays::from_pose(py, &r.target_from_source)?.unbind(),
        rms: r.rms,
        inliers: r.inliers,
        iterations: r.iterations,
        converged: r.converged,
    })
}

/// The options of ICP, with levels from a rejection distance or from `[(metres, iterations, stride), ...]`.
fn icp_options(
    rejection_distance: f64,
    levels: Option<&Bound<'_, PyAny>>,
    max_angle: f64,
) -> PyResult<IcpOptions> {
    let rejection_distance = positive("rejection_distance", rejection_distance)?;
    let mut options = IcpOptions::coarse_to_fine(rejection_distance);
    if let Some(levels) = levels {
        let expected = "a list of (rejection distance in metres, iterations, stride)";
        options.levels.clear();
        for level in levels.try_iter().map_err(|_| bad("levels", expected, levels.get_type().to_string()))? {
            let (distance, iterations, stride) = level?
                .extract::<(f64, i64, i64)>()
                .map_err(|error| bad("levels", expected, error.value(levels.py()).to_string()))?;
            options.levels.push(IcpLevel {
                rejection_distance: positive("levels", distance)?,
                iterations: whole("levels", iterations, 0)?,
                stride: whole("levels", stride, 1)?,
            });
        }
    }
    options.max_angle = max_angle;
    options.check().map_err(|error| PyValueError::new_err(error.to_string()))?;
    Ok(options)
}

fn cloud(
    points: (&'static str, &Bound<'_, PyAny>),
    normals: Option<(&'static str, &Bound<'_, PyAny>)>,
) -> PyResult<PointCloud> {
    let list = arrays::points3(points.0, points.1)?;
    if list.is_empty() {
        return Err(bad(points.0, "at least one point", "none"));
    }
    let normals = match normals {
        None => Vec::new(),
        Some((argument, object)) => {
            let normals = arrays::points3(argument, object)?;
            if normals.len() != list.len() {
                return Err(bad(
                    argument,
                    format!("{} normals, one per point", list.len()),
                    normals.len().to_string(),
                ));
            }
            normals
                .iter()
                .map(|n| n.try_normalize(1e-12).unwrap_or_else(sixfold::geometry::Vec3::zeros))
                .collect()
        }
    };
    Ok(PointCloud { points: list, normals })
}

/// Aligns points with a target cloud by coarse-to-fine point-to-plane ICP (Chen and Medioni 1992) with Tukey's weights.
///
/// source: (N, 3), metres. target: (M, 3), metres; target_normals: (M, 3). initial: the start, target_from_source (4, 4),
/// the identity by default; its error must be below about the rejection distance. rejection_distance: pairs further apart than
/// this are left out, metres; half of it on the second level, a quarter on the third. levels: [(metres, iterations, stride), ...]
/// instead of this schedule, where only every stride-th source point is used. source_normals: (N, 3); if given, the normals of a
/// pair must agree within max_angle radians. Ctrl-C interrupts it.
///
/// Raises ValueError for arrays of different lengths or numbers that are not finite; NoSolutionError when too few points have a
/// correspondence, or when the surface does not determine the pose (the object can slide on it).
///
/// >>> import numpy as np
/// >>> normals = np.random.default_rng(0).normal(size=(2000, 3))
/// >>> normals /= np.linalg.norm(normals, axis=1, keepdims=True)
/// >>> shape = normals * [0.05, 0.04, 0.03]
/// >>> n = normals / [0.05, 0.04, 0.03]
/// >>> moved = icp(shape + [0.002, 0, 0], shape, n, rejection_distance=0.01)
/// >>> moved.target_from_source[:3, 3].round(4) + 0
/// array([-0.002,  0.   ,  0.   ])
#[pyfunction]
#[pyo3(signature = (source, target, target_normals, initial=None, *, rejection_distance=0.02, source_normals=None, levels=None, max_angle=1.0471975511965976))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn icp(
    py: Python<'_>,
    source: &Bound<'_, PyAny>,
    target: &Bound<'_, PyAny>,
    target_normals: &Bound<'_, PyAny>,
    initial: Option<&Bound<'_, PyAny>>,
    rejection_distance: f64,
    source_normals: Option<&Bound<'_, PyAny>>,
    levels: Option<&Bound<'_, PyAny>>,
    max_angle: f64,
) -> PyResult<IcpResult> {
    let source = cloud(("source", source), source_normals.map(|n| ("source_normals", n)))?;
    let target = cloud(("target", target), Some(("target_normals", target_normals)))?;
    let initial = initial.map_or(Ok(Pose::identity()), |i| arrays::pose("initial", i))?;
    let options = icp_options(rejection_distance, levels, max_angle)?;
    let report = interruptible(py, move |_| {
        let target = IndexedCloud::new(target)?;
        sixfold::geometry::icp(&source, &target, &initial, &options)
    })?;
    icp_result(py, report)
}

/// Aligns points with a depth image (H, W) in metres, as icp does with a cloud. A point corresponds to the surface at its pixel
/// (Blais and Levine 1995). The source is in the object's frame; target_from_source of the result is camera_from_object.
///
/// Raises ValueError when depth and camera differ in size or the camera has distortion; NoSolutionError as icp.
///
/// >>> seen = render(mesh, start, camera)  # doctest: +SKIP
/// >>> icp_to_depth(seen.coordinates[seen.mask], depth, camera, start).target_from_source  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (source, depth, camera, initial, *, rejection_distance=0.02, source_normals=None, levels=None, max_angle=1.0471975511965976))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn icp_to_depth(
    py: Python<'_>,
    source: &Bound<'_, PyAny>,
    depth: &Bound<'_, PyAny>,
    camera: PyCamera,
    initial: &Bound<'_, PyAny>,
    rejection_distance: f64,
    source_normals: Option<&Bound<'_, PyAny>>,
    levels: Option<&Bound<'_, PyAny>>,
    max_angle: f64,
) -> PyResult<IcpResult> {
    let source = cloud(("source", source), source_normals.map(|n| ("source_normals", n)))?;
    let depth = arrays::depth("depth", depth)?;
    let camera = camera.of_image("depth", depth.size())?;
    let initial = arrays::pose("initial", initial)?;
    let options = icp_options(rejection_distance, levels, max_angle)?;
    let report = interruptible(py, move |_| {
        let normals = sixfold::geometry::normals_from_depth(&depth, &camera, &NormalOptions::default());
        let target = DepthTarget { depth: &depth, normals: &normals, camera: &camera };
        sixfold::geometry::icp(&source, &target, &initial, &options)
    })?;
    icp_result(py, report)
}
