//! The store on a PostgreSQL server, against a real one from a wheel; where there is none the tests say so and pass.
//!
//! `cargo test --workspace --release --features sixfold-experience/postgres --test postgres -- --nocapture` runs them;
//! `SIXFOLD_KILLS=100` in the environment kills server and robot a hundred times.
#![cfg(all(feature = "postgres", feature = "sqlite", unix))]

mod support;

use std::collections::{BTreeSet, HashMap};
use std::io::Write;
use std::path::Path;
use std::process::Child;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_experience::{
    COPIES, Copy, Experience, ExperienceStore, FEATURE, FeatureIndex, OutboxOptions, OutboxStore, Position,
    PostgresStore, StoreError, StorePlace,
};
use support::server::Server;
use support::{contract, experience, feature, heard, helped, helper, kills, named, objects, said};

const SOON: OutboxOptions = OutboxOptions { retry: Duration::from_millis(50) };

fn outbox(file: &Path, url: &str) -> OutboxStore {
    let remote = Box::new(PostgresStore::at(url).unwrap());
    OutboxStore::create(file, remote, &SOON, Box::new(|notice| eprintln!("{notice}"))).unwrap()
}

#[test]
fn a_server_keeps_the_contract_and_so_does_a_copy_of_it() {
    let Some(server) = Server::start() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut number = 0;
    contract(|| {
        number += 1;
        Box::new(PostgresStore::create(&server.database(&format!("fleet{number}"))).unwrap())
    });
    contract(|| {
        number += 1;
        Box::new(outbox(
            &folder.path().join(format!("{number}.db")),
            &server.database(&format!("fleet{number}")),
        ))
    });
}

#[test]
fn the_server_finds_what_the_index_finds() {
    let Some(server) = Server::start() else { return };
    let url = server.database("fleet");
    let mut store = PostgresStore::create(&url).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let base = feature(0, 0.0);
    for number in 0..120 {
        let mut e = experience(number);
        for copy in &mut e.copies {
            // Many near each other, some equal, so that rounding and ties would change the order.
            let noise = [0.0, 1e-6, 1e-4, 0.02][number as usize % 4];
            for (value, base) in copy.feature.iter_mut().zip(&base) {
                *value = (base + noise * random.random_range(-1.0f32..1.0)).clamp(-1.0, 1.0);
            }
        }
        if number % 10 == 9 {
            e.network = "another".to_owned();
        }
        store.add(&e).unwrap();
    }
    store.forget(5).unwrap();
    let mut index = FeatureIndex::new("test");
    index.refresh(&store).unwrap();
    let handles: BTreeSet<i64> =
        store.list().unwrap().iter().filter(|s| s.part.is_some()).map(|s| s.id).collect();
    for (k, query) in [base.clone(), feature(3, 0.0)].iter().enumerate() {
        for count in [1, 7, 150, 1000] {
            let found = store.nearest("test", query, count, None).unwrap();
            assert_eq!(found, index.nearest(query, count, |_| true), "query {k}, {count}");
            let found = store.nearest("test", query, count, Some("handle")).unwrap();
            assert_eq!(found, index.nearest(query, count, |id| handles.contains(&id)));
        }
    }
    assert!(store.nearest("unknown", &base, 3, None).unwrap().is_empty());
    assert!(store.nearest("test", &base, 0, None).unwrap().is_empty());
    // A feature of another length is no feature of ours.
    let short = Copy { angle: 0.0, feature: vec![0.5; FEATURE - 1] };
    let error = store.add(&Experience { copies: vec![short], ..experience(500) }).unwrap_err();
    assert!(matches!(error, StoreError::Field { field: "feature", .. }), "{error}");
}

/// Follows a store until `done`, and counts of how many features of each experience it has heard.
fn follow(url: &str, done: &AtomicBool) -> HashMap<i64, usize> {
    let store = PostgresStore::open(url).unwrap();
    let (mut position, mut heard) = (Position::default(), HashMap::new());
    loop {
        let last = done.load(Ordering::SeqCst);
        let changes = store.changes(position).unwrap();
        position = changes.position;
        for feature in changes.features {
            *heard.entry(feature.experience).or_default() += 1;
        }
        if last {
            return heard;
        }
    }
}

