//! `sixfold grasp learn`: the incremental loop of section 6.2.1 with a simulated hand. Propose a grasp from experience if one is
//! near enough, else by geometry; execute it; store it if it worked; continue.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sixfold_dgcm::learner::{GraspTask, JournalOf, Learned, Learner, LearnerOptions, PartOf, PlanGrasps};
use sixfold_dgcm::transfer::Memory;
use sixfold_experience::{ExperienceStore, JournalEntry, StorePlace, TaskRecord};
use sixfold_geometry::{Pose, Vec3};
use sixfold_grasp::{AntipodalOptions, Grasp, GraspView, Gripper, centre_between_pads};
use sixfold_mesh::Mesh;
use sixfold_simulation::{AttemptOutcome, ConvexParts, PartsOptions, scene, try_grasp, wilson_interval};
use sixfold_synth::shapes::{Family, Member, Rest, member};

use super::experience::{
    NetworkArguments, OutboxArguments, local_file, model, note_left_out, now, store_place, writable_store,
};
use super::journal::StoreJournal;
use super::object_list::{ObjectsArguments, named_objects};
use super::planner::Planner;
use super::trial::{Hardness, PhysicsArguments, hardness, outcome_name};
use crate::output::JsonArguments;
use crate::progress::{Progress, check_interrupt};
use crate::ranges::in_range;

/// Arguments of `sixfold grasp learn`.
#[derive(Debug, Args)]
pub struct LearnArguments {
    /// The store of experiences, a file or postgres://user@host/database; it is created if it does not exist
    #[arg(long, value_name = "FILE", value_parser = store_place())]
    pub experiences: StorePlace,
    /// Where experiences wait for a server.
    #[command(flatten)]
    pub outbox: OutboxArguments,
    /// Families of synthetic objects: all, or some of can, mug, cup, bottle, bowl, box, clamp, drill
    #[arg(long, value_name = "NAME", value_delimiter = ',', required_unless_present_any = ["objects", "list"], conflicts_with_all = ["objects", "list", "meshes"])]
    pub families: Vec<String>,
    /// Synthetic objects of each family
    #[arg(long, value_name = "N", default_value = "4", requires = "families", conflicts_with_all = ["objects", "list"])]
    pub members: u64,
    /// The objects to learn on, where they are not synthetic.
    #[command(flatten)]
    pub objects: ObjectsArguments,
    /// Scenes of each object
    #[arg(long, value_name = "N", default_value = "4")]
    pub attempts: u64,
    /// Maximum number of grasps tried in a scene until one holds, the best first
    #[arg(long, value_name = "N", default_value = "1")]
    pub tries: usize,
    /// Number of further grasps tried in every scene, spread over the ranking; failures improve the ranking
    #[arg(long, value_name = "N", default_value = "0")]
    pub explore: usize,
    /// Learn as published (section 6.3.2): DGCM-Net alone if the nearest experience is near enough, else GPD
    #[arg(long, value_enum, value_name = "NAME")]
    pub preset: Option<LearnPreset>,
    /// Maximum feature distance at which the nearest experience proposes the grasp; 0 for never (dissertation: 0.9)
    #[arg(long, value_name = "DISTANCE", default_value = "0.9")]
    pub near: f64,
    /// Try and store only grasps on parts of this name (synthetic objects: handle of mug and drill)
    #[arg(long, value_name = "NAME")]
    pub part: Option<String>,
    /// Stronger sensor noise, an imprecise gripper, less friction and a heavier object, see `sixfold grasp compare --help`
    #[arg(long)]
    pub hard: bool,
    /// The simulated trials.
    #[command(flatten)]
    pub physics: PhysicsArguments,
    /// The network.
    #[command(flatten)]
    pub network: NetworkArguments,
    /// Folder for attempts.jsonl, from which a stopped run continues
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Seed of objects, poses, view points, noise and the planner
    #[arg(long, default_value = "0")]
    pub seed: u64,
    /// Where the result goes.
    #[command(flatten)]
    pub json: JsonArguments,
}

/// How experience is used in the dissertation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum LearnPreset {
    /// As in the dissertation
    #[value(alias = "paper")]
    Published,
}

