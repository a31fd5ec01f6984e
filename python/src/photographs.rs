//! Neural Object Learning: `refine_poses` and `synthesize` (`sixfold-nol`; dissertation, chapter 4).

use std::path::PathBuf;
use std::sync::atomic::Ordering;

use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use sixfold::data::PosedImage;
use sixfold::mesh::Mesh;
use sixfold::nn::weights::WeightsError;
use sixfold::nol::SourceView;
use sixfold::nol::agreement::leave_out_what_differs;
use sixfold::nol::model::{ModelError, NolModel};
use sixfold::nol::refine::{PoseRefinementOptions, PosedSource, Refinement, SceneKind, refine_scene};
use sixfold::nol::synthesis::{NewView, ViewMaker, Weighting};

use crate::arrays::{self, bad, whole};
use crate::camera::PyCamera;
use crate::guard::{Leave, Tell, free, os_error, reporting};
use crate::mesh::PyMesh;
use crate::photograph::{PyPhotograph, nol_error};

/// Side of the crops from which new views take their colours, pixels. The command line uses the same value.
const CROP: usize = 256;

fn model_error(error: ModelError) -> PyErr {
    match &error {
        ModelError::Weights(WeightsError::Read { source, .. }) => os_error(source.kind(), error.to_string()),
        _ => PyValueError::new_err(format!("weights: {error}")),
    }
}

/// The refined poses of photographs.
#[pyclass(name = "RefinedPoses", module = "sixfold", frozen)]
pub(crate) struct RefinedPoses {
    refinement: Refinement,
    photographs: Vec<PosedImage>,
}

impl RefinedPoses {
    fn numbers<'py>(
        &self,
        py: Python<'py>,
        of: impl Fn(&sixfold::nol::refine::SourceReport) -> f64,
    ) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_iter(py, self.refinement.sources.iter().map(of))
    }
}

#[pymethods]
impl RefinedPoses {
    /// The refined poses, (N, 4, 4) float64, metres, in the order of the photographs. A dropped photograph keeps its given pose.
    #[getter]
    fn camera_from_object<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let poses: Vec<_> = self.refinement.sources.iter().map(|s| s.camera_from_object).collect();
        arrays::from_poses(py, &poses)
    }

    /// Distance by which the object's origin moved, (N,) float64, metres.
    #[getter]
    fn moved<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.numbers(py, |s| s.moved)
    }

    /// Angle by which the object was rotated, (N,) float64, radians.
    #[getter]
    fn rotated<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.numbers(py, |s| s.rotated)
    }

    /// Mean difference in colour from the other photographs, before and after the refinement, (N, 2) float64, 0 to 1. NaN if
    /// there is nothing to compare.
    #[getter]
    fn differences<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::from_rows(py, self.refinement.sources.iter().map(|s| s.difference).collect())
    }

    /// For each photograph, the reason why it should not be used, or None.
    #[getter]
    fn dropped(&self) -> Vec<Option<String>> {
        self.refinement.sources.iter().map(|s| s.dropped.clone()).collect()
    }

    /// Whether the objects were assumed to have stood still in all photographs.
    #[getter]
    fn still(&self) -> bool {
        self.refinement.still
    }

    /// Number of places at which the objects stood. It is the number of objects if nothing moved or if this is unknown, and
    /// larger if some objects were moved between some of the photographs.
    #[getter]
    fn places(&self) -> usize {
        self.refinement.places
    }

    /// Disagreement of the given poses with one common arrangement, relative to the disagreement that their standard deviation
    /// (rough) explains: 1 is as expected. None if there is nothing to compare.
    #[getter]
    fn disagreement(&self) -> Option<f64> {
        self.refinement.disagreement
    }

    /// The photographs that were not dropped, with their refined poses: a list of Photograph.
    #[getter]
    fn photographs(&self) -> PyResult<Vec<PyPhotograph>> {
        let kept = self.photographs.iter().zip(&self.refinement.sources).filter(|(_, s)| s.dropped.is_none());
        kept.map(|(p, s)| {
            p.with_pose(s.camera_from_object).map(PyPhotograph).map_err(|e| nol_error(e.into()))
        })
        .collect()
    }

    fn __len__(&self) -> usize {
        self.refinement.sources.len()
    }

    fn __repr__(&self) -> String {
        let dropped = self.refinement.sources.iter().filter(|s| s.dropped.is_some()).count();
        format!("<RefinedPoses: {} photographs, {dropped} dropped>", self.refinement.sources.len())
    }
}

