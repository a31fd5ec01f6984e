//! The method `auto`, which runs the other methods and compares their poses.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use sixfold_align::evidence::{Scene, Shape};
use sixfold_align::{ColorGradients, DepthOptions, VerificationMesh, VerificationOptions};
use sixfold_estimator::{
    EstimatorError, MinConfidence, Need, Needs, Object, PoseEstimate, PoseEstimator, PreparedObject, Query,
    downcast,
};
use sixfold_geometry::{Pose, RgbImage};
use sixfold_mesh::Mesh;

use crate::calibration::{Calibration, CalibrationError};
use crate::hypotheses::{Hypothesis, Pool};
use crate::lookalikes::LookAlikes;

const METHOD: &str = "auto";
/// File of the mesh that is rendered; shared with template matching.
const MESH_FILE: &str = "verification-mesh.bin";
/// Step at which a continuous symmetry is sampled, as a fraction of the diameter.
const SYMMETRY_STEP: f64 = 0.05;
/// Poses requested from a method in addition to the number of instances: the second best pose shows how certain the best is. Chosen
/// by hand; not swept.
const MORE: usize = 2;
/// When every instance has a pose this probable, no further method runs; chosen by hand, not swept.
const SURE: f64 = 0.9;
/// A colour image whose brightest and darkest values differ by no more than this, in each channel, has no content: a covered lens,
/// or an image of one colour. Chosen by hand; not swept.
const FLAT: u8 = 8;
/// Below this probability a pose is not reported by default.
const REPORTED: f64 = 0.5;

/// A method that runs other methods in order, compares their poses, and estimates the probability of each.
#[derive(Clone)]
pub struct AutoEstimator {
    members: Vec<Arc<dyn PoseEstimator>>,
    calibration: Arc<Calibration>,
    /// How depth images are prepared, the same for all methods.
    pub depth: DepthOptions,
    /// Once this time has passed for an object, no further method runs; the first always does. With a budget, results depend on the
    /// speed of the machine.
    pub budget: Option<Duration>,
    /// Run all methods, even if the first ones are certain.
    pub ask_all: bool,
}

impl AutoEstimator {
    /// Runs `members` in this order, with the shipped calibration.
    ///
    /// # Errors
    /// [`CalibrationError`], never if the tests pass.
    pub fn new(members: Vec<Arc<dyn PoseEstimator>>) -> Result<AutoEstimator, CalibrationError> {
        let calibration = Arc::new(Calibration::shipped()?);
        Ok(AutoEstimator {
            members,
            calibration,
            depth: DepthOptions::default(),
            budget: None,
            ask_all: false,
        })
    }

    /// Uses another calibration.
    #[must_use]
    pub fn with_calibration(self, calibration: Calibration) -> AutoEstimator {
        AutoEstimator { calibration: Arc::new(calibration), ..self }
    }

    /// All hypotheses for an object in an image: the poses of all methods that ran, the most probable first; and the estimates made of
    /// them, also those below the query's minimum confidence.
    ///
    /// # Errors
    /// [`EstimatorError`], passed on from the method that fails; [`EstimatorError::Lacks`] for an object without a mesh.
    pub fn hypotheses(
        &self,
        object: &AutoObject,
        query: &Query<'_>,
    ) -> Result<(Vec<Hypothesis>, Vec<PoseEstimate>), EstimatorError> {
        let Some(surface) = &object.surface else {
            return Err(lacks_mesh(object));
        };
        self.pool((object, surface), query, |pool, _| {
            let estimates = pool.estimates(query.max_instances);
            Ok((pool.hypotheses, estimates))
        })
    }

