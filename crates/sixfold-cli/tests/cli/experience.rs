//! Grasps from experience: `sixfold train dgcm`, `sixfold grasp store`, `sixfold grasp learn`, `sixfold grasp propose
//! --experiences`.

use std::fs;
use std::path::Path;

use sixfold_geometry::RgbImage;
use sixfold_io::write_mask;
use sixfold_render::render_depth;

use crate::support::*;

const VIEW: &str = "grasp propose --depth depth.png --camera camera.json --mask mask.png";

/// An object on a table, and a hardly trained network: the stored and found grasps do not depend on it.
fn folder() -> OneImage {
    let case = OneImage::new();
    let alone = render_depth(&part(), &case.truth, &camera());
    write_mask(&case.path().join("mask.png"), &alone.map(|&z| z > 0.0)).unwrap();
    let run = sixfold(case.path(), "train dgcm --views 64 --steps 2 --pairs 2 --out net --json").expect(0);
    assert_eq!(run.json()["steps"], 2);
    fs::rename(case.path().join("net/model.safetensors"), case.path().join("w.safetensors")).unwrap();
    case
}

fn add(folder: &Path, file: &str, more: &str) -> Run {
    let command = format!(
        "grasp store add {file} --depth depth.png --camera camera.json --mask mask.png --grasp out/grasps.json --object part --weights w.safetensors {more} --json"
    );
    sixfold(folder, &command)
}

#[test]
fn experience_is_stored_shown_used_merged_exported_and_forgotten() {
    let case = folder();
    let path = case.path();
    sixfold(path, &format!("{VIEW} --out out")).expect(0);
    let first = add(path, "a.db", "--part handle").expect(0).json();
    assert_eq!((first["id"].as_i64(), first["new"].as_bool()), (Some(1), Some(true)));
    assert_eq!(add(path, "a.db", "--part handle").expect(0).json()["new"], false);
    add(path, "b.db", "--number 2").expect(0);

    let found =
        sixfold(path, &format!("{VIEW} --experiences a.db --weights w.safetensors --number 100 --json"))
            .expect(0)
            .json();
    assert_eq!(found["method"], "antipodal and dgcm");
    let agreement = |grasp: &serde_json::Value| grasp["experience"]["agreement"].as_f64().unwrap();
    assert!(
        found["grasps"].as_array().unwrap().iter().any(|g| agreement(g) > 0.0),
        "the object itself is stored: {found}"
    );
    let part = format!("{VIEW} --experiences a.db --weights w.safetensors --part");
    let handle = sixfold(path, &format!("{part} handle --number 100 --json")).expect(0).json();
    let grasps = handle["grasps"].as_array().unwrap();
    let kinds = ["geometry", "experience"];
    assert!(grasps.iter().all(|g| kinds.contains(&g["experience"]["kind"].as_str().unwrap())));
    // The transferred grasp, or one of the planner's within 5 cm and 15 degrees of it.
    assert!(grasps.iter().any(|g| agreement(g) > 0.0), "what was stored is among them: {handle}");
    let lid = sixfold(path, &format!("{part} lid")).expect(1);
    assert!(lid.stderr.contains("no experience on a part named lid"), "{}", lid.stderr);

    let merged = sixfold(path, "grasp store merge a.db b.db --json").expect(0).json();
    assert_eq!((merged["added"].as_i64(), merged["experiences"].as_i64()), (Some(1), Some(2)));
    sixfold(path, "grasp store merge a.db b.db").expect(1);
    sixfold(path, "grasp store show a.db 1 --picture shown.png").expect(0);
    assert!(fs::metadata(path.join("shown.png")).unwrap().len() > 2000);
    // The object beside its nearest experiences: two are stored; the columns show them as `store show` does.
    sixfold(path, &format!("{VIEW} --experiences a.db --weights w.safetensors --out near")).expect(0);
    let near = sixfold_io::read_rgb(&path.join("near/experiences.png")).unwrap();
    let side = near.height() / 2;
    assert_eq!(near.width(), 3 * side);
    let quarter = |image: &RgbImage, left: usize| -> Vec<[u8; 3]> {
        (0..side * side / 2).map(|i| image[(left + i % side, i / side)]).collect()
    };
    let columns = [1, 2].map(|column| quarter(&near, column * side));
    for id in [1, 2] {
        sixfold(path, &format!("grasp store show a.db {id} --picture shown.png")).expect(0);
        let shown = quarter(&sixfold_io::read_rgb(&path.join("shown.png")).unwrap(), 0);
        assert!(columns.contains(&shown), "experience {id} is not in the picture");
    }
    assert!(!path.join("out/experiences.png").exists(), "that was without experiences");
    sixfold(path, "grasp store export a.db --out files").expect(0);
    let text = fs::read_to_string(path.join("files/000001.json")).unwrap();
    let exported: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(exported["part"], "handle");
    assert_eq!(exported["feature"].as_array().unwrap().len(), 256);
    let again = "grasp store refresh a.db --out c.db --weights w.safetensors --json";
    assert_eq!(sixfold(path, again).expect(0).json()["experiences"], 2);
    sixfold(path, "grasp store forget a.db 1 2").expect(0);
    sixfold(path, "grasp store list a.db").expect(1);
    sixfold(path, "grasp store forget a.db 1").expect(1);
}

