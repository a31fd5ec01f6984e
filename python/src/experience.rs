//! `ExperienceStore`: successful grasps, kept in one file (`sixfold-dgcm`).

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use sixfold::dgcm::model::DgcmModel;
use sixfold::dgcm::transfer::Memory;
use sixfold::experience::{
    Description, Experience, ExperienceStore as _, FEATURE, Match, SqliteStore, StoreError, StorePlace,
    Summary,
};
use sixfold::grasp::{AntipodalQuality, Grasp};

use crate::arrays::{self, about, bad, whole};
use crate::bop::json_to_python;
use crate::camera::PyCamera;
use crate::dgcm_net::{DepthInput, network_of};
use crate::experienced::PyExperience;
use crate::grasp::PyGrasp;
use crate::gripper::gripper_of;
use crate::guard::{Stop, image_error, interruptible, os_error};

/// The Python exception for an error of a store.
pub(crate) fn store_error(error: StoreError) -> PyErr {
    use std::io::ErrorKind;
    let text = error.to_string();
    match &error {
        StoreError::Open { file, .. } if !file.exists() => os_error(ErrorKind::NotFound, text),
        StoreError::ReadOnly { .. } => os_error(ErrorKind::PermissionDenied, text),
        StoreError::Open { .. }
        | StoreError::Full { .. }
        | StoreError::Busy { .. }
        | StoreError::Other { .. } => os_error(ErrorKind::Other, text),
        _ => PyValueError::new_err(text),
    }
}

/// The opened file. After the first search, also all features of one network in memory.
pub(crate) struct Opened {
    path: PathBuf,
    store: SqliteStore,
    memory: Option<(String, Memory)>,
}

impl Opened {
    /// The experiences of a network, including those that other processes have stored meanwhile.
    pub(crate) fn memory(&mut self, model: &DgcmModel) -> Result<&mut Memory, StoreError> {
        let name = model.fingerprint();
        let kept = self.memory.take().filter(|(network, _)| *network == name);
        let memory = match kept {
            Some((_, mut memory)) => {
                memory.refresh()?;
                memory
            }
            None => Memory::new(Box::new(SqliteStore::open(&self.path)?), model)?,
        };
        Ok(&mut self.memory.insert((name, memory)).1)
    }
}

/// A store of successful grasps, each with the camera's view of its object (dissertation, section 6.2.1).
/// `propose_grasps(..., experiences=store)` transfers the grasps to other objects. A store is one file, which several processes may
/// use at the same time.
///
/// path: the file; it is created if it does not exist, unless create is False. weights: a DgcmNet, or the path of its weight file;
/// needed to add and compare experiences. Without it the store can be listed, merged and exported.
///
/// Raises FileNotFoundError or OSError for a file that cannot be opened; ValueError for a file that is not a store.
///
/// >>> import tempfile
/// >>> with tempfile.TemporaryDirectory() as folder:
/// ...     store = ExperienceStore(folder + "/experience.db")
/// ...     len(store)
/// 0
#[pyclass(name = "ExperienceStore", module = "sixfold", frozen)]
pub(crate) struct ExperienceStore {
    path: PathBuf,
    network: Option<Arc<DgcmModel>>,
    opened: Arc<Mutex<Opened>>,
}

impl ExperienceStore {
    /// The network given in a call, or otherwise that of the store.
    pub(crate) fn network(
        &self,
        py: Python<'_>,
        weights: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Arc<DgcmModel>> {
        if let Some(weights) = weights {
            return network_of(py, weights);
        }
        self.network.clone().ok_or_else(|| {
            bad("weights", "a DgcmNet or the path of its file, here or with the store", "None")
        })
    }

    pub(crate) fn share(&self) -> Arc<Mutex<Opened>> {
        self.opened.clone()
    }

    /// Runs work on the opened store without the interpreter lock.
    fn with<T: Send + 'static>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut Opened, &Stop) -> Result<T, StoreError> + Send + 'static,
    ) -> PyResult<T> {
        let opened = self.opened.clone();
        interruptible(py, move |stop| work(&mut lock(&opened), stop))?.map_err(store_error)
    }
}

/// Locks the store, also after a call that ended in a panic. Features in memory are read again when they are needed.
pub(crate) fn lock(opened: &Mutex<Opened>) -> MutexGuard<'_, Opened> {
    opened.lock().unwrap_or_else(PoisonError::into_inner)
}

#[pymethods]
impl ExperienceStore {
    #[new]
    #[pyo3(signature = (path, weights=None, *, create=true))]
    fn new(
        py: Python<'_>,
        path: PathBuf,
        weights: Option<&Bound<'_, PyAny>>,
        create: bool,
    ) -> PyResult<Self> {
        let network = weights.map(|w| network_of(py, w)).transpose()?;
        let path = file_of("path", path)?;
        let file = path.clone();
        let open = move |_: &Stop| if create { SqliteStore::create(&file) } else { SqliteStore::open(&file) };
        let store = interruptible(py, open)?.map_err(store_error)?;
        let opened = Arc::new(Mutex::new(Opened { path: path.clone(), store, memory: None }));
        Ok(ExperienceStore { path, network, opened })
    }

