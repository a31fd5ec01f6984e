//! `sixfold.bop`: datasets, result files and single images in the BOP format. Files are in millimetres; everything here is in
//! metres unless its name contains `mm`.

use std::path::PathBuf;
use std::sync::Arc;

use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use sixfold::bop::{BopDataset, Estimate, MaskKind, Models, Placement, Scene};
use sixfold::geometry::Pose;

use crate::arrays::{self, about, bad, id, positive, whole};
use crate::camera::PyCamera;
use crate::guard::{dataset_error, free, image_error, results_error};
use crate::mesh::PyMesh;

/// Converts a serialisable value to Python's dicts, lists and numbers.
pub(crate) fn json_to_python<'py>(
    py: Python<'py>,
    value: &impl serde::Serialize,
) -> PyResult<Bound<'py, PyAny>> {
    let text = serde_json::to_string(value).map_err(|error| PyValueError::new_err(error.to_string()))?;
    py.import("json")?.call_method1("loads", (text,))
}

/// An estimated pose of an object in an image: a row of a result file.
///
/// camera_from_object: (4, 4), metres. score: the confidence; higher is more confident. time: seconds for the whole image, or
/// None if not measured.
///
/// Raises ValueError for an id below 0, a score that is not finite, a negative time, or an invalid pose.
///
/// >>> import numpy as np
/// >>> from sixfold import bop
/// >>> bop.Estimate(2, 3, 8, 0.9, np.eye(4)).obj_id
/// 8
#[pyclass(name = "Estimate", module = "sixfold.bop", frozen, from_py_object)]
#[derive(Clone)]
pub(crate) struct PyEstimate(pub(crate) Estimate);

#[pymethods]
impl PyEstimate {
    #[new]
    #[pyo3(signature = (scene_id, im_id, obj_id, score, camera_from_object, time=None))]
    fn new(
        scene_id: i64,
        im_id: i64,
        obj_id: i64,
        score: f64,
        camera_from_object: &Bound<'_, PyAny>,
        time: Option<f64>,
    ) -> PyResult<Self> {
        if !score.is_finite() {
            return Err(bad("score", "a finite number", score.to_string()));
        }
        if let Some(t) = time
            && !(t.is_finite() && t >= 0.0)
        {
            return Err(bad("time", "seconds from 0, or None", t.to_string()));
        }
        let pose = arrays::pose("camera_from_object", camera_from_object)?;
        let placement = arrays::placement("camera_from_object", camera_from_object)?;
        let mut estimate =
            Estimate::new(id("scene_id", scene_id)?, id("im_id", im_id)?, id("obj_id", obj_id)?, score, pose);
        estimate.time = time;
        estimate.rotation_as_written = Some(placement.rotation);
        Ok(PyEstimate(estimate))
    }

    /// The scene's id.
    #[getter]
    fn scene_id(&self) -> u32 {
        self.0.scene_id
    }

    /// The image's id in its scene.
    #[getter]
    fn im_id(&self) -> u32 {
        self.0.im_id
    }

    /// The object's id.
    #[getter]
    fn obj_id(&self) -> u32 {
        self.0.obj_id
    }

    /// The confidence; higher is more confident.
    #[getter]
    fn score(&self) -> f64 {
        self.0.score
    }

    /// Seconds for the whole image, or None if not measured.
    #[getter]
    fn time(&self) -> Option<f64> {
        self.0.time
    }

    /// The pose, (4, 4) float64, metres; its rotation is the exact one nearest to the rotation as written.
    #[getter]
    fn camera_from_object<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::from_pose(py, &self.0.camera_from_object)
    }

    /// The pose with the rotation as written, (4, 4) float64, metres. Scores are computed with it.
    #[getter]
    fn camera_from_object_as_written<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::from_placement(py, &self.0.placement())
    }

    fn __repr__(&self) -> String {
        let e = &self.0;
        format!("<Estimate: scene {}, image {}, object {}, score {}>", e.scene_id, e.im_id, e.obj_id, e.score)
    }
}