/// One mesh or several.
#[derive(FromPyObject)]
enum Meshes<'py> {
    One(Bound<'py, PyMesh>),
    Several(Vec<Bound<'py, PyMesh>>),
}

/// One whole number per photograph, or the default.
fn numbering(
    argument: &str,
    given: Option<&Bound<'_, PyAny>>,
    count: usize,
    default: impl Fn(usize) -> usize,
) -> PyResult<Vec<usize>> {
    let Some(given) = given else { return Ok((0..count).map(default).collect()) };
    let ids = arrays::ids(argument, given)?;
    if ids.len() != count {
        return Err(bad(argument, format!("{count} numbers, one per photograph"), ids.len().to_string()));
    }
    Ok(ids.into_iter().map(|id| id as usize).collect())
}

/// Refines approximate poses of photographs by comparing what the photographs show of the object.
///
/// The method is robust Gauss-Newton over the differences in colour and the outline (after the dissertation, section 4.2.3).
///
/// mesh: the object, or a list of meshes. With a list, objects (N,) gives the index of the mesh that each photograph shows.
/// images (N,): equal numbers for photographs cut out of the same image. Their objects share its camera.
/// scene: "still" if only the camera moved, "moving" if objects may have moved, "judge" to decide from the poses.
/// rough: standard deviations of the given poses, metres and radians.
/// shared: number of rounds at each resolution that search for the error common to all poses of an object. For uniformly painted
///     objects under uniform light.
/// progress: called with the completed fraction, 0 to 1.
/// seed: seed of the surface points that are compared.
///
/// Ctrl-C interrupts it.
///
/// Raises ValueError if there is no photograph, for options out of range, a mesh without faces, a mesh that extends behind a
/// camera, and a mask that does not show the object.
///
/// >>> better = refine_poses(mesh, photographs)  # doctest: +SKIP
/// >>> views = synthesize(mesh, better.photographs, poses, camera)  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (mesh, photographs, *, objects=None, images=None, scene="judge", rough=(0.006, 0.03), shared=0, progress=None, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn refine_poses(
    py: Python<'_>,
    mesh: &Bound<'_, PyAny>,
    photographs: Vec<PyRef<'_, PyPhotograph>>,
    objects: Option<&Bound<'_, PyAny>>,
    images: Option<&Bound<'_, PyAny>>,
    scene: &str,
    rough: (f64, f64),
    shared: i64,
    progress: Option<Py<PyAny>>,
    seed: i64,
) -> PyResult<RefinedPoses> {
    let meshes = match mesh.extract::<Meshes<'_>>() {
        Ok(Meshes::One(mesh)) => vec![mesh.get().mesh.as_ref().clone()],
        Ok(Meshes::Several(meshes)) => meshes.iter().map(|m| m.get().mesh.as_ref().clone()).collect(),
        Err(_) => return Err(bad("mesh", "a Mesh or a list of them", mesh.get_type().to_string())),
    };
    meshes.iter().try_for_each(with_surface)?;
    let photographs = given(&photographs)?;
    let objects = numbering("objects", objects, photographs.len(), |_| 0)?;
    if let Some(wrong) = objects.iter().find(|o| **o >= meshes.len()) {
        return Err(bad("objects", format!("numbers below {}", meshes.len()), wrong.to_string()));
    }
    let images = numbering("images", images, photographs.len(), |number| number)?;
    let kinds = [("judge", SceneKind::Judge), ("still", SceneKind::Still), ("moving", SceneKind::Moving)];
    let kind = kinds.iter().find(|(name, _)| *name == scene);
    let (_, scene) = kind.ok_or_else(|| bad("scene", "judge, still or moving", format!("{scene:?}")))?;
    if !(rough.0 > 0.0 && rough.1 > 0.0 && rough.0.is_finite() && rough.1.is_finite()) {
        return Err(bad("rough", "metres and radians above 0", format!("{rough:?}")));
    }
    let options = PoseRefinementOptions {
        scene: *scene,
        rough: [rough.0, rough.1],
        shared: whole("shared", shared, 0)?,
        seed: arrays::seed(seed)?,
        ..PoseRefinementOptions::default()
    };
    let kept = photographs.clone();
    let refinement = reporting(
        py,
        Leave::AtOnce,
        move |stop, tell: &Tell<f64>| {
            let sources: Vec<PosedSource<'_>> = photographs
                .iter()
                .zip(objects.iter().zip(&images))
                .map(|(photograph, (object, image))| PosedSource {
                    object: *object,
                    image: *image,
                    photograph,
                })
                .collect();
            refine_scene(&sources, &meshes, &options, &|done, total| {
                tell.tell(done as f64 / total as f64);
                !stop.flag().load(Ordering::Relaxed)
            })
        },
        |done| progress.as_ref().map_or(Ok(()), |call| call.call1(py, (done,)).map(drop)),
    )?;
    Ok(RefinedPoses { refinement: refinement.map_err(nol_error)?, photographs: kept })
}

fn with_surface(mesh: &Mesh) -> PyResult<()> {
    if mesh.faces().is_empty() {
        return Err(bad("mesh", "a mesh with faces", "a list of points"));
    }
    Ok(())
}