#[test]
fn a_reader_misses_nothing_however_many_write() {
    let Some(server) = Server::start() else { return };
    let url = server.database("fleet");
    PostgresStore::create(&url).unwrap();
    // A writer that takes its time between its numbers and its commit.
    server
        .client("fleet")
        .batch_execute(
            "CREATE FUNCTION dawdle() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN
                IF (SELECT object = 'object 100000' FROM sixfold.experience WHERE id = NEW.experience)
                THEN PERFORM pg_sleep(0.1); END IF; RETURN NEW; END $$;
             CREATE TRIGGER dawdle AFTER INSERT ON sixfold.feature FOR EACH ROW EXECUTE FUNCTION dawdle()",
        )
        .unwrap();
    const WRITERS: i64 = 4;
    const EACH: i64 = 50;
    let done = AtomicBool::new(false);
    let heard = std::thread::scope(|scope| {
        let reader = scope.spawn(|| follow(&url, &done));
        let write = |numbers: std::ops::Range<i64>| {
            let mut store = PostgresStore::open(&url).unwrap();
            for number in numbers {
                assert!(store.add(&experience(number)).unwrap().1);
            }
        };
        let slow = scope.spawn(move || write(100_000..100_001));
        std::thread::sleep(Duration::from_millis(150));
        let writers: Vec<_> =
            (0..WRITERS).map(|w| scope.spawn(move || write(1000 * w..1000 * w + EACH))).collect();
        for writer in writers.into_iter().chain([slow]) {
            writer.join().unwrap();
        }
        done.store(true, Ordering::SeqCst);
        reader.join().unwrap()
    });
    let store = PostgresStore::open(&url).unwrap();
    let there: Vec<i64> = store.list().unwrap().iter().map(|s| s.id).collect();
    assert_eq!(there.len() as i64, WRITERS * EACH + 1);
    let missed: Vec<_> =
        there.iter().map(|id| (id, heard.get(id))).filter(|h| h.1 != Some(&COPIES.len())).collect();
    assert!(missed.is_empty(), "the reader missed {missed:?}");
}

#[test]
fn robots_make_the_same_store_at_once() {
    let Some(server) = Server::start() else { return };
    let url = server.database("fleet");
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| PostgresStore::create(&url).unwrap().add(&experience(1)).unwrap());
        }
    });
    assert_eq!(objects(&PostgresStore::open(&url).unwrap()), named([1]));
}

