//! What befalls a store file, and what is left then: two writers, broken rows, a truncated file, a file that may only be read.
#![cfg(feature = "sqlite")]

mod support;

use std::path::Path;
use std::process::Stdio;

use sixfold_experience::{
    Attempt, ExperienceStore, FeatureIndex, JournalEntry, SqliteStore, StoreError, StorePlace, TaskRecord,
};
use support::{attempt, experience, helped, helper, named, objects};

const EACH: i64 = 40;

#[test]
#[ignore = "started by the other tests"]
fn helper_process() {
    let Some((file, what)) = helped() else { return };
    if what == "read" {
        let mut store = StorePlace::File(file).open().unwrap();
        assert_eq!(objects(&*store), named(0..3));
        assert_eq!(store.get(2).unwrap().unwrap().experience.object, "object 1");
        assert_eq!(store.attempts(0).unwrap().len(), 2);
        let error = store.add(&experience(9)).unwrap_err();
        assert!(matches!(error, StoreError::ReadOnly { .. }), "{error}");
        return;
    }
    let first: i64 = what.parse().unwrap();
    let mut store = SqliteStore::create(&file).unwrap();
    for number in first..first + EACH {
        let row = move |_| number.to_string();
        let record = TaskRecord {
            attempts: &[attempt(number as u32)],
            experience: Some(&experience(number)),
            journal: Some(JournalEntry { journal: &what, row: &row }),
        };
        store.add_record(&record).unwrap();
    }
}

fn ends_well(child: std::process::Child) {
    let output = child.wait_with_output().unwrap();
    let said = [output.stdout, output.stderr].concat();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&said));
}

#[test]
fn two_processes_write_one_store_and_lose_no_row() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("experience.db");
    // Nobody made the file before them.
    let writers =
        ["0", "1000", "2000"].map(|first| helper(&file, first).stderr(Stdio::piped()).spawn().unwrap());
    writers.into_iter().for_each(ends_well);
    let store = SqliteStore::open(&file).unwrap();
    store.check_integrity().unwrap();
    let mut there = objects(&store);
    there.sort();
    let mut expected = named((0..EACH).chain(1000..1000 + EACH).chain(2000..2000 + EACH));
    expected.sort();
    assert_eq!(there, expected);
    assert_eq!(store.attempts(0).unwrap().len() as i64, 3 * EACH);
    for first in [0, 1000, 2000] {
        let rows: Vec<String> = (first..first + EACH).map(|n| n.to_string()).collect();
        assert_eq!(store.journal(&first.to_string()).unwrap(), rows);
    }
}

#[test]
fn a_record_is_stored_whole_or_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let mut store = SqliteStore::create(&folder.path().join("a.db")).unwrap();
    let state = |store: &SqliteStore| {
        (objects(store).len(), store.attempts(0).unwrap().len(), store.journal("mine").unwrap())
    };
    let row = |id: Option<i64>| format!("{id:?}");
    let journal = Some(JournalEntry { journal: "mine", row: &row });
    let mine = experience(1);
    let attempts = [attempt(1), attempt(2)];
    let record = TaskRecord { attempts: &attempts, experience: Some(&mine), journal };
    assert_eq!(store.add_record(&record).unwrap(), Some(1));
    let before = state(&store);
    assert_eq!(before, (1, 2, vec!["Some(1)".to_owned()]));
    // Something in it cannot be stored.
    let mut wrong = attempt(3);
    wrong.description.lever = f64::NAN;
    let error = store.add_record(&TaskRecord { attempts: &[attempt(4), wrong], ..record }).unwrap_err();
    assert!(matches!(error, StoreError::Field { .. }), "{error}");
    assert_eq!(state(&store), before);
    // The disk is full within it: there is room for some attempts, and for no experience.
    store.limit_size(std::fs::metadata(folder.path().join("a.db")).unwrap().len() as i64 + 40_000).unwrap();
    let full = (10..200).find_map(|number| {
        let attempts: Vec<Attempt> = (0..10).map(|k| attempt(10 * number + k)).collect();
        let experience = experience(number.into());
        let before = state(&store);
        let stored =
            store.add_record(&TaskRecord { attempts: &attempts, experience: Some(&experience), journal });
        stored.err().map(|error| (error, before))
    });
    let (error, before) = full.expect("the disk is full at last");
    assert!(matches!(error, StoreError::Full { .. }), "{error}");
    assert_eq!(state(&store), before);
}

/// A store of three experiences and two attempts.
fn three(file: &Path) -> SqliteStore {
    let mut store = SqliteStore::create(file).unwrap();
    for number in 0..3 {
        store.add(&experience(number)).unwrap();
    }
    for number in 0..2 {
        store.add_attempt(&attempt(number)).unwrap();
    }
    store
}