#[test]
fn learning_grasps_resumes() {
    let case = folder();
    let path = case.path();
    let learn = "grasp learn --experiences e.db --object part.ply --unit mm --attempts 3 --tries 3 --near 9 --weights w.safetensors --out learn --json";
    let first = sixfold(path, learn).expect(0).json();
    assert_eq!(first["attempts"], 3);
    let held = first["held"].as_i64().unwrap();
    assert!(held >= 1);
    assert_eq!(first["experiences"].as_i64(), Some(held));
    // Failed grasps are recorded too, and so are additional trials.
    assert!(first["outcomes"].as_i64().unwrap() >= 3, "{first}");
    let explore = "grasp learn --experiences more.db --object part.ply --unit mm --attempts 1 --explore 3 --near 0 --seed 5 --weights w.safetensors --out more --json";
    let more = sixfold(path, explore).json();
    assert!((2..=4).contains(&more["outcomes"].as_i64().unwrap()), "{more}");
    let merged = sixfold(path, "grasp store merge all.db e.db more.db --json").expect(0).json();
    assert_eq!(merged["experiences"].as_i64().unwrap(), held + more["experiences"].as_i64().unwrap());
    // From the second success on there is experience, and the distance limit is large enough for all of it.
    assert!(first["from_experience"].as_i64().unwrap() >= 1, "{first}");
    // Nothing is left to do; a truncated line is done again.
    let journal = path.join("learn/attempts.jsonl");
    let text = fs::read_to_string(&journal).unwrap();
    fs::write(&journal, &text[..text.len() - 20]).unwrap();
    let second = sixfold(path, learn).expect(0).json();
    assert_eq!(second["attempts"], 3);
    fails(path, &learn.replace("--attempts 3", "--attempts 4"), &["attempts.jsonl", "other options"]);
}

const LEARN: &str = "grasp learn --experiences e.db --object part.ply --unit mm --attempts 3 --tries 3 --explore 2 --near 9 --weights w.safetensors --out learn --json";

/// Rows of a learning folder, without the first line, which holds the journal's name.
fn rows(folder: &Path) -> Vec<String> {
    let text = fs::read_to_string(folder.join("attempts.jsonl")).unwrap_or_default();
    text.lines().skip(1).map(str::to_owned).collect()
}

#[test]
fn a_journal_without_its_store_is_refused() {
    let case = folder();
    let path = case.path();
    let learn = LEARN.replace("--attempts 3 --tries 3 --explore 2", "--attempts 2");
    let first = sixfold(path, &learn).json();
    assert_eq!(first["attempts"], 2);
    for name in ["e.db", "e.db-wal", "e.db-shm"] {
        let _ = fs::rename(path.join(name), path.join(format!("kept-{name}")));
    }
    fails(path, &learn, &["attempts.jsonl", "holds 2 scenes", "e.db has 0", "another store", "--out"]);
    assert!(!path.join("e.db").exists(), "what is refused makes no store");
    // Another store at its place.
    let another = learn.replace("--out learn", "--out other").replace("--attempts 2", "--attempts 1");
    sixfold(path, &another);
    fails(path, &learn, &["attempts.jsonl", "holds 2 scenes", "e.db has 0"]);
    // Its own store is put back.
    for name in ["e.db", "e.db-wal", "e.db-shm"] {
        let _ = fs::remove_file(path.join(name));
        let _ = fs::rename(path.join(format!("kept-{name}")), path.join(name));
    }
    assert_eq!(sixfold(path, &learn).json(), first);
}

