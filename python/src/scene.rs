//! Depth images: points, normals, planes, and poses from point pair features (`estimate_ppf`).

use std::path::PathBuf;
use std::sync::Arc;

use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sixfold_geometry::{NormalOptions, Plane, PlaneOptions, PointCloud, Vec3};
use sixfold_match::{EstimateOptions, ModelOptions, ObjectModel, Scene, SceneError, SceneOptions};

use crate::arrays::{self, about, bad, positive, seed, whole};
use crate::camera::PyCamera;
use crate::guard::{free, interruptible};
use crate::mesh::PyMesh;

/// Step of discretised symmetry axes in a description, as a share of the diameter: as the command line does.
const SYMMETRY_STEP: f64 = 0.05;

/// Unit normals (H, W, 3) float32 in the camera frame, turned to the camera, from depth (H, W) in metres; 0 where depth is
/// missing (Hinterstoisser et al. 2012, section 3.3).
///
/// radius: half width of the window in pixels; max_relative_step: a neighbour counts when its depth differs by less than
/// this share.
///
/// Raises ValueError when depth and camera differ in size.
///
/// >>> import numpy as np
/// >>> normals_from_depth(np.ones((480, 640), np.float32), Camera(500, 500, 320, 240, 640, 480))[240, 320].round(6)
/// array([ 0.,  0., -1.], dtype=float32)
#[pyfunction]
#[pyo3(signature = (depth, camera, *, radius=None, max_relative_step=None))]
pub(crate) fn normals_from_depth<'py>(
    py: Python<'py>,
    depth: &Bound<'py, PyAny>,
    camera: PyCamera,
    radius: Option<i64>,
    max_relative_step: Option<f64>,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    let depth = arrays::depth("depth", depth)?;
    let camera = camera.of_image("depth", depth.size())?;
    let mut options = NormalOptions::default();
    if let Some(radius) = radius {
        options.radius = whole("radius", radius, 1)?.min(64);
    }
    if let Some(step) = max_relative_step {
        options.max_relative_step = positive("max_relative_step", step)?;
    }
    let normals = free(py, || sixfold_geometry::normals_from_depth(&depth, &camera, &options))?;
    arrays::from_image_of(py, normals)
}

/// Depth (H, W) with holes filled from their borders, up to 2 * rounds pixels wide.
///
/// >>> import numpy as np
/// >>> inpaint_depth(np.array([[1, 0, 1]], np.float32), 1)
/// array([[1., 1., 1.]], dtype=float32)
#[pyfunction]
#[pyo3(signature = (depth, rounds=2))]
pub(crate) fn inpaint_depth<'py>(
    py: Python<'py>,
    depth: &Bound<'py, PyAny>,
    rounds: i64,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let (depth, rounds) = (arrays::depth("depth", depth)?, whole("rounds", rounds, 0)?);
    // More rounds than the image has pixels along a side change nothing.
    let rounds = rounds.min(depth.width().max(depth.height()));
    arrays::from_image(py, free(py, || sixfold_geometry::inpaint_depth(&depth, rounds))?)
}

/// The points (N, 3) float64 in the camera frame of a depth image (H, W) in metres, one a valid pixel, and their normals
/// (N, 3); pixels without a normal are left out.
///
/// Raises ValueError when depth and camera differ in size.
///
/// >>> import numpy as np
/// >>> points, normals = point_cloud(np.ones((48, 64), np.float32), Camera(50, 50, 32, 24, 64, 48))
/// >>> points.shape[1], float(points[:, 2].mean())
/// (3, 1.0)
#[pyfunction]
#[allow(clippy::type_complexity)]
pub(crate) fn point_cloud<'py>(
    py: Python<'py>,
    depth: &Bound<'py, PyAny>,
    camera: PyCamera,
) -> PyResult<(Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<f64>>)> {
    let depth = arrays::depth("depth", depth)?;
    let camera = camera.of_image("depth", depth.size())?;
    let cloud = free(py, || {
        let normals = sixfold_geometry::normals_from_depth(&depth, &camera, &NormalOptions::default());
        PointCloud::from_depth(&depth, Some(&normals), &camera)
    })?;
    Ok((arrays::from_points3(py, &cloud.points)?, arrays::from_points3(py, &cloud.normals)?))
}