/// An object of the learning run.
pub struct TestObject {
    /// Class, as in the provenance.
    pub class: String,
    /// Name, as in the rows and the store.
    pub name: String,
    /// Mesh in metres, in its resting orientation.
    pub mesh: Mesh,
    /// The synthetic object, with its named parts, and its resting orientation.
    pub made: Option<(Member, Rest)>,
}

impl TestObject {
    /// The part that a grasp is on: the part at the surface point nearest to the centre between the pads (a centimetre behind the
    /// tips), if most of the seen points between the pads belong to it too; otherwise `None`. For example, a hand over the body of
    /// a drill is not on the handle even if its tips reach it.
    fn part(
        &self,
        camera_from_object: &Pose,
        grasp: &Grasp,
        view: &GraspView,
        gripper: &Gripper,
    ) -> Option<&'static str> {
        let (member, rest) = self.made.as_ref()?;
        let member_from_camera = (*camera_from_object * rest.rotation()).inverse();
        let part_at = |p: &Vec3| member.part_at(&member_from_camera.transform_point(p));
        let central_part = part_at(&centre_between_pads(&grasp.camera_from_gripper));
        let gripper_from_camera = grasp.camera_from_gripper.inverse();
        let held: Vec<&Vec3> = view
            .object
            .points
            .iter()
            .filter(|p| gripper.is_between_pads(&gripper_from_camera.transform_point(p), grasp.opening))
            .collect();
        let same = held.iter().filter(|p| part_at(p) == central_part).count();
        (10 * same >= 7 * held.len()).then_some(central_part)
    }
}

/// Synthetic objects, the same for the same seed.
pub fn synthetic_objects(names: &[String], members: u64, seed: u64) -> Result<Vec<TestObject>> {
    let mut test_objects = vec![];
    let families: Vec<Family> = if names.iter().any(|n| n == "all") {
        Family::ALL.to_vec()
    } else {
        names
            .iter()
            .map(|name| {
                let known = || Family::ALL.map(Family::name).join(", ");
                Family::ALL
                    .into_iter()
                    .find(|f| f.name() == name)
                    .with_context(|| format!("--families: found {name}, expected all or some of {}", known()))
            })
            .collect::<Result<_>>()?
    };
    for family in families {
        for number in 0..members {
            let mut random = ChaCha8Rng::seed_from_u64(seed ^ 0x6465_6d6f);
            random.set_stream(number * 64 + family as u64);
            let made = member(family, &mut random)?;
            let rest = family.rests()[number as usize % family.rests().len()];
            test_objects.push(TestObject {
                class: family.name().to_owned(),
                name: format!("{}-{number}", family.name()),
                mesh: made.mesh.transformed(&rest.rotation()),
                made: Some((made, rest)),
            });
        }
    }
    Ok(test_objects)
}

/// One grasp that was tried.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Row {
    object: String,
    class: String,
    attempt: u64,
    /// Whether experience proposed it; else geometry did.
    from_experience: bool,
    /// Distance of the nearest experience's feature.
    nearest: Option<f64>,
    ending: String,
    held: bool,
    /// Its rank among the proposals, from 0.
    rank: usize,
    /// Id of the experience stored from it.
    stored: Option<i64>,
}

#[derive(Serialize)]
struct Recorded<'a> {
    experiences: &'a StorePlace,
    objects: Vec<&'a str>,
    attempts: u64,
    tries: usize,
    explore: usize,
    near: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    preset: Option<LearnPreset>,
    part: &'a Option<String>,
    hard: bool,
    seed: u64,
    network: String,
    gripper: &'a Gripper,
}

/// Summary of the learning run.
#[derive(Serialize)]
pub struct Whole {
    /// Scenes.
    pub attempts: usize,
    /// Scenes in which a grasp held.
    pub held: usize,
    /// Success rate.
    pub rate: f64,
    /// Wilson interval of the rate, 95 %.
    pub interval: (f64, f64),
    /// Scenes in which experience proposed the grasp.
    pub from_experience: usize,
    /// Experiences in the store.
    pub experiences: usize,
    /// Grasps whose outcome is known for this gripper.
    pub outcomes: usize,
    /// The objects, in order.
    pub objects: Vec<Curve>,
}

