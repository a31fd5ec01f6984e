//! The store's promise: what `add` has returned for is there, whenever the writer is killed, and readers continue meanwhile.
//!
//! `SIXFOLD_KILLS=1000 cargo test --workspace --release --test kill -- --nocapture` kills a writer a thousand times.
#![cfg(feature = "sqlite")]

mod support;

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_experience::{COPIES, ExperienceStore, FeatureIndex, Position, SqliteStore, StoreError};
use support::{experience, feature, helped, helper, kills, said};

#[test]
#[ignore = "started by the other tests"]
fn helper_process() {
    let Some((file, what)) = helped() else { return };
    let mut out = std::io::stdout();
    if what == "write" {
        let mut store = SqliteStore::create(&file).unwrap();
        let first = store.list().unwrap().len() as i64;
        for number in first.. {
            let (id, new) = store.add(&experience(number)).unwrap();
            assert!(new);
            // The acknowledgement leaves the process only after `add` has returned.
            writeln!(out, "\nstored {number} {id}").unwrap();
            out.flush().unwrap();
        }
    } else {
        let store = SqliteStore::open(&file).unwrap();
        let mut index = FeatureIndex::new("test");
        let end = Instant::now() + Duration::from_secs(20);
        while Instant::now() < end {
            let before = index.len();
            index.refresh(&store).unwrap();
            assert!(
                index.len() >= before && index.len().is_multiple_of(COPIES.len()),
                "half an experience was seen"
            );
            writeln!(out, "\nread {}", index.len() / COPIES.len()).unwrap();
            out.flush().unwrap();
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

#[test]
fn nothing_acknowledged_is_lost_when_the_writer_is_killed() {
    let kills = kills(12);
    let folder = tempfile::tempdir().unwrap();
    let mut file = folder.path().join("experience.db");
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let mut acknowledged = 0;
    let mut all = 0;
    for kill in 0..kills {
        // A new store now and then: its making is interrupted too, and lists stay short.
        if kill % 25 == 0 {
            file = folder.path().join(format!("experience-{kill}.db"));
            acknowledged = 0;
        }
        let mut writer = helper(&file, "write").spawn().unwrap();
        // The last one gets as far as storing something, on a slow computer too.
        let after = if kill + 1 == kills { 1_000_000 } else { random.random_range(0..120_000) };
        std::thread::sleep(Duration::from_micros(after));
        writer.kill().unwrap();
        let output = writer.wait_with_output().unwrap();
        let rows = said(&String::from_utf8_lossy(&output.stdout), "stored ");
        let last = rows.iter().filter(|r| r.len() == 2).map(|r| r[0] + 1).max();
        let newly = last.unwrap_or(acknowledged) - acknowledged;
        assert!(newly >= 0);
        all += newly;
        acknowledged = acknowledged.max(last.unwrap_or(0));
        if !file.exists() {
            assert_eq!(acknowledged, 0);
            continue;
        }
        let store = SqliteStore::create(&file).unwrap();
        store.check_integrity().unwrap();
        let listed = store.list().unwrap();
        let found = listed.len() as i64;
        // One more may be there: it was stored, and the writer was killed before it could say so.
        assert!(found == acknowledged || found == acknowledged + 1, "kill {kill}: {found} of {acknowledged}");
        acknowledged = found;
        if let Some(last) = listed.last() {
            let stored = store.get(last.id).unwrap().unwrap().experience;
            assert_eq!(stored.object, format!("object {}", found - 1));
            assert_eq!(stored.copies[0].feature, feature(found - 1, 0.0));
        }
        assert_eq!(store.changes(Position::default()).unwrap().features.len(), COPIES.len() * found as usize);
    }
    println!("{kills} kills, {all} experiences acknowledged, none lost");
    assert!(kills < 10 || all > 0, "the writer never got as far as storing anything");
}

#[test]
fn two_processes_read_while_one_writes() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("experience.db");
    SqliteStore::create(&file).unwrap();
    let mut writer = helper(&file, "write").spawn().unwrap();
    let mut readers = [helper(&file, "read").spawn().unwrap(), helper(&file, "read").spawn().unwrap()];
    // Both readers hear of new experiences while the writer continues.
    for reader in &mut readers {
        let lines = BufReader::new(reader.stdout.take().unwrap()).lines();
        let mut counts: Vec<i64> = vec![];
        for line in lines {
            counts.extend(said(&line.unwrap(), "read ").iter().map(|r| r[0]));
            counts.dedup();
            if counts.len() > 4 {
                break;
            }
        }
        assert!(counts.len() > 4 && counts.is_sorted(), "{counts:?}");
        assert!(writer.try_wait().unwrap().is_none(), "the writer continues");
    }
    for mut child in readers.into_iter().chain([writer]) {
        let _ = child.kill();
        let _ = child.wait();
    }
}

#[test]
fn an_experience_comes_back_as_it_went_in() {
    let folder = tempfile::tempdir().unwrap();
    let mut store = SqliteStore::create(&folder.path().join("a.db")).unwrap();
    let mine = experience(4);
    let (id, new) = store.add(&mine).unwrap();
    assert!(new);
    assert_eq!(store.add(&mine).unwrap(), (id, false), "the same experience keeps its number");
    let back = store.get(id).unwrap().unwrap().experience;
    assert_eq!((&back.region, &back.copies, &back.gripper), (&mine.region, &mine.copies, &mine.gripper));
    assert_eq!((back.part.as_deref(), back.time), (Some("handle"), mine.time));
    assert!(back.camera_from_gripper.distance_to(&mine.camera_from_gripper) < 1e-12);
    assert_eq!(back.crop.mask, mine.crop.mask);
    for i in mine.crop.pixels() {
        // Depth in steps of 0.1 mm; the pixel's ray instead of the nearest pixel's.
        assert!((back.crop.point(i) - mine.crop.point(i)).norm() < 2e-3);
        assert!((0..3).all(|k| (back.crop.vd_noc[i][k] - mine.crop.vd_noc[i][k]).abs() < 0.01));
    }
}

#[test]
fn stores_are_merged_forgotten_and_followed() {
    let folder = tempfile::tempdir().unwrap();
    let mut a = SqliteStore::create(&folder.path().join("a.db")).unwrap();
    let mut b = SqliteStore::create(&folder.path().join("b.db")).unwrap();
    for number in 0..4 {
        a.add(&experience(number)).unwrap();
    }
    for number in 2..6 {
        b.add(&experience(number)).unwrap();
    }
    let mut index = FeatureIndex::new("test");
    index.refresh(&a).unwrap();
    assert_eq!(index.len(), 4 * COPIES.len());
    assert_eq!(a.merge(&b).unwrap(), 2);
    assert_eq!(a.merge(&b).unwrap(), 0);
    assert!(a.forget(2).unwrap() && !a.forget(2).unwrap() && !a.forget(99).unwrap());
    index.refresh(&a).unwrap();
    assert_eq!(index.len(), 5 * COPIES.len());
    let nearest = index.nearest(&feature(5, COPIES[1]), 1, |_| true)[0];
    assert_eq!((nearest.experience, nearest.angle), (6, COPIES[1]));
    assert!(nearest.distance < 1e-6);
    assert!(index.nearest(&feature(1, 0.0), 3, |_| true).iter().all(|m| m.experience != 2));
    // A number is never used twice.
    a.forget(6).unwrap();
    assert_eq!(a.add(&experience(50)).unwrap(), (7, true));
    let mut other = FeatureIndex::new("another network");
    other.refresh(&a).unwrap();
    assert!(other.is_empty());
}

#[test]
fn a_store_of_version_1_keeps_its_contents() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("old.db");
    let id = SqliteStore::create(&file).unwrap().add(&experience(2)).unwrap().0;
    let before = SqliteStore::open(&file).unwrap().get(id).unwrap().unwrap().experience;
    assert!(before.crop.table.is_some());
    rusqlite::Connection::open(&file)
        .unwrap()
        .execute_batch(
            "DROP TABLE attempt; ALTER TABLE experience DROP COLUMN table_plane; PRAGMA user_version=1",
        )
        .unwrap();
    let mut store = SqliteStore::open(&file).unwrap();
    let mut old = store.get(id).unwrap().unwrap().experience;
    assert_eq!(old.crop.table, None, "it knew no tables");
    // A new one brings the file up to date.
    let new = store.add(&experience(4)).unwrap().0;
    let tables = [id, new].map(|id| store.get(id).unwrap().unwrap().experience.crop.table);
    assert_eq!(tables, [None, experience(4).crop.table]);
    old.crop.table = before.crop.table;
    assert_eq!(old, before);
}

#[test]
fn a_file_that_is_no_store_is_reported() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("x.db");
    let error = SqliteStore::open(&file).unwrap_err().to_string();
    assert!(error.contains("x.db") && error.contains("no such file"), "{error}");
    std::fs::write(&file, "not a database, but long enough to look like one to somebody who is in a hurry")
        .unwrap();
    let error = SqliteStore::open(&file).unwrap_err();
    assert!(matches!(error, StoreError::NotAStore { .. }), "{error}");

    let version = folder.path().join("version.db");
    SqliteStore::create(&version).unwrap();
    write_version(&version, 7);
    let error = SqliteStore::open(&version).unwrap_err();
    assert!(matches!(error, StoreError::Version { found: 7, expected: 2, .. }), "{error}");
    assert!(SqliteStore::create(&version).is_err());

    // Pages overwritten in the middle of the file.
    let broken = folder.path().join("broken.db");
    {
        let mut store = SqliteStore::create(&broken).unwrap();
        for number in 0..6 {
            store.add(&experience(number)).unwrap();
        }
    }
    let mut bytes = std::fs::read(&broken).unwrap();
    let length = bytes.len();
    assert!(length > 40_000, "the log is in the file once all connections are closed: {length}");
    for page in 1..length / 4096 {
        bytes[page * 4096..page * 4096 + 64].fill(0xA5);
    }
    std::fs::write(&broken, &bytes).unwrap();
    let store = SqliteStore::open(&broken);
    let error = store.and_then(|s| s.list().map(|_| s)).map(|s| s.check_integrity()).err();
    let error = error.expect("a damaged store is noticed");
    assert!(matches!(error, StoreError::Broken { .. }), "{error}");

    // A disk with room for a few experiences only.
    let full = folder.path().join("full.db");
    let mut store = SqliteStore::create(&full).unwrap();
    store.limit_size(300_000).unwrap();
    let mut stored = 0;
    let error = (0..200).find_map(|number| match store.add(&experience(number)) {
        Ok(_) => {
            stored += 1;
            None
        }
        Err(error) => Some(error),
    });
    assert!(matches!(error, Some(StoreError::Full { .. })), "{error:?}");
    assert!(stored > 0);
    drop(store);
    let store = SqliteStore::open(&full).unwrap();
    store.check_integrity().unwrap();
    assert_eq!(store.list().unwrap().len(), stored);
}

/// Writes another version into a store: the four bytes at offset 60 of a SQLite file.
fn write_version(file: &Path, version: u32) {
    let mut bytes = std::fs::read(file).unwrap();
    bytes[60..64].copy_from_slice(&version.to_be_bytes());
    std::fs::write(file, bytes).unwrap();
}