    /// The file.
    #[getter]
    fn path(&self) -> &Path {
        &self.path
    }

    fn __len__(&self, py: Python<'_>) -> PyResult<usize> {
        self.with(py, |opened, _| opened.store.list().map(|all| all.len()))
    }

    /// Stores a successful grasp. Returns the experience's number, and True if it is new or False if it was stored before. When the
    /// call returns, the experience is on disk.
    ///
    /// depth: (H, W), metres, without lens distortion. mask: (H, W) bool, the object's pixels. grasp: a Grasp, or
    /// camera_from_gripper (4, 4), metres, together with opening (distance of the pads before closing) and width (distance of the
    /// contacts), both in metres. object: the name of the grasped object. part: the part that was grasped, such as "handle".
    /// provenance: where the experience comes from, as text. Ctrl-C interrupts it.
    ///
    /// Raises ValueError for a mask without depth, a gripper that is not near the object, or a store without a network.
    #[pyo3(signature = (depth, camera, mask, grasp, *, object, part=None, gripper=None, opening=None, width=None, provenance="added by hand", weights=None, seed=0))]
    #[allow(clippy::too_many_arguments)]
    fn add(
        &self,
        py: Python<'_>,
        depth: &Bound<'_, PyAny>,
        camera: PyCamera,
        mask: &Bound<'_, PyAny>,
        grasp: &Bound<'_, PyAny>,
        object: String,
        part: Option<String>,
        gripper: Option<&Bound<'_, PyAny>>,
        opening: Option<f64>,
        width: Option<f64>,
        provenance: &str,
        weights: Option<&Bound<'_, PyAny>>,
        seed: i64,
    ) -> PyResult<(i64, bool)> {
        let input = DepthInput::new(depth, camera, mask, seed)?;
        let grasp = grasp_of(grasp, opening, width)?;
        let gripper = gripper_of(gripper)?;
        let model = self.network(py, weights)?;
        let (provenance, time) = (provenance.to_owned(), now());
        let made = interruptible(py, move |_| {
            let crop = input.crop(&model)?;
            let part = part.as_deref();
            let experience =
                Experience::new(model.as_ref(), crop, &grasp, &gripper, &object, part, time, &provenance);
            if !experience.region.contains(&true) {
                let expected = "a gripper at the object, in metres in the camera's frame";
                return Err(bad("grasp", expected, "one that is nowhere near it"));
            }
            Ok(experience)
        })??;
        self.with(py, move |opened, _| opened.store.add(&made))
    }