/// Reads a result file of the BOP Challenge (scene_id,im_id,obj_id,score,R,t,time; t in millimetres).
///
/// lenient=True leaves invalid rows out and warns. Returns a list of Estimate.
///
/// Raises OSError when the file cannot be read; ValueError with line and column for an invalid row.
///
/// >>> estimates = read_results("results.csv")  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (path, *, lenient=false))]
fn read_results(py: Python<'_>, path: PathBuf, lenient: bool) -> PyResult<Vec<PyEstimate>> {
    let estimates = if lenient {
        let (good, rows) = free(py, || sixfold::bop::read_results_lenient(&path))?.map_err(results_error)?;
        if let Some(first) = rows.first() {
            let text = format!("{}: {} rows left out, the first: {first}", path.display(), rows.len());
            py.import("warnings")?.call_method1("warn", (text,))?;
        }
        good
    } else {
        free(py, || sixfold::bop::read_results(&path))?.map_err(results_error)?
    };
    Ok(estimates.into_iter().map(PyEstimate).collect())
}

/// Writes a result file of the BOP Challenge, completely or not at all.
///
/// Raises OSError when it cannot be written.
///
/// >>> write_results("results.csv", estimates)  # doctest: +SKIP
#[pyfunction]
fn write_results(py: Python<'_>, path: PathBuf, estimates: Vec<PyEstimate>) -> PyResult<()> {
    let rows: Vec<Estimate> = estimates.into_iter().map(|e| e.0).collect();
    free(py, || sixfold::bop::write_results(&path, &rows))?.map_err(results_error)
}

/// Converts a rotation (3, 3) and a translation (3,) in millimetres, as in BOP files, to a pose (4, 4) in metres.
///
/// >>> import numpy as np
/// >>> pose_from_mm(np.eye(3), [0, 0, 1000])[2, 3]
/// np.float64(1.0)
#[pyfunction]
fn pose_from_mm<'py>(
    py: Python<'py>,
    rotation: &Bound<'py, PyAny>,
    translation_mm: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let rotation = arrays::matrix3("rotation", rotation)?;
    let translation = arrays::vector3("translation_mm", translation_mm)? / 1000.0;
    Pose::from_parts(&rotation, translation).map_err(about("rotation"))?;
    arrays::from_placement(py, &Placement { rotation, translation })
}

/// Converts a pose (4, 4) in metres to a rotation (3, 3) and a translation (3,) in millimetres, as in BOP files.
///
/// >>> import numpy as np
/// >>> pose_to_mm(np.diag([1.0, 1, 1, 1]))[1]
/// array([0., 0., 0.])
#[pyfunction]
#[allow(clippy::type_complexity)]
fn pose_to_mm<'py>(
    py: Python<'py>,
    pose: &Bound<'py, PyAny>,
) -> PyResult<(Bound<'py, PyArray2<f64>>, Bound<'py, PyArray1<f64>>)> {
    let placement = arrays::placement("pose", pose)?;
    let millimetres = placement.translation * 1000.0;
    Ok((arrays::from_matrix3(py, &placement.rotation)?, arrays::from_vector3(py, &millimetres)))
}

/// A BOP dataset on disk.
///
/// path: the dataset's folder, with scene folders in `path/split`, models in `path/models`, and their text files; or a single
/// scene folder.
///
/// Raises FileNotFoundError when the folder, the split or its scenes are missing; ValueError when a file is invalid.
///
/// >>> from sixfold import bop
/// >>> dataset = bop.Dataset("data/demo")  # doctest: +SKIP
/// >>> dataset.rgb(2, 3).shape  # doctest: +SKIP
/// (480, 640, 3)
#[pyclass(name = "Dataset", module = "sixfold.bop", frozen)]
pub(crate) struct PyDataset(pub(crate) Arc<BopDataset>, pub(crate) String);

impl PyDataset {
    fn scene(&self, scene_id: i64) -> PyResult<Scene> {
        self.0.scene(id("scene_id", scene_id)?).map_err(dataset_error)
    }

