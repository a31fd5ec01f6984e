//! Figure 6.7: the error of a transferred grasp against the target grasp, over the number of experiences, between every pair
//! of objects, and between an object and stretched copies of it.
//!
//! As in section 6.3.1, the target grasp is from above, on the object's upright axis, and a rotation about the approach
//! direction is ignored. There the poses were annotated by hand on depth images; here they follow from the meshes, and the
//! depth images are simulated, or both are recorded ([`super::recorded`]). The first grasp of the ranking by equation 6.6 is evaluated, whether it would hold or not.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use rand::RngExt;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};
use sixfold_dgcm::model::DgcmModel;
use sixfold_dgcm::transfer::{Memory, ProposeOptions, propose, rank, rank_experience_as_published};
use sixfold_experience::{Crop, Experience, SqliteStore};
use sixfold_geometry::random::stream;
use sixfold_geometry::{Pose, Vec3};
use sixfold_grasp::{
    AntipodalOptions, AntipodalQuality, ClusterOptions, Grasp, GraspFitter, GraspView, Gripper, gripper_pose,
};
use sixfold_mesh::Mesh;
use sixfold_simulation::{AttemptOptions, ConvexParts, PartsOptions, scene};

use sixfold_shell::grasp::journal::Journal;
use sixfold_shell::progress::{Progress, check_interrupt};

/// Maximum number of experiences of each object in a test.
const POOL: usize = 8;
/// Numbers of experiences that are compared.
pub(super) const COUNTS: [usize; 4] = [1, 2, 4, 8];
/// Clearance for the fingers, metres: an object wider than the open gripper minus this clearance has no grasp from above.
const ROOM: f64 = 0.01;

/// How much further than the object's width the gripper opens, metres.
const CLEARANCE: f64 = 0.024;

/// An object with its target grasp.
pub(super) struct Instance {
    pub class: String,
    pub name: String,
    pub shape: Shape,
}

/// Where an object's views come from.
pub(super) enum Shape {
    /// Simulated: its mesh, the target grasp, and the width there in metres.
    Mesh(Mesh, (Pose, f64)),
    /// Recorded views, each with the target grasp in the camera's frame.
    Recorded(Vec<(Arc<GraspView>, Grasp)>),
}

/// The objects of a list that can be grasped from above, in its order.
pub(super) fn instances(objects: &[(String, String, Mesh)], gripper: &Gripper) -> Vec<Instance> {
    objects
        .iter()
        .filter_map(|(class, name, mesh)| {
            let grasp = from_above(mesh, gripper)?;
            Some(Instance {
                class: class.clone(),
                name: name.clone(),
                shape: Shape::Mesh(mesh.clone(), grasp),
            })
        })
        .collect()
}

/// The grasp from above on the axis through the centre of an object's top, closing along its narrower side.
fn from_above(mesh: &Mesh, gripper: &Gripper) -> Option<(Pose, f64)> {
    let (low, high) = mesh.bounding_box();
    let height = high.z - low.z;
    let depth = (0.4 * height).min(0.02);
    let within = |from: f64| -> Option<(Vec3, Vec3)> {
        let mut points = mesh.vertices().iter().filter(|p| p.z >= from).copied();
        let first = points.next()?;
        Some(points.fold((first, first), |(a, b), p| (a.inf(&p), b.sup(&p))))
    };
    let (a, b) = within(high.z - 0.05 * height)?;
    let centre = (a + b) * 0.5;
    let (a, b) = within(high.z - depth)?;
    let size = b - a;
    let (closing, width) = if size.x <= size.y { (Vec3::x(), size.x) } else { (Vec3::y(), size.y) };
    if width > gripper.max_opening - ROOM {
        return None;
    }
    let tip = Vec3::new(centre.x, centre.y, high.z - depth);
    Some((gripper_pose(&tip, &-Vec3::z(), &closing)?, width))
}

/// The target grasp at this pose, where the object has this width in metres.
pub(super) fn wanted(camera_from_gripper: Pose, width: f64, gripper: &Gripper) -> Grasp {
    let quality = AntipodalQuality { alignment: 1.0, support: 1.0, centring: 1.0, observed: 0.5 };
    let opening = (width + CLEARANCE).min(gripper.max_opening);
    Grasp { camera_from_gripper, opening, width, quality }
}

/// One view of an object.
struct View {
    instance: usize,
    number: u64,
    view: Arc<GraspView>,
    /// The target grasp in the camera's frame.
    wanted: Grasp,
}

