//! Poses from depth images without training: point pair features (`estimate_ppf`).

use std::path::PathBuf;
use std::sync::Arc;

use numpy::PyArray2;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sixfold::align::{DepthOptions, DepthRegion, PreparedDepthError, VerificationScore, verification_mesh};
use sixfold::mesh::Mesh;
use sixfold::ppf::{ModelOptions, ObjectModel, PpfOptions};

use crate::arrays::{self, about, bad, positive, seed, whole};
use crate::camera::PyCamera;
use crate::guard::interruptible;
use crate::mesh::PyMesh;
use crate::scene::PyPlane;

/// Step at which continuous symmetries are discretised in a description, as a fraction of the diameter. The command line uses
/// the same value.
const SYMMETRY_STEP: f64 = 0.05;

/// An object prepared for matching in depth images by point pair features (Drost et al. 2010). Create it once per mesh and use
/// it for any number of images.
///
/// sampling_step: distance between samples as a fraction of the diameter.
/// angle_steps: number of steps of each angle from 0 to 180 degrees.
/// cache: a file. The description is read from it if it fits the mesh and options; otherwise it is computed and written there.
///
/// The symmetries are those of the mesh. Ctrl-C interrupts it.
///
/// Raises ValueError for a mesh without faces and options out of range.
///
/// >>> model = PpfModel(Mesh.load("data/demo/models/obj_000008.ply", "mm"))  # doctest: +SKIP
#[pyclass(name = "PpfModel", module = "sixfold", frozen)]
pub(crate) struct PpfModel {
    pub(crate) model: Arc<ObjectModel>,
    /// Why the description in `cache` was not used or could not be written; None otherwise.
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

    /// The surface samples from which the features are computed, (N, 3) in the object's frame, metres.
    #[getter]
    fn samples<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::from_points3(py, &self.model.samples().points)
    }

    /// Number of point pairs in the feature table.
    #[getter]
    fn pair_count(&self) -> usize {
        self.model.pair_count()
    }

    fn __repr__(&self) -> String {
        format!("<PpfModel: {:.1} mm, {} pairs>", 1000.0 * self.model.diameter(), self.model.pair_count())
    }
}

/// The error for a depth image or a mask that cannot be searched.
pub(crate) fn depth_error(error: PreparedDepthError) -> PyErr {
    match &error {
        PreparedDepthError::MaskSize { .. } => about("mask")(error),
        _ => about("depth")(error),
    }
}

/// A depth image prepared for estimate_ppf: in-painting, normals, table plane, downsampled points. Prepare it once and search it
/// for any number of objects.
///
/// depth: (H, W), metres.
/// mask: where objects may be, (H, W) bool.
/// remove_plane: leave out the points of the dominant plane.
/// max_depth: points further away are left out, metres.
/// seed: seed of the search for the plane.
///
/// Ctrl-C interrupts it.
///
/// Raises ValueError for images of different sizes, and depth in the wrong unit or without any value.
///
/// >>> scene = PpfScene(depth, camera)  # doctest: +SKIP
#[pyclass(name = "PpfScene", module = "sixfold", frozen)]
pub(crate) struct PpfScene(pub(crate) Arc<DepthRegion>);

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
        let options = DepthOptions { remove_plane, max_depth, seed, ..DepthOptions::default() };
        let scene =
            interruptible(py, move |_| DepthRegion::from_depth(&depth, &camera, mask.as_ref(), &options))?;
        let scene = scene.map_err(depth_error)?;
        Ok(PpfScene(Arc::new(scene)))
    }

    /// The table plane, its normal towards the camera, or None.
    #[getter]
    fn plane(&self) -> Option<PyPlane> {
        self.0.plane().map(|p| PyPlane(*p))
    }

    /// The points that are matched, (N, 3) in the camera frame, metres: inside the mask and not on the plane.
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
    /// The score by which estimates are ranked, 0 to 1.
    #[pyo3(get)]
    confidence: f64,
    /// Votes of the hypothesis from which the pose was refined.
    #[pyo3(get)]
    votes: f32,
    /// The scores of the verification by rendering (dissertation, section 5.2.5). Numbers of pixels: rendered, inliers,
    /// occluded, outliers. From 0 to 1: depth, boundary, normals, total, visible_fraction.
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