/// The results of one object, attempt by attempt.
#[derive(Serialize)]
pub struct Curve {
    /// Its name.
    pub object: String,
    /// Whether a grasp held.
    pub held: Vec<bool>,
    /// Distance of the nearest experience's feature.
    pub nearest: Vec<Option<f64>>,
    /// Whether experience proposed the grasp; else geometry did.
    pub from_experience: Vec<bool>,
}

/// The objects that the arguments name.
fn test_objects(a: &LearnArguments) -> Result<Vec<TestObject>> {
    if !a.families.is_empty() {
        return synthetic_objects(&a.families, a.members, a.seed);
    }
    let named = named_objects(&a.objects)?.into_iter();
    Ok(named.map(|(class, name, mesh)| TestObject { class, name, mesh, made: None }).collect())
}

/// Learns, or continues learning.
///
/// # Errors
/// When the arguments, the store or the folder of an earlier run do not fit, and when the user asks to stop.
pub fn learn(a: &LearnArguments) -> Result<Whole> {
    learn_with(a, |store| store)
}

/// `wrap` gets the store before anything is done with it.
fn learn_with(a: &LearnArguments, wrap: impl FnOnce(BoxedStore) -> BoxedStore) -> Result<Whole> {
    if a.near.is_nan() || a.near < 0.0 {
        bail!("--near: found {}, expected 0 or more", a.near);
    }
    in_range("--attempts", a.attempts, 1..=1_000_000)?;
    in_range("--tries", a.tries, 1..=1000)?;
    in_range("--explore", a.explore, 0..=1000)?;
    in_range("--members", a.members, 1..=10_000)?;
    let setting = hardness(&a.physics, a.hard)?;
    let network = model(&a.network)?;
    let test_objects = test_objects(a)?;
    let recorded = Recorded {
        experiences: &a.experiences,
        objects: test_objects.iter().map(|p| p.name.as_str()).collect(),
        attempts: a.attempts,
        tries: a.tries,
        explore: a.explore,
        near: a.near,
        preset: a.preset,
        part: &a.part,
        hard: a.hard,
        seed: a.seed,
        network: network.fingerprint(),
        gripper: &setting.real,
    };
    let file = local_file(&a.experiences, &a.outbox, &a.out)?;
    let mut journal = StoreJournal::open(&a.out.join("attempts.jsonl"), &recorded)?;
    let place = file.display().to_string();
    if !journal.is_empty() && !file.exists() {
        bail!(journal.of_another_store(0, &place));
    }
    let store = wrap(writable_store(&a.experiences, &file)?);
    let mut rows: Vec<Row> = journal.complete(&*store, &place)?;
    let mut memory = Memory::new(store, &network)?;
    let options = LearnerOptions { tries: a.tries, explore: a.explore, near: a.near, part: a.part.clone() };
    let gripper = &setting.gripper;
    let gpd = a.preset.map(|LearnPreset::Published| Planner::gpd(None)).transpose()?;
    let plan = |view: &GraspView, options: &AntipodalOptions| {
        let Some(gpd) = &gpd else { return Ok(vec![]) };
        let grasps = gpd.grasps(view, gripper, options)?;
        Ok(gpd.ranked(&grasps))
    };
    let published = a.preset.map(|LearnPreset::Published| &plan as &PlanGrasps<'_>);
    let mut learner =
        Learner { network: &network, memory: &mut memory, gripper, options: &options, published };
    let mut progress = Progress::new("scenes", test_objects.len() * a.attempts as usize);
    for test_object in &test_objects {
        let done =
            |rows: &[Row], attempt| rows.iter().any(|r| r.object == test_object.name && r.attempt == attempt);
        if (0..a.attempts).all(|n| done(&rows, n)) {
            (0..a.attempts).for_each(|_| progress.step(test_object.name.clone()));
            continue;
        }
        let parts = ConvexParts::of_mesh(&test_object.mesh, &PartsOptions::default())
            .with_context(|| test_object.name.clone())?;
        for attempt in 0..a.attempts {
            if !done(&rows, attempt) {
                check_interrupt("what was learned is kept; run the same command again to continue")?;
                let row =
                    self::attempt(a, &setting, &mut learner, test_object, &parts, attempt, &journal.name)?;
                journal.line(&line(&row))?;
                rows.push(row);
                note_left_out(&learner.memory.take_left_out(), &place);
            }
            progress.step(test_object.name.clone());
        }
    }
    progress.finish();
    memory.refresh()?;
    note_left_out(&memory.take_left_out(), &place);
    Ok(whole(&test_objects, &rows, &mut memory, &gripper.name))
}

type BoxedStore = Box<dyn ExperienceStore + Send>;

/// A row as text, as store and journal keep it.
fn line(row: &Row) -> String {
    serde_json::to_string(row).unwrap_or_default()
}

fn whole(test_objects: &[TestObject], rows: &[Row], memory: &mut Memory, gripper: &str) -> Whole {
    let held = rows.iter().filter(|r| r.held).count();
    let curve = |p: &TestObject| {
        let mine: Vec<&Row> = rows.iter().filter(|r| r.object == p.name).collect();
        Curve {
            object: p.name.clone(),
            held: mine.iter().map(|r| r.held).collect(),
            nearest: mine.iter().map(|r| r.nearest).collect(),
            from_experience: mine.iter().map(|r| r.from_experience).collect(),
        }
    };
    Whole {
        attempts: rows.len(),
        held,
        rate: held as f64 / rows.len().max(1) as f64,
        interval: wilson_interval(held, rows.len()),
        from_experience: rows.iter().filter(|r| r.from_experience).count(),
        experiences: memory.len(),
        outcomes: memory.outcomes(gripper).attempts,
        objects: test_objects.iter().map(curve).collect(),
    }
}

/// One letter per attempt: G for geometry, E for experience; a capital means that the grasp held.
pub fn marks(curve: &Curve) -> String {
    let letter = |(held, e): (&bool, &bool)| match (held, e) {
        (true, true) => 'E',
        (true, false) => 'G',
        (false, true) => 'e',
        (false, false) => 'g',
    };
    curve.held.iter().zip(&curve.from_experience).map(letter).collect()
}

/// One attempt on an object. The store keeps the result together with a row of the journal.
fn attempt(
    a: &LearnArguments,
    setting: &Hardness,
    learner: &mut Learner<'_>,
    test_object: &TestObject,
    parts: &ConvexParts,
    attempt: u64,
    journal: &str,
) -> Result<Row> {
    let scene = scene(&test_object.mesh, parts, &setting.options, a.seed, attempt);
    let empty = Row {
        object: test_object.name.clone(),
        class: test_object.class.clone(),
        attempt,
        from_experience: false,
        nearest: None,
        ending: outcome_name(scene.ending),
        held: false,
        rank: 0,
        stored: None,
    };
    let (Some(view), Some(seen)) = (&scene.view, &scene.seen) else {
        let journal = Some(JournalEntry { journal, row: &|_| line(&empty) });
        learner.memory.store().add_record(&TaskRecord { journal, ..TaskRecord::default() })?;
        return Ok(empty);
    };
    let camera_from_object = seen.world_from_camera.inverse() * scene.world_from_object;
    let part_of = |grasp: &Grasp| test_object.part(&camera_from_object, grasp, view, &setting.gripper);
    let task = GraspTask {
        view,
        planner: AntipodalOptions { seed: scene.noise, ..setting.options.planner },
        object: &test_object.name,
        provenance: &format!("simulated, class {}, seed {}, attempt {attempt}", test_object.class, a.seed),
        part_of: test_object.made.as_ref().map(|_| &part_of as &PartOf<'_>),
        now,
    };
    let mut try_one = |grasp: &Grasp| {
        let sent = seen.world_from_camera * grasp.camera_from_gripper;
        let tried = try_grasp(
            parts,
            &scene.world_from_object,
            &setting.real,
            &setting.reached(&sent, scene.noise),
            grasp.opening,
            &setting.options.trial,
        )?;
        let ending = AttemptOutcome::Tried(tried.outcome);
        Ok((ending.is_success(), ending))
    };
    let row = |learned: &Learned<AttemptOutcome>, stored: Option<i64>| {
        let mut row = Row {
            nearest: learned.nearest,
            from_experience: learned.from_experience,
            held: learned.held,
            stored,
            ..empty.clone()
        };
        if let Some((rank, ending)) = learned.last {
            row.rank = rank;
            row.ending = outcome_name(ending);
        }
        row
    };
    let of_task = JournalOf { journal, row: &|learned, stored| line(&row(learned, stored)) };
    let learned = learner.learn(&task, &mut try_one, Some(&of_task))?;
    Ok(row(&learned, learned.stored))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use sixfold_experience::{Attempt, Changes, Experience, Position, StoreError, Stored, Summary};
    use sixfold_geometry::{Camera, DepthImage, Mask, PointCloud};
    use sixfold_grasp::{AntipodalQuality, gripper_pose};

    #[test]
    fn a_hand_over_the_body_is_not_on_the_handle() {
        let test_object = synthetic_objects(&["drill".to_owned()], 4, 0)
            .unwrap()
            .into_iter()
            .find(|p| {
                p.made
                    .as_ref()
                    .is_some_and(|(_, rest)| rest.rotation().rotation_angle_to(&Pose::identity()) < 0.1)
            })
            .expect("a drill that stands");
        let points = test_object.mesh.sample_surface(4000, 0).points;
        let (member, _) = test_object.made.as_ref().unwrap();
        let on = |part: &str| -> Vec<Vec3> {
            points.iter().copied().filter(|p| member.part_at(p) == part).collect()
        };
        let handle = on("handle");
        let centre = handle.iter().sum::<Vec3>() / handle.len() as f64;
        let top = handle.iter().map(|p| p.z).fold(f64::MIN, f64::max);
        // The camera's frame is the object's.
        let view = GraspView {
            camera: Camera::new(500.0, 500.0, 31.5, 31.5, 64, 64).unwrap(),
            depth: DepthImage::filled(64, 64, 0.0),
            mask: Mask::filled(64, 64, false),
            table: None,
            object: PointCloud { normals: vec![Vec3::z(); points.len()], points: points.clone() },
            obstacles: PointCloud::default(),
            step: 0.0025,
            cut_by_edge: false,
        };
        let gripper = Gripper::built_in("jaws-140").unwrap();
        let quality = AntipodalQuality { alignment: 1.0, support: 1.0, centring: 1.0, observed: 1.0 };
        let part = |tips: Vec3, approach: Vec3| {
            let pose = gripper_pose(&tips, &approach, &Vec3::y()).unwrap();
            let grasp = Grasp { camera_from_gripper: pose, opening: 0.08, width: 0.03, quality };
            test_object.part(&Pose::identity(), &grasp, &view, &gripper)
        };
        // From behind across the handle, the tips a centimetre past its centre.
        assert_eq!(part(centre + Vec3::x() * 0.01, Vec3::x()), Some("handle"));
        // From above, the tips at the upper end of the handle, the body between the fingers.
        let above = Vec3::new(centre.x, centre.y, top - 0.025);
        assert_eq!(part(above, -Vec3::z()), None);
        // Across the body before the handle.
        let body = on("body");
        let front = body.iter().map(|p| p.x).fold(f64::MIN, f64::max);
        let height = body.iter().map(|p| p.z).sum::<f64>() / body.len() as f64;
        assert_eq!(part(Vec3::new(0.6 * front, 0.0, height - 0.01), -Vec3::z()), Some("body"));
    }

    #[derive(clap::Parser)]
    struct Line {
        #[command(flatten)]
        learn: LearnArguments,
    }

    /// A store whose process is stopped before its n-th write.
    struct Stopping {
        store: BoxedStore,
        left: usize,
    }

    impl Stopping {
        fn write(&mut self) -> Result<&mut BoxedStore, StoreError> {
            let file = PathBuf::from("stopped");
            self.left = self.left.checked_sub(1).ok_or(StoreError::Full { file })?;
            Ok(&mut self.store)
        }
    }

    impl ExperienceStore for Stopping {
        fn add(&mut self, experience: &Experience) -> Result<(i64, bool), StoreError> {
            self.write()?.add(experience)
        }

        fn add_attempt(&mut self, attempt: &Attempt) -> Result<bool, StoreError> {
            self.write()?.add_attempt(attempt)
        }

        fn add_record(&mut self, record: &TaskRecord<'_>) -> Result<Option<i64>, StoreError> {
            self.write()?.add_record(record)
        }

        fn forget(&mut self, id: i64) -> Result<bool, StoreError> {
            self.write()?.forget(id)
        }

        fn get(&self, id: i64) -> Result<Option<Stored>, StoreError> {
            self.store.get(id)
        }

        fn list(&self) -> Result<Vec<Summary>, StoreError> {
            self.store.list()
        }

        fn changes(&self, since: Position) -> Result<Changes, StoreError> {
            self.store.changes(since)
        }

        fn attempts(&self, after: i64) -> Result<Vec<(i64, Attempt)>, StoreError> {
            self.store.attempts(after)
        }

        fn journal(&self, name: &str) -> Result<Vec<String>, StoreError> {
            self.store.journal(name)
        }
    }

    /// The journal's lines, the attempts, and the experiences with their features.
    type LeftBehind = (Vec<String>, Vec<Attempt>, Vec<(Summary, Vec<f32>)>);

    /// All results of a run, except times and the journal's name.
    fn left_behind(folder: &Path) -> LeftBehind {
        let text = std::fs::read_to_string(folder.join("attempts.jsonl")).unwrap();
        let store = StorePlace::File(folder.join("e.db")).open().unwrap();
        let attempts =
            store.attempts(0).unwrap().into_iter().map(|(_, a)| Attempt { time: 0, ..a }).collect();
        let experiences = store.list().unwrap().into_iter().map(|summary| {
            let stored = store.get(summary.id).unwrap().unwrap().experience;
            (Summary { time: 0, ..summary }, stored.copies[0].feature.clone())
        });
        (text.lines().skip(1).map(str::to_owned).collect(), attempts, experiences.collect())
    }

    #[test]
    fn a_run_that_is_stopped_at_any_write_ends_as_one_that_was_not() {
        use clap::Parser;
        let weights = concat!(env!("CARGO_MANIFEST_DIR"), "/../../weights/dgcm.safetensors");
        let all = tempfile::tempdir().unwrap();
        let arguments = |name: &str| {
            let folder = all.path().join(name);
            let store = folder.join("e.db");
            let place = [store.to_str().unwrap(), folder.to_str().unwrap()].map(str::to_owned);
            let [store, out] = place;
            let text = ["learn", "--families", "box", "--members", "1", "--attempts", "3", "--tries", "2"];
            let more = ["--explore", "2", "--weights", weights, "--experiences", &store, "--out", &out];
            (Line::parse_from(text.into_iter().chain(more)).learn, folder)
        };
        let (undisturbed, folder) = arguments("undisturbed");
        let whole = learn(&undisturbed).unwrap();
        let expected = left_behind(&folder);
        assert!(whole.held > 0 && expected.1.len() > 3 && !expected.2.is_empty());
        for stop in 0..3 {
            let (a, folder) = arguments(&format!("stopped {stop}"));
            let stopped = learn_with(&a, |store| Box::new(Stopping { store, left: stop }));
            assert!(stopped.is_err());
            let before = left_behind(&folder);
            assert_eq!(before.0, expected.0[..stop], "scenes are there whole, or not at all");
            // Stopped after the store's write, and before or within the journal's.
            let file = folder.join("attempts.jsonl");
            let text = std::fs::read_to_string(&file).unwrap();
            let last = text.trim_end().rfind('\n').map_or(text.len(), |end| end + 1);
            let cut = [text.len(), last, text.len() - 4][if stop == 0 { 0 } else { stop }];
            std::fs::write(&file, &text[..cut]).unwrap();
            let resumed = learn(&a).unwrap();
            assert_eq!(left_behind(&folder), expected, "stopped before write {stop}");
            assert_eq!((resumed.held, resumed.outcomes), (whole.held, whole.outcomes));
        }
    }
}
