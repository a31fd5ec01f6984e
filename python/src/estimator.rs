//! `Estimator`: any method of `sixfold estimate` on one image or on a dataset, through the same trait as the program
//! (`sixfold-estimator`).

use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use numpy::PyArray2;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sixfold::align::PreparedDepth;
use sixfold::estimator::{
    EstimatorError, Need, Object, PoseEstimate, PoseEstimator, PreparedObject, Query, Region,
};
use sixfold::geometry::{Camera, Mask, Rect};
use sixfold::mesh::{Mesh, ModelInfo};
use sixfold::mttm::mask::to_image;
use sixfold::pix2pose::aligned::MAX_STARTS;
use sixfold::runner::{RunOptions, describe};

use crate::arrays::{self, about, bad, seed, whole};
use crate::bop::json_to_python;
use crate::camera::PyCamera;
use crate::dataset_run::{self, Run};
use crate::guard::{free, interruptible};
use crate::mesh::PyMesh;
use crate::methods::{Options, make};
use crate::ppf::{depth_error, verification_to_python};

/// A pose found by an Estimator.
#[pyclass(name = "Estimate", module = "sixfold", frozen)]
pub(crate) struct PyPoseEstimate {
    /// The pose, (4, 4) float64, metres.
    #[pyo3(get)]
    camera_from_object: Py<PyArray2<f64>>,
    /// Confidence, 0 to 1; comparable only between estimates of one method.
    #[pyo3(get)]
    confidence: f64,
    /// The probability that the pose is right, if the method computes it (auto); None otherwise. A pose is right if no point of the
    /// object is further than a tenth of the diameter from its true position.
    #[pyo3(get)]
    probability: Option<f64>,
    /// Mask of the object's visible pixels, (H, W) bool, if the method segments; None otherwise.
    #[pyo3(get)]
    mask: Option<Py<PyArray2<bool>>>,
    /// Other results of the method, under the same keys as in `sixfold estimate --json`. If the pose was verified with depth, also
    /// `verification`, a dict as in PpfEstimate.
    #[pyo3(get)]
    details: Py<PyDict>,
    /// Notes on this pose, one sentence each; usually empty.
    #[pyo3(get)]
    notes: Vec<String>,
}

#[pymethods]
impl PyPoseEstimate {
    fn __repr__(&self) -> String {
        format!("<Estimate: confidence {:.3}>", self.confidence)
    }
}

fn to_python(py: Python<'_>, estimate: PoseEstimate, camera: &Camera) -> PyResult<PyPoseEstimate> {
    let details = json_to_python(py, &estimate.details)?.cast_into::<PyDict>()?;
    details.set_item("alternatives", json_to_python(py, &estimate.weighted_alternatives())?)?;
    if let Some(probability) = estimate.probability_with_alternatives() {
        details.set_item("probability_with_alternatives", probability)?;
    }
    if let Some(score) = &estimate.verification {
        details.set_item("verification", verification_to_python(py, score)?)?;
    }
    let image = |pixels: &Vec<u32>| arrays::from_image(py, to_image(pixels, camera.width, camera.height));
    Ok(PyPoseEstimate {
        camera_from_object: arrays::from_pose(py, &estimate.camera_from_object)?.unbind(),
        confidence: estimate.confidence,
        probability: estimate.probability,
        mask: estimate.mask.as_ref().map(image).transpose()?.map(Bound::unbind),
        details: details.unbind(),
        notes: estimate.notes,
    })
}

/// An object that was searched before. The next search for an equal one needs no preparation.
struct Known {
    id: Option<u32>,
    shape: Option<(Arc<Mesh>, ModelInfo)>,
    prepared: Arc<dyn PreparedObject>,
}

/// Maximum number of objects kept, those of the latest searches.
const KEPT: usize = 32;

/// The objects of the latest searches, the most recent one last.
#[derive(Default)]
struct Searched(Mutex<Vec<Known>>);