/// Searches for an object in a depth image by point pair features with verification by rendering, without training (Drost et al.
/// 2010; Hinterstoisser et al. 2016; Vidal et al. 2018).
///
/// Returns a list of PpfEstimate, best first; empty if no confidence reaches min_score.
///
/// scene: a PpfScene, or depth (H, W) in metres with `camera` (and `mask` (H, W) bool).
/// model: a PpfModel, or a Mesh, from which a PpfModel is made first.
/// instances: maximum number of poses returned.
/// min_score: poses with a lower confidence are left out, 0 to 1.
/// refined: number of hypotheses that get a short ICP.
/// verified: number of hypotheses that get a full ICP and are verified by rendering.
/// seed: seed of the search for the plane.
///
/// The same input gives the same result at any number of threads. Ctrl-C interrupts it.
///
/// Raises ValueError for images of different sizes, a mesh without faces, and depth in the wrong unit or without any value.
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
        PpfOptions { max_instances: whole("instances", instances, 1)?, ..PpfOptions::default() };
    if !(0.0..=1.0).contains(&min_score) {
        return Err(bad("min_score", "a number from 0 to 1", min_score.to_string()));
    }
    options.min_score = min_score;
    options.verified = verified.map_or(Ok(options.verified), |v| whole("verified", v, 1))?;
    options.refined = refined.map_or(Ok(options.refined), |r| whole("refined", r, 1))?;
    let scene = scene_of(py, scene, camera, mask, seed)?;
    let model = model_of(py, "model", model)?;
    let found = interruptible(py, move |_| sixfold::ppf::estimate(&scene, &model, &options))?;
    found
        .into_iter()
        .map(|e| {
            Ok(PpfEstimate {
                camera_from_object: arrays::from_pose(py, &e.camera_from_object)?.unbind(),
                confidence: e.confidence,
                votes: e.votes,
                verification: verification_to_python(py, &e.score)?,
            })
        })
        .collect()
}

/// A PpfScene as it is, or a depth image prepared as one.
pub(crate) fn scene_of(
    py: Python<'_>,
    scene: &Bound<'_, PyAny>,
    camera: Option<PyCamera>,
    mask: Option<&Bound<'_, PyAny>>,
    seed: i64,
) -> PyResult<Arc<DepthRegion>> {
    match scene.cast::<PpfScene>() {
        Ok(scene) => {
            if camera.is_some() || mask.is_some() {
                return Err(bad("camera", "none with a PpfScene, which has its own", "camera or mask"));
            }
            Ok(scene.get().0.clone())
        }
        Err(_) => {
            let camera = camera.ok_or_else(|| bad("camera", "the camera of the depth image", "None"))?;
            Ok(PpfScene::new(py, scene, camera, mask, true, 5.0, seed)?.0)
        }
    }
}

/// A PpfModel as it is, or a Mesh described as one.
fn model_of(py: Python<'_>, argument: &str, model: &Bound<'_, PyAny>) -> PyResult<Arc<ObjectModel>> {
    match model.extract::<ModelOrMesh<'_>>() {
        Ok(ModelOrMesh::Model(model)) => Ok(model.get().model.clone()),
        Ok(ModelOrMesh::Mesh(mesh)) => Ok(describe(py, mesh.get(), ModelOptions::default(), None)?.model),
        Err(_) => Err(bad(argument, "a PpfModel or a Mesh", model.get_type().to_string())),
    }
}

/// The mesh that verification renders, of a Mesh or a PpfModel.
pub(crate) fn rendered_of(py: Python<'_>, argument: &'static str, mesh: &Bound<'_, PyAny>) -> PyResult<Mesh> {
    match mesh.extract::<ModelOrMesh<'_>>() {
        Ok(ModelOrMesh::Model(model)) => Ok(model.get().model.mesh().clone()),
        Ok(ModelOrMesh::Mesh(mesh)) => {
            let mesh = mesh.get().mesh.clone();
            if mesh.faces().is_empty() {
                return Err(bad(argument, "a mesh with faces", "points without faces"));
            }
            interruptible(py, move |_| verification_mesh(&mesh))?.map_err(about(argument))
        }
        Err(_) => Err(bad(argument, "a PpfModel or a Mesh", mesh.get_type().to_string())),
    }
}

/// The scores of the verification as a dict.
pub(crate) fn verification_to_python(py: Python<'_>, s: &VerificationScore) -> PyResult<Py<PyDict>> {
    let verification = PyDict::new(py);
    for (name, value) in
        [("rendered", s.rendered), ("inliers", s.inliers), ("occluded", s.occluded), ("outliers", s.outliers)]
    {
        verification.set_item(name, value)?;
    }
    for (name, value) in [
        ("depth", s.depth),
        ("boundary", s.boundary),
        ("normals", s.normals),
        ("total", s.total),
        ("visible_fraction", s.visible_fraction()),
    ] {
        verification.set_item(name, value)?;
    }
    Ok(verification.unbind())
}
