//! What the tests of all stores share: experiences, and the contract that every store keeps.
#![allow(dead_code, missing_docs)]

#[cfg(all(feature = "postgres", unix))]
pub mod server;

use std::ffi::OsStr;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_experience::{
    Attempt, COPIES, Copy, Crop, CropOptions, Experience, ExperienceStore, FEATURE, FeatureIndex, Position,
    SqliteStore, StoreError, TaskRecord,
};
use sixfold_geometry::{Camera, Image, Mask, Plane, Pose, Vec3};
use sixfold_grasp::{AntipodalQuality, GraspDescription, Gripper};

/// This test binary again, as a process of its own in which only its test `helper_process` runs, on `file` and with another word;
/// what it prints can be read, its errors are dropped.
pub fn helper(file: impl AsRef<OsStr>, word: &str) -> Command {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command
        .args(["--exact", "helper_process", "--nocapture", "--ignored"])
        .env("SIXFOLD_HELPER_FILE", file)
        .env("SIXFOLD_HELPER", word)
        .stdout(Stdio::piped())
        .stderr(Stdio::null());
    command
}

/// In the process of [`helper`], the file and the word; `None` where somebody runs all ignored tests.
pub fn helped() -> Option<(PathBuf, String)> {
    let file = std::env::var_os("SIXFOLD_HELPER_FILE")?;
    Some((file.into(), std::env::var("SIXFOLD_HELPER").ok()?))
}

fn crop() -> Crop {
    let camera = Camera::new(575.0, 575.0, 159.5, 119.5, 320, 240).unwrap();
    let inside = |x: usize, y: usize| (120..180).contains(&x) && (90..150).contains(&y);
    let depth = Image::from_fn(320, 240, |x, y| if inside(x, y) { 0.7 + 0.0003 * x as f32 } else { 0.0 });
    Crop::new(&depth, &camera, &Mask::from_fn(320, 240, inside), &CropOptions::compact()).unwrap()
}

/// An experience that can be told from all others, with a feature that follows from its number.
pub fn experience(number: i64) -> Experience {
    static CROP: OnceLock<Crop> = OnceLock::new();
    let crop = CROP.get_or_init(crop).clone();
    // Every second one was made where no table was known.
    let table = (number % 2 == 0).then(|| Plane { normal: Vec3::new(0.0, -0.6, -0.8), offset: -0.7 });
    let region = crop.mask.iter().enumerate().map(|(i, m)| *m && i % 3 == 0).collect();
    Experience {
        crop: Crop { table, ..crop },
        camera_from_gripper: Pose::exp(&[0.0, 0.01, 0.7, 0.1, 3.0, number as f64 * 1e-3].into()),
        opening: 0.07,
        width: 0.05,
        region,
        copies: COPIES.iter().map(|&angle| Copy { angle, feature: feature(number, angle) }).collect(),
        network: "test".to_owned(),
        gripper: Gripper::built_in("jaws-85").unwrap(),
        object: format!("object {number}"),
        part: (number % 2 == 0).then(|| "handle".to_owned()),
        time: 1_700_000_000 + number,
        provenance: "a test".to_owned(),
    }
}

pub fn feature(number: i64, angle: f64) -> Vec<f32> {
    let mut random = ChaCha8Rng::seed_from_u64(number as u64 ^ angle.to_bits());
    (0..FEATURE).map(|_| random.random_range(-1.0f32..1.0)).collect()
}

/// What the objects of a store's experiences are called, in the order of their numbers.
pub fn objects(store: &dyn ExperienceStore) -> Vec<String> {
    store.list().unwrap().into_iter().map(|s| s.object).collect()
}

/// The names of the experiences with these numbers.
pub fn named(numbers: impl IntoIterator<Item = i64>) -> Vec<String> {
    numbers.into_iter().map(|n| format!("object {n}")).collect()
}

/// The numbers after a word in the lines that a process printed.
pub fn said(text: &str, word: &str) -> Vec<Vec<i64>> {
    text.lines()
        .filter_map(|line| line.strip_prefix(word))
        .filter_map(|rest| rest.split_whitespace().map(|n| n.parse().ok()).collect())
        .collect()
}

/// How many experiences a process that counts them has acknowledged after it was killed, and how many more it and those before it
/// may have stored without a word: each at most one, killed between storing and saying so.
pub fn heard(rows: &[Vec<i64>], acknowledged: i64, unsaid: i64) -> (i64, i64) {
    match rows.iter().map(|r| r[0] + 1).max() {
        Some(now) if now > acknowledged => (now, 1),
        _ => (acknowledged, unsaid + 1),
    }
}

/// How often something is killed.
pub fn kills(default: u64) -> u64 {
    std::env::var("SIXFOLD_KILLS").ok().and_then(|n| n.parse().ok()).unwrap_or(default)
}