#[test]
fn a_hand_that_is_killed_ends_as_if_nothing_had_happened() {
    let case = folder();
    let path = case.path();
    let began = std::time::Instant::now();
    let expected = sixfold(path, LEARN).expect(0).json();
    let whole = began.elapsed();
    let kills: u32 = std::env::var("SIXFOLD_KILLS").ok().and_then(|n| n.parse().ok()).unwrap_or(4);
    for kill in 0..kills {
        let (store, out) = (format!("e{kill}.db"), format!("learn{kill}"));
        let learn = LEARN.replace("e.db", &store).replace("--out learn", &format!("--out {out}"));
        // Two kills in each round, spread over the duration of the command.
        for part in [f64::from(kill) + 0.4, f64::from(kills - kill) + 0.7] {
            let mut hand = std::process::Command::new(crate::PROGRAM)
                .args(learn.split_whitespace())
                .current_dir(path)
                .stdout(std::process::Stdio::null())
                .stderr(std::process::Stdio::null())
                .spawn()
                .unwrap();
            std::thread::sleep(whole.mul_f64(part / f64::from(kills + 1)));
            hand.kill().unwrap();
            hand.wait().unwrap();
        }
        let end = sixfold(path, &learn).expect(0).json();
        assert_eq!(end, expected, "killed for the {kill}. time");
        assert_eq!(rows(&path.join(out)), rows(&path.join("learn")));
        let attempts = |file: &str| {
            let listed =
                sixfold(path, &format!("grasp store list {file} --attempts --json")).expect(0).json();
            let mut listed = listed.as_array().unwrap().clone();
            listed.iter_mut().for_each(|attempt| attempt["time"] = 0.into());
            listed
        };
        assert_eq!(attempts(&store), attempts("e.db"));
    }
}

#[test]
fn two_hands_do_not_learn_into_one_folder() {
    let case = folder();
    let path = case.path();
    let lock = sixfold_io::WriteLock::take(&path.join("learn/attempts.jsonl")).unwrap();
    fails(path, LEARN, &["attempts.jsonl", "another process"]);
    drop(lock);
    assert!(!path.join("e.db").exists());
}

#[test]
fn a_gripper_under_a_centimetre_is_no_panic() {
    let case = folder();
    let path = case.path();
    sixfold(path, &format!("{VIEW} --out out")).expect(0);
    add(path, "a.db", "").expect(0);
    let small = |opening: f64, others: f64| {
        serde_json::json!({
            "kind": "parallel-jaws", "name": "small", "max_opening": opening, "finger_length": 5.0 * others,
            "finger_width": others, "finger_thickness": others, "palm_width": 5.0 * others, "palm_depth": 5.0 * others,
            "palm_height": 5.0 * others, "force": 1.0, "friction": 0.5,
        })
    };
    for (opening, others) in [(0.001, 0.001), (0.0099, 0.001), (0.009, 0.05), (1.0, 0.001)] {
        fs::write(path.join("small.json"), small(opening, others).to_string()).unwrap();
        let run =
            sixfold(path, &format!("{VIEW} --experiences a.db --weights w.safetensors --gripper small.json"));
        assert!(run.code == 0 || run.code == 1, "{}", run.stderr);
    }
    for (field, value) in [("max_opening", 0.0), ("palm_width", 1e300), ("finger_width", -1.0)] {
        let mut gripper = small(0.05, 0.01);
        gripper[field] = value.into();
        fs::write(path.join("small.json"), gripper.to_string()).unwrap();
        fails(path, &format!("{VIEW} --gripper small.json"), &["small.json", field, "expected"]);
    }
}

/// Overwrites the first byte of a byte sequence in a file.
fn overwrite(file: &Path, bytes: &[u8]) {
    let mut content = fs::read(file).unwrap();
    let place = content.windows(bytes.len()).position(|found| found == bytes).unwrap();
    content[place] = b'[';
    fs::write(file, content).unwrap();
}