impl Searched {
    fn prepare(
        &self,
        method: &dyn PoseEstimator,
        id: Option<u32>,
        shape: Option<(Arc<Mesh>, ModelInfo)>,
    ) -> Result<Arc<dyn PreparedObject>, EstimatorError> {
        let kept = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        {
            let mut kept = kept();
            if let Some(at) = kept.iter().position(|k| k.id == id && k.shape == shape) {
                let known = kept.remove(at);
                let prepared = known.prepared.clone();
                kept.push(known);
                return Ok(prepared);
            }
        }
        let name = id.map_or_else(|| "the object".to_owned(), |id| format!("object {id}"));
        let (mesh, info) = shape.clone().unzip();
        let object = Object { name, id, mesh, info, folder: None };
        let prepared: Arc<dyn PreparedObject> = Arc::from(method.prepare(&object)?);
        let mut kept = kept();
        if kept.len() >= KEPT {
            kept.remove(0);
        }
        kept.push(Known { id, shape, prepared: prepared.clone() });
        Ok(prepared)
    }
}

/// A method of `sixfold estimate`. The interface is the same for all methods: `find` searches one image, `run_dataset` all targets
/// of a BOP dataset.
///
/// method, the default is "auto":
///
/// - "ppf": point pair features in depth, without training.
/// - "mttm": templates in depth, without training.
/// - "pix2pose": object coordinates predicted from colour by a network trained on the objects, in given boxes.
/// - "views": rendered views of the mesh matched with colour, without training; in given boxes, or in the proposals of a built-in
///   detector.
/// - "auto": all methods that the images allow, one after the other, until one is certain. Each pose has a probability.
///
/// weights: the network of pix2pose (required; that of a taught object is `pix2pose.safetensors` in its folder of the store); for
/// mttm and views a network instead of the built-in one; for auto the network of pix2pose, without which pix2pose is left out. budget (auto): seconds per object after which no further method starts; poses then
/// depend on the speed of the machine. keep_plane (ppf, mttm, auto): also search points on the table plane. matcher (mttm):
/// "points", "network" or "both". templates_only (mttm): verify poses with the templates only, as if there were no mesh. templates
/// (mttm): "above" (default), for objects that stand on a table with their z axis up, or "around", for objects in any orientation
/// (slower). refine (pix2pose, views): align the rendered outline with the image. For pix2pose this needs a mesh, and a network
/// then refines the pose too, unless icp is set. passes (pix2pose): maximum number of passes over an object, 1 by default.
/// starts (pix2pose): number of boxes from which a pose is estimated, 1 to 5, 1 by default: the given one and copies of it of other
/// sizes; the pose with which the image agrees best is kept.
/// icp (pix2pose): align poses with the depth image. seed: the seed of all random numbers.
///
/// Raises ValueError for an unknown method, a changed option that the method does not have, or a file that is not such a network;
/// OSError when the file cannot be read. Ctrl-C interrupts it.
///
/// >>> estimator = Estimator("ppf")
/// >>> estimator.needs["depth"], estimator.needs["rgb"]
/// ('required', 'unused')
/// >>> found = estimator.find(mesh, camera, depth)  # doctest: +SKIP
/// >>> found[0].camera_from_object  # doctest: +SKIP
#[pyclass(name = "Estimator", module = "sixfold", frozen)]
pub(crate) struct PyEstimator {
    method: Arc<dyn PoseEstimator>,
    /// Ids of the objects that the weights were trained on; empty if any mesh can be searched.
    ids: Vec<u32>,
    record: RunOptions,
    searched: Arc<Searched>,
}

