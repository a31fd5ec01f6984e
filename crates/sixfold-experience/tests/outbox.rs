//! The contract of all stores, held by the file and by a robot's copy of a remote store; and what that copy promises beyond:
//! whatever was acknowledged gets to the remote store exactly once, in order, whoever goes away or is killed meanwhile.
//!
//! `SIXFOLD_KILLS=1000 cargo test --workspace --release --test outbox -- --nocapture` kills a robot a thousand times.
#![cfg(feature = "sqlite")]

mod support;

use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_experience::{
    Attempt, Changes, Experience, ExperienceStore, FeatureIndex, Notice, OutboxOptions, OutboxStore,
    Position, SqliteStore, StoreError, StorePlace, Stored, Summary,
};
use support::{attempt, contract, experience, feature, heard, helped, helper, kills, named, objects, said};

const FINE: u32 = 0;
/// No answer at all.
const AWAY: u32 = 1;
/// It does what it is asked, and its answer gets lost.
const LOSES_ANSWERS: u32 = 2;
/// Every third call is one or the other.
const SHAKY: u32 = 3;

/// A remote store, for which a file stands in.
struct Remote {
    store: SqliteStore,
    state: Arc<AtomicU32>,
    calls: AtomicU32,
    identity: String,
}

impl Remote {
    fn new(file: &Path, state: &Arc<AtomicU32>) -> Box<Remote> {
        let store = SqliteStore::create(file).unwrap();
        Box::new(Remote {
            store,
            state: state.clone(),
            calls: AtomicU32::new(0),
            identity: "first".to_owned(),
        })
    }

    fn state(&self) -> u32 {
        match self.state.load(Ordering::SeqCst) {
            SHAKY => match self.calls.fetch_add(1, Ordering::SeqCst) % 7 {
                2 => AWAY,
                5 => LOSES_ANSWERS,
                _ => FINE,
            },
            state => state,
        }
    }

    fn answer<T>(&self, state: u32, answer: Result<T, StoreError>) -> Result<T, StoreError> {
        let reason = "a test".to_owned();
        match state {
            LOSES_ANSWERS => Err(StoreError::Lost { server: "remote".to_owned(), reason }),
            _ => answer,
        }
    }

    fn ask(&self) -> Result<u32, StoreError> {
        match self.state() {
            AWAY => Err(StoreError::Unreachable { server: "remote".to_owned(), reason: "a test".to_owned() }),
            state => Ok(state),
        }
    }
}

impl ExperienceStore for Remote {
    fn add(&mut self, experience: &Experience) -> Result<(i64, bool), StoreError> {
        let state = self.ask()?;
        if experience.object == "unwanted" {
            let found = String::new();
            return Err(StoreError::Field { id: 0, field: "object", expected: "something wanted", found });
        }
        let answer = self.store.add(experience);
        self.answer(state, answer)
    }

    fn get(&self, id: i64) -> Result<Option<Stored>, StoreError> {
        self.answer(self.ask()?, self.store.get(id))
    }

    fn list(&self) -> Result<Vec<Summary>, StoreError> {
        self.answer(self.ask()?, self.store.list())
    }

    fn forget(&mut self, id: i64) -> Result<bool, StoreError> {
        let state = self.ask()?;
        let answer = self.store.forget(id);
        self.answer(state, answer)
    }

    fn changes(&self, since: Position) -> Result<Changes, StoreError> {
        self.answer(self.ask()?, self.store.changes(since))
    }

    fn add_attempt(&mut self, attempt: &Attempt) -> Result<bool, StoreError> {
        let state = self.ask()?;
        let answer = self.store.add_attempt(attempt);
        self.answer(state, answer)
    }

    fn attempts(&self, after: i64) -> Result<Vec<(i64, Attempt)>, StoreError> {
        self.answer(self.ask()?, self.store.attempts(after))
    }

    fn identity(&self) -> Result<Option<String>, StoreError> {
        self.ask()?;
        Ok(Some(self.identity.clone()))
    }
}

const NOW: OutboxOptions = OutboxOptions { retry: Duration::ZERO };

