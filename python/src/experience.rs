//! `ExperienceStore`: grasps that worked, kept in one file (`sixfold-dgcm`).

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

/// A store that cannot do what was asked.
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

/// The file, and all features of one network in memory once something was searched.
pub(crate) struct Opened {
    path: PathBuf,
    store: SqliteStore,
    memory: Option<(String, Memory)>,
}

impl Opened {
    /// The experiences for a network, with what other processes have stored meanwhile.
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

/// Grasps that worked, with what the camera saw, in one file that several processes may use at once (dissertation, section
/// 6.2.1). `propose_grasps(..., experiences=store)` transfers them to other objects.
///
/// path: the file; it is made where there is none, unless create is False. weights: a DgcmNet, or the path of its weight
/// file, for all that compares experiences; without it the store can be listed, merged and exported.
///
/// Raises FileNotFoundError or OSError for a file that cannot be opened, ValueError for one that is no store.
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
    /// The network of a call, or else of the store.
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

    /// Runs work on the opened store, without the interpreter lock.
    fn with<T: Send + 'static>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut Opened, &Stop) -> Result<T, StoreError> + Send + 'static,
    ) -> PyResult<T> {
        let opened = self.opened.clone();
        interruptible(py, move |stop| work(&mut lock(&opened), stop))?.map_err(store_error)
    }
}

/// The store, also after a call that ended in a panic: what it has in memory is read again when it is asked for.
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

    /// Stores a grasp that worked: its number, and False where it was stored already. When the call returns, the experience
    /// is on the disk.
    ///
    /// depth (H, W) in metres, without lens distortion; mask (H, W) bool of the object; grasp: a Grasp, or a (4, 4)
    /// camera_from_gripper in metres together with opening (distance of the pads before closing) and width (distance of the
    /// contacts), metres; object: what was grasped; part: the part that was grasped, such as "handle"; provenance: where
    /// the experience comes from, in words. Ctrl-C is heard.
    ///
    /// Raises ValueError for a mask without depth, a gripper that is nowhere near the object, a store without network.
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

    /// All experiences, in the order of their numbers: dicts with id, time (seconds since 1970), object, part, gripper,
    /// width (metres), network, provenance.
    fn list<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        json_to_python(py, &self.with(py, |opened, _| opened.store.list())?)
    }

    /// An experience by its number, or None.
    ///
    /// Raises ValueError when it cannot be read.
    fn get(&self, py: Python<'_>, id: i64) -> PyResult<Option<PyExperience>> {
        let stored = self.with(py, move |opened, _| opened.store.get(id))?;
        Ok(stored.map(PyExperience::new))
    }

    /// Forgets an experience; False when there was none of this number. Numbers are never used twice.
    fn forget(&self, py: Python<'_>, id: i64) -> PyResult<bool> {
        self.with(py, move |opened, _| opened.store.forget(id))
    }

    /// Takes over the experiences of another store (its path) that are not here yet; how many were new. Ctrl-C keeps what
    /// was taken over until then.
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

    /// Encodes all experiences again with another network, into another store: how many are new there.
    ///
    /// out: the other file; weights: a DgcmNet or the path of its file. Ctrl-C keeps what was encoded until then.
    ///
    /// Raises ValueError when out is this store, or for an experience of another size than the network wants.
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

    /// Writes all experiences as files of a folder, 000001.png and 000001.json, ...: an image, and everything else. How
    /// many were written, and for each that cannot be read why. Ctrl-C is heard.
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

    /// The experiences whose features are nearest to one, nearest first: dicts with id, angle (the stored in-plane copy's
    /// turn about the optical axis, radians), distance (Euclidean; `propose_grasps` weighs by exp(-distance)).
    ///
    /// feature (256,): what DgcmNet.feature made; part: only experiences on parts of this name; without_object: not those
    /// with an object of this name.
    ///
    /// Raises ValueError for a feature that is none, a store without network.
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

/// A Match in Python's words.
#[derive(serde::Serialize)]
struct Near {
    id: i64,
    angle: f64,
    distance: f64,
}

/// A path, unless it is the address of a server, which must not become a file whose name holds a password.
fn file_of(argument: &str, path: PathBuf) -> PyResult<PathBuf> {
    match StorePlace::from(path.into_os_string()) {
        StorePlace::File(path) => Ok(path),
        place => {
            Err(bad(argument, "the path of a file; servers are for the program `sixfold`", place.to_string()))
        }
    }
}

/// Seconds since 1970.
fn now() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs() as i64)
}

/// A Grasp, or what one needs to be stored.
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
