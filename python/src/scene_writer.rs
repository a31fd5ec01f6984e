//! `bop.SceneWriter`, `write_models`, `write_targets`, `write_camera`: they write datasets in the BOP format.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Mutex;

use pyo3::prelude::*;
use sixfold::bop::{
    GroundTruth, NewImage, SceneWriter, Target, TargetObject, VISIBILITY_DELTA, ground_truth_visibility,
};
use sixfold::mesh::{ModelsInfo, PlyFormat, Unit, write_ply};

use crate::arrays::{self, bad, id, positive, whole};
use crate::camera::PyCamera;
use crate::guard::{dataset_error, free, mesh_file_error, os_error};
use crate::mesh::PyMesh;

/// Writes a scene of a BOP dataset, for example `path/split/000001`. `add` writes the images. `finish` writes the text files; the
/// end of a with block calls it. Folders are created as needed. Existing text files of the scene are replaced.
///
/// >>> with SceneWriter("out/mine", "train", scene_id=1) as scene:  # doctest: +SKIP
/// ...     scene.add(0, camera, [(8, pose)], rgb=rgb, depth=depth, meshes={8: mesh})
#[pyclass(name = "SceneWriter", module = "sixfold.bop", frozen)]
pub(crate) struct PySceneWriter(Mutex<SceneWriter>);

#[pymethods]
impl PySceneWriter {
    #[new]
    fn new(path: PathBuf, split: &str, scene_id: i64) -> PyResult<Self> {
        Ok(PySceneWriter(Mutex::new(SceneWriter::new(&path, split, id("scene_id", scene_id)?))))
    }

    /// Writes the files of an image and keeps its entries of the text files for `finish`.
    ///
    /// camera: the camera, without distortion.
    /// objects: the ground truth, [(obj_id, camera_from_object (4, 4)), ...].
    /// rgb: (H, W, 3) uint8.
    /// depth: (H, W), metres. It is written in steps of mm_per_unit millimetres (BOP's depth_scale); 16 bits reach 6.5 m with
    ///     0.1.
    /// camera_from_world: (4, 4), if there is a world frame.
    /// meshes: {obj_id: Mesh} of all objects in the image. If given, masks, boxes and visibility as defined by BOP are also
    ///     written.
    ///
    /// Raises ValueError for a camera with distortion, an image of another size than the camera's and a missing mesh; OSError if
    /// a file cannot be written.
    #[pyo3(signature = (im_id, camera, objects, *, rgb=None, depth=None, mm_per_unit=0.1, camera_from_world=None, meshes=None))]
    #[allow(clippy::too_many_arguments)]
    fn add(
        &self,
        py: Python<'_>,
        im_id: i64,
        camera: PyCamera,
        objects: &Bound<'_, PyAny>,
        rgb: Option<&Bound<'_, PyAny>>,
        depth: Option<&Bound<'_, PyAny>>,
        mm_per_unit: f64,
        camera_from_world: Option<&Bound<'_, PyAny>>,
        meshes: Option<BTreeMap<u32, Py<PyMesh>>>,
    ) -> PyResult<()> {
        let im_id = id("im_id", im_id)?;
        let camera = camera.pinhole()?;
        let expected = "a list of pairs (obj_id, camera_from_object)";
        let objects: Vec<(i64, Bound<'_, PyAny>)> =
            objects.extract().map_err(|_| bad("objects", expected, objects.get_type().to_string()))?;
        let ground_truth = objects
            .iter()
            .map(|(object, pose)| {
                Ok(GroundTruth::new(id("objects", *object)?, arrays::pose("objects", pose)?))
            })
            .collect::<PyResult<Vec<_>>>()?;
        let rgb = rgb.map(|image| arrays::rgb("rgb", image)).transpose()?;
        let depth = depth.map(|image| arrays::depth("depth", image)).transpose()?;
        let size = (camera.width, camera.height);
        let sizes = [("rgb", rgb.as_ref().map(|i| i.size())), ("depth", depth.as_ref().map(|i| i.size()))];
        for (argument, found) in sizes {
            if let Some(found) = found.filter(|found| *found != size) {
                let expected = format!("an image of the camera's {}x{} pixels", size.0, size.1);
                return Err(bad(argument, expected, format!("{}x{}", found.0, found.1)));
            }
        }
        let depth_scale = positive("mm_per_unit", mm_per_unit)? / 1000.0;
        let camera_from_world =
            camera_from_world.map(|pose| arrays::pose("camera_from_world", pose)).transpose()?;
        let meshes = meshes
            .map(|meshes| {
                let mesh_of = |truth: &GroundTruth| match meshes.get(&truth.obj_id) {
                    Some(mesh) => Ok(mesh.get().mesh.clone()),
                    None => Err(bad("meshes", format!("one of object {}", truth.obj_id), "none")),
                };
                PyCamera(camera).drawable()?;
                ground_truth.iter().map(mesh_of).collect::<PyResult<Vec<_>>>()
            })
            .transpose()?;
        free(py, || {
            let (mut info, mut masks, mut masks_visible) = (vec![], vec![], vec![]);
            if let Some(meshes) = &meshes {
                let posed: Vec<_> = meshes
                    .iter()
                    .zip(&ground_truth)
                    .map(|(m, g)| (m.as_ref(), g.camera_from_object))
                    .collect();
                for seen in ground_truth_visibility(&posed, &camera, depth.as_ref(), VISIBILITY_DELTA) {
                    info.push(seen.info);
                    masks.push(seen.mask);
                    masks_visible.push(seen.mask_visible);
                }
            }
            let known = meshes.is_some();
            let image = NewImage {
                depth_scale,
                camera_from_world,
                rgb: rgb.as_ref(),
                depth: depth.as_ref(),
                ground_truth: &ground_truth,
                info: known.then_some(&info),
                masks: known.then_some(&masks),
                masks_visible: known.then_some(&masks_visible),
                ..NewImage::new(im_id, &camera)
            };
            self.writer().add(&image)
        })?
        .map_err(dataset_error)
    }

    /// Writes scene_camera.json, scene_gt.json and, if meshes were given, scene_gt_info.json. It may be called at any time to
    /// save the images written so far.
    ///
    /// Raises OSError if a file cannot be written.
    fn finish(&self, py: Python<'_>) -> PyResult<()> {
        free(py, || self.writer().finish())?.map_err(dataset_error)
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_error))]
    fn __exit__(&self, py: Python<'_>, _error: &Bound<'_, pyo3::types::PyTuple>) -> PyResult<bool> {
        self.finish(py)?;
        Ok(false)
    }
}