#[pymethods]
impl PyEstimator {
    #[new]
    #[pyo3(signature = (method="auto", *, weights=None, keep_plane=false, matcher="both", templates_only=false, templates=None, refine=true, passes=None, starts=None, icp=false, budget=None, seed=0))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        py: Python<'_>,
        method: &str,
        weights: Option<PathBuf>,
        keep_plane: bool,
        matcher: &str,
        templates_only: bool,
        templates: Option<String>,
        refine: bool,
        passes: Option<i64>,
        starts: Option<i64>,
        icp: bool,
        budget: Option<f64>,
        seed: i64,
    ) -> PyResult<Self> {
        let options = Options {
            weights,
            keep_plane,
            matcher: matcher.to_owned(),
            templates_only,
            templates,
            refine,
            passes: passes.map(|n| whole("passes", n, 1)).transpose()?,
            starts: starts.map(self::starts).transpose()?,
            icp,
            budget,
            seed: self::seed(seed)?,
        };
        let (method, ids) = make(py, options.check(method)?, &options)?;
        let record = free(py, || options.record())?;
        Ok(PyEstimator { method, ids, record, searched: Arc::default() })
    }

    /// The method: "ppf", "mttm", "pix2pose", "views" or "auto".
    #[getter]
    fn name(&self) -> &'static str {
        self.method.name()
    }

    /// The method's inputs, a dict: "required", "optional" or "unused" for each of depth, rgb, region (box or mask) and object.
    #[getter]
    fn needs<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let needs = self.method.needs();
        let dict = PyDict::new(py);
        for (name, need) in
            [("depth", needs.depth), ("rgb", needs.rgb), ("region", needs.region), ("object", needs.object)]
        {
            let word = match need {
                Need::Required => "required",
                Need::Optional => "optional",
                Need::Unused => "unused",
            };
            dict.set_item(name, word)?;
        }
        Ok(dict)
    }

    /// Searches for an object in an image: a list of Estimate, best first; empty if it is not found.
    ///
    /// object: a Mesh; None is possible if the weights were trained on the object (pix2pose without icp; its outline is then not
    /// aligned). id: the object's id in the weights; not needed if they have only one object. depth: (H, W), metres. rgb: (H, W, 3)
    /// uint8. Images are without lens distortion; images that the method does not use are ignored (`needs`). auto needs depth or
    /// rgb. box: (4,) x, y, width, height in pixels. mask: (H, W) bool. box and mask contain the object; with both, their
    /// intersection does. instances: maximum number of poses. min_confidence: poses with a lower confidence are left out; by
    /// default 0.25 for ppf, 0.45 for mttm, 0.4 for views, 0 for pix2pose, 0.5 for auto.
    ///
    /// Data computed from an object are kept for the next call. The same input gives the same result with any number of threads.
    /// Ctrl-C interrupts it.
    ///
    /// Raises ValueError for a missing input that the method needs, a mesh without faces or of another object than the weights',
    /// images of different sizes, a box without area or outside the image, an empty mask, and a depth image in the wrong unit or
    /// without any value.
    #[pyo3(signature = (object, camera, depth=None, rgb=None, r#box=None, mask=None, instances=1, min_confidence=None, *, id=None))]
    #[allow(clippy::too_many_arguments)]
    fn find(
        &self,
        py: Python<'_>,
        object: Option<&Bound<'_, PyAny>>,
        camera: PyCamera,
        depth: Option<&Bound<'_, PyAny>>,
        rgb: Option<&Bound<'_, PyAny>>,
        r#box: Option<&Bound<'_, PyAny>>,
        mask: Option<&Bound<'_, PyAny>>,
        instances: i64,
        min_confidence: Option<f64>,
        id: Option<i64>,
    ) -> PyResult<Vec<PyPoseEstimate>> {
        let (needs, name) = (self.method.needs(), self.method.name());
        let given = |argument: &str, need: Need, what: &str, there: bool| match need {
            Need::Required if !there => Err(bad(argument, format!("{what}, which {name} needs"), "None")),
            _ => Ok(()),
        };
        given("object", needs.object, "a Mesh", object.is_some())?;
        given("depth", needs.depth, "a depth image", depth.is_some())?;
        given("rgb", needs.rgb, "a colour image", rgb.is_some())?;
        given("box", needs.region, "a box (or a mask)", r#box.is_some() || mask.is_some())?;
        let id = self.id_of(id)?;
        let shape = object.map(|object| shape_of(py, object)).transpose()?;
        let depth = depth.filter(|_| needs.depth != Need::Unused);
        let depth = depth.map(|d| arrays::depth("depth", d)).transpose()?;
        let rgb = rgb.filter(|_| needs.rgb != Need::Unused);
        let rgb = rgb.map(|i| arrays::rgb("rgb", i)).transpose()?;
        let camera = camera.pinhole()?;
        for (argument, size) in
            [("depth", depth.as_ref().map(|d| d.size())), ("rgb", rgb.as_ref().map(|i| i.size()))]
        {
            if let Some((width, height)) = size {
                camera.check_image(width, height).map_err(about(argument))?;
            }
        }
        let region = region_of(&camera, r#box, mask)?;
        let max_instances = whole("instances", instances, 1)?;
        let min_confidence = confidence(min_confidence)?.unwrap_or(self.method.min_confidence().image);
        let (method, searched) = (self.method.clone(), self.searched.clone());
        let found = interruptible(py, move |stop| -> Result<_, EstimatorError> {
            let options = method.depth_options();
            let depth = depth.map(|d| PreparedDepth::new(&d, &camera, &options)).transpose()?;
            stop.check();
            let prepared = searched.prepare(method.as_ref(), id, shape)?;
            stop.check();
            let query = Query {
                rgb: rgb.as_ref(),
                depth: depth.as_ref(),
                region: region.as_ref(),
                max_instances,
                min_confidence,
                ..Query::new(&camera)
            };
            method.estimate(prepared.as_ref(), &query)
        })?;
        let found = found.map_err(estimator_error)?;
        found.into_iter().map(|estimate| to_python(py, estimate, &camera)).collect()
    }

    /// Searches for all targets of a BOP dataset, as `sixfold estimate --dataset` does. Poses are written image by image to a
    /// result file of the BOP Challenge. If the file exists and the same call started it, the run resumes; the file `out`.run.json
    /// next to it records the options.
    ///
    /// path: the dataset's folder. out: the result file (.csv). boxes: "gt" for ground-truth boxes, or a file of COCO detections.
    /// detector: a weight file written by `train_detector`, to use its boxes; without boxes and detector the whole image is
    /// searched. targets: a targets file; by default test_targets_bop19.json, or without this file all ground-truth poses that are
    /// at least 10 % visible. min_confidence: poses with a lower confidence are left out; by default 0.05 for ppf and mttm, 0 for
    /// pix2pose, views and auto. cache: a folder for data computed from the models, which makes later runs faster. progress: called
    /// after every image with a dict of stage, done, total and image.
    ///
    /// Returns a dict with images, targets, poses (rows of the file), skipped (images and targets left out, with reasons),
    /// seconds_per_image (mean over the images of this run, or None) and results (the result file). Ctrl-C ends the run after the
    /// current image; the same call resumes it.
    ///
    /// Raises OSError for files that cannot be read or written; ValueError for invalid files, a method that needs boxes but has
    /// none, and a result file that was made with other options.
    #[pyo3(signature = (path, out, split="test", boxes=None, detector=None, targets=None, min_confidence=None, *, cache=None, progress=None))]
    #[allow(clippy::too_many_arguments)]
    fn run_dataset<'py>(
        &self,
        py: Python<'py>,
        path: PathBuf,
        out: PathBuf,
        split: &str,
        boxes: Option<PathBuf>,
        detector: Option<PathBuf>,
        targets: Option<PathBuf>,
        min_confidence: Option<f64>,
        cache: Option<PathBuf>,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let run = Run {
            method: self.method.clone(),
            path,
            out,
            split: split.to_owned(),
            boxes,
            detector,
            targets,
            min_confidence: confidence(min_confidence)?,
            cache,
            record: self.record.clone(),
        };
        dataset_run::run(py, run, progress)
    }

    fn __repr__(&self) -> String {
        format!("<Estimator: {}>", self.method.name())
    }
}

