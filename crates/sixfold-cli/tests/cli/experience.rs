//! Grasps from experience: `sixfold train dgcm`, `sixfold grasp store`, `sixfold grasp learn`, `sixfold grasp propose
//! --experiences`.

use std::fs;
use std::path::Path;

use sixfold_io::write_mask;
use sixfold_render::render_depth;

use crate::support::*;

const VIEW: &str = "grasp propose --depth depth.png --camera camera.json --mask mask.png";

/// An object on a table, and a network that has learned next to nothing: what is stored and found does not depend on it.
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
    let share = |grasp: &serde_json::Value| grasp["experience"]["share"].as_f64().unwrap();
    assert!(
        found["grasps"].as_array().unwrap().iter().any(|g| share(g) > 0.0),
        "the object itself is stored: {found}"
    );
    let part = format!("{VIEW} --experiences a.db --weights w.safetensors --part");
    let handle = sixfold(path, &format!("{part} handle --number 100 --json")).expect(0).json();
    let grasps = handle["grasps"].as_array().unwrap();
    let kinds = ["geometry", "experience"];
    assert!(grasps.iter().all(|g| kinds.contains(&g["experience"]["kind"].as_str().unwrap())));
    // The transferred one, or one of the planner's within 5 cm and 15 degrees of it.
    assert!(grasps.iter().any(|g| share(g) > 0.0), "what was stored is among them: {handle}");
    let lid = sixfold(path, &format!("{part} lid")).expect(1);
    assert!(lid.stderr.contains("no experience on a part named lid"), "{}", lid.stderr);

    let merged = sixfold(path, "grasp store merge a.db b.db --json").expect(0).json();
    assert_eq!((merged["added"].as_i64(), merged["experiences"].as_i64()), (Some(1), Some(2)));
    sixfold(path, "grasp store merge a.db b.db").expect(1);
    sixfold(path, "grasp store show a.db 1 --picture shown.png").expect(0);
    assert!(fs::metadata(path.join("shown.png")).unwrap().len() > 2000);
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
fn a_hand_learns_and_goes_on() {
    let case = folder();
    let path = case.path();
    let learn = "grasp learn --experiences e.db --object part.ply --unit mm --attempts 3 --tries 3 --near 9 --weights w.safetensors --out learn --json";
    let first = sixfold(path, learn).expect(0).json();
    assert_eq!(first["attempts"], 3);
    let held = first["held"].as_i64().unwrap();
    assert!(held >= 1);
    assert_eq!(first["experiences"].as_i64(), Some(held));
    // What failed is known as well, and what is tried besides.
    assert!(first["outcomes"].as_i64().unwrap() >= 3, "{first}");
    let explore = "grasp learn --experiences more.db --object part.ply --unit mm --attempts 1 --explore 3 --near 0 --seed 5 --weights w.safetensors --out more --json";
    let more = sixfold(path, explore).json();
    assert!((2..=4).contains(&more["outcomes"].as_i64().unwrap()), "{more}");
    let merged = sixfold(path, "grasp store merge all.db e.db more.db --json").expect(0).json();
    assert_eq!(merged["experiences"].as_i64().unwrap(), held + more["experiences"].as_i64().unwrap());
    // From the second success on there is experience, and near is far enough for all of it.
    assert!(first["from_experience"].as_i64().unwrap() >= 1, "{first}");
    // Nothing is left to do; a line that was cut off is done again.
    let journal = path.join("learn/attempts.jsonl");
    let text = fs::read_to_string(&journal).unwrap();
    fs::write(&journal, &text[..text.len() - 20]).unwrap();
    let second = sixfold(path, learn).expect(0).json();
    assert_eq!(second["attempts"], 3);
    fails(path, &learn.replace("--attempts 3", "--attempts 4"), &["attempts.jsonl", "other options"]);
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

/// Nobody listens there, and nobody may read the password.
const ADDRESS: &str = "postgres://robot:secret@127.0.0.1:1/fleet";

#[test]
fn a_server_that_cannot_be_had_is_named_without_its_password() {
    let case = folder();
    let path = case.path();
    sixfold(path, &format!("{VIEW} --out out")).expect(0);
    add(path, "a.db", "").expect(0);
    // A build of the whole workspace may have the feature without the program's own name for it.
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
    // The outbox may lie elsewhere; what is wrong with it is told.
    fs::write(path.join("text.db"), "not a database, but long enough to look like one to somebody").unwrap();
    fails(
        path,
        &learn.replace("--out learn", "--out other --outbox text.db"),
        &["text.db", "expected an experience store"],
    );
}