    /// All images, as pairs of scene and image id.
    pub(crate) fn images(&self) -> PyResult<Vec<(u32, u32)>> {
        let mut images = vec![];
        for scene_id in self.0.scene_ids() {
            let scene = self.scene(i64::from(scene_id))?;
            images.extend(scene.image_ids().into_iter().map(|im_id| (scene_id, im_id)));
        }
        Ok(images)
    }
}

#[pymethods]
impl PyDataset {
    #[new]
    #[pyo3(signature = (path, split="test"))]
    fn new(py: Python<'_>, path: PathBuf, split: &str) -> PyResult<Self> {
        let dataset = free(py, || BopDataset::open(&path, split))?.map_err(dataset_error)?;
        Ok(PyDataset(Arc::new(dataset), split.to_owned()))
    }

    /// The dataset's folder.
    #[getter]
    fn path(&self) -> PathBuf {
        self.0.root().to_owned()
    }

    /// Ids of the split's scenes, ascending.
    #[getter]
    fn scene_ids(&self) -> Vec<u32> {
        self.0.scene_ids()
    }

    /// Ids of a scene's images, ascending.
    fn image_ids(&self, scene_id: i64) -> PyResult<Vec<u32>> {
        Ok(self.scene(scene_id)?.image_ids())
    }

    /// Ids of the objects in models_info.json, ascending; empty without this file.
    #[getter]
    fn object_ids(&self) -> PyResult<Vec<u32>> {
        let infos = self.0.models_info(Models::Rendering).map_err(dataset_error)?;
        Ok(infos.map_or_else(Vec::new, |i| i.0.keys().copied().collect()))
    }

    /// The camera of an image.
    fn camera(&self, scene_id: i64, im_id: i64) -> PyResult<PyCamera> {
        Ok(PyCamera(self.scene(scene_id)?.camera(id("im_id", im_id)?).map_err(dataset_error)?))
    }