#[test]
fn errors_name_the_problem_without_the_password() {
    let Some(server) = Server::start() else { return };
    let open = |url: &str| {
        let error = PostgresStore::open(url).expect_err(url);
        let create = PostgresStore::create(url).err().map(|e| e.to_string()).unwrap_or_default();
        for text in [error.to_string(), format!("{error:?}"), create] {
            assert!(!text.contains("secret"), "{text}");
        }
        error
    };
    // Nobody is there.
    let error = open("postgres://robot:secret@127.0.0.1:1/fleet");
    assert!(matches!(error, StoreError::Unreachable { .. }) && error.is_passing(), "{error:?}");
    assert!(error.to_string().contains("postgres://robot@127.0.0.1:1/fleet"), "{error}");
    // Wrong, missing and right passwords.
    server.database("guarded");
    server.client("postgres").batch_execute("CREATE USER guard SUPERUSER PASSWORD 'right secret'").unwrap();
    for user in ["guard:wrong-secret", "guard"] {
        let error = open(&server.url_as(user, "guarded"));
        assert!(matches!(error, StoreError::Refused { .. }) && !error.is_passing(), "{error:?}");
    }
    let place = StorePlace::from(server.url_as("guard:right%20secret", "guarded").as_str());
    assert!(place.create().unwrap().add(&experience(1)).unwrap().1);
    assert!(!format!("{place} {place:?}").contains("secret"));
    let debug =
        format!("{:?}", PostgresStore::open(&server.url_as("guard:right%20secret", "guarded")).unwrap());
    assert!(!debug.contains("secret"), "{debug}");
    // Addresses.
    for (url, expected) in [
        ("postgres://robot:sec@secret@host/fleet", "%40"),
        ("postgres:///fleet", "no host"),
        ("postgres://host/fleet?sslmode=require&password=secret", "tunnel"),
        ("postgres://host:x/fleet?password=secret", "port"),
        ("postgres://host/fleet?colour=secret", "colour"),
    ] {
        let error = open(url);
        assert!(matches!(error, StoreError::Address { .. }), "{error:?}");
        assert!(error.to_string().contains(expected), "{error}");
    }
    let error = open(&server.url("nowhere"));
    assert!(matches!(error, StoreError::Refused { .. }), "{error:?}");

    // No store, and who opens makes none.
    let empty = server.database("empty");
    let error = PostgresStore::open(&empty).unwrap_err();
    assert!(matches!(error, StoreError::Open { .. }), "{error:?}");
    assert!(error.to_string().contains("sixfold grasp store add"), "{error}");
    // pgvector is there, but the user may not switch it on; and it is not there.
    server
        .client("empty")
        .batch_execute("CREATE USER guest; GRANT CREATE ON DATABASE empty TO guest")
        .unwrap();
    let guest = server.url_as("guest", "empty");
    let error = PostgresStore::create(&guest).unwrap_err();
    assert!(matches!(error, StoreError::Extension { .. }), "{error:?}");
    assert!(error.to_string().contains("CREATE EXTENSION vector"), "{error}");
    let moved = server.extension().with_extension("away");
    std::fs::rename(server.extension(), &moved).unwrap();
    let error = PostgresStore::create(&empty).unwrap_err();
    assert!(matches!(error, StoreError::Extension { .. }), "{error:?}");
    assert!(error.to_string().contains("does not have it"), "{error}");
    std::fs::rename(&moved, server.extension()).unwrap();
    // Once an administrator has, a guest may make the store, and another one may not read it.
    server.client("empty").batch_execute("CREATE EXTENSION vector; CREATE USER stranger").unwrap();
    assert!(PostgresStore::create(&guest).unwrap().add(&experience(1)).unwrap().1);
    let error = PostgresStore::open(&server.url_as("stranger", "empty")).unwrap_err();
    assert!(matches!(error, StoreError::Refused { .. }), "{error:?}");
    // A reader may read and no more.
    server
        .client("empty")
        .batch_execute("GRANT USAGE ON SCHEMA sixfold TO stranger; GRANT SELECT ON ALL TABLES IN SCHEMA sixfold TO stranger")
        .unwrap();
    let mut reader = PostgresStore::open(&server.url_as("stranger", "empty")).unwrap();
    assert_eq!(objects(&reader), named([1]));
    let error = reader.add(&experience(2)).unwrap_err();
    assert!(matches!(error, StoreError::Refused { .. }), "{error:?}");

    // Not ours, and another version.
    let other = server.database("other");
    server
        .client("other")
        .batch_execute("CREATE SCHEMA sixfold; CREATE TABLE sixfold.store (x int)")
        .unwrap();
    let error = PostgresStore::create(&other).unwrap_err();
    assert!(matches!(error, StoreError::NotAStore { .. }), "{error:?}");
    server
        .client("other")
        .batch_execute("DROP TABLE sixfold.store; CREATE TABLE sixfold.things (x int)")
        .unwrap();
    let error = PostgresStore::create(&other).unwrap_err();
    assert!(matches!(error, StoreError::NotAStore { .. }), "{error:?}");
    server.client("other").batch_execute("DROP TABLE sixfold.things").unwrap();
    let mut store = PostgresStore::create(&other).unwrap();
    server.client("other").batch_execute("UPDATE sixfold.store SET version = 7").unwrap();
    let error = PostgresStore::create(&other).unwrap_err();
    assert!(matches!(error, StoreError::Version { found: 7, expected: 1, .. }), "{error:?}");
    server.client("other").batch_execute("UPDATE sixfold.store SET version = 1").unwrap();

    // A connection that the server has closed is opened again, and another store behind it is noticed.
    let close = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = 'sixfold' AND datname = 'other'";
    server.client("postgres").batch_execute(close).unwrap();
    assert!(store.add(&experience(1)).unwrap().1);
    assert_eq!(store.connections(), 2);
    server.client("other").batch_execute("UPDATE sixfold.store SET identity = 'x'").unwrap();
    server.client("postgres").batch_execute(close).unwrap();
    let error = store.list().unwrap_err();
    assert!(error.to_string().contains("another store"), "{error}");
    // A standby cannot be written.
    let standby = server.database("standby");
    let mut store = PostgresStore::create(&standby).unwrap();
    server
        .client("postgres")
        .batch_execute("ALTER DATABASE standby SET default_transaction_read_only = on")
        .unwrap();
    server.client("postgres").batch_execute(&close.replace("other", "standby")).unwrap();
    let error = store.add(&experience(1)).unwrap_err();
    assert!(matches!(error, StoreError::ReadOnly { .. }) && error.is_passing(), "{error:?}");
    assert!(objects(&store).is_empty());
}

