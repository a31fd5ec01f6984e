//! `Pix2Pose`: poses from colour images with a trained network (dissertation, chapter 3).

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PyType};
use sixfold::estimator::Object;
use sixfold::geometry::Rect;
use sixfold::mesh::Mesh;
use sixfold::nn::weights::WeightsError;
use sixfold::pix2pose::aligned::AlignOptions;
use sixfold::pix2pose::depth::{align, prepare};
use sixfold::pix2pose::estimate::{EstimateError, Found, Pix2PoseOptions};
use sixfold::pix2pose::estimator::{self, Pix2PoseEstimator, Pix2PoseObject};
use sixfold::pix2pose::model::{ModelError, Pix2PoseModel};
use sixfold::runner::describe;
use sixfold::views::ViewsRefiner;

use crate::arrays::{self, about, bad, positive, seed};
use crate::camera::PyCamera;
use crate::guard::{interruptible, os_error};
use crate::mesh::PyMesh;

pub(crate) fn model_error(error: ModelError) -> PyErr {
    match &error {
        ModelError::Weights(WeightsError::Read { source, .. }) => os_error(source.kind(), error.to_string()),
        _ => PyValueError::new_err(error.to_string()),
    }
}

/// The pose of one object in one box.
#[pyclass(name = "Pix2PosePose", module = "sixfold", frozen)]
pub(crate) struct Pix2PosePose {
    /// The id of the object.
    #[pyo3(get)]
    object_id: u32,
    /// The pose, (4, 4) float64, metres. It includes the alignment of the outline, the refinement and the alignment with depth
    /// where they were done.
    #[pyo3(get)]
    camera_from_object: Py<PyArray2<f64>>,
    /// Number of correspondences that fit the pose divided by the number of the object's pixels, 0 to 1.
    #[pyo3(get)]
    score: f64,
    /// Whether enough of the mesh's outline was found in the image to align it.
    #[pyo3(get)]
    refined: bool,
    /// Agreement of the image with the refined pose, 0 to 1. None without a mesh, with depth, with refine=False, or if the image
    /// does not show the object there.
    #[pyo3(get)]
    agreement: Option<f64>,
    /// Whether the pose was aligned with depth.
    #[pyo3(get)]
    aligned_to_depth: bool,
    /// The poses from PnP, best first: dicts with camera_from_object (4, 4), score, inliers, threshold.
    #[pyo3(get)]
    hypotheses: Py<PyList>,
    /// The square of the image that was the input of the last pass, (4,): x, y, width, height in pixels.
    #[pyo3(get)]
    window: Py<PyArray1<f64>>,
    /// The network's input, (input side, input side, 3) uint8.
    #[pyo3(get)]
    input: Py<PyArray3<u8>>,
    /// The predicted object coordinates, (side, side, 3) float32, normalised to -1 to 1 over the object's box. side is that of
    /// the network's output, which may be smaller than its input.
    #[pyo3(get)]
    coordinates: Py<PyArray3<f32>>,
    /// The expected error of the coordinates, (side, side) float32, 0 to 1.
    #[pyo3(get)]
    error: Py<PyArray2<f32>>,
    /// Probability that the object is visible, (side, side) float32.
    #[pyo3(get)]
    visible: Py<PyArray2<f32>>,
    /// The correspondences of the best hypothesis: points (N, 3) in the object's frame, metres.
    #[pyo3(get)]
    object_points: Py<PyArray2<f64>>,
    /// The pixels of these correspondences, (N, 2).
    #[pyo3(get)]
    image_points: Py<PyArray2<f64>>,
}

#[pymethods]
impl Pix2PosePose {
    fn __repr__(&self) -> String {
        format!("<Pix2PosePose: object {}, score {:.3}>", self.object_id, self.score)
    }
}

/// The result for one box, before its conversion to Python.
struct Posed {
    object_id: u32,
    pose: estimator::Pix2PosePose,
    aligned: bool,
}