/// What every store does, whatever is behind it. `make` makes an empty one.
pub fn contract(mut make: impl FnMut() -> Box<dyn ExperienceStore + Send>) {
    what_is_added_is_there(&mut *make());
    a_wrong_experience_is_refused(&mut *make());
    changes_are_followed(&mut *make());
    attempts_are_kept(&mut *make());
    records_are_kept(&mut *make());
    let folder = tempfile::tempdir().unwrap();
    let mut file = SqliteStore::create(&folder.path().join("other.db")).unwrap();
    stores_are_merged(&mut *make(), &mut file);
    stores_are_merged(&mut *make(), &mut *make());
}

/// An attempt, another one for every number.
pub fn attempt(number: u32) -> Attempt {
    let n = f64::from(number);
    let quality =
        AntipodalQuality { alignment: 1.0 / (n + 3.0), support: 0.5, centring: 0.7, observed: 0.25 };
    let description =
        GraspDescription { quality, overlap: 0.03, lever: n / 700.0, above_middle: -0.01, table_room: None };
    Attempt {
        description,
        agreement: n / 17.0,
        transferred: number % 2 == 1,
        held: number.is_multiple_of(3),
        gripper: "jaws-85".to_owned(),
        object: "mug".to_owned(),
        time: 7,
        provenance: format!("a test, {number}"),
    }
    .rounded()
}

fn attempts_are_kept(store: &mut dyn ExperienceStore) {
    assert!(store.attempts(0).unwrap().is_empty());
    assert!(store.add_attempt(&attempt(1)).unwrap() && store.add_attempt(&attempt(2)).unwrap());
    assert!(
        !store.add_attempt(&Attempt { time: 99, ..attempt(1) }).unwrap(),
        "time does not tell them apart"
    );
    let kept = store.attempts(0).unwrap();
    assert_eq!(kept.iter().map(|a| a.1.clone()).collect::<Vec<_>>(), [attempt(1), attempt(2)]);
    assert_eq!(store.attempts(kept[0].0).unwrap(), kept[1..]);
    let mut wrong = attempt(3);
    wrong.description.lever = f64::NAN;
    let error = store.add_attempt(&wrong).unwrap_err().to_string();
    assert!(error.contains("lever"), "{error}");
    assert_eq!(store.attempts(0).unwrap().len(), 2);
}

fn records_are_kept(store: &mut dyn ExperienceStore) {
    let (attempts, mine) = ([attempt(1), attempt(2)], experience(1));
    let record = TaskRecord { attempts: &attempts, experience: Some(&mine), journal: None };
    let id = store.add_record(&record).unwrap();
    assert!(id.is_some());
    assert_eq!(store.add_record(&record).unwrap(), id, "once");
    assert_eq!(store.add_record(&TaskRecord::default()).unwrap(), None);
    assert_eq!((store.numbers().unwrap(), objects(store)), (vec![id.unwrap()], named([1])));
    let rows = store.attempt_rows(0).unwrap();
    assert_eq!(rows.iter().map(|row| row.1.as_ref().unwrap().clone()).collect::<Vec<_>>(), attempts);
    assert!(store.forget_attempt(rows[0].0).unwrap() && !store.forget_attempt(rows[0].0).unwrap());
    assert_eq!(store.attempts(0).unwrap(), [(rows[1].0, attempt(2))]);
    // One thing in it is wrong.
    let mut wrong = attempt(3);
    wrong.agreement = f64::INFINITY;
    assert!(store.add_record(&TaskRecord { attempts: &[attempt(4), wrong], ..record }).is_err());
    assert_eq!(store.attempts(0).unwrap().len(), 1);
}

fn what_is_added_is_there(store: &mut dyn ExperienceStore) {
    assert!(store.list().unwrap().is_empty() && store.get(1).unwrap().is_none());
    // What was stored once is in the steps in which images are kept: from then on nothing changes any more.
    let folder = tempfile::tempdir().unwrap();
    let mut file = SqliteStore::create(&folder.path().join("a.db")).unwrap();
    let mine = experience(4);
    let rough = file.add(&mine).unwrap().0;
    let mine = file.get(rough).unwrap().unwrap().experience;

    let (id, new) = store.add(&experience(4)).unwrap();
    assert!(new);
    assert_eq!(store.add(&mine).unwrap(), (id, false), "the same experience keeps its number");
    assert_eq!(
        store.add(&Experience { time: 5, ..mine.clone() }).unwrap(),
        (id, false),
        "time does not tell them apart"
    );
    let back = store.get(id).unwrap().unwrap();
    assert_eq!(back.id, id);
    assert_eq!(back.experience, mine, "it comes back as it went in");
    let (second, new) = store.add(&experience(5)).unwrap();
    assert!(new && second > id);
    let listed = store.list().unwrap();
    assert_eq!(listed.iter().map(|s| s.id).collect::<Vec<_>>(), [id, second]);
    let summary = &listed[0];
    assert_eq!((summary.object.as_str(), summary.part.as_deref()), ("object 4", Some("handle")));
    assert_eq!((summary.gripper.as_str(), summary.network.as_str()), (mine.gripper.name.as_str(), "test"));
    assert_eq!((summary.time, summary.width, summary.provenance.as_str()), (mine.time, 0.05, "a test"));
    assert_eq!(listed[1].part, None);
    let tables = [id, second].map(|id| store.get(id).unwrap().unwrap().experience.crop.table);
    assert_eq!(tables, [experience(4).crop.table, None]);
    assert!(tables[0].is_some());
}