#[test]
fn one_broken_row_blocks_nothing_and_can_be_removed() {
    let case = folder();
    let path = case.path();
    sixfold(path, &format!("{VIEW} --out out")).expect(0);
    add(path, "e.db", "").expect(0);
    overwrite(&path.join("e.db"), b"\x89PNG");
    for number in 2..=3 {
        add(path, "e.db", &format!("--number {number}")).expect(0);
    }
    sixfold(path, &LEARN.replace("--attempts 3", "--attempts 1"));
    overwrite(&path.join("e.db"), b"{\"description\"");
    let listed = sixfold(path, "grasp store list e.db --attempts").expect(0).stderr;
    let broken = listed.split_once("note: attempt ").unwrap().1.split_once(':').unwrap().0;
    let propose = format!("{VIEW} --experiences e.db --weights w.safetensors");
    let learn = LEARN.replace("--out learn", "--out again");
    for command in [&propose, &learn] {
        let run = sixfold(path, command).expect(0);
        for words in [
            ["experience 1", "field depth", "grasp store forget e.db 1`"],
            [
                &format!("attempt {broken}"),
                "left out",
                &format!("grasp store forget e.db --attempt {broken}`"),
            ],
        ] {
            let named = run.stderr.lines().any(|line| words.iter().all(|word| line.contains(word)));
            assert!(named, "{command}: {words:?}: {}", run.stderr);
        }
    }
    let merged = sixfold(path, "grasp store merge new.db e.db --json").expect(2);
    assert_eq!(merged.json()["unreadable"], 2);
    sixfold(path, &format!("grasp store forget e.db 1 --attempt {broken}")).expect(0);
    let run = sixfold(path, &propose).expect(0);
    assert!(!run.stderr.contains("left out"), "{}", run.stderr);
    sixfold(path, &format!("grasp store forget e.db --attempt {broken}")).expect(1);
    sixfold(path, "grasp store merge other.db e.db").expect(0);
}

#[test]
fn a_damaged_store_is_saved_by_the_command_that_it_names() {
    let case = folder();
    let path = case.path();
    sixfold(path, &format!("{VIEW} --out out --number 9")).expect(0);
    for number in 1..=6 {
        add(path, "a.db", &format!("--number {number}"));
    }
    let bytes = fs::read(path.join("a.db")).unwrap();
    fs::write(path.join("a.db"), &bytes[..bytes.len() * 3 / 4]).unwrap();
    for command in
        ["grasp store list a.db".to_owned(), format!("{VIEW} --experiences a.db --weights w.safetensors")]
    {
        fails(path, &command, &["a.db", "damaged", "sixfold grasp store merge NEW.db a.db"]);
    }
    let saved = sixfold(path, "grasp store merge NEW.db a.db --json").expect(2).json();
    let experiences = saved["experiences"].as_u64().unwrap();
    assert!(experiences > 0 && saved["unreadable"].as_u64().unwrap() > 0, "{saved}");
    let files = sixfold(path, "grasp store export a.db --out files --json").expect(2).json();
    assert_eq!(files["experiences"].as_u64(), Some(experiences));
}

#[test]
fn an_address_that_is_none_is_refused_without_its_password() {
    let case = folder();
    let path = case.path();
    for address in [
        "Postgres://robot:secret@127.0.0.1:1/fleet",
        "postgresql+psycopg://robot:secret@127.0.0.1:1/fleet",
        "password=secret",
        "postgres://robot%3Asecret@127.0.0.1:1/fleet",
        "robot:secret@127.0.0.1/fleet",
    ] {
        let learn = LEARN.replace("e.db", address).replace("--attempts 3", "--attempts 1");
        for command in
            [format!("grasp store list {address}"), format!("grasp store merge {address} {address}")]
        {
            let run = sixfold(path, &command).expect(2);
            assert!(!run.stderr.contains("secret"), "{}", run.stderr);
        }
        // With an unreachable server, learning continues without it.
        if !(cfg!(feature = "postgres") && address.starts_with("Postgres")) {
            let run = sixfold(path, &learn).expect(2);
            assert!(!run.stderr.contains("secret"), "{}", run.stderr);
        }
    }
    let made = fs::read_dir(path).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let made: Vec<String> = made.filter(|name| name.contains("secret")).collect();
    assert!(made.is_empty(), "{made:?}");
}