/// One point a voxel of edge `size` metres and a group of similar normals in it (Vidal et al. 2018, section 3.1): points
/// (N, 3), normals (N, 3) or None; returns the same.
///
/// >>> import numpy as np
/// >>> points, normals = voxel_downsample(np.zeros((10, 3)), 0.01)
/// >>> len(points), normals
/// (1, None)
#[pyfunction]
#[pyo3(signature = (points, size, normals=None, *, max_angle=1.0))]
#[allow(clippy::type_complexity)]
pub(crate) fn voxel_downsample<'py>(
    py: Python<'py>,
    points: &Bound<'py, PyAny>,
    size: f64,
    normals: Option<&Bound<'py, PyAny>>,
    max_angle: f64,
) -> PyResult<(Bound<'py, PyArray2<f64>>, Option<Bound<'py, PyArray2<f64>>>)> {
    let points = arrays::points3("points", points)?;
    let (size, max_angle) = (positive("size", size)?, positive("max_angle", max_angle)?);
    let normals = normals.map(|n| arrays::points3("normals", n)).transpose()?;
    if let Some(n) = &normals
        && n.len() != points.len()
    {
        return Err(bad("normals", format!("{} normals, one a point", points.len()), n.len().to_string()));
    }
    let with_normals = normals.is_some();
    let cloud = PointCloud { points, normals: normals.unwrap_or_default() };
    let thin = free(py, || cloud.voxel_downsample(size, max_angle))?;
    let normals = with_normals.then(|| arrays::from_points3(py, &thin.normals)).transpose()?;
    Ok((arrays::from_points3(py, &thin.points)?, normals))
}

/// A plane: the points p with normal . p = offset, metres.
#[pyclass(name = "Plane", module = "sixfold", frozen)]
pub(crate) struct PyPlane(pub(crate) Plane);

#[pymethods]
impl PyPlane {
    /// Unit normal, (3,) float64.
    #[getter]
    fn normal<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        arrays::from_vector3(py, &self.0.normal)
    }

    /// Signed distance of the plane from the origin along the normal, metres.
    #[getter]
    fn offset(&self) -> f64 {
        self.0.offset
    }

    /// Signed distances (N,) of points (N, 3), positive on the side the normal points to; metres.
    fn distance<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let points = arrays::points3("points", points)?;
        Ok(PyArray1::from_vec(py, points.iter().map(|p| self.0.distance(p)).collect()))
    }

    fn __repr__(&self) -> String {
        let n = &self.0.normal;
        format!("<Plane: normal ({:.4}, {:.4}, {:.4}), offset {:.4} m>", n.x, n.y, n.z, self.0.offset)
    }
}

/// The plane that holds most of the points (N, 3), found by RANSAC (Fischler and Bolles 1981), normal to the origin; None
/// when none holds `min_share` of them. threshold in metres; with normals (N, 3) these must agree within 30 degrees.
///
/// >>> import numpy as np
/// >>> grid = np.stack(np.meshgrid(np.linspace(-1, 1, 20), np.linspace(-1, 1, 20), [1.0]), -1).reshape(-1, 3)
/// >>> dominant_plane(grid).normal.round(6) + 0
/// array([ 0.,  0., -1.])
#[pyfunction]
#[pyo3(signature = (points, normals=None, *, threshold=0.01, iterations=300, min_share=0.15, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn dominant_plane(
    py: Python<'_>,
    points: &Bound<'_, PyAny>,
    normals: Option<&Bound<'_, PyAny>>,
    threshold: f64,
    iterations: i64,
    min_share: f64,
    seed: i64,
) -> PyResult<Option<PyPlane>> {
    let points = arrays::points3("points", points)?;
    let normals = normals.map(|n| arrays::points3("normals", n)).transpose()?.unwrap_or_default();
    if !normals.is_empty() && normals.len() != points.len() {
        return Err(bad(
            "normals",
            format!("{} normals, one a point", points.len()),
            normals.len().to_string(),
        ));
    }
    let options = PlaneOptions {
        threshold: positive("threshold", threshold)?,
        iterations: whole("iterations", iterations, 1)?,
        min_share,
        ..PlaneOptions::default()
    };
    let (cloud, seed) = (PointCloud { points, normals }, self::seed(seed)?);
    let plane = interruptible(py, move |_| sixfold_geometry::dominant_plane(&cloud, &options, seed))?;
    Ok(plane.map(PyPlane))
}