fn a_wrong_experience_is_refused(store: &mut dyn ExperienceStore) {
    let mut wrong = experience(1);
    wrong.copies[1].feature[3] = f32::NAN;
    let error = store.add(&wrong).unwrap_err();
    assert!(matches!(error, StoreError::Field { field: "feature", .. }), "{error}");
    assert!(store.list().unwrap().is_empty());
}

fn changes_are_followed(store: &mut dyn ExperienceStore) {
    let copies = COPIES.len();
    let mut index = FeatureIndex::new("test");
    index.refresh(store).unwrap();
    assert!(index.is_empty());
    let ids: Vec<i64> = (0..4).map(|n| store.add(&experience(n)).unwrap().0).collect();
    index.refresh(store).unwrap();
    assert_eq!(index.len(), 4 * copies);
    let all = store.changes(Position::default()).unwrap();
    let owners: Vec<i64> = all.features.iter().map(|f| f.experience).collect();
    assert_eq!(
        owners,
        ids.iter().flat_map(|id| vec![*id; copies]).collect::<Vec<_>>(),
        "in the order of adding"
    );
    assert_eq!(all.features[1].feature, feature(0, COPIES[1]));
    assert_eq!((all.features[1].angle, all.features[1].network.as_str()), (COPIES[1], "test"));
    let none = store.changes(all.position).unwrap();
    assert!(none.features.is_empty() && none.forgotten.is_empty() && none.position == all.position);

    assert!(store.forget(ids[2]).unwrap());
    assert!(!store.forget(ids[2]).unwrap() && !store.forget(99_999).unwrap());
    assert!(store.get(ids[2]).unwrap().is_none());
    let changes = store.changes(all.position).unwrap();
    assert_eq!((changes.forgotten.as_slice(), changes.features.len()), ([ids[2]].as_slice(), 0));
    index.refresh(store).unwrap();
    assert_eq!(index.len(), 3 * copies);
    let nearest = index.nearest(&feature(3, COPIES[1]), 1, |_| true)[0];
    assert_eq!((nearest.experience, nearest.angle), (ids[3], COPIES[1]));
    assert!(nearest.distance < 1e-6);

    // A number is never used twice, whether the last one was forgotten or the same comes again.
    store.forget(ids[3]).unwrap();
    let (again, new) = store.add(&experience(3)).unwrap();
    assert!(new && again > ids[3]);
    // Who followed step by step knows what one knows who begins now.
    index.refresh(store).unwrap();
    let mut fresh = FeatureIndex::new("test");
    fresh.refresh(store).unwrap();
    for query in 0..4 {
        let query = feature(query, 0.3);
        assert_eq!(index.nearest(&query, 7, |_| true), fresh.nearest(&query, 7, |_| true));
    }
    let mut other = FeatureIndex::new("another network");
    other.refresh(store).unwrap();
    assert!(other.is_empty());
}

fn stores_are_merged(a: &mut dyn ExperienceStore, b: &mut dyn ExperienceStore) {
    for number in 0..4 {
        a.add(&experience(number)).unwrap();
    }
    for number in 2..6 {
        b.add(&experience(number)).unwrap();
    }
    b.add_attempt(&attempt(1)).unwrap();
    assert_eq!((a.merge(b).unwrap(), a.merge(b).unwrap()), (2, 0));
    assert_eq!(a.attempts(0).unwrap().len(), 1, "attempts are merged, once");
    assert_eq!(objects(a), named(0..6));
    assert_eq!((b.merge(a).unwrap(), b.merge(a).unwrap()), (2, 0));
    assert_eq!(objects(b), named([2, 3, 4, 5, 0, 1]));
    for (summary, number) in b.list().unwrap().iter().zip([2, 3, 4, 5, 0, 1]) {
        let stored = b.get(summary.id).unwrap().unwrap().experience;
        assert_eq!(stored.copies, experience(number).copies);
    }
}