    /// Lists all experiences in the order of their numbers: dicts with id, time (seconds since 1970), object, part, gripper, width
    /// (metres), network and provenance.
    fn list<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        json_to_python(py, &self.with(py, |opened, _| opened.store.list())?)
    }

    /// The experience with this number, or None.
    ///
    /// Raises ValueError when it cannot be read.
    fn get(&self, py: Python<'_>, id: i64) -> PyResult<Option<PyExperience>> {
        let stored = self.with(py, move |opened, _| opened.store.get(id))?;
        Ok(stored.map(PyExperience::new))
    }

    /// Removes an experience; False if there was none with this number. Numbers are never reused.
    fn forget(&self, py: Python<'_>, id: i64) -> PyResult<bool> {
        self.with(py, move |opened, _| opened.store.forget(id))
    }

    /// Copies the experiences of another store that are missing here. Returns the number of new experiences.
    ///
    /// other: the path of that store. Ctrl-C interrupts it; experiences copied until then are kept.
    ///
    /// Raises OSError or ValueError when the other file cannot be read.
    fn merge(&self, py: Python<'_>, other: PathBuf) -> PyResult<usize> {
        let other = file_of("other", other)?;
        self.with(py, move |opened, stop| {
            let source = SqliteStore::open(&other)?;
            let mut added = 0;
            for summary in source.list()? {
                stop.check();
                if let Some(stored) = source.get(summary.id)? {
                    added += usize::from(opened.store.add(&stored.experience)?.1);
                }
            }
            Ok(added)
        })
    }

    /// Encodes all experiences with another network and adds them to another store. Returns the number of new experiences there.
    ///
    /// out: the path of that store, which is created if it does not exist. weights: a DgcmNet or the path of its weight file.
    /// Ctrl-C interrupts it; experiences encoded until then are kept.
    ///
    /// Raises ValueError when out is this store, or for an experience whose crop is not of the network's size.
    fn refresh(&self, py: Python<'_>, out: PathBuf, weights: &Bound<'_, PyAny>) -> PyResult<usize> {
        let model = network_of(py, weights)?;
        let out = file_of("out", out)?;
        let same =
            |a: &Path, b: &Path| matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b);
        if same(&out, &self.path) {
            return Err(bad("out", "another file than the store itself", out.display().to_string()));
        }
        self.with(py, move |opened, stop| {
            let mut target = SqliteStore::create(&out)?;
            let mut added = 0;
            for summary in opened.store.list()? {
                stop.check();
                if let Some(stored) = opened.store.get(summary.id)? {
                    added += usize::from(target.add(&stored.experience.encoded(model.as_ref())?)?.1);
                }
            }
            Ok(added)
        })
    }

    /// Writes all experiences to a folder as 000001.png, 000001.json, and so on: an image, and a description with all numbers.
    ///
    /// Returns the number of experiences written, and a list with the reason for each that cannot be read. Ctrl-C interrupts it.
    ///
    /// Raises OSError when a file cannot be written.
    fn export(&self, py: Python<'_>, folder: PathBuf) -> PyResult<(usize, Vec<String>)> {
        let opened = self.opened.clone();
        interruptible(py, move |stop| {
            let opened = lock(&opened);
            let (mut written, mut unreadable) = (0, vec![]);
            for Summary { id, .. } in opened.store.list().map_err(store_error)? {
                stop.check();
                let stored = match opened.store.get(id) {
                    Ok(Some(stored)) => stored,
                    Ok(None) => continue,
                    Err(error) => {
                        unreadable.push(error.to_string());
                        continue;
                    }
                };
                let picture = stored.experience.picture().map_err(about("folder"))?;
                let file = folder.join(format!("{id:06}.png"));
                sixfold::io::write_rgb(&file, &picture).map_err(image_error)?;
                let file = file.with_extension("json");
                let text = serde_json::to_string_pretty(&Description::new(&stored, true))
                    .map_err(about("folder"))?;
                let failed = |e: std::io::Error| os_error(e.kind(), format!("{}: {e}", file.display()));
                std::fs::write(&file, text).map_err(failed)?;
                written += 1;
            }
            Ok((written, unreadable))
        })?
    }

    /// Finds the experiences with the features nearest to a given one, nearest first.
    ///
    /// feature: (256,), from DgcmNet.feature. count: maximum number of results. part: only experiences with a part of this name.
    /// without_object: leave out experiences with an object of this name.
    ///
    /// Returns dicts with id, angle (rotation of the stored in-plane copy about the optical axis, radians) and distance (Euclidean;
    /// `propose_grasps` weights experiences by exp(-distance)).
    ///
    /// Raises ValueError for an invalid feature or a store without a network.
    #[pyo3(signature = (feature, count=10, *, part=None, without_object=None, weights=None))]
    fn nearest<'py>(
        &self,
        py: Python<'py>,
        feature: &Bound<'py, PyAny>,
        count: i64,
        part: Option<String>,
        without_object: Option<String>,
        weights: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let feature: Vec<f32> = arrays::numbers("feature", feature)?.into_iter().map(|v| v as f32).collect();
        if feature.len() != FEATURE {
            let found = format!("shape ({},)", feature.len());
            return Err(bad("feature", format!("an array of shape ({FEATURE},)"), found));
        }
        let count = whole("count", count, 1)?;
        let model = self.network(py, weights)?;
        let found: Vec<Match> = self.with(py, move |opened, _| {
            let wanted = |s: &Summary| {
                part.as_ref().is_none_or(|part| s.part.as_ref() == Some(part))
                    && without_object.as_ref().is_none_or(|object| s.object != *object)
            };
            Ok(opened.memory(&model)?.nearest(&feature, count, wanted))
        })?;
        let near = |m: &Match| Near { id: m.experience, angle: m.angle, distance: m.distance };
        json_to_python(py, &found.iter().map(near).collect::<Vec<_>>())
    }

    fn __repr__(&self) -> String {
        format!("<ExperienceStore: {}>", self.path.display())
    }
}

/// A Match with the names used in Python.
#[derive(serde::Serialize)]
struct Near {
    id: i64,
    angle: f64,
    distance: f64,
}

/// A path. The address of a server is refused: it must not become a file with a password in its name.
fn file_of(argument: &str, path: PathBuf) -> PyResult<PathBuf> {
    match StorePlace::from(path.into_os_string()) {
        StorePlace::File(path) => Ok(path),
        place => {
            Err(bad(argument, "a file's path; only the program `sixfold` uses servers", place.to_string()))
        }
    }
}

/// Seconds since 1970.
fn now() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs() as i64)
}

/// The grasp to store, from a Grasp or from a pose with opening and width.
fn grasp_of(grasp: &Bound<'_, PyAny>, opening: Option<f64>, width: Option<f64>) -> PyResult<Grasp> {
    let quality = AntipodalQuality { alignment: 0.0, support: 0.0, centring: 0.0, observed: 0.0 };
    let (pose, known) = match grasp.cast::<PyGrasp>() {
        Ok(grasp) => (grasp.get().pose(), Some((grasp.get().opening(), grasp.get().width()))),
        Err(_) => (arrays::pose("grasp", grasp)?, None),
    };
    let metres = |argument: &str, given: Option<f64>, known: Option<f64>| {
        let value =
            given.or(known).ok_or_else(|| bad(argument, "metres, which a pose alone lacks", "None"))?;
        if value > 0.0 && value < 1.0 {
            return Ok(value);
        }
        Err(bad(argument, "above 0 and below 1 m", value.to_string()))
    };
    Ok(Grasp {
        camera_from_gripper: pose,
        opening: metres("opening", opening, known.map(|k| k.0))?,
        width: metres("width", width, known.map(|k| k.1))?,
        quality,
    })
}