impl Posed {
    fn into_python(self, py: Python<'_>) -> PyResult<Pix2PosePose> {
        let Found { hypotheses, view, object_points, image_points, .. } = self.pose.found;
        let list = PyList::empty(py);
        for h in &hypotheses {
            let entry = PyDict::new(py);
            entry.set_item("camera_from_object", arrays::from_pose(py, &h.camera_from_object)?)?;
            entry.set_item("score", h.score)?;
            entry.set_item("inliers", h.inliers)?;
            entry.set_item("threshold", h.threshold)?;
            list.append(entry)?;
        }
        let (w, p) = (view.window, view.prediction);
        let side = p.side;
        let coordinates = PyArray1::from_vec(py, p.coordinates.into_flattened()).reshape([side, side, 3])?;
        Ok(Pix2PosePose {
            object_id: self.object_id,
            camera_from_object: arrays::from_pose(py, &self.pose.camera_from_object)?.unbind(),
            score: self.pose.score,
            refined: self.pose.refined,
            agreement: self.pose.agreement,
            aligned_to_depth: self.aligned,
            hypotheses: list.unbind(),
            window: PyArray1::from_vec(py, vec![w.x, w.y, w.width, w.height]).unbind(),
            input: arrays::from_image_of(py, view.input)?.unbind(),
            coordinates: coordinates.unbind(),
            error: PyArray1::from_vec(py, p.error).reshape([side, side])?.unbind(),
            visible: PyArray1::from_vec(py, p.visible).reshape([side, side])?.unbind(),
            object_points: arrays::from_points3(py, &object_points)?.unbind(),
            image_points: arrays::from_points2(py, image_points.into_iter().map(Some))?.unbind(),
        })
    }
}

/// A trained Pix2Pose network: estimates poses of known objects in given boxes of colour images (Park et al. 2019). Create it
/// with `load`.
///
/// >>> pix2pose = Pix2Pose.load("weights/pix2pose-lmo.safetensors", camera=camera)  # doctest: +SKIP
/// >>> poses = pix2pose(rgb, [[330, 120, 110, 150]], object_ids=[8])  # doctest: +SKIP
#[pyclass(name = "Pix2Pose", module = "sixfold", frozen)]
pub(crate) struct Pix2Pose {
    estimator: Pix2PoseEstimator,
    camera: Option<PyCamera>,
    meshes: Meshes,
}

/// Objects and their meshes by object id.
type Meshes = BTreeMap<u32, (Arc<Pix2PoseObject>, Arc<Mesh>)>;

fn meshes_of(estimator: &Pix2PoseEstimator, meshes: Option<BTreeMap<u32, Py<PyMesh>>>) -> PyResult<Meshes> {
    let mut out = BTreeMap::new();
    for (id, mesh) in meshes.unwrap_or_default() {
        let mesh = mesh.get().mesh.clone();
        let object = Object { name: id.to_string(), mesh: Some(mesh.clone()), ..Object::of_model(Some(id)) };
        let named = |error| PyValueError::new_err(format!("meshes: {}", describe(&error)));
        out.insert(id, (Arc::new(estimator.object(&object).map_err(named)?), mesh));
    }
    Ok(out)
}

#[pymethods]
impl Pix2Pose {
    /// Reads a weight file (.safetensors) that `train_pix2pose` or `sixfold train pix2pose` wrote.
    ///
    /// camera: the camera of the images, if calls do not give one.
    /// meshes: {object id: Mesh}. If an object's mesh is given, its outline is aligned with the image and its pose refined, as
    ///     the last steps.
    ///
    /// Raises OSError if the file cannot be read; ValueError if it is not such a model, or if a mesh is not that of its object.
    #[classmethod]
    #[pyo3(signature = (path, camera=None, meshes=None))]
    fn load(
        _class: &Bound<'_, PyType>,
        py: Python<'_>,
        path: PathBuf,
        camera: Option<PyCamera>,
        meshes: Option<BTreeMap<u32, Py<PyMesh>>>,
    ) -> PyResult<Self> {
        let model = interruptible(py, move |_| Pix2PoseModel::load(&path))?.map_err(model_error)?;
        let refiner = interruptible(py, |_| ViewsRefiner::shipped())?;
        let refiner = refiner.map_err(|e| PyValueError::new_err(describe(&e)))?;
        let estimator = Pix2PoseEstimator::new(model).with_refiner(Arc::new(refiner));
        let meshes = meshes_of(&estimator, meshes)?;
        Ok(Pix2Pose { estimator, camera, meshes })
    }

