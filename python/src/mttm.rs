//! `Templates`, `Mttm` and `estimate_mttm`: find objects in depth images by templates, with or without a mesh, and without training
//! on them (`sixfold-mttm`).

use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use sixfold::geometry::{Camera, DepthImage, Mask, Pose};
use sixfold::mttm::mask::to_image;
use sixfold::mttm::mask_check::{WORTH_A_WARNING, check_mask};
use sixfold::mttm::model::{ModelError, MttmModel};
use sixfold::mttm::{
    DepthView, KnownObject, MatchedBy, MttmOptions, ObjectTemplates, SIDE, Source, StoreError, TemplateError,
    TemplateOptions, ViewCoverage, estimate,
};

use crate::arrays::{self, bad, whole};
use crate::camera::PyCamera;
use crate::guard::{interruptible, os_error};
use crate::mesh::PyMesh;
use crate::ppf::{rendered_of, scene_of, verification_to_python};
use crate::training::file_or_value;

fn template_error(argument: &str, error: &TemplateError) -> PyErr {
    PyValueError::new_err(format!("{argument}: {error}"))
}

fn file_error(error: StoreError) -> PyErr {
    match &error {
        StoreError::Io { source, .. } => os_error(source.kind(), error.to_string()),
        _ => PyValueError::new_err(error.to_string()),
    }
}

/// Templates of an object: its depth from many sides, as patches of a fixed metric size. Created by `from_mesh`, `from_depth` or
/// `load`; nothing is trained.
///
/// >>> cube = Mesh([[x, y, z] for x in (0, .06) for y in (0, .08) for z in (0, .1)]).convex_hull()
/// >>> templates = Templates.from_mesh(cube)
/// >>> len(templates), templates.source
/// (305, 'mesh')
#[pyclass(name = "Templates", module = "sixfold", frozen)]
pub(crate) struct PyTemplates(Arc<ObjectTemplates>);

/// A view as given.
struct View {
    depth: DepthImage,
    camera: Camera,
    mask: Mask,
    pose: Option<Pose>,
}

#[pymethods]
impl PyTemplates {
    /// Renders templates of a mesh from many directions.
    ///
    /// coverage: "above" for objects that stand on a table with their z axis up, seen from above by a camera held upright within 45
    /// degrees (305 views); "around" for all directions and any roll of the camera (642 views). Ctrl-C interrupts it.
    ///
    /// Raises ValueError for a mesh without faces and another coverage.
    #[staticmethod]
    #[pyo3(signature = (mesh, *, coverage="above"))]
    fn from_mesh(py: Python<'_>, mesh: &Bound<'_, PyMesh>, coverage: &str) -> PyResult<Self> {
        let coverage = self::coverage("coverage", coverage)?;
        let options = TemplateOptions { coverage, ..TemplateOptions::default() };
        let mesh = mesh.get().mesh.clone();
        let made = interruptible(py, move |_| ObjectTemplates::from_mesh(&mesh, &options))?;
        made.map(|t| PyTemplates(Arc::new(t))).map_err(|error| template_error("mesh", &error))
    }

    /// Cuts templates of an object without a mesh out of depth images; one view is enough to search for it.
    ///
    /// views: tuples (depth, camera, mask) or (depth, camera, mask, camera_from_object), the same form for all: depth (H, W) in
    /// metres, without lens distortion; mask (H, W) bool; pose (4, 4). Without poses every view has an object frame of its own:
    /// parallel to its view frame, with the origin at the centroid of the visible points. Poses found with the view are those of
    /// this frame.
    ///
    /// check_masks: leaves out the pixels of the masks that, by their depth, do not show the object: those on the table around it
    /// and on surfaces beyond a depth edge. Warns from 3 % of a mask on.
    ///
    /// Raises ValueError for no view; a mask of another size, with too little depth or, with check_masks, of which more than a
    /// third would be left out; an object smaller than 1.5 cm or larger than 60 cm; poses for some views only.
    #[staticmethod]
    #[pyo3(signature = (views, *, check_masks=true))]
    fn from_depth(py: Python<'_>, views: Vec<Bound<'_, PyAny>>, check_masks: bool) -> PyResult<Self> {
        let mut views = views.iter().enumerate().map(|(i, v)| view_of(i, v)).collect::<PyResult<Vec<_>>>()?;
        if check_masks {
            views = checked(py, views)?;
        }
        let made = interruptible(py, move |_| {
            let borrowed: Vec<DepthView<'_>> = views
                .iter()
                .map(|v| DepthView {
                    depth: &v.depth,
                    camera: &v.camera,
                    mask: &v.mask,
                    camera_from_object: v.pose,
                })
                .collect();
            ObjectTemplates::from_depth(&borrowed, &TemplateOptions::default())
        })?;
        made.map(|t| PyTemplates(Arc::new(t))).map_err(|error| template_error("views", &error))
    }