    /// The colour image, (H, W, 3) uint8, or None if there is none.
    fn rgb<'py>(
        &self,
        py: Python<'py>,
        scene_id: i64,
        im_id: i64,
    ) -> PyResult<Option<Bound<'py, PyArray3<u8>>>> {
        let (scene, im_id) = (self.scene(scene_id)?, id("im_id", im_id)?);
        let image = free(py, || scene.rgb(im_id))?.map_err(dataset_error)?;
        image.map(|i| arrays::from_image_of(py, i)).transpose()
    }

    /// The depth image, (H, W) float32 metres, 0 where nothing was measured; None if there is no image.
    fn depth<'py>(
        &self,
        py: Python<'py>,
        scene_id: i64,
        im_id: i64,
    ) -> PyResult<Option<Bound<'py, PyArray2<f32>>>> {
        let (scene, im_id) = (self.scene(scene_id)?, id("im_id", im_id)?);
        let image = free(py, || scene.depth(im_id))?.map_err(dataset_error)?;
        image.map(|i| arrays::from_image(py, i)).transpose()
    }

    /// The mask of ground-truth pose number `index` (from 0), (H, W) bool: its visible part, or with visible=False its whole
    /// silhouette; None if there is no mask.
    #[pyo3(signature = (scene_id, im_id, index, *, visible=true))]
    fn mask<'py>(
        &self,
        py: Python<'py>,
        scene_id: i64,
        im_id: i64,
        index: i64,
        visible: bool,
    ) -> PyResult<Option<Bound<'py, PyArray2<bool>>>> {
        let (scene, im_id, index) = (self.scene(scene_id)?, id("im_id", im_id)?, whole("index", index, 0)?);
        let kind = if visible { MaskKind::Visible } else { MaskKind::Full };
        let image = free(py, || scene.mask(im_id, index, kind))?.map_err(dataset_error)?;
        image.map(|i| arrays::from_image(py, i)).transpose()
    }

    /// The ground truth of an image: a list of dicts with obj_id, camera_from_object (4, 4) in metres, visible (the visible
    /// fraction, or None), box and box_visible (x, y, width, height in pixels, or None).
    fn ground_truth<'py>(&self, py: Python<'py>, scene_id: i64, im_id: i64) -> PyResult<Bound<'py, PyList>> {
        let scene = self.scene(scene_id)?;
        let image = scene.image(id("im_id", im_id)?).map_err(dataset_error)?;
        let out = PyList::empty(py);
        for (index, truth) in image.ground_truth.iter().enumerate() {
            let info = image.info.as_ref().map(|i| &i[index]);
            let corners = |r: Option<sixfold::geometry::Rect>| {
                r.map(|r| PyArray1::from_vec(py, vec![r.x, r.y, r.width, r.height]))
            };
            let entry = PyDict::new(py);
            entry.set_item("obj_id", truth.obj_id)?;
            entry.set_item("camera_from_object", arrays::from_placement(py, &truth.placement())?)?;
            entry.set_item("visible", info.map(|i| i.visib_fract))?;
            entry.set_item("box", corners(info.and_then(|i| i.bbox_obj)))?;
            entry.set_item("box_visible", corners(info.and_then(|i| i.bbox_visib)))?;
            out.append(entry)?;
        }
        Ok(out)
    }

    /// The targets, the objects to be found: a list of (scene_id, im_id, obj_id, count).
    ///
    /// path: a targets file. Without it, test_targets_bop19.json is read; without that file too, the targets are all ground-truth
    /// poses that are at least 10 % visible or of unknown visibility.
    #[pyo3(signature = (path=None))]
    fn targets(&self, path: Option<PathBuf>) -> PyResult<Vec<(u32, u32, u32, usize)>> {
        let targets = self.0.targets(path.as_deref()).map_err(dataset_error)?;
        let targets = self.0.object_targets(&targets).map_err(dataset_error)?;
        Ok(targets
            .iter()
            .filter_map(|t| t.object.map(|o| (t.scene_id, t.im_id, o.obj_id, o.inst_count)))
            .collect())
    }

    /// The model of an object: a Mesh in metres with the symmetries of models_info.json. evaluation=True takes the model from
    /// models_eval if the dataset has this folder.
    #[pyo3(signature = (obj_id, *, evaluation=false))]
    fn model(&self, py: Python<'_>, obj_id: i64, evaluation: bool) -> PyResult<PyMesh> {
        let (obj_id, dataset) = (id("obj_id", obj_id)?, &self.0);
        let models = if evaluation { Models::Evaluation } else { Models::Rendering };
        let mesh = free(py, || dataset.model(obj_id, models))?.map_err(dataset_error)?;
        let infos = dataset.models_info(models).map_err(dataset_error)?;
        Ok(PyMesh::with_info(mesh, infos.as_ref().and_then(|i| i.0.get(&obj_id))))
    }

    fn __repr__(&self) -> String {
        format!("<Dataset {}: {} scenes>", self.0.root().display(), self.0.scene_ids().len())
    }
}

/// Sets the maximum number of pixels of an image that is read from a file, for the whole process; 100 million by default.
///
/// Raises ValueError for a limit below 1.
///
/// >>> set_max_pixels(100_000_000)
#[pyfunction]
fn set_max_pixels(pixels: i64) -> PyResult<()> {
    sixfold::io::set_max_pixels(whole("pixels", pixels, 1)? as u64);
    Ok(())
}