impl PyEstimator {
    /// The object's id, checked against the objects of the weights, if these have any.
    fn id_of(&self, given: Option<i64>) -> PyResult<Option<u32>> {
        let id = given.map(|id| arrays::id("id", id)).transpose()?;
        let known = || self.ids.iter().map(u32::to_string).collect::<Vec<_>>().join(" or ");
        match (id, &self.ids[..]) {
            (_, []) => Ok(id),
            (None, [only]) => Ok(Some(*only)),
            (None, _) => Err(bad("id", known(), "None")),
            (Some(id), ids) if !ids.contains(&id) => Err(bad("id", known(), id.to_string())),
            (Some(id), _) => Ok(Some(id)),
        }
    }
}

/// A mesh with the properties of its object.
pub(crate) fn shape_of(py: Python<'_>, object: &Bound<'_, PyAny>) -> PyResult<(Arc<Mesh>, ModelInfo)> {
    let found = || bad("object", "a Mesh", object.get_type().to_string());
    let mesh = object.cast::<PyMesh>().map_err(|_| found())?.get();
    Ok((mesh.mesh.clone(), free(py, || mesh.info())?))
}

/// The number of boxes from which Pix2Pose starts.
fn starts(value: i64) -> PyResult<usize> {
    match usize::try_from(value) {
        Ok(starts) if (1..=MAX_STARTS).contains(&starts) => Ok(starts),
        _ => Err(bad("starts", format!("a whole number from 1 to {MAX_STARTS}"), value.to_string())),
    }
}