    /// Reads a file written by `save` or `sixfold object add`.
    ///
    /// Raises OSError when it cannot be read, ValueError when it is damaged or of another version.
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let read = interruptible(py, move |_| ObjectTemplates::read(&path))?;
        read.map(|t| PyTemplates(Arc::new(t))).map_err(file_error)
    }

    /// Writes a file; an existing one stays until the new one is complete.
    ///
    /// Raises OSError when it cannot be written.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        let templates = self.0.clone();
        interruptible(py, move |_| templates.write(&path))?.map_err(file_error)
    }

    /// Diameter of the object, metres; for objects from depth images the largest visible extent.
    #[getter]
    fn diameter(&self) -> f64 {
        self.0.diameter
    }

    /// Side of a patch at the object's distance, metres.
    #[getter]
    fn size(&self) -> f64 {
        self.0.size
    }

    /// What the templates were made from: "mesh", "posed depth", or "depth", where every view has an object frame of its own.
    #[getter]
    fn source(&self) -> &'static str {
        match self.0.source {
            Source::Mesh => "mesh",
            Source::PosedDepth => "posed depth",
            Source::Depth => "depth",
        }
    }

    /// Transformations from the object's frame to each view frame (origin at a point of the surface, z along the ray through it),
    /// (N, 4, 4) float64.
    #[getter]
    fn view_from_object<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let poses: Vec<Pose> = self.0.templates.iter().map(|t| t.view_from_object).collect();
        arrays::from_poses(py, &poses)
    }

    /// Depth relative to the origin of the view frame, (N, 64, 64) float32, metres; NaN where the object is not visible.
    #[getter]
    fn patches<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let relative = self.0.templates.iter().flat_map(|t| {
            (0..SIDE * SIDE).map(|i| t.relative_depth(i % SIDE, i / SIDE).map_or(f32::NAN, |z| z as f32))
        });
        PyArray1::from_vec(py, relative.collect()).reshape([self.0.templates.len(), SIDE, SIDE])
    }

    fn __len__(&self) -> usize {
        self.0.templates.len()
    }

    fn __repr__(&self) -> String {
        format!(
            "<Templates: {} views from {}, {:.3} m>",
            self.0.templates.len(),
            self.source(),
            self.0.diameter
        )
    }
}

/// The views with their masks reduced to the pixels that, by their depth, show the object; warns where much is left out.
fn checked(py: Python<'_>, views: Vec<View>) -> PyResult<Vec<View>> {
    let checked = interruptible(py, move |_| {
        let checked = views.into_iter().map(|view| (check_mask(&view.depth, &view.camera, &view.mask), view));
        checked.collect::<Vec<_>>()
    })?;
    let mut views = vec![];
    for (number, (checked, view)) in checked.into_iter().enumerate() {
        let checked = checked.map_err(|error| match &error {
            TemplateError::MaskTooLarge { .. } => {
                let name = format!("views[{number}] (check_masks=False takes masks as they are)");
                template_error(&name, &error)
            }
            _ => template_error("views", &error),
        })?;
        if checked.left_out() >= WORTH_A_WARNING {
            let text = format!(
                "views[{number}]: left out {:.0} % of the mask on the plane around the object and {:.0} % beyond a depth edge",
                100.0 * checked.on_plane,
                100.0 * checked.beyond_edges
            );
            py.import("warnings")?.call_method1("warn", (text,))?;
        }
        views.push(View { mask: checked.mask, ..view });
    }
    Ok(views)
}

fn view_of(number: usize, view: &Bound<'_, PyAny>) -> PyResult<View> {
    let expected = "a tuple (depth, camera, mask) or (depth, camera, mask, camera_from_object)";
    let name = format!("views[{number}]");
    let wrong = |found: String| bad(&name, expected, found);
    let parts = view.cast::<PyTuple>().map_err(|_| wrong(view.get_type().to_string()))?;
    if !(3..=4).contains(&parts.len()) {
        return Err(wrong(format!("{} things", parts.len())));
    }
    let depth = arrays::depth(&format!("{name}: depth"), &parts.get_item(0)?)?;
    let camera = parts.get_item(1)?;
    let camera: PyCamera =
        camera.extract().map_err(|_| wrong(format!("{} instead of the camera", camera.get_type())))?;
    let camera = camera.of_image("views", depth.size())?;
    let mask = arrays::mask(&format!("{name}: mask"), &parts.get_item(2)?)?;
    let pose = match parts.len() {
        4 => Some(arrays::pose("views", &parts.get_item(3)?)?),
        _ => None,
    };
    Ok(View { depth, camera, mask, pose })
}