/// One question: the available experiences, and the error of the answer.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Answer {
    pub question: Question,
    /// Distance between the midpoints of the finger tips, metres, and angle between the approach directions, radians; `None`
    /// without a proposal.
    pub error: Option<(f64, f64)>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub(super) enum Question {
    /// A number of experiences per object, of the tested object's class or of all.
    Count { class: String, object: String, view: u64, count: usize, all: bool, round: u64 },
    /// All experiences of one object.
    Pair { from: String, to: String, view: u64 },
    /// All experiences of the object as it is, tested on a stretched one.
    Stretched { object: String, view: u64, factors: [i64; 3] },
}

impl Answer {
    /// Whether the error is within these limits.
    pub fn within(&self, distance: f64, degrees: f64) -> bool {
        self.error.is_some_and(|(d, a)| d <= distance && a <= degrees.to_radians())
    }
}

/// The extent of the experiments.
#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Size {
    /// Tested views of each object.
    pub views: u64,
    /// Random samples of experiences for each number.
    pub rounds: u64,
    /// Stretched copies of each object.
    pub stretched: u64,
}

/// How grasps are transferred.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Form {
    /// The default: all hypotheses.
    Ours,
    /// The network's hypothesis alone; the gripper is placed where it is free, and surfaces that fit count more.
    Network,
    /// The same with the gripper at a fixed distance from the surface ([`ProposeOptions::published`]).
    Published,
}

/// The inputs of the offline experiments.
pub(super) struct Offline<'a> {
    pub instances: &'a [Instance],
    /// A hash of the list of recorded views.
    pub recorded: Option<u64>,
    pub network: &'a DgcmModel,
    pub gripper: &'a Gripper,
    pub options: &'a AttemptOptions,
    pub size: Size,
    pub form: Form,
    pub seed: u64,
}

