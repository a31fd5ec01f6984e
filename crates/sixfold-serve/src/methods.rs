//! Methods and prepared objects that are kept in memory between requests, so that a second request for the same object does
//! not prepare it again.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::SystemTime;

use serde::Serialize;
use sixfold_estimator::{EstimatorError, Object, ObjectStore, PoseEstimator, PreparedObject, StoreError};
use sixfold_mesh::Mesh;
use sixfold_mttm::{MatchedBy, MttmEstimator, MttmOptions};
use sixfold_ppf::PpfEstimator;
use utoipa::ToSchema;

use crate::error::{Answer, ApiError, ServeError};
use crate::objects::WEIGHTS;

/// Maximum number of prepared objects kept; the least recently used are removed. Each takes a few to some ten MB.
const MAX_KEPT: usize = 64;

/// A method as clients name it.
#[derive(Debug, Clone, Serialize, ToSchema)]
pub(crate) struct MethodInfo {
    /// Its name.
    pub name: &'static str,
    /// What it is.
    pub about: &'static str,
    /// Whether it works on depth: required, optional or unused.
    pub depth: &'static str,
    /// The same for a colour image.
    pub rgb: &'static str,
    /// The same for a box or a mask.
    pub region: &'static str,
}

type Estimator = Arc<dyn PoseEstimator>;
type Built = Result<Estimator, EstimatorError>;

/// A method that is built when it is first used.
struct Method {
    name: &'static str,
    about: &'static str,
    build: Box<dyn Fn() -> Built + Send + Sync>,
    built: OnceLock<Estimator>,
}

impl Method {
    fn new(
        name: &'static str,
        about: &'static str,
        build: impl Fn() -> Built + Send + Sync + 'static,
    ) -> Method {
        Method { name, about, build: Box::new(build), built: OnceLock::new() }
    }

    fn estimator(&self) -> Built {
        if let Some(built) = self.built.get() {
            return Ok(built.clone());
        }
        let built = (self.build)()?;
        Ok(self.built.get_or_init(|| built).clone())
    }
}

/// The state of a stored object from which data was derived; it changes when the object is replaced or a network is trained for it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Stamp([Option<SystemTime>; 2], u64);

impl Stamp {
    /// The state of the object as stored now; the store has accepted its name before.
    fn of(store_folder: &std::path::Path, name: &str, record: &str) -> Stamp {
        let changed = |file| std::fs::metadata(store_folder.join(name).join(file)).and_then(|m| m.modified());
        Stamp(["object.json", WEIGHTS].map(|file| changed(file).ok()), sixfold_io::fnv1a(record.as_bytes()))
    }
}

struct Kept<T> {
    stamp: Stamp,
    used: u64,
    value: T,
}

/// The most recently used values by key.
struct Recent<K, T> {
    kept: HashMap<K, Kept<T>>,
    clock: u64,
}

impl<K: Eq + std::hash::Hash + Clone, T: Clone> Recent<K, T> {
    fn new() -> Recent<K, T> {
        Recent { kept: HashMap::new(), clock: 0 }
    }

    fn get(&mut self, key: &K, stamp: &Stamp) -> Option<T> {
        self.clock += 1;
        let kept = self.kept.get_mut(key).filter(|kept| kept.stamp == *stamp)?;
        kept.used = self.clock;
        Some(kept.value.clone())
    }

    fn put(&mut self, key: K, stamp: Stamp, value: T) {
        self.clock += 1;
        self.kept.insert(key, Kept { stamp, used: self.clock, value });
        while self.kept.len() > MAX_KEPT {
            let oldest = self.kept.iter().min_by_key(|(_, kept)| kept.used).map(|(key, _)| key.clone());
            if let Some(oldest) = oldest {
                self.kept.remove(&oldest);
            }
        }
    }
}