/// The directions from which templates are rendered, by name.
pub(crate) fn coverage(argument: &str, name: &str) -> PyResult<ViewCoverage> {
    let known = [ViewCoverage::Above, ViewCoverage::Around];
    known.into_iter().find(|c| c.name() == name).ok_or_else(|| {
        bad(argument, known.map(|c| format!("{:?}", c.name())).join(" or "), format!("{name:?}"))
    })
}

/// How regions are matched with templates, by name.
const MATCHERS: [(&str, MatchedBy); 3] =
    [("points", MatchedBy::Points), ("network", MatchedBy::Network), ("both", MatchedBy::Both)];

/// How regions are matched, by name.
pub(crate) fn matched_by(matcher: &str) -> PyResult<MatchedBy> {
    let known = MATCHERS.into_iter().find(|(name, _)| *name == matcher);
    known.map(|(_, by)| by).ok_or_else(|| {
        bad("matcher", MATCHERS.map(|(name, _)| format!("{name:?}")).join(" or "), format!("{matcher:?}"))
    })
}

/// The network in the package, read once, or that of a file.
pub(crate) fn network(weights: Option<PathBuf>) -> Result<Arc<MttmModel>, ModelError> {
    static SHIPPED: OnceLock<Arc<MttmModel>> = OnceLock::new();
    match (weights, SHIPPED.get()) {
        (Some(file), _) => MttmModel::load(&file).map(Arc::new),
        (None, Some(model)) => Ok(model.clone()),
        (None, None) => {
            let model = Arc::new(MttmModel::shipped()?);
            Ok(SHIPPED.get_or_init(|| model).clone())
        }
    }
}

/// An object prepared for the search by templates (dissertation, chapter 5). Prepared once, used for any number of images.
///
/// templates: Templates, or a Mesh, of which templates from above are made first. mesh: a Mesh or PpfModel of the object, with
/// which poses are refined and verified; without it (and with Templates), only the templates are used. matcher: how regions of the
/// image are matched with templates: "points" compares them point by point, "network" uses only a network's descriptors (as the
/// dissertation does), "both" uses both. The built-in network was trained on synthetic objects; weights: another one, a file
/// written by `train_mttm` or `sixfold train mttm`. cache: a file with the network's descriptors of the templates; it is read if it
/// belongs to network and templates, otherwise computed and written.
///
/// Raises ValueError for a mesh without faces, another matcher, weights or cache with matcher="points", or a file that is not such
/// a network; OSError when it cannot be read. Ctrl-C interrupts it.
///
/// >>> known = Mttm(Templates.load("mug.sixfold-templates"), matcher="both")  # doctest: +SKIP
/// >>> estimate_mttm(depth, known, camera)[0].camera_from_object  # doctest: +SKIP
#[pyclass(name = "Mttm", module = "sixfold", frozen)]
pub(crate) struct Mttm {
    known: Arc<KnownObject>,
    matched_by: MatchedBy,
    /// Why `cache` could not be read or written; None otherwise, also if it is new or was made for other templates or another
    /// network.
    #[pyo3(get)]
    cache_note: Option<String>,
}

#[pymethods]
impl Mttm {
    #[new]
    #[pyo3(signature = (templates, mesh=None, *, matcher="both", weights=None, cache=None))]
    fn new(
        py: Python<'_>,
        templates: &Bound<'_, PyAny>,
        mesh: Option<&Bound<'_, PyAny>>,
        matcher: &str,
        weights: Option<PathBuf>,
        cache: Option<PathBuf>,
    ) -> PyResult<Self> {
        let matched_by = matched_by(matcher)?;
        for (argument, file) in [("weights", &weights), ("cache", &cache)] {
            if let (MatchedBy::Points, Some(file)) = (matched_by, file) {
                return Err(bad(argument, "None with matcher=\"points\"", file.display().to_string()));
            }
        }
        let (templates, mesh) = if let Ok(templates) = templates.cast::<PyTemplates>() {
            (templates.get().0.clone(), mesh)
        } else if let Ok(own) = templates.cast::<PyMesh>() {
            (PyTemplates::from_mesh(py, own, "above")?.0, Some(mesh.unwrap_or(templates)))
        } else {
            return Err(bad("templates", "Templates or a Mesh", templates.get_type().to_string()));
        };
        let rendered = mesh.map(|mesh| rendered_of(py, "mesh", mesh)).transpose()?;
        let made = interruptible(py, move |_| -> Result<_, ModelError> {
            let network = (matched_by != MatchedBy::Points).then(|| network(weights)).transpose()?;
            let known = KnownObject::new(ObjectTemplates::clone(&templates), rendered);
            Ok(match (network, cache) {
                (None, _) => (known, None),
                (Some(network), None) => (known.with_network(network), None),
                (Some(network), Some(file)) => known.with_network_cached(network, &file),
            })
        })?;
        let (known, note) = made.map_err(|error| file_or_value(&error))?;
        Ok(Mttm { known: Arc::new(known), matched_by, cache_note: note.map(|n| n.to_string()) })
    }