#[test]
fn a_password_is_never_sent_in_clear_text() {
    let Some(server) = Server::start() else { return };
    server.database("guarded");
    // Its superuser makes it, who is trusted in all other databases.
    server.database("in_clear");
    server.client("postgres").batch_execute("CREATE USER guard SUPERUSER PASSWORD 'secret'").unwrap();
    // With the right password: a server that is told it would let us in.
    let error = PostgresStore::create(&server.url_as("guard:secret", "in_clear")).unwrap_err();
    assert!(matches!(error, StoreError::Refused { .. }) && !error.is_passing(), "{error:?}");
    let text = format!("{error} {error:?}");
    assert!(text.contains("clear text") && !text.contains("secret"), "{text}");
    // Asked in another way it is answered.
    assert!(PostgresStore::create(&server.url_as("guard:secret", "guarded")).is_ok());
    // A server that asks for it is told nothing, not even a wrong one.
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let heard = std::thread::spawn(move || {
        use std::io::Read;
        let mut heard = vec![];
        let mut stream = listener.accept().unwrap().0;
        let mut startup = [0; 4];
        stream.read_exact(&mut startup).unwrap();
        stream.read_exact(&mut vec![0; u32::from_be_bytes(startup) as usize - 4]).unwrap();
        for byte in [b'R', 0, 0, 0, 8, 0, 0, 0, 3] {
            stream.write_all(&[byte]).unwrap();
            std::thread::sleep(Duration::from_millis(5));
        }
        let _ = stream.read_to_end(&mut heard);
        heard
    });
    let error = PostgresStore::open(&format!("postgres://guard:secret@127.0.0.1:{port}/fleet")).unwrap_err();
    assert!(error.to_string().contains("clear text"), "{error}");
    assert_eq!(heard.join().unwrap(), b"");
}