    /// The first method that can find an object without a mesh, with the object prepared for it.
    fn without_mesh(&self, object: &AutoObject) -> Result<Option<Knowing<'_>>, EstimatorError> {
        for (number, member) in self.members.iter().enumerate() {
            if !member.knows(&object.object) {
                continue;
            }
            if let (Ok(prepared), _) = object.prepared(number, member.as_ref())? {
                return Ok(Some((member.as_ref(), prepared)));
            }
        }
        Ok(None)
    }

    /// Poses of an object without a mesh: nothing can be rendered, so only one method runs and its confidence is not a probability.
    fn answer_of_one(
        &self,
        object: &AutoObject,
        query: &Query<'_>,
    ) -> Result<Vec<PoseEstimate>, EstimatorError> {
        let Some((member, prepared)) = self.without_mesh(object)? else {
            return Err(lacks_mesh(object));
        };
        if !can_answer(member, query) {
            return Err(EstimatorError::Input {
                what: "depth image",
                method: METHOD,
                advice: "the object has no mesh and is known by depth images alone: give --depth FILE",
            });
        }
        let mut found = member.estimate(prepared.as_ref().as_ref(), query)?;
        for pose in &mut found {
            pose.details.entry("method").or_insert_with(|| member.name().into());
        }
        if let Some(first) = found.first_mut() {
            let (name, method) = (&object.object.name, member.name());
            first.notes.push(format!(
                "{name} has no mesh: --method {method} answered alone, and its confidence is no probability"
            ));
        }
        Ok(found)
    }

    /// Fills a pool and passes it to `done`, with notes about what was left out.
    fn pool<T>(
        &self,
        (object, surface): (&AutoObject, &Surface),
        query: &Query<'_>,
        done: impl FnOnce(Pool<'_>, Vec<String>) -> Result<T, EstimatorError>,
    ) -> Result<T, EstimatorError> {
        let mut notes = vec![];
        let color = match query
            .rgb
            .map(|image| (image, unusable(image, (query.camera.width, query.camera.height))))
        {
            Some((_, Some(why))) => {
                notes.push(format!("the colour image {why}: colours are not used"));
                None
            }
            given => given.map(|(image, _)| image),
        };
        let gradients = color.map(|image| {
            let kept: Arc<OnceLock<ColorGradients>> = query.image_memo.get_or_default();
            kept.get_or_init(|| ColorGradients::new(image));
            (image, kept)
        });
        let color = gradients.as_ref().and_then(|(image, kept)| kept.get().map(|g| (*image, g)));
        let none = LookAlikes::default();
        let look_alikes =
            if color.is_some() && query.depth.is_some() { surface.look_alikes() } else { &none };
        let mut pool = Pool {
            scene: Scene { camera: query.camera, depth: query.depth.map(|d| d.as_ref()), color },
            shape: Shape { mesh: &surface.rendered, colored: &surface.mesh, threshold: surface.threshold },
            diameter: surface.diameter,
            symmetries: &surface.symmetries,
            look_alikes,
            calibration: &self.calibration,
            one_instance: query.max_instances == 1,
            hypotheses: vec![],
            asked: 0,
        };
        let start = Instant::now();
        let asked = Query {
            rgb: color.map(|c| c.0),
            runners_up: MORE,
            ..query.passed_on(query.max_instances.saturating_add(MORE), 0.0)
        };
        let mut possible = 0;
        for (number, member) in self.members.iter().enumerate() {
            if !can_answer(member.as_ref(), &asked) || !member.knows(&object.object) {
                continue;
            }
            possible += 1;
            let sure = pool.chosen(query.max_instances).iter().filter(|(h, _)| h.probability >= SURE).count();
            let late = self.budget.is_some_and(|budget| start.elapsed() >= budget);
            if pool.asked > 0 && (late || (!self.ask_all && sure >= query.max_instances)) {
                break;
            }
            let (known, first) = object.prepared(number, member.as_ref())?;
            let prepared = match known {
                Ok(prepared) => {
                    if first {
                        notes.extend(prepared.notes().iter().cloned());
                    }
                    prepared
                }
                Err(lack) => {
                    notes.push(lack);
                    continue;
                }
            };
            pool.add(member.as_ref(), member.estimate(prepared.as_ref().as_ref(), &asked)?);
        }
        if possible == 0 && !notes.is_empty() {
            return Err(EstimatorError::method(notes.join("; ")));
        }
        if possible == 0 {
            let names: Vec<&str> = self.members.iter().map(|m| m.name()).collect();
            return Err(EstimatorError::Input {
                what: "image that a method works on",
                method: METHOD,
                advice: if names.is_empty() {
                    "no method is there to be asked"
                } else {
                    "give --depth FILE, or --rgb FILE"
                },
            });
        }
        if pool.asked == 0 {
            return Err(EstimatorError::method(notes.join("; ")));
        }
        done(pool, notes)
    }
}

/// Why a colour image cannot be used; `None` if it can.
fn unusable(image: &RgbImage, camera: (usize, usize)) -> Option<&'static str> {
    if image.size() != camera {
        return Some("has another size than the camera");
    }
    let flat = |channel: usize| {
        let values = || image.as_slice().iter().map(|pixel| pixel[channel]);
        let (lowest, highest) = (values().min().unwrap_or(0), values().max().unwrap_or(0));
        highest - lowest <= FLAT
    };
    (0..3).all(flat).then_some("has one colour everywhere")
}

/// The error for an object that no method can search.
fn lacks_mesh(object: &AutoObject) -> EstimatorError {
    EstimatorError::Lacks {
        object: object.object.name.clone(),
        what: "mesh",
        method: METHOD,
        advice: "add it with a mesh, or from depth images and look for it with --method mttm",
    }
}

/// Whether a query has the inputs that a method needs.
fn can_answer(method: &dyn PoseEstimator, query: &Query<'_>) -> bool {
    let needs = method.needs();
    let has = |need: Need, there: bool| need != Need::Required || there;
    has(needs.depth, query.depth.is_some())
        && has(needs.rgb, query.rgb.is_some())
        && has(needs.region, query.region.is_some())
}

/// An object prepared for all methods.
pub struct AutoObject {
    object: Object,
    /// `None` for an object known only from depth images.
    surface: Option<Surface>,
    members: Vec<Prepared>,
    notes: Vec<String>,
}