    /// The templates.
    #[getter]
    fn templates(&self) -> PyTemplates {
        PyTemplates(Arc::new(self.known.templates().clone()))
    }

    /// Whether poses are refined and verified with a mesh.
    #[getter]
    fn has_mesh(&self) -> bool {
        self.known.has_mesh()
    }

    /// How regions are matched with templates: "points", "network" or "both".
    #[getter]
    fn matcher(&self) -> &'static str {
        MATCHERS.iter().find(|(_, matched_by)| *matched_by == self.matched_by).map_or("", |(name, _)| name)
    }

    fn __repr__(&self) -> String {
        let verified = if self.known.has_mesh() { "a mesh" } else { "templates alone" };
        let views = self.known.templates().templates.len();
        format!("<Mttm: {views} views matched by {}, verified by {verified}>", self.matcher())
    }
}

/// A pose found by templates.
#[pyclass(name = "MttmEstimate", module = "sixfold", frozen)]
pub(crate) struct MttmEstimate {
    /// The pose, (4, 4) float64, metres; for views without poses, that of the matched view's own object frame.
    #[pyo3(get)]
    camera_from_object: Py<PyArray2<f64>>,
    /// Confidence, 0 to 1, by which estimates are ranked.
    #[pyo3(get)]
    confidence: f64,
    /// Index of the matched template.
    #[pyo3(get)]
    template: usize,
    /// Pixels of the object according to the matched template, (H, W) bool.
    #[pyo3(get)]
    mask: Py<PyArray2<bool>>,
    /// Scores of the verification with the mesh, or with the template if there is no mesh, a dict: rendered, inliers, occluded,
    /// outliers (pixels); depth, boundary, normals, total, visible_fraction (0 to 1).
    #[pyo3(get)]
    verification: Py<PyDict>,
}

#[pymethods]
impl MttmEstimate {
    fn __repr__(&self) -> String {
        format!("<MttmEstimate: confidence {:.3}, template {}>", self.confidence, self.template)
    }
}

/// Finds an object in a depth image by its templates, without training on it (dissertation, chapter 5). Returns a list of
/// MttmEstimate, best first; empty if none reaches a confidence of min_score.
///
/// scene: a PpfScene, or depth (H, W) in metres with `camera` (and `mask` (H, W) bool: where objects may be). model: an Mttm, or
/// Templates or a Mesh, which are prepared first (with matcher "both"). instances: maximum number of poses. The same input gives
/// the same result for any number of threads. Ctrl-C interrupts it.
///
/// Raises ValueError for images of different sizes, a mesh without faces, and a depth image in the wrong unit or without any value.
///
/// >>> found = estimate_mttm(depth, Templates.from_depth([(seen, camera, mask)]), camera)  # doctest: +SKIP
/// >>> found[0].mask.sum()  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (scene, model, camera=None, mask=None, *, instances=1, min_score=0.45, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn estimate_mttm(
    py: Python<'_>,
    scene: &Bound<'_, PyAny>,
    model: &Bound<'_, PyAny>,
    camera: Option<PyCamera>,
    mask: Option<&Bound<'_, PyAny>>,
    instances: i64,
    min_score: f64,
    seed: i64,
) -> PyResult<Vec<MttmEstimate>> {
    if !(0.0..=1.0).contains(&min_score) {
        return Err(bad("min_score", "a number from 0 to 1", min_score.to_string()));
    }
    let max_instances = whole("instances", instances, 1)?;
    let scene = scene_of(py, scene, camera, mask, seed)?;
    let (known, matched_by) = match model.cast::<Mttm>() {
        Ok(known) => (known.get().known.clone(), known.get().matched_by),
        Err(_) if model.is_instance_of::<PyTemplates>() || model.is_instance_of::<PyMesh>() => {
            let made = Mttm::new(py, model, None, "both", None, None)?;
            (made.known, made.matched_by)
        }
        Err(_) => return Err(bad("model", "an Mttm, Templates or a Mesh", model.get_type().to_string())),
    };
    let options = MttmOptions { matched_by, max_instances, min_score, ..MttmOptions::default() };
    let options = options.for_templates(known.templates());
    let size = scene.depth().size();
    let found = interruptible(py, move |_| estimate(&scene, &known, &options).0)?;
    found
        .into_iter()
        .map(|e| {
            Ok(MttmEstimate {
                camera_from_object: arrays::from_pose(py, &e.camera_from_object)?.unbind(),
                confidence: e.confidence,
                template: e.template,
                mask: arrays::from_image(py, to_image(&e.mask, size.0, size.1))?.unbind(),
                verification: verification_to_python(py, &e.score)?,
            })
        })
        .collect()
}