    /// The objects of the model: a list of dicts with id, diameter (metres), centre and half_size (3,) of its coordinates in
    /// metres, thresholds, and correction (the systematic error of aligned poses).
    #[getter]
    fn objects<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        crate::bop::json_to_python(py, &self.estimator.model.objects())
    }

    /// The model's card: its training data, training options and scores.
    #[getter]
    fn card<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        crate::bop::json_to_python(py, self.estimator.model.card())
    }

    /// Searches for one object in every box of an image: a list with a Pix2PosePose for each box, or None if the object is not
    /// visible.
    ///
    /// rgb: the image, (H, W, 3) uint8, without lens distortion.
    /// boxes: (N, 4), x, y, width, height in pixels.
    /// object_ids: (N,). Not needed for a model of one object.
    /// camera, meshes: instead of those of `load`.
    /// depth: (H, W), metres. Poses of objects with a mesh are aligned with it, instead of refined by the network that refines
    ///     poses.
    /// thresholds: thresholds on the expected error, instead of the model's.
    /// two_stages: False uses the poses of the first pass.
    /// refine: False skips the alignment of the outline and the refinement.
    /// passes: maximum number of passes over an object with a mesh. Each pass after the first uses the box of the previous pose.
    ///     This helps with inaccurate boxes.
    /// correct: False skips the correction of aligned poses by the model's systematic error, which was measured on the training
    ///     photographs.
    /// crop_factor: ratio of the crop's side to the longer side of the box.
    ///
    /// The same input and seed give the same result. Ctrl-C interrupts it.
    ///
    /// Raises ValueError for an unknown object, a box without area or outside the image, an image of another size than the
    /// camera's, and depth without meshes.
    #[pyo3(signature = (rgb, boxes, object_ids=None, *, camera=None, meshes=None, depth=None, thresholds=None, two_stages=true, refine=true, passes=1, correct=true, crop_factor=1.5, seed=0))]
    #[allow(clippy::too_many_arguments)]
    fn __call__(
        &self,
        py: Python<'_>,
        rgb: &Bound<'_, PyAny>,
        boxes: &Bound<'_, PyAny>,
        object_ids: Option<&Bound<'_, PyAny>>,
        camera: Option<PyCamera>,
        meshes: Option<BTreeMap<u32, Py<PyMesh>>>,
        depth: Option<&Bound<'_, PyAny>>,
        thresholds: Option<&Bound<'_, PyAny>>,
        two_stages: bool,
        refine: bool,
        passes: i64,
        correct: bool,
        crop_factor: f64,
        seed: i64,
    ) -> PyResult<Vec<Option<Pix2PosePose>>> {
        let image = arrays::rgb("rgb", rgb)?;
        let boxes: Vec<Rect> = arrays::boxes("boxes", boxes)?;
        let camera = camera.or(self.camera);
        let camera = camera.ok_or_else(|| bad("camera", "the image's camera, here or in load", "None"))?;
        let camera = camera.of_image("rgb", image.size())?;
        let ids = match object_ids {
            Some(ids) => arrays::ids("object_ids", ids)?,
            None => match self.estimator.model.objects() {
                [only] => vec![only.id; boxes.len()],
                several => {
                    let known: Vec<String> = several.iter().map(|o| o.id.to_string()).collect();
                    let expected = format!("one id per box out of {}", known.join(", "));
                    return Err(bad("object_ids", expected, "None"));
                }
            },
        };
        if ids.len() != boxes.len() {
            return Err(bad("object_ids", format!("{} ids, 1 per box", boxes.len()), ids.len().to_string()));
        }
        let mut objects = BTreeMap::new();
        for id in &ids {
            let object = self.estimator.object(&Object::of_model(Some(*id)));
            let named = |error| PyValueError::new_err(format!("object_ids: {}", describe(&error)));
            objects.insert(*id, Arc::new(object.map_err(named)?));
        }
        let meshes = match meshes {
            Some(meshes) => meshes_of(&self.estimator, Some(meshes))?,
            None => self.meshes.clone(),
        };
        let depth = depth.map(|d| arrays::depth("depth", d)).transpose()?;
        if let Some(image) = &depth {
            camera.check_image(image.width(), image.height()).map_err(about("depth"))?;
            if meshes.is_empty() {
                return Err(bad("meshes", "the objects' meshes, which alignment with depth needs", "none"));
            }
        }
        let thresholds = match thresholds {
            Some(list) => arrays::numbers("thresholds", list)?.into_iter().map(|t| t as f32).collect(),
            None => Vec::new(),
        };
        let options = Pix2PoseOptions {
            thresholds,
            two_stages,
            crop_factor: positive("crop_factor", crop_factor)?,
            seed: self::seed(seed)?,
            ..Pix2PoseOptions::default()
        };
        let options = AlignOptions {
            estimate: options,
            passes: arrays::whole("passes", passes, 1)?,
            correct,
            ..AlignOptions::default()
        };
        objects.extend(meshes.iter().map(|(id, (object, _))| (*id, object.clone())));
        // The depth image determines a pose better than the refiner does.
        let refiner = self.estimator.refiner.clone().filter(|_| depth.is_none());
        let estimator = Pix2PoseEstimator { options, refine, refiner, ..self.estimator.clone() };
        let prepared = match depth {
            None => None,
            Some(depth) => {
                Some(interruptible(py, move |_| prepare(&depth, &camera))?.map_err(about("depth"))?)
            }
        };
        let found = interruptible(py, move |stop| {
            let mut out: Vec<Option<Posed>> = Vec::with_capacity(boxes.len());
            for (region, object_id) in boxes.iter().zip(ids) {
                stop.check();
                let object = &objects[&object_id];
                let Some(mut pose) = estimator.pose_in_box(&image, &camera, object, region)? else {
                    out.push(None);
                    continue;
                };
                let mut aligned = false;
                if let (Some((_, mesh)), Some(depth)) = (meshes.get(&object_id), &prepared) {
                    let diameter = estimator.model.object(object_id).map(|(_, o)| o.diameter)?;
                    let start = pose.camera_from_object;
                    // With too little depth on the object, the pose from colour is kept.
                    if let Ok(to_depth) = align(depth, mesh, diameter, &start, &pose.found, None) {
                        pose.camera_from_object = to_depth.camera_from_object;
                        aligned = true;
                    }
                }
                out.push(Some(Posed { object_id, pose, aligned }));
            }
            Ok::<_, EstimateError>(out)
        })?;
        let found = found.map_err(|error| {
            let argument = match &error {
                EstimateError::Box(_) | EstimateError::Outside { .. } => "boxes",
                EstimateError::Size { .. } => "rgb",
                EstimateError::Distorted => "camera",
                EstimateError::Model(_) => "object_ids",
                EstimateError::Refiner(_) => "meshes",
            };
            PyValueError::new_err(format!("{argument}: {error}"))
        })?;
        found.into_iter().map(|posed| posed.map(|p| p.into_python(py)).transpose()).collect()
    }

    fn __repr__(&self) -> String {
        let ids: Vec<String> = self.estimator.model.objects().iter().map(|o| o.id.to_string()).collect();
        format!("<Pix2Pose: objects {}>", ids.join(", "))
    }
}