type PreparedKey = (&'static str, String, Option<u32>);

/// All methods, with what they have prepared.
pub(crate) struct Methods {
    store: ObjectStore,
    folder: PathBuf,
    methods: Vec<Method>,
    objects: Mutex<Recent<String, Arc<Object>>>,
    prepared: Mutex<Recent<PreparedKey, Arc<dyn PreparedObject>>>,
}

impl Methods {
    /// The methods that this program has; `pix2pose` is a trained model.
    pub fn new(
        store: ObjectStore,
        folder: PathBuf,
        pix2pose: Option<PathBuf>,
    ) -> Result<Methods, ServeError> {
        let mut methods = with_networks::methods(pix2pose)?;
        // After the method that combines all others, which is the default.
        let first = methods.len().min(1);
        methods.splice(
            first..first,
            [
                Method::new("ppf", "point pair features on depth, no training", || {
                    Ok(Arc::new(PpfEstimator::default()))
                }),
                Method::new("mttm", "templates in depth, no training", mttm),
            ],
        );
        Ok(Methods {
            store,
            folder,
            methods,
            objects: Mutex::new(Recent::new()),
            prepared: Mutex::new(Recent::new()),
        })
    }

    /// The names of all methods.
    pub fn names(&self) -> Vec<&'static str> {
        self.methods.iter().map(|m| m.name).collect()
    }

    /// All methods in the form for clients.
    pub fn describe(&self) -> Vec<MethodInfo> {
        let describe = |method: &Method| {
            let needs = method.estimator().ok()?.needs();
            Some(MethodInfo {
                name: method.name,
                about: method.about,
                depth: word(needs.depth),
                rgb: word(needs.rgb),
                region: word(needs.region),
            })
        };
        self.methods.iter().filter_map(describe).collect()
    }

    /// A method by its name.
    pub fn estimator(&self, name: &str) -> Answer<Estimator> {
        let method = self.methods.iter().find(|m| m.name == name).ok_or_else(|| {
            let advice = match name {
                "pix2pose" | "views" | "auto" => with_networks::ADVICE,
                _ => "choose one of them",
            };
            ApiError::field(
                "method",
                format!("{name:?}"),
                format!("one of {}", self.names().join(", ")),
                advice,
            )
        })?;
        method.estimator().map_err(|e| ApiError::system(&format!("method {name}"), e))
    }

    /// A stored object with its mesh.
    pub fn object(&self, name: &str) -> Result<(Arc<Object>, Stamp), StoreError> {
        let record = self.store.record(name)?;
        let text = serde_json::to_string(&record).unwrap_or_default();
        let stamp = Stamp::of(&self.folder, name, &text);
        let key = name.to_owned();
        if let Some(object) = locked(&self.objects).get(&key, &stamp) {
            return Ok((object, stamp));
        }
        let object = Arc::new(self.store.load(name)?);
        locked(&self.objects).put(key, stamp.clone(), object.clone());
        Ok((object, stamp))
    }

    /// A stored object prepared for a method, now or earlier. `id`: its number in a trained model.
    pub fn prepared(
        &self,
        estimator: &dyn PoseEstimator,
        name: &str,
        id: Option<u32>,
    ) -> Answer<Arc<dyn PreparedObject>> {
        let (object, stamp) = self.object(name).map_err(|e| ApiError::of_store("objects", &e))?;
        let key = (estimator.name(), name.to_owned(), id);
        if let Some(prepared) = locked(&self.prepared).get(&key, &stamp) {
            return Ok(prepared);
        }
        let object = Object { id, ..Object::clone(&object) };
        let prepared = estimator.prepare(&object).map_err(|e| of_estimator("objects", e))?;
        let prepared: Arc<dyn PreparedObject> = prepared.into();
        locked(&self.prepared).put(key, stamp, prepared.clone());
        Ok(prepared)
    }
}

fn locked<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn word(need: sixfold_estimator::Need) -> &'static str {
    use sixfold_estimator::Need;
    match need {
        Need::Unused => "unused",
        Need::Optional => "optional",
        Need::Required => "required",
    }
}

/// A method's error as an answer to the client.
pub(crate) fn of_estimator(field: &str, error: EstimatorError) -> ApiError {
    let text = sixfold_shell::describe(&anyhow::Error::new(error));
    ApiError::about(field, text, "what the method works on", "choose another method or other images")
}

/// An object that several requests share.
pub(crate) struct SharedObject(pub Arc<dyn PreparedObject>);

impl PreparedObject for SharedObject {
    fn name(&self) -> &str {
        self.0.name()
    }