fn given(photographs: &[PyRef<'_, PyPhotograph>]) -> PyResult<Vec<PosedImage>> {
    if photographs.is_empty() {
        return Err(bad("photographs", "at least one Photograph", "none"));
    }
    Ok(photographs.iter().map(|p| p.0.clone()).collect())
}

/// A synthesized view of an object.
#[pyclass(name = "SynthesizedView", module = "sixfold", frozen)]
pub(crate) struct SynthesizedView {
    /// Colours, (H, W, 3) uint8; black outside the object.
    #[pyo3(get)]
    rgb: Py<PyArray3<u8>>,
    /// Where the object is, (H, W) bool.
    #[pyo3(get)]
    mask: Py<PyArray2<bool>>,
    /// Where the object is but no photograph shows it, (H, W) bool. These pixels are filled from nearby ones.
    #[pyo3(get)]
    unseen: Py<PyArray2<bool>>,
    /// Fraction of the object's pixels that no photograph shows, 0 to 1.
    #[pyo3(get)]
    unseen_fraction: f64,
    /// Indices of the photographs that were used.
    #[pyo3(get)]
    sources: Vec<usize>,
}

impl SynthesizedView {
    fn of(py: Python<'_>, view: NewView) -> PyResult<Self> {
        Ok(SynthesizedView {
            unseen_fraction: view.unseen_fraction(),
            rgb: arrays::from_image_of(py, free(py, || view.patch.to_rgb())?)?.unbind(),
            mask: arrays::from_image(py, view.mask)?.unbind(),
            unseen: arrays::from_image(py, view.unseen)?.unbind(),
            sources: view.sources,
        })
    }
}

#[pymethods]
impl SynthesizedView {
    fn __repr__(&self) -> String {
        format!("<SynthesizedView: {:.0} % unseen>", 100.0 * self.unseen_fraction)
    }
}

/// Renders an object at new poses from photographs of it (Neural Object Learning; dissertation, chapter 4).
///
/// Returns a list of SynthesizedView, one per pose.
///
/// photographs: for example those of the result of refine_poses.
/// poses: camera_from_object of the new views, (N, 4, 4), metres.
/// camera: the camera of the new views.
/// weighting: how the colours of several photographs at one point are combined: "network", "average", or "best" for the
///     photograph with the most frontal view of the point.
/// weights: a file that `train_nol` wrote, instead of the built-in network.
/// per_view: maximum number of photographs used for a view.
/// leave_out: leave out pixels that do not agree with the other photographs.
/// progress: called with the number of completed views and their total.
///
/// Ctrl-C interrupts it.
///
/// Raises ValueError if there is no photograph, for a photograph that does not show the object, a mesh without faces, a mesh that
/// extends behind a camera, and an unknown weighting; OSError if the weights cannot be read.
///
/// >>> [view] = synthesize(mesh, photographs, [pose], camera, weighting="best")  # doctest: +SKIP
/// >>> view.rgb.shape  # doctest: +SKIP
/// (480, 640, 3)
#[pyfunction]
#[pyo3(signature = (mesh, photographs, poses, camera, *, weighting="network", weights=None, per_view=6, leave_out=true, progress=None))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn synthesize(
    py: Python<'_>,
    mesh: &Bound<'_, PyMesh>,
    photographs: Vec<PyRef<'_, PyPhotograph>>,
    poses: &Bound<'_, PyAny>,
    camera: PyCamera,
    weighting: &str,
    weights: Option<PathBuf>,
    per_view: i64,
    leave_out: bool,
    progress: Option<Py<PyAny>>,
) -> PyResult<Vec<SynthesizedView>> {
    let mesh = mesh.get().mesh.clone();
    with_surface(&mesh)?;
    let photographs = given(&photographs)?;
    let poses = arrays::poses("poses", poses)?;
    camera.drawable()?;
    let camera = camera.pinhole()?;
    let per_view = whole("per_view", per_view, 1)?;
    if !["network", "average", "best"].contains(&weighting) {
        return Err(bad("weighting", "network, average or best", format!("{weighting:?}")));
    }
    if weights.is_some() && weighting != "network" {
        return Err(bad("weights", "weighting network, which they belong to", weighting));
    }
    let weighting = weighting.to_owned();
    let views = reporting(
        py,
        Leave::AtOnce,
        move |stop, tell: &Tell<(usize, usize)>| {
            let model = match (weighting.as_str(), weights) {
                ("network", Some(file)) => Some(NolModel::load(&file).map_err(model_error)?),
                ("network", None) => Some(NolModel::shipped().map_err(model_error)?),
                _ => None,
            };
            let weighting = match (&model, weighting.as_str()) {
                (Some(model), _) => Weighting::Network(model),
                (None, "best") => Weighting::Best,
                (None, _) => Weighting::Average,
            };
            let sources = photographs.iter().map(|p| SourceView::new(p, &mesh, CROP));
            let mut sources = sources.collect::<Result<Vec<_>, _>>().map_err(nol_error)?;
            stop.check();
            if leave_out {
                leave_out_what_differs(&mut sources, &mesh);
                stop.check();
            }
            let maker = ViewMaker::new(&mesh, sources, weighting, per_view).map_err(nol_error)?;
            let mut views = Vec::with_capacity(poses.len());
            for pose in &poses {
                stop.check();
                views.push(maker.render(&camera, pose));
                tell.tell((views.len(), poses.len()));
            }
            Ok::<_, PyErr>(views)
        },
        |done| progress.as_ref().map_or(Ok(()), |call| call.call1(py, done).map(drop)),
    )??;
    views.into_iter().map(|view| SynthesizedView::of(py, view)).collect()
}