#[test]
fn what_is_wrong_is_named() {
    let case = folder();
    let path = case.path();
    sixfold(path, &format!("{VIEW} --out out")).expect(0);
    fails(path, "grasp store list none.db", &["none.db", "no such file"]);
    fs::write(
        path.join("text.db"),
        "not a database, but long enough to look like one to somebody in a hurry",
    )
    .unwrap();
    fails(path, "grasp store list text.db", &["text.db", "expected an experience store"]);
    fails(
        path,
        "grasp store add a.db --depth depth.png --camera camera.json --grasp out/grasps.json --object a --weights none",
        &["--weights", "sixfold train dgcm"],
    );
    let command = format!("{VIEW} --experiences text.db --weights w.safetensors");
    fails(path, &command, &["text.db"]);
    let run = add(path, "a.db", "--number 99");
    assert_eq!(run.code, 2);
    assert!(run.stderr.contains("--number: found 99"), "{}", run.stderr);
    let far = r#"{"camera_from_gripper": [[1,0,0,5],[0,1,0,0],[0,0,1,1],[0,0,0,1]], "opening": 0.05, "width": 0.03}"#;
    fs::write(path.join("far.json"), far).unwrap();
    let command = "grasp store add a.db --depth depth.png --camera camera.json --mask mask.png --grasp far.json --object a --weights w.safetensors";
    fails(path, command, &["far.json", "nowhere near the object"]);
    fs::write(path.join("far.json"), far.replace("0.05", "-1")).unwrap();
    fails(path, command, &["far.json", "opening"]);
    let learn = "grasp learn --experiences e.db --weights w.safetensors --out learn";
    fails(path, &format!("{learn} --families can --outbox o.db"), &["--outbox", "o.db", "postgres://"]);
    fails(path, &format!("{learn} --families chair"), &["--families", "chair", "mug"]);
    fails(path, "train dgcm --views 3 --out x", &["--views", "64"]);
}

/// No server listens there, and the password must not be printed.
const ADDRESS: &str = "postgres://robot:secret@127.0.0.1:1/fleet";

#[test]
fn a_server_that_cannot_be_had_is_named_without_its_password() {
    let case = folder();
    let path = case.path();
    sixfold(path, &format!("{VIEW} --out out")).expect(0);
    add(path, "a.db", "").expect(0);
    // A build of the whole workspace may enable the feature without the program's own feature flag.
    let words = ["server of the experience store cannot be reached", "--features postgres"];
    let expected = &words[..if cfg!(feature = "postgres") { 1 } else { 2 }];
    for command in [
        format!("grasp store list {ADDRESS}"),
        format!("grasp store show {ADDRESS} 1"),
        format!("grasp store merge {ADDRESS} a.db"),
        format!("grasp store merge a.db {ADDRESS}"),
        format!("grasp store refresh a.db --out {ADDRESS} --weights w.safetensors"),
        format!("{VIEW} --experiences {ADDRESS} --weights w.safetensors"),
    ] {
        let run = sixfold(path, &command).expect(2);
        assert!(expected.iter().any(|words| run.stderr.contains(words)), "{}", run.stderr);
        assert!(run.stderr.contains("postgres://robot@127.0.0.1:1/fleet"), "{}", run.stderr);
        assert!(!run.stderr.contains("secret"), "{}", run.stderr);
    }
}

#[test]
#[cfg(feature = "postgres")]
fn a_hand_learns_while_the_server_is_away() {
    let case = folder();
    let path = case.path();
    let learn = format!(
        "grasp learn --experiences {ADDRESS} --object part.ply --unit mm --attempts 3 --tries 3 --near 9 --weights w.safetensors --out learn --json"
    );
    let run = sixfold(path, &learn).expect(0);
    let whole = run.json();
    let held = whole["held"].as_i64().unwrap();
    assert!(held >= 1 && whole["from_experience"].as_i64().unwrap() >= 1, "{whole}");
    assert!(run.stderr.contains("Going on without"), "{}", run.stderr);
    assert!(run.stderr.contains(&format!("{held} experiences wait in learn/outbox.db")), "{}", run.stderr);
    let journal = fs::read_to_string(path.join("learn/attempts.jsonl")).unwrap();
    assert!(!journal.contains("secret") && !run.stderr.contains("secret") && !run.stdout.contains("secret"));
    let listed = sixfold(path, "grasp store list learn/outbox.db --json").expect(0).json();
    assert_eq!(listed.as_array().unwrap().len() as i64, held);
    // The outbox may be elsewhere; errors in it are reported.
    fs::write(path.join("text.db"), "not a database, but long enough to look like one to somebody").unwrap();
    fails(
        path,
        &learn.replace("--out learn", "--out other --outbox text.db"),
        &["text.db", "expected an experience store"],
    );
}