    fn mesh(&self) -> Option<&Mesh> {
        self.0.mesh()
    }

    fn notes(&self) -> &[String] {
        self.0.notes()
    }
}

#[cfg(feature = "networks")]
fn mttm() -> Built {
    let network = sixfold_mttm::model::MttmModel::shipped().map_err(EstimatorError::method)?;
    let options = MttmOptions { matched_by: MatchedBy::Both, ..MttmOptions::default() };
    Ok(Arc::new(MttmEstimator { options, network: Some(Arc::new(network)), ..MttmEstimator::default() }))
}

#[cfg(not(feature = "networks"))]
fn mttm() -> Built {
    let options = MttmOptions { matched_by: MatchedBy::Points, ..MttmOptions::default() };
    Ok(Arc::new(MttmEstimator { options, ..MttmEstimator::default() }))
}

#[cfg(feature = "networks")]
mod with_networks {
    use super::*;
    use sixfold_auto::AutoMembers;
    use sixfold_detect::detector::TrainedDetector;
    use sixfold_pix2pose::model::Pix2PoseModel;
    use sixfold_pix2pose::own_weights::OwnWeights;
    use sixfold_views::ViewsRefiner;
    use sixfold_views::estimator::ViewsEstimator;

    pub const ADVICE: &str = "choose one of them";

    /// The methods that need a network. A model that cannot be read is an error at the start, not at the first request. Pix2Pose finds
    /// the objects that have weights of their own and, with a model, those that this was trained on.
    pub fn methods(pix2pose: Option<PathBuf>) -> Result<Vec<Method>, ServeError> {
        let views = || {
            let views = ViewsEstimator::shipped().map_err(EstimatorError::method)?;
            let proposals = TrainedDetector::proposals().map_err(EstimatorError::method)?;
            Ok(Arc::new(views.with_proposals(Arc::new(proposals))) as Estimator)
        };
        let of_auto = pix2pose.clone();
        let auto = move || {
            let pix2pose = of_auto.as_deref().map(|file| (file, None));
            let members = AutoMembers { pix2pose, own_weights_first: true, ..AutoMembers::default() };
            Ok(Arc::new(members.estimator()?) as Estimator)
        };
        let given = pix2pose.is_some();
        let trained = move || {
            let model = pix2pose.as_deref().map(Pix2PoseModel::load).transpose();
            let refiner = ViewsRefiner::shipped().map_err(EstimatorError::method)?;
            let own = OwnWeights {
                others: model.map_err(EstimatorError::method)?,
                refiner: Some(Arc::new(refiner)),
                ..OwnWeights::default()
            };
            Ok(Arc::new(own) as Estimator)
        };
        let trained = Method::new("pix2pose", "object coordinates by a trained network, in boxes", trained);
        if given {
            let fault = |e| ServeError::Method(anyhow::Error::new(e).context("--pix2pose"));
            trained.estimator().map_err(fault)?;
        }
        Ok(vec![
            Method::new("auto", "all methods, their poses judged together, with probabilities", auto),
            Method::new("views", "rendered views matched with a colour image, no training", views),
            trained,
        ])
    }
}

#[cfg(not(feature = "networks"))]
mod with_networks {
    use super::*;

    pub const ADVICE: &str =
        "this program was built without the feature networks: build it with, or choose one of them";

    pub fn methods(pix2pose: Option<PathBuf>) -> Result<Vec<Method>, ServeError> {
        match pix2pose {
            None => Ok(vec![]),
            Some(file) => Err(ServeError::Option {
                option: "pix2pose",
                found: file.display().to_string(),
                expected: "nothing: this program was built without the feature networks".to_owned(),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_are_removed_and_replaced_ones_do_not_count() {
        let stamp = |n| Stamp([None; 2], n);
        let mut recent = Recent::new();
        for i in 0..MAX_KEPT as u32 {
            recent.put(i, stamp(0), i);
        }
        assert_eq!(recent.get(&0, &stamp(0)), Some(0));
        recent.put(1000, stamp(0), 7);
        assert_eq!(recent.get(&1, &stamp(0)), None);
        assert_eq!(recent.get(&0, &stamp(0)), Some(0));
        assert_eq!(recent.get(&0, &stamp(1)), None);
    }
}