/// The least-squares plane through points (N, 3). Raises ValueError for fewer than three or points on one line.
#[pyfunction]
pub(crate) fn fit_plane(py: Python<'_>, points: &Bound<'_, PyAny>) -> PyResult<PyPlane> {
    let points = arrays::points3("points", points)?;
    let plane = free(py, || sixfold_geometry::fit_plane(&points))?;
    let found = format!("{} points that do not fix a plane", points.len());
    plane.map(PyPlane).ok_or_else(|| bad("points", "at least three points that are not on one line", found))
}

/// An object ready to be matched in depth images by point pair features (Drost et al. 2010). Made once a mesh, used for
/// any number of images.
///
/// sampling_step: distance between samples as a share of the diameter; angle_steps: steps of each angle over half a turn.
/// With `cache`, a file, the description is read from there when it fits mesh and options, and written there otherwise.
/// Symmetries are those of the mesh.
///
/// Raises ValueError for a mesh without faces or options out of range. Ctrl-C is heard.
///
/// >>> model = PpfModel(Mesh.load("data/demo/models/obj_000008.ply", "mm"))  # doctest: +SKIP
#[pyclass(name = "PpfModel", module = "sixfold", frozen)]
pub(crate) struct PpfModel {
    model: Arc<ObjectModel>,
    /// Why a description in `cache` was not taken, or could not be written; None otherwise.
    #[pyo3(get)]
    cache_note: Option<String>,
}

fn describe(
    py: Python<'_>,
    mesh: &PyMesh,
    options: ModelOptions,
    cache: Option<PathBuf>,
) -> PyResult<PpfModel> {
    options.check().map_err(|error| PyValueError::new_err(error.to_string()))?;
    let (surface, symmetries) = (mesh.mesh.clone(), mesh.symmetry_poses(SYMMETRY_STEP));
    let (model, note) = interruptible(py, move |_| match cache {
        Some(path) => ObjectModel::cached(&path, &surface, &symmetries, &options),
        None => ObjectModel::new(&surface, &symmetries, &options).map(|model| (model, None)),
    })?
    .map_err(about("mesh"))?;
    Ok(PpfModel { model: Arc::new(model), cache_note: note.map(|n| n.to_string()) })
}

#[pymethods]
impl PpfModel {
    #[new]
    #[pyo3(signature = (mesh, *, sampling_step=0.05, angle_steps=15, cache=None))]
    fn new(
        py: Python<'_>,
        mesh: &Bound<'_, PyMesh>,
        sampling_step: f64,
        angle_steps: i64,
        cache: Option<PathBuf>,
    ) -> PyResult<Self> {
        let options = ModelOptions { sampling_step, angle_steps: whole("angle_steps", angle_steps, 1)? };
        describe(py, mesh.get(), options, cache)
    }

    /// Largest distance between two points of the object, metres.
    #[getter]
    fn diameter(&self) -> f64 {
        self.model.diameter()
    }