/// A robot's store, and what it told the user.
fn robot(file: &Path, remote: Box<Remote>) -> (OutboxStore, Arc<Mutex<Vec<Notice>>>) {
    let heard = Arc::new(Mutex::new(vec![]));
    let listener = heard.clone();
    let listener = Box::new(move |notice: &Notice| listener.lock().unwrap().push(notice.clone()));
    (OutboxStore::create(file, remote, &NOW, listener).unwrap(), heard)
}

#[test]
fn attempts_wait_for_the_server_and_come_from_others() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let state = Arc::new(AtomicU32::new(AWAY));
    let remote = || Remote::new(&at("server.db"), &state);
    let (mut mine, _) = robot(&at("mine.db"), remote());
    // While the server is away, and while it answers now and then only.
    for k in 0..6 {
        assert!(mine.add_attempt(&attempt(k)).unwrap());
    }
    assert_eq!(mine.attempts(0).unwrap().len(), 6, "they are there to learn from");
    state.store(SHAKY, Ordering::SeqCst);
    for _ in 0..40 {
        mine.changes(Position::default()).unwrap();
    }
    drop(mine);
    state.store(FINE, Ordering::SeqCst);
    let (mine, _) = robot(&at("mine.db"), remote());
    let server = SqliteStore::open(&at("server.db")).unwrap();
    let all: Vec<Attempt> = server.attempts(0).unwrap().into_iter().map(|a| a.1).collect();
    assert_eq!(all, (0..6).map(attempt).collect::<Vec<_>>(), "each once, in order");
    // Another robot gets them, adds its own, and the first one gets that.
    let (mut other, _) = robot(&at("other.db"), remote());
    assert_eq!(other.attempts(0).unwrap().len(), 6);
    other.add_attempt(&attempt(9)).unwrap();
    other.changes(Position::default()).unwrap();
    mine.changes(Position::default()).unwrap();
    let last = mine.attempts(0).unwrap().pop().map(|a| a.1);
    assert_eq!(last, Some(attempt(9)));
    assert_eq!(server.attempts(0).unwrap().len(), 7);
}