/// A confidence threshold from 0 to 1.
fn confidence(value: Option<f64>) -> PyResult<Option<f64>> {
    match value {
        Some(v) if !(0.0..=1.0).contains(&v) => {
            Err(bad("min_confidence", "a number from 0 to 1", v.to_string()))
        }
        value => Ok(value),
    }
}

/// The region to search: a box, a mask, or their intersection.
fn region_of(
    camera: &Camera,
    bbox: Option<&Bound<'_, PyAny>>,
    mask: Option<&Bound<'_, PyAny>>,
) -> PyResult<Option<Region>> {
    let bbox = bbox.map(|b| box_of(camera, b)).transpose()?;
    let Some(mask) = mask else { return Ok(bbox.map(Region::of_box)) };
    let mut mask = arrays::mask("mask", mask)?;
    camera.check_image(mask.width(), mask.height()).map_err(about("mask"))?;
    if let Some(bbox) = bbox {
        let inside = Region::of_box(bbox).pixels(camera);
        mask = Mask::from_fn(mask.width(), mask.height(), |x, y| mask[(x, y)] && inside[(x, y)]);
    }
    let expected = "at least one pixel in which the object can be";
    Ok(Some(Region::of_mask(mask).ok_or_else(|| bad("mask", expected, "none"))?))
}

/// A box that has an area and overlaps the image.
fn box_of(camera: &Camera, given: &Bound<'_, PyAny>) -> PyResult<Rect> {
    let boxes = arrays::boxes("box", given)?;
    let [bbox] = boxes[..] else {
        return Err(bad("box", "one box x, y, width, height", format!("{} boxes", boxes.len())));
    };
    let words = format!("{}, {}, {}, {}", bbox.x, bbox.y, bbox.width, bbox.height);
    if !(bbox.width > 0.0 && bbox.height > 0.0) {
        return Err(bad("box", "x, y, width, height with a size above 0", words));
    }
    let image = Rect { x: 0.0, y: 0.0, width: camera.width as f64, height: camera.height as f64 };
    if bbox.intersect(&image).is_none() {
        return Err(bad("box", format!("a part of the {}x{} image", camera.width, camera.height), words));
    }
    Ok(bbox)
}

/// The Python exception for a search that is not possible.
pub(crate) fn estimator_error(error: EstimatorError) -> PyErr {
    let named = |argument: &str, source: &(dyn std::error::Error + 'static)| {
        PyValueError::new_err(format!("{argument}: {}", describe(source)))
    };
    match error {
        EstimatorError::Depth(error) => depth_error(error),
        EstimatorError::Object { source, .. } => named("object", source.as_ref()),
        EstimatorError::Region { source } => named("box", source.as_ref()),
        other => PyValueError::new_err(describe(&other)),
    }
}