#[test]
fn one_broken_row_is_named_costs_itself_alone_and_can_be_removed() {
    for broken in [
        "depth = x'00'",
        "depth = 7",
        "object = x'ff'",
        "time = 'yesterday'",
        "camera = 3.5",
        "gripper = '{'",
        "opening = 'wide'",
        "side = -1",
        "camera_from_gripper = zeroblob(128)",
        "extent = ''",
        "region = 'none'",
        "part = x'05'",
        "network = x'00'",
    ] {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.db");
        let mut store = three(&file);
        let other = rusqlite::Connection::open(&file).unwrap();
        other.execute_batch(&format!("UPDATE experience SET {broken} WHERE id = 2")).unwrap();
        assert_eq!(store.list().unwrap().iter().map(|s| s.id).collect::<Vec<_>>(), [1, 2, 3], "{broken}");
        let error = store.get(2).expect_err(broken);
        assert!(error.is_of_one_row() && error.to_string().contains("experience 2"), "{broken}: {error}");
        assert!([1, 3].iter().all(|id| store.get(*id).unwrap().is_some()));
        let mut index = FeatureIndex::new("test");
        index.refresh(&store).unwrap();
        assert!(index.len() >= 10, "{broken}");
        assert!(store.forget(2).unwrap());
        assert_eq!(objects(&store), named([0, 2]));
    }
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.db");
    let mut store = three(&file);
    let other = rusqlite::Connection::open(&file).unwrap();
    // Something else in place of a feature.
    other.execute_batch("UPDATE feature SET feature = x'0102' WHERE experience = 3").unwrap();
    let mut index = FeatureIndex::new("test");
    index.refresh(&store).unwrap();
    assert_eq!((index.len(), index.take_unusable()), (10, vec![3]));
    for broken in ["'an attempt'", "x'ff'", "3"] {
        other.execute_batch(&format!("UPDATE attempt SET attempt = {broken} WHERE id = 1")).unwrap();
        assert_eq!(store.attempts(0).unwrap(), [(2, attempt(1))]);
        let rows = store.attempt_rows(0).unwrap();
        let error = rows[0].1.as_ref().expect_err(broken);
        assert!(error.is_of_one_row() && error.to_string().contains("attempt 1"), "{error}");
    }
    assert!(store.forget_attempt(1).unwrap() && !store.forget_attempt(1).unwrap());
    assert!(store.attempt_rows(0).unwrap().iter().all(|row| row.1.is_ok()));
}

#[test]
fn readable_rows_of_a_truncated_store_are_saved() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.db");
    {
        let mut store = SqliteStore::create(&file).unwrap();
        for number in 0..30 {
            store.add(&experience(number)).unwrap();
            store.add_attempt(&attempt(number as u32)).unwrap();
        }
    }
    let whole = std::fs::read(&file).unwrap();
    for (part, minimum) in [(0.9, 15), (0.6, 5), (0.1, 0)] {
        let file = folder.path().join("truncated.db");
        std::fs::write(&file, &whole[..(whole.len() as f64 * part) as usize]).unwrap();
        let before = std::fs::read(&file).unwrap();
        let place = StorePlace::File(file.clone());
        let error = place.open().and_then(|store| store.list().map(|_| ())).unwrap_err();
        assert!(matches!(error, StoreError::Broken { .. }), "{error}");
        assert!(error.to_string().contains("grasp store merge NEW.db"), "{error}");
        let store = place.open_to_save().unwrap();
        let numbers = store.numbers().unwrap();
        let read: Vec<_> = numbers.iter().filter_map(|id| store.get(*id).ok().flatten()).collect();
        assert!(read.len() >= minimum && read.len() < 30, "{part}: {} of {}", read.len(), numbers.len());
        assert!(read.iter().all(|stored| stored.experience.object == format!("object {}", stored.id - 1)));
        drop(store);
        assert_eq!(std::fs::read(&file).unwrap(), before, "the file is as it was");
    }
}

#[test]
#[cfg(unix)]
fn a_store_that_may_only_be_read_is_read() {
    use std::os::unix::fs::{MetadataExt, PermissionsExt, chown};
    use std::os::unix::process::CommandExt;
    /// Root may write everywhere.
    const NOBODY: u32 = 65534;
    let allow = |path: &Path, mode| {
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).unwrap();
    };
    for (name, of_folder) in [("folder", 0o555), ("file", 0o755)] {
        let folder = tempfile::tempdir().unwrap();
        let root = std::fs::metadata(folder.path()).unwrap().uid() == 0;
        let file = folder.path().join("experience #1 50%.db");
        drop(three(&file));
        allow(&file, 0o444);
        allow(folder.path(), of_folder);
        let mut reader = helper(&file, "read");
        reader.stderr(Stdio::piped());
        if root {
            if name == "file" {
                chown(folder.path(), Some(NOBODY), None).unwrap();
            }
            reader.uid(NOBODY).gid(NOBODY).current_dir("/");
        }
        match reader.spawn() {
            Ok(child) => ends_well(child),
            Err(error) => eprintln!("skipped: nobody may start this test's program: {error}"),
        }
        allow(folder.path(), 0o755);
    }
}