/// Asks for what is new until the pause that follows a failure is over.
fn until_delivered(store: &OutboxStore) {
    for _ in 0..1000 {
        store.changes(Position::default()).unwrap();
        if store.waiting().unwrap() == 0 {
            return;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    panic!("{} experiences still wait", store.waiting().unwrap());
}

#[test]
fn a_file_keeps_the_contract() {
    let folder = tempfile::tempdir().unwrap();
    let mut number = 0;
    contract(|| {
        number += 1;
        Box::new(SqliteStore::create(&folder.path().join(format!("{number}.db"))).unwrap())
    });
}

#[test]
fn a_copy_keeps_the_contract_whatever_the_remote_store_does() {
    for state in [FINE, AWAY, LOSES_ANSWERS, SHAKY] {
        let folder = tempfile::tempdir().unwrap();
        let mut number = 0;
        contract(|| {
            number += 1;
            let remote = Remote::new(&folder.path().join(format!("{number}.db")), &Arc::new(state.into()));
            Box::new(robot(&folder.path().join(format!("{number}-outbox.db")), remote).0)
        });
    }
}

#[test]
fn a_robot_continues_offline_and_delivers_later() {
    let folder = tempfile::tempdir().unwrap();
    let (fleet, file) = (folder.path().join("fleet.db"), folder.path().join("outbox.db"));
    let state = Arc::new(AtomicU32::new(AWAY));
    let (mut store, heard) = robot(&file, Remote::new(&fleet, &state));
    let ids: Vec<i64> = (0..3).map(|n| store.add(&experience(n)).unwrap().0).collect();
    assert_eq!(store.waiting().unwrap(), 3);
    let mut index = FeatureIndex::new("test");
    index.refresh(&store).unwrap();
    assert_eq!(index.nearest(&feature(1, 0.0), 1, |_| true)[0].experience, ids[1], "what waits is found");
    assert!(matches!(heard.lock().unwrap().as_slice(), [Notice::Away { waiting: 0, .. }]), "it is said once");
    drop(store);
    let last = heard.lock().unwrap().last().cloned();
    assert_eq!(last, Some(Notice::Waiting { waiting: 3, file: file.clone() }));
    assert!(last.unwrap().to_string().contains("outbox.db"));

    // At the next start.
    state.store(FINE, Ordering::SeqCst);
    let (mut store, heard) = robot(&file, Remote::new(&fleet, &state));
    assert_eq!(heard.lock().unwrap().as_slice(), [Notice::Delivered { delivered: 3, waiting: 0 }]);
    assert_eq!(objects(&SqliteStore::open(&fleet).unwrap()), named(0..3));
    // At the next contact; answers get lost before.
    state.store(LOSES_ANSWERS, Ordering::SeqCst);
    store.add(&experience(3)).unwrap();
    store.add(&experience(4)).unwrap();
    state.store(AWAY, Ordering::SeqCst);
    store.add(&experience(5)).unwrap();
    assert!(store.forget(ids[0]).unwrap());
    state.store(FINE, Ordering::SeqCst);
    until_delivered(&store);
    assert_eq!(objects(&SqliteStore::open(&fleet).unwrap()), named(1..6), "exactly once, in order");
    assert_eq!(objects(&store), named(1..6));
    assert_eq!(store.add(&experience(1)).unwrap(), (ids[1], false), "numbers do not change on delivery");
    let delivered = heard.lock().unwrap().iter().filter(|n| matches!(n, Notice::Delivered { .. })).count();
    assert!(delivered >= 2, "{heard:?}");
}

#[test]
fn robots_share_experiences() {
    let folder = tempfile::tempdir().unwrap();
    let fleet = folder.path().join("fleet.db");
    let state = Arc::new(AtomicU32::new(FINE));
    // One robot has learned before there was a server.
    let old = folder.path().join("old.db");
    SqliteStore::create(&old).unwrap().add(&experience(7)).unwrap();
    let (mut a, _) = robot(&old, Remote::new(&fleet, &state));
    let (mut b, _) = robot(&folder.path().join("b.db"), Remote::new(&fleet, &state));
    assert_eq!(objects(&b), named([7]));
    state.store(AWAY, Ordering::SeqCst);
    a.add(&experience(1)).unwrap();
    b.add(&experience(2)).unwrap();
    b.add(&experience(1)).unwrap();
    state.store(FINE, Ordering::SeqCst);
    for store in [&a, &b, &a] {
        until_delivered(store);
    }
    assert_eq!(objects(&SqliteStore::open(&fleet).unwrap()), named([7, 1, 2]));
    assert_eq!((objects(&a), objects(&b)), (named([7, 1, 2]), named([7, 2, 1])));
    // What one forgets all forget, and it does not come back.
    a.forget(1).unwrap();
    b.changes(Position::default()).unwrap();
    assert_eq!((objects(&a), objects(&b)), (named([1, 2]), named([2, 1])));
    until_delivered(&a);
    assert_eq!(objects(&SqliteStore::open(&fleet).unwrap()), named([1, 2]));
}

#[test]
fn another_server_is_noticed_and_an_unwanted_experience_does_not_block_the_rest() {
    let folder = tempfile::tempdir().unwrap();
    let (fleet, file) = (folder.path().join("fleet.db"), folder.path().join("outbox.db"));
    let state = Arc::new(AtomicU32::new(AWAY));
    let (mut store, heard) = robot(&file, Remote::new(&fleet, &state));
    store.add(&Experience { object: "unwanted".to_owned(), ..experience(0) }).unwrap();
    store.add(&experience(1)).unwrap();
    state.store(FINE, Ordering::SeqCst);
    until_delivered(&store);
    assert_eq!(objects(&SqliteStore::open(&fleet).unwrap()), named([1]));
    let refused = heard.lock().unwrap().iter().filter(|n| matches!(n, Notice::Refused { id: 1, .. })).count();
    assert_eq!(refused, 1);
    drop(store);
    let other = Remote { identity: "second".to_owned(), ..*Remote::new(&folder.path().join("x.db"), &state) };
    let error =
        OutboxStore::create(&file, Box::new(other), &NOW, Box::new(|_| {})).err().unwrap().to_string();
    assert!(error.contains("outbox.db") && error.contains("another store"), "{error}");
}

#[test]
fn a_place_never_shows_a_password() {
    for (url, expected) in [
        ("postgres://robot:secret@host:5433/fleet", "postgres://robot@host:5433/fleet"),
        ("postgres://robot@host/fleet?connect_timeout=3", "postgres://robot@host/fleet"),
        ("postgresql://host/fleet", "postgresql://host/fleet"),
        ("postgres://robot:sec/ret?x@host/fleet", "postgres://robot@host/fleet"),
        ("postgres://robot:a:secret@host", "postgres://robot@host"),
        // A @ that should be %40: which one ends the password is not clear.
        ("postgres://robot:sec@ret@host/fleet", "postgres://(not shown)"),
        ("postgres://host/fleet?user=robot&password=secret", "postgres://(not shown)"),
        ("postgres://host/fleet?Password=sec@ret", "postgres://(not shown)"),
    ] {
        let place = StorePlace::from(url);
        assert!(matches!(place, StorePlace::Server(_)));
        assert_eq!(place.to_string(), expected);
        let all = format!("{place:?} {} {}", place.display(), serde_json::to_string(&place).unwrap());
        assert!(!all.contains("sec") && !all.contains("ret"), "{all}");
    }
    assert_eq!(StorePlace::from("out/a.db"), StorePlace::File("out/a.db".into()));
    if cfg!(not(feature = "postgres")) {
        let place = StorePlace::from("postgres://robot:secret@host/fleet");
        for error in [place.open().err(), place.create().err()] {
            let error = error.unwrap().to_string();
            assert!(error.contains("--features postgres") && !error.contains("secret"), "{error}");
        }
    }
}

#[test]
#[ignore = "started by the other tests"]
fn helper_process() {
    let Some((folder, _)) = helped() else { return };
    let remote = Remote::new(&folder.join("fleet.db"), &Arc::new(SHAKY.into()));
    let (mut store, _) = robot(&folder.join("outbox.db"), remote);
    let mut out = std::io::stdout();
    for number in store.list().unwrap().len() as i64.. {
        store.add(&experience(number)).unwrap();
        writeln!(out, "\nstored {number}").unwrap();
        out.flush().unwrap();
    }
}

#[test]
fn what_a_killed_robot_acknowledged_is_delivered_exactly_once() {
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let kills = kills(12);
    let mut folder = tempfile::tempdir().unwrap();
    let (mut acknowledged, mut unsaid, mut all) = (0, 0, 0);
    for kill in 0..kills {
        if kill % 25 == 0 {
            all += acknowledged;
            (acknowledged, unsaid) = (0, 0);
            folder = tempfile::tempdir().unwrap();
        }
        let mut robot_process = helper(folder.path(), "").spawn().unwrap();
        // The last one gets as far as storing something, on a slow computer too.
        let after = if kill + 1 == kills { 1_000_000 } else { random.random_range(0..200_000) };
        std::thread::sleep(Duration::from_micros(after));
        robot_process.kill().unwrap();
        let output = robot_process.wait_with_output().unwrap();
        let rows = said(&String::from_utf8_lossy(&output.stdout), "stored ");
        (acknowledged, unsaid) = heard(&rows, acknowledged, unsaid);
        if kill % 5 == 4 || kill + 1 == kills {
            let fleet = folder.path().join("fleet.db");
            let (store, _) =
                robot(&folder.path().join("outbox.db"), Remote::new(&fleet, &Arc::new(FINE.into())));
            until_delivered(&store);
            let there = objects(&SqliteStore::open(&fleet).unwrap());
            let expected = acknowledged..=acknowledged + unsaid;
            assert!(expected.contains(&(there.len() as i64)), "{expected:?}: {there:?}");
            assert_eq!(there, named(0..there.len() as i64), "each exactly once, in order");
            (acknowledged, unsaid) = (there.len() as i64, 0);
        }
    }
    all += acknowledged;
    println!("{kills} kills, {all} experiences acknowledged, all delivered exactly once");
    assert!(kills < 10 || all > 0, "the robot never got as far as storing anything");
}