#[test]
fn nothing_acknowledged_is_lost_when_the_server_is_killed() {
    let Some(mut server) = Server::start() else { return };
    let kills = kills(3);
    let url = server.database("fleet");
    PostgresStore::create(&url).unwrap();
    let acknowledged = Mutex::new(vec![]);
    let failures = Mutex::new(0);
    let done = AtomicBool::new(false);
    let mut random = ChaCha8Rng::seed_from_u64(5);
    std::thread::scope(|scope| {
        for writer in 0..2 {
            let (url, acknowledged, failures, done) = (&url, &acknowledged, &failures, &done);
            scope.spawn(move || {
                let mut store = PostgresStore::open(url).unwrap();
                for number in (1_000_000 * writer).. {
                    // The same again until the server has said yes.
                    let id = loop {
                        match store.add(&experience(number)) {
                            Ok((id, _)) => break id,
                            Err(error) => {
                                assert!(error.is_passing(), "{error:?}");
                                *failures.lock().unwrap() += 1;
                                std::thread::sleep(Duration::from_millis(20));
                            }
                        }
                    };
                    acknowledged.lock().unwrap().push((id, format!("object {number}")));
                    if done.load(Ordering::SeqCst) {
                        break;
                    }
                }
            });
        }
        for _ in 0..kills {
            std::thread::sleep(Duration::from_millis(random.random_range(20..300)));
            server.kill();
            server.run();
        }
        done.store(true, Ordering::SeqCst);
    });
    let store = PostgresStore::open(&url).unwrap();
    let there: Vec<(i64, String)> = store.list().unwrap().into_iter().map(|s| (s.id, s.object)).collect();
    let mut acknowledged = acknowledged.into_inner().unwrap();
    acknowledged.sort();
    assert_eq!(there, acknowledged, "all that was acknowledged, once, under its number");
    let features = store.changes(Position::default()).unwrap().features;
    assert_eq!(features.len(), COPIES.len() * there.len());
    let failures = failures.into_inner().unwrap();
    println!(
        "server killed {kills} times: {} experiences acknowledged, none lost, {failures} calls failed",
        there.len()
    );
    assert!(there.len() as u64 > kills && failures > 0);
}

#[test]
#[ignore = "started by the other tests"]
fn helper_process() {
    let Some((file, url)) = helped() else { return };
    let mut store = outbox(&file, &url);
    let mut out = std::io::stdout();
    for number in store.list().unwrap().len() as i64.. {
        store.add(&experience(number)).unwrap();
        writeln!(out, "\nstored {number}").unwrap();
        out.flush().unwrap();
        // Else it would store far more while the server is away than it can deliver before the next kill.
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn pending_experiences_are_delivered_exactly_once_despite_kills() {
    let Some(mut server) = Server::start() else { return };
    let kills = kills(6);
    let url = server.database("fleet");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("outbox.db");
    let mut random = ChaCha8Rng::seed_from_u64(9);
    let (mut robots, mut servers, mut late) = (0, 0, 0);
    let (mut acknowledged, mut unsaid) = (0, 0);
    let mut hear = |mut process: Child| {
        process.kill().unwrap();
        let output = process.wait_with_output().unwrap();
        let rows = said(&String::from_utf8_lossy(&output.stdout), "stored ");
        (acknowledged, unsaid) = heard(&rows, acknowledged, unsaid);
    };
    let mut process = helper(&file, &url).spawn().unwrap();
    let mut up = true;
    for _ in 0..kills {
        std::thread::sleep(Duration::from_millis(random.random_range(20..300)));
        match random.random_range(0..3) {
            0 => {
                hear(process);
                process = helper(&file, &url).spawn().unwrap();
                robots += 1;
            }
            _ if up => {
                server.kill();
                up = false;
                servers += 1;
            }
            _ => {
                server.run();
                up = true;
            }
        }
    }
    // The server is gone while the robot stores its last ones, and the robot is killed before they are delivered.
    server.kill();
    std::thread::sleep(Duration::from_millis(300));
    hear(process);
    server.run();
    {
        let before = PostgresStore::at(&url).and_then(|s| s.list()).map_or(0, |l| l.len());
        let store = outbox(&file, &url);
        let end = Instant::now() + Duration::from_secs(30);
        while store.waiting().unwrap() > 0 && Instant::now() < end {
            store.changes(Position::default()).unwrap();
        }
        assert_eq!(store.waiting().unwrap(), 0);
        late += store.list().unwrap().len() - before;
    }
    let there = objects(&PostgresStore::open(&url).unwrap());
    let expected = acknowledged..=acknowledged + unsaid;
    assert!(expected.contains(&(there.len() as i64)), "{expected:?}: {}", there.len());
    assert_eq!(there, named(0..there.len() as i64), "each exactly once, in order");
    println!(
        "robot killed {robots} times, server {servers}: {acknowledged} experiences acknowledged, delivered exactly once, the last {late} after the last start"
    );
    assert!(acknowledged > 0 && late > 0);
}