/// Reads a colour image, PNG or JPEG: (H, W, 3) uint8. A grey image is converted to colour.
///
/// Raises OSError when the file cannot be read; ValueError when it is not such an image.
///
/// >>> rgb = read_rgb("data/demo/test/000002/rgb/000003.png")  # doctest: +SKIP
#[pyfunction]
fn read_rgb(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyArray3<u8>>> {
    let image = free(py, || sixfold::io::read_rgb(&path))?.map_err(image_error)?;
    arrays::from_image_of(py, image)
}

/// Reads a 16-bit depth image: (H, W) float32 metres.
///
/// mm_per_unit: millimetres per unit of the file, BOP's depth_scale.
///
/// Raises OSError when the file cannot be read; ValueError when it is not such an image.
///
/// >>> depth = read_depth("data/demo/test/000002/depth/000003.png", mm_per_unit=1.0)  # doctest: +SKIP
#[pyfunction]
fn read_depth(py: Python<'_>, path: PathBuf, mm_per_unit: f64) -> PyResult<Bound<'_, PyArray2<f32>>> {
    let metres = positive("mm_per_unit", mm_per_unit)? / 1000.0;
    let image = free(py, || sixfold::io::read_depth(&path, metres))?.map_err(image_error)?;
    arrays::from_image(py, image)
}

/// Reads a mask: (H, W) bool, True where the file is not zero.
///
/// The file is grey, has a palette, or is RGB with one colour besides black. An alpha channel that is not opaque everywhere is
/// the mask itself.
///
/// Raises OSError when the file cannot be read; ValueError when it is not such an image (a JPEG never is) or is ambiguous.
///
/// >>> mask = read_mask("mask.png")  # doctest: +SKIP
#[pyfunction]
fn read_mask(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyArray2<bool>>> {
    let image = free(py, || sixfold::io::read_mask(&path))?.map_err(image_error)?;
    arrays::from_image(py, image)
}

/// Writes a colour image (H, W, 3) uint8 as PNG.
///
/// Raises OSError when the file cannot be written.
///
/// >>> write_rgb("out/rgb.png", rgb)  # doctest: +SKIP
#[pyfunction]
fn write_rgb(py: Python<'_>, path: PathBuf, rgb: &Bound<'_, PyAny>) -> PyResult<()> {
    let image = arrays::rgb("rgb", rgb)?;
    free(py, || sixfold::io::write_rgb(&path, &image))?.map_err(image_error)
}

/// Writes a depth image (H, W) in metres as a 16-bit PNG.
///
/// mm_per_unit: millimetres per unit of the file, BOP's depth_scale. Values that do not fit are stored as missing (0).
///
/// Raises OSError when the file cannot be written.
///
/// >>> write_depth("out/depth.png", depth, mm_per_unit=0.1)  # doctest: +SKIP
#[pyfunction]
fn write_depth(py: Python<'_>, path: PathBuf, depth: &Bound<'_, PyAny>, mm_per_unit: f64) -> PyResult<()> {
    let image = arrays::depth("depth", depth)?;
    let metres = positive("mm_per_unit", mm_per_unit)? / 1000.0;
    free(py, || sixfold::io::write_depth(&path, &image, metres))?.map_err(image_error)
}

/// Writes a mask (H, W) bool as PNG.
///
/// Raises OSError when the file cannot be written.
///
/// >>> write_mask("out/mask.png", mask)  # doctest: +SKIP
#[pyfunction]
fn write_mask(py: Python<'_>, path: PathBuf, mask: &Bound<'_, PyAny>) -> PyResult<()> {
    let image = arrays::mask("mask", mask)?;
    free(py, || sixfold::io::write_mask(&path, &image))?.map_err(image_error)
}

/// Computes masks and visibility of posed objects as BOP's ground truth does.
///
/// objects: [(mesh, camera_from_object (4, 4)), ...]. depth: the sensor's image, (H, W), metres, if there is one. delta: tolerance
/// of the visibility test, metres; a surface counts as visible up to this far behind the measured depth.
///
/// Returns a list of dicts with mask (the whole silhouette) and mask_visible, both (H, W) bool, and visible (the visible
/// fraction).
///
/// Raises ValueError without objects, or for a depth image of another size than the camera's.
///
/// >>> ground_truth_visibility([(mesh, pose)], camera, depth)[0]["visible"]  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (objects, camera, depth=None, *, delta=0.015))]
fn ground_truth_visibility<'py>(
    py: Python<'py>,
    objects: &Bound<'py, PyAny>,
    camera: PyCamera,
    depth: Option<&Bound<'py, PyAny>>,
    delta: f64,
) -> PyResult<Bound<'py, PyList>> {
    let objects = crate::render::posed_objects("objects", objects)?;
    let depth = depth.map(|d| arrays::depth("depth", d)).transpose()?;
    let camera = match &depth {
        Some(image) => camera.of_image("depth", image.size())?,
        None => camera.pinhole()?,
    };
    PyCamera(camera).drawable()?;
    let delta = positive("delta", delta)?;
    let seen = free(py, || {
        let posed: Vec<_> = objects.iter().map(|(mesh, pose)| (mesh.as_ref(), *pose)).collect();
        sixfold::bop::ground_truth_visibility(&posed, &camera, depth.as_ref(), delta)
    })?;
    let out = PyList::empty(py);
    for object in seen {
        let entry = PyDict::new(py);
        entry.set_item("mask", arrays::from_image(py, object.mask)?)?;
        entry.set_item("mask_visible", arrays::from_image(py, object.mask_visible)?)?;
        entry.set_item("visible", object.info.visib_fract)?;
        out.append(entry)?;
    }
    Ok(out)
}

/// Encodes a mask (H, W) bool as COCO's compressed run lengths: a dict with size [H, W] and counts.
///
/// >>> import numpy as np
/// >>> encode_mask(np.array([[False, True]]))
/// {'size': [1, 2], 'counts': '11'}
#[pyfunction]
pub(crate) fn encode_mask<'py>(py: Python<'py>, mask: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyDict>> {
    let mask = arrays::mask("mask", mask)?;
    let rle = sixfold::bop::Rle::encode(&mask).map_err(about("mask"))?;
    let out = PyDict::new(py);
    out.set_item("size", [rle.height(), rle.width()])?;
    out.set_item("counts", rle.to_compressed())?;
    Ok(out)
}

/// Decodes COCO's run lengths to a mask (H, W) bool.
///
/// rle: a dict with size [H, W] and counts, a text (compressed) or a list of numbers.
///
/// Raises ValueError when the counts are invalid or do not add up to the size.
///
/// >>> decode_mask({"size": [1, 2], "counts": [1, 1]})
/// array([[False,  True]])
#[pyfunction]
pub(crate) fn decode_mask<'py>(
    py: Python<'py>,
    rle: &Bound<'py, PyDict>,
) -> PyResult<Bound<'py, PyArray2<bool>>> {
    let wrong =
        || bad("rle", "a dict with size [H, W] and counts (text or a list of runs)", "something else");
    let size = rle.get_item("size")?.ok_or_else(wrong)?;
    let (height, width) = size.extract::<[u64; 2]>().map(|[h, w]| (h, w)).map_err(|_| wrong())?;
    let counts = rle.get_item("counts")?.ok_or_else(wrong)?;
    let rle = if let Ok(text) = counts.extract::<String>() {
        sixfold::bop::Rle::from_compressed(width, height, &text)
    } else if let Ok(bytes) = counts
        .extract::<Vec<u8>>()
        .and_then(|b| if counts.is_instance_of::<pyo3::types::PyBytes>() { Ok(b) } else { Err(wrong()) })
    {
        let text = String::from_utf8(bytes).map_err(|_| wrong())?;
        sixfold::bop::Rle::from_compressed(width, height, &text)
    } else {
        sixfold::bop::Rle::new(width, height, counts.extract::<Vec<u32>>().map_err(|_| wrong())?)
    };
    arrays::from_image(py, rle.map_err(about("rle"))?.decode())
}

/// Adds the contents of `sixfold.bop`.
pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PyEstimate>()?;
    module.add_class::<PyDataset>()?;
    module.add_function(wrap_pyfunction!(read_results, module)?)?;
    module.add_function(wrap_pyfunction!(write_results, module)?)?;
    module.add_function(wrap_pyfunction!(pose_from_mm, module)?)?;
    module.add_function(wrap_pyfunction!(pose_to_mm, module)?)?;
    module.add_function(wrap_pyfunction!(set_max_pixels, module)?)?;
    module.add_function(wrap_pyfunction!(read_rgb, module)?)?;
    module.add_function(wrap_pyfunction!(read_depth, module)?)?;
    module.add_function(wrap_pyfunction!(read_mask, module)?)?;
    module.add_function(wrap_pyfunction!(write_rgb, module)?)?;
    module.add_function(wrap_pyfunction!(write_depth, module)?)?;
    module.add_function(wrap_pyfunction!(write_mask, module)?)?;
    module.add_function(wrap_pyfunction!(ground_truth_visibility, module)?)?;
    crate::scene_writer::register(module)
}