impl PySceneWriter {
    fn writer(&self) -> std::sync::MutexGuard<'_, SceneWriter> {
        self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

/// Writes the models of a dataset, {obj_id: Mesh}, with their diameters and symmetries: path/models/obj_000001.ply and so on, in
/// millimetres, and models_info.json.
///
/// Raises OSError if a file cannot be written.
///
/// >>> write_models("out/mine", {8: mesh})  # doctest: +SKIP
#[pyfunction]
fn write_models(py: Python<'_>, path: PathBuf, meshes: BTreeMap<u32, Py<PyMesh>>) -> PyResult<()> {
    let meshes: Vec<_> =
        meshes.iter().map(|(id, mesh)| (*id, mesh.get().mesh.clone(), mesh.get().info())).collect();
    let folder = path.join("models");
    let made = free(py, || std::fs::create_dir_all(&folder))?;
    made.map_err(|error| os_error(error.kind(), format!("{}: {error}", folder.display())))?;
    let written = free(py, || {
        let mut infos = ModelsInfo::default();
        for (id, mesh, info) in meshes {
            let path = folder.join(format!("obj_{id:06}.ply"));
            write_ply(&path, &mesh, Unit::Millimetre, PlyFormat::BinaryLittleEndian)?;
            infos.0.insert(id, info);
        }
        infos.write(folder.join("models_info.json"))
    })?;
    written.map_err(mesh_file_error)
}

/// Writes a targets file, which lists the objects to find: [(scene_id, im_id, obj_id, count), ...], as returned by
/// Dataset.targets.
///
/// Raises OSError if the file cannot be written.
///
/// >>> write_targets("out/mine/test_targets_bop19.json", [(1, 0, 8, 1)])  # doctest: +SKIP
#[pyfunction]
fn write_targets(py: Python<'_>, path: PathBuf, targets: Vec<(i64, i64, i64, i64)>) -> PyResult<()> {
    let target = |(scene_id, im_id, obj_id, count)| {
        let object = TargetObject { obj_id: id("targets", obj_id)?, inst_count: whole("targets", count, 1)? };
        let (scene_id, im_id) = (id("targets", scene_id)?, id("targets", im_id)?);
        Ok(Target { scene_id, im_id, object: Some(object) })
    };
    let targets = targets.into_iter().map(target).collect::<PyResult<Vec<_>>>()?;
    free(py, || sixfold::bop::write_targets(&path, &targets))?.map_err(dataset_error)
}

/// Writes the camera.json of a dataset into the folder `path`. mm_per_unit is BOP's depth_scale.
///
/// Raises ValueError for a camera with distortion; OSError if the file cannot be written.
///
/// >>> write_camera("out/mine", Camera(572, 573, 325, 242, 640, 480), mm_per_unit=0.1)  # doctest: +SKIP
#[pyfunction]
fn write_camera(py: Python<'_>, path: PathBuf, camera: PyCamera, mm_per_unit: f64) -> PyResult<()> {
    let (camera, scale) = (camera.pinhole()?, positive("mm_per_unit", mm_per_unit)? / 1000.0);
    free(py, || sixfold::bop::write_camera(&path, &camera, scale))?.map_err(dataset_error)
}

/// Adds the classes and functions of this file to `sixfold.bop`.
pub(crate) fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<PySceneWriter>()?;
    module.add_function(wrap_pyfunction!(write_models, module)?)?;
    module.add_function(wrap_pyfunction!(write_targets, module)?)?;
    module.add_function(wrap_pyfunction!(write_camera, module)?)
}