    /// The surface samples the features are made of, (N, 3) in the object's frame, metres.
    #[getter]
    fn samples<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::from_points3(py, &self.model.samples().points)
    }

    /// Point pairs in the feature table.
    #[getter]
    fn pair_count(&self) -> usize {
        self.model.pair_count()
    }

    fn __repr__(&self) -> String {
        format!("<PpfModel: {:.1} mm, {} pairs>", 1000.0 * self.model.diameter(), self.model.pair_count())
    }
}

/// A depth image prepared for estimate_ppf: in-painting, normals, table plane, thinned points. Prepare once, search any
/// number of objects.
///
/// depth (H, W) metres; mask (H, W) bool says where objects may be; remove_plane leaves the dominant plane out;
/// max_depth in metres.
///
/// Raises ValueError for images of different sizes, a depth in the wrong unit or without any value. Ctrl-C is heard.
///
/// >>> scene = PpfScene(depth, camera)  # doctest: +SKIP
#[pyclass(name = "PpfScene", module = "sixfold", frozen)]
pub(crate) struct PpfScene(Arc<Scene>);

#[pymethods]
impl PpfScene {
    #[new]
    #[pyo3(signature = (depth, camera, mask=None, *, remove_plane=true, max_depth=5.0, seed=0))]
    fn new(
        py: Python<'_>,
        depth: &Bound<'_, PyAny>,
        camera: PyCamera,
        mask: Option<&Bound<'_, PyAny>>,
        remove_plane: bool,
        max_depth: f64,
        seed: i64,
    ) -> PyResult<Self> {
        let depth = arrays::depth("depth", depth)?;
        let camera = camera.of_image("depth", depth.size())?;
        let mask = mask.map(|m| arrays::mask("mask", m)).transpose()?;
        let (max_depth, seed) = (positive("max_depth", max_depth)?, self::seed(seed)?);
        let options = SceneOptions { remove_plane, max_depth, seed, ..SceneOptions::default() };
        let scene = interruptible(py, move |_| Scene::new(&depth, &camera, mask.as_ref(), &options))?;
        let scene = scene.map_err(|error| match &error {
            SceneError::MaskSize { .. } => about("mask")(error),
            _ => about("depth")(error),
        })?;
        Ok(PpfScene(Arc::new(scene)))
    }

    /// The table plane, normal to the camera, or None.
    #[getter]
    fn plane(&self) -> Option<PyPlane> {
        self.0.plane().map(|p| PyPlane(*p))
    }

    /// The points that are matched, (N, 3) in the camera frame, metres: off the plane and inside the mask.
    #[getter]
    fn points<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::from_points3(py, &self.0.cloud().points)
    }
}

/// A pose found in a depth image.
#[pyclass(name = "PpfEstimate", module = "sixfold", frozen)]
pub(crate) struct PpfEstimate {
    /// The pose, (4, 4) float64, metres.
    #[pyo3(get)]
    camera_from_object: Py<PyArray2<f64>>,
    /// What decides between estimates, 0 to 1.
    #[pyo3(get)]
    confidence: f64,
    /// Votes of the hypothesis it came from.
    #[pyo3(get)]
    votes: f32,
    /// The verification by rendering (dissertation, section 5.2.5): rendered, inliers, occluded, outliers (pixels), depth,
    /// boundary, normals, total (0 to 1), visible_share.
    #[pyo3(get)]
    verification: Py<PyDict>,
}

#[pymethods]
impl PpfEstimate {
    fn __repr__(&self) -> String {
        format!("<PpfEstimate: confidence {:.3}>", self.confidence)
    }
}