/// The surface with which poses are verified.
struct Surface {
    mesh: Arc<Mesh>,
    rendered: Mesh,
    diameter: f64,
    threshold: f64,
    symmetries: Vec<Pose>,
    /// Computed on first use.
    look_alikes: OnceLock<LookAlikes>,
}

/// An object prepared for one method; `Err` says why the method cannot be used.
type Known = Result<Arc<Box<dyn PreparedObject>>, String>;
/// A method with an object prepared for it.
type Knowing<'a> = (&'a dyn PoseEstimator, Arc<Box<dyn PreparedObject>>);
/// The same as [`Known`], prepared when the method first runs.
type Prepared = Mutex<Option<Known>>;

impl Surface {
    /// The surface of an object with this mesh, and a note if a file could not be written.
    fn of(object: &Object, mesh: &Arc<Mesh>) -> Result<(Surface, Option<String>), EstimatorError> {
        let kept = VerificationMesh::cached(object.file(MESH_FILE).as_deref(), mesh);
        let kept =
            kept.map_err(|e| EstimatorError::Object { object: object.name.clone(), source: Box::new(e) })?;
        let note = kept.note.map(|n| format!("mesh of {} not kept, or simplified again: {n}", object.name));
        let diameter = object.info.as_ref().map_or_else(|| mesh.diameter(), |info| info.diameter);
        let surface = Surface {
            mesh: mesh.clone(),
            rendered: kept.mesh,
            diameter,
            threshold: VerificationOptions::default().threshold_for(diameter),
            symmetries: object.info.as_ref().map_or_else(Vec::new, |i| i.symmetry_poses(SYMMETRY_STEP)),
            look_alikes: OnceLock::new(),
        };
        Ok((surface, note))
    }

    fn look_alikes(&self) -> &LookAlikes {
        self.look_alikes.get_or_init(|| LookAlikes::of(&self.mesh, self.diameter, &self.symmetries))
    }
}

impl AutoObject {
    /// The object prepared for method number `number`, or why this method cannot be used; and whether it was prepared in this call.
    fn prepared(&self, number: usize, method: &dyn PoseEstimator) -> Result<(Known, bool), EstimatorError> {
        let Some(place) = self.members.get(number) else {
            return Err(EstimatorError::Foreign { method: METHOD });
        };
        let mut kept = place.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(kept) = kept.as_ref() {
            return Ok((kept.clone(), false));
        }
        let prepared = method
            .prepare(&self.object)
            .map(Arc::new)
            .map_err(|error| format!("--method {} was not asked: {error}", method.name()));
        *kept = Some(prepared.clone());
        Ok((prepared, true))
    }
}

impl PreparedObject for AutoObject {
    fn name(&self) -> &str {
        &self.object.name
    }

    fn mesh(&self) -> Option<&Mesh> {
        self.surface.as_ref().map(|surface| &*surface.mesh)
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }
}

impl PoseEstimator for AutoEstimator {
    fn name(&self) -> &'static str {
        METHOD
    }

    /// An object (with a mesh, for probabilities) and at least one image.
    fn needs(&self) -> Needs {
        Needs { depth: Need::Optional, rgb: Need::Optional, region: Need::Optional, object: Need::Required }
    }

    fn depth_options(&self) -> DepthOptions {
        self.depth
    }

    /// Probabilities have the same threshold for all images. In a dataset all hypotheses are reported, because its scores rank them
    /// by confidence.
    fn min_confidence(&self) -> MinConfidence {
        MinConfidence { image: REPORTED, dataset: 0.0 }
    }

    fn prepare(&self, object: &Object) -> Result<Box<dyn PreparedObject>, EstimatorError> {
        let (surface, note) = object.mesh.as_ref().map(|mesh| Surface::of(object, mesh)).transpose()?.unzip();
        let notes = note.flatten().into_iter().collect();
        let members = self.members.iter().map(|_| Prepared::default()).collect();
        let prepared = AutoObject { object: object.clone(), surface, members, notes };
        if prepared.surface.is_none() && self.without_mesh(&prepared)?.is_none() {
            return Err(lacks_mesh(&prepared));
        }
        Ok(Box::new(prepared))
    }

    fn estimate(
        &self,
        object: &dyn PreparedObject,
        query: &Query<'_>,
    ) -> Result<Vec<PoseEstimate>, EstimatorError> {
        let object: &AutoObject = downcast(object, METHOD)?;
        let Some(surface) = &object.surface else {
            return self.answer_of_one(object, query);
        };
        self.pool((object, surface), query, |pool, notes| {
            let mut found = pool.estimates(query.max_instances);
            found.retain(|e| e.probability_with_alternatives() >= Some(query.min_confidence));
            if let Some(first) = found.first_mut() {
                first.notes.extend(notes);
            }
            Ok(found)
        })
    }
}