impl Offline<'_> {
    /// All answers, those of an earlier run included.
    pub fn run(&self, folder: &Path) -> Result<Vec<Answer>> {
        let mut recorded = serde_json::json!({
            "objects": self.instances.iter().map(|i| i.name.as_str()).collect::<Vec<_>>(),
            "size": self.size, "seed": self.seed, "form": self.form, "network": self.network.fingerprint(), "gripper": self.gripper,
        });
        if let Some(list) = self.recorded {
            recorded["recorded"] = format!("{list:016x}").into();
        }
        let (mut journal, rows) = Journal::open::<Answer>(&folder.join("answers.jsonl"), &recorded)?;
        let mut answers: BTreeMap<Question, Answer> =
            rows.into_iter().map(|r| (r.question.clone(), r)).collect();
        let store = SqliteStore::create(&folder.join("experience.db"))?;
        let mut memory = Memory::new(Box::new(store), self.network)?;
        let mut progress = Progress::new("views", self.instances.len());
        let mut known: Vec<Vec<i64>> = vec![];
        let mut tests: Vec<View> = vec![];
        for (number, instance) in self.instances.iter().enumerate() {
            check_interrupt("what was answered is kept; run the same command again to continue")?;
            let (pool, views) = self.views(number, instance)?;
            let ids: Result<Vec<i64>> = pool.iter().map(|v| self.remember(&mut memory, v)).collect();
            known.push(ids?);
            tests.extend(views);
            progress.step(instance.name.clone());
        }
        progress.finish();
        memory.refresh()?;
        let questions = self.questions(&known, &tests);
        let mut progress = Progress::new("questions", questions.len());
        for (question, test, only) in questions {
            if let Entry::Vacant(place) = answers.entry(question) {
                check_interrupt("what was answered is kept; run the same command again to continue")?;
                let error = self.ask(&mut memory, test, only)?;
                let answer = Answer { question: place.key().clone(), error };
                journal.row(&answer)?;
                place.insert(answer);
            }
            progress.step(String::new());
        }
        progress.finish();
        self.stretched(&known, &mut memory, &mut journal, &mut answers)?;
        Ok(answers.into_values().collect())
    }

    /// The views used as experience, and the tested views.
    fn views(&self, number: usize, instance: &Instance) -> Result<(Vec<View>, Vec<View>)> {
        let (mesh, grasp) = match &instance.shape {
            Shape::Mesh(mesh, grasp) => (mesh, grasp),
            Shape::Recorded(views) => return Ok(self.split(number, views)),
        };
        let parts =
            ConvexParts::of_mesh(mesh, &PartsOptions::default()).with_context(|| instance.name.clone())?;
        let mut views = vec![];
        let wanted = POOL + self.size.views as usize;
        for k in 0..3 * wanted as u64 {
            if views.len() == wanted {
                break;
            }
            views.extend(self.view(number, mesh, grasp, &parts, k));
        }
        if views.len() < wanted {
            bail!("{}: the object stood upright in {} of {} views", instance.name, views.len(), 3 * wanted);
        }
        let tests = views.split_off(POOL);
        Ok((views, tests))
    }

    /// Recorded views in random order: the first half, at most [`POOL`], as experience; the others are tested.
    fn split(&self, instance: usize, recorded: &[(Arc<GraspView>, Grasp)]) -> (Vec<View>, Vec<View>) {
        let mut views: Vec<View> = (0..)
            .zip(recorded)
            .map(|(number, (view, wanted))| View { instance, number, view: view.clone(), wanted: *wanted })
            .collect();
        views.shuffle(&mut stream(self.seed ^ 0x7265_636f, instance as u64));
        let tests = views.split_off((views.len() / 2).min(POOL));
        (views, tests)
    }

    /// One view with its target grasp; `None` if the object did not stand upright or was not visible.
    fn view(
        &self,
        instance: usize,
        mesh: &Mesh,
        grasp: &(Pose, f64),
        parts: &ConvexParts,
        number: u64,
    ) -> Option<View> {
        let scene = scene(mesh, parts, self.options, self.seed.wrapping_add(1000 * instance as u64), number);
        let upright = scene.world_from_object.transform_direction(&Vec3::z()).z > 0.99;
        let (Some(view), Some(seen), true) = (scene.view, scene.seen, upright) else { return None };
        let (pose, width) = grasp;
        let camera_from_gripper = seen.world_from_camera.inverse() * scene.world_from_object * *pose;
        let wanted = wanted(camera_from_gripper, *width, self.gripper);
        Some(View { instance, number, view: Arc::new(view), wanted })
    }

    fn remember(&self, memory: &mut Memory, view: &View) -> Result<i64> {
        let crop = Crop::of_view(&view.view, self.network.crop_options())?;
        let instance = &self.instances[view.instance];
        let provenance = format!("wanted grasp of view {}", view.number);
        let experience = Experience::new(
            self.network,
            crop,
            &view.wanted,
            self.gripper,
            &instance.name,
            Some("top"),
            0,
            &provenance,
        );
        Ok(memory.store().add(&experience)?.0)
    }

    /// Every question with its view and the available experiences.
    fn questions<'v>(
        &self,
        known: &[Vec<i64>],
        tests: &'v [View],
    ) -> Vec<(Question, &'v View, BTreeSet<i64>)> {
        let mut questions = vec![];
        for test in tests {
            let instance = &self.instances[test.instance];
            for count in COUNTS {
                for round in 0..self.size.rounds {
                    for all in [false, true] {
                        let mut random = stream(self.seed, round * 64 + count as u64);
                        let mut only = BTreeSet::new();
                        for (other, ids) in self.instances.iter().zip(known) {
                            let mut ids = ids.clone();
                            ids.shuffle(&mut random);
                            if all || other.class == instance.class {
                                only.extend(ids.into_iter().take(count));
                            }
                        }
                        let question = Question::Count {
                            class: instance.class.clone(),
                            object: instance.name.clone(),
                            view: test.number,
                            count,
                            all,
                            round,
                        };
                        questions.push((question, test, only));
                    }
                }
            }
            for (from, ids) in self.instances.iter().zip(known) {
                let question =
                    Question::Pair { from: from.name.clone(), to: instance.name.clone(), view: test.number };
                questions.push((question, test, ids.iter().copied().collect()));
            }
        }
        questions
    }

    /// The error of the first grasp proposed from these experiences.
    fn ask(&self, memory: &mut Memory, test: &View, only: BTreeSet<i64>) -> Result<Option<(f64, f64)>> {
        let options = AntipodalOptions::default();
        let fitter = GraspFitter::new(&test.view, self.gripper, &options)?;
        let form = match self.form {
            Form::Ours => ProposeOptions::default(),
            Form::Network => {
                let ProposeOptions { reach, fit_scale, .. } = ProposeOptions::default();
                ProposeOptions { reach, fit_scale, ..ProposeOptions::published() }
            }
            Form::Published => ProposeOptions::published(),
        };
        let options = ProposeOptions { only: Some(only), ..form };
        let found = propose(&fitter, self.network, memory, &options)?;
        let clusters = ClusterOptions::default();
        let ranked = match self.form {
            Form::Ours | Form::Network => rank(&[], &found.proposals, &clusters),
            Form::Published => rank_experience_as_published(&found.proposals, &clusters),
        };
        Ok(ranked.first().map(|best| {
            let wanted = &test.wanted;
            let distance = best.grasp.camera_from_gripper.distance_to(&wanted.camera_from_gripper);
            (distance, best.grasp.approach().angle(&wanted.approach()))
        }))
    }

    /// Objects stretched by 0.5 to 2 along each of their axes.
    fn stretched(
        &self,
        known: &[Vec<i64>],
        memory: &mut Memory,
        journal: &mut Journal,
        answers: &mut BTreeMap<Question, Answer>,
    ) -> Result<()> {
        let mut progress = Progress::new("stretched", self.instances.len() * self.size.stretched as usize);
        for (number, instance) in self.instances.iter().enumerate() {
            let Shape::Mesh(mesh, _) = &instance.shape else { continue };
            for view in 0..self.size.stretched {
                check_interrupt("what was answered is kept; run the same command again to continue")?;
                progress.step(instance.name.clone());
                let mut random = stream(self.seed ^ 0x73_7472, view);
                // Shrunk as often as enlarged; in hundredths, so that it can be a key.
                let factors: [i64; 3] = std::array::from_fn(|_| {
                    (100.0 * 2f64.powf(random.random_range(-1.0..1.0))).round() as i64
                });
                let question = Question::Stretched { object: instance.name.clone(), view, factors };
                if answers.contains_key(&question) {
                    continue;
                }
                let stretch = Vec3::from(factors.map(|f| f as f64 / 100.0));
                let vertices = mesh.vertices();
                let vertices = vertices.iter().map(|p| p.component_mul(&stretch)).collect();
                let mesh = Mesh::new(vertices, mesh.faces().to_vec())?;
                let Some(grasp) = from_above(&mesh, self.gripper) else { continue };
                let Ok(parts) = ConvexParts::of_mesh(&mesh, &PartsOptions::default()) else { continue };
                let Some(test) = self.view(number, &mesh, &grasp, &parts, 500 + view) else { continue };
                let only = known[number].iter().copied().collect();
                let answer = Answer { question: question.clone(), error: self.ask(memory, &test, only)? };
                journal.row(&answer)?;
                answers.insert(question, answer);
            }
        }
        progress.finish();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wanted_grasp_is_on_top_and_across() {
        // A box of 6 x 10 x 12 cm that stands on z = 0.
        let corner = |i: usize| {
            let at = |bit: usize, size: f64| if i >> bit & 1 == 1 { size } else { 0.0 };
            Vec3::new(at(0, 0.06), at(1, 0.10), at(2, 0.12))
        };
        let faces = vec![[0, 1, 2], [4, 5, 6], [0, 1, 4], [3, 7, 1]];
        let mesh = Mesh::new((0..8).map(corner).collect(), faces).unwrap();
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let (pose, width) = from_above(&mesh, &gripper).unwrap();
        assert!((pose.translation() - Vec3::new(0.03, 0.05, 0.10)).norm() < 1e-9);
        assert!((pose.transform_direction(&Vec3::z()) + Vec3::z()).norm() < 1e-9);
        assert!((width - 0.06).abs() < 1e-9 && pose.transform_direction(&Vec3::x()).x.abs() > 0.999);
        // This one is too wide for the hand.
        let wide = mesh.vertices().iter().map(|p| p * 2.0).collect();
        assert!(from_above(&Mesh::new(wide, mesh.faces().to_vec()).unwrap(), &gripper).is_none());
    }

    #[test]
    fn near_enough_needs_both_distance_and_angle() {
        let question = Question::Pair { from: "a".into(), to: "b".into(), view: 0 };
        let answer = |error| Answer { question: question.clone(), error };
        assert!(answer(Some((0.02, 0.1))).within(0.05, 15.0));
        assert!(!answer(Some((0.02, 0.3))).within(0.05, 15.0));
        assert!(!answer(Some((0.02, 0.1))).within(0.01, 15.0));
        assert!(!answer(None).within(1.0, 180.0));
    }
}