#[derive(FromPyObject)]
enum ModelOrMesh<'py> {
    Model(Bound<'py, PpfModel>),
    Mesh(Bound<'py, PyMesh>),
}

/// Finds an object in a depth image by point pair features, verified by rendering; no training (Drost et al. 2010;
/// Hinterstoisser et al. 2016; Vidal et al. 2018). A list of PpfEstimate, best first, empty when nothing scores min_score.
///
/// scene: a PpfScene, or depth (H, W) in metres with `camera` (and `mask` (H, W) bool). model: a PpfModel or a Mesh,
/// which is described first. instances: most poses returned; refined and verified: hypotheses that get a short ICP and
/// the full check. The same input gives the same result at any number of threads. Ctrl-C is heard.
///
/// Raises ValueError for images of different sizes, a mesh without faces, a depth in the wrong unit or without any value.
///
/// >>> found = estimate_ppf(depth, mesh, camera)  # doctest: +SKIP
/// >>> found[0].camera_from_object  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (scene, model, camera=None, mask=None, *, instances=1, min_score=0.05, refined=None, verified=None, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn estimate_ppf(
    py: Python<'_>,
    scene: &Bound<'_, PyAny>,
    model: &Bound<'_, PyAny>,
    camera: Option<PyCamera>,
    mask: Option<&Bound<'_, PyAny>>,
    instances: i64,
    min_score: f64,
    refined: Option<i64>,
    verified: Option<i64>,
    seed: i64,
) -> PyResult<Vec<PpfEstimate>> {
    let mut options =
        EstimateOptions { max_instances: whole("instances", instances, 1)?, ..EstimateOptions::default() };
    if !(0.0..=1.0).contains(&min_score) {
        return Err(bad("min_score", "a number from 0 to 1", min_score.to_string()));
    }
    options.min_score = min_score;
    options.verified = verified.map_or(Ok(options.verified), |v| whole("verified", v, 1))?;
    options.refined = refined.map_or(Ok(options.refined), |r| whole("refined", r, 1))?;
    let scene = match scene.cast::<PpfScene>() {
        Ok(scene) => {
            if camera.is_some() || mask.is_some() {
                return Err(bad("camera", "none beside a PpfScene, which has its own", "camera or mask"));
            }
            scene.get().0.clone()
        }
        Err(_) => {
            let camera = camera.ok_or_else(|| bad("camera", "the camera of the depth image", "None"))?;
            PpfScene::new(py, scene, camera, mask, true, 5.0, seed)?.0
        }
    };
    let model = match model.extract::<ModelOrMesh<'_>>() {
        Ok(ModelOrMesh::Model(model)) => model.get().model.clone(),
        Ok(ModelOrMesh::Mesh(mesh)) => describe(py, mesh.get(), ModelOptions::default(), None)?.model,
        Err(_) => return Err(bad("model", "a PpfModel or a Mesh", model.get_type().to_string())),
    };
    let found = interruptible(py, move |_| sixfold_match::estimate(&scene, &model, &options))?;
    found
        .into_iter()
        .map(|e| {
            let verification = PyDict::new(py);
            let s = e.score;
            for (name, value) in [
                ("rendered", s.rendered),
                ("inliers", s.inliers),
                ("occluded", s.occluded),
                ("outliers", s.outliers),
            ] {
                verification.set_item(name, value)?;
            }
            for (name, value) in [
                ("depth", s.depth),
                ("boundary", s.boundary),
                ("normals", s.normals),
                ("total", s.total),
                ("visible_share", s.visible_share()),
            ] {
                verification.set_item(name, value)?;
            }
            Ok(PpfEstimate {
                camera_from_object: arrays::from_pose(py, &e.camera_from_object)?.unbind(),
                confidence: e.confidence,
                votes: e.votes,
                verification: verification.unbind(),
            })
        })
        .collect()
}

/// `count` evenly spread unit directions (N, 3): a Fibonacci sphere (Gonzalez 2010).
///
/// >>> sphere_directions(100).shape
/// (100, 3)
#[pyfunction]
pub(crate) fn sphere_directions<'py>(py: Python<'py>, count: i64) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let count = whole("count", count, 0)?;
    if count > 1 << 26 {
        return Err(bad("count", "at most 67108864", count.to_string()));
    }
    let directions: Vec<Vec3> = free(py, || sixfold_geometry::sphere_directions(count))?;
    arrays::from_points3(py, &directions)
}
