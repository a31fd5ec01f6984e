//! `sixfold grasp measure` and `sixfold grasp compare`.

use clap::Parser;
use sixfold_shell::grasp::learn::{LearnArguments, learn};

use crate::support::*;

/// The network that comes with Sixfold.
const NETWORK: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../weights/dgcm.safetensors");

#[derive(Parser)]
struct Learn {
    #[command(flatten)]
    arguments: LearnArguments,
}

#[test]
fn the_planner_is_measured() {
    let case = OneImage::new();
    let measure = "grasp measure --object part.ply --unit mm --trials 2 --out out --json";
    let first = sixfold(case.path(), measure).expect(0).json();
    assert_eq!(first["classes"][0]["trials"], 2);
    assert!(case.path().join("out/trials.json").exists());
    let again = sixfold(case.path(), &format!("--threads 1 {measure}")).expect(0).json();
    for number in 0..2 {
        let trial = |json: &serde_json::Value| json["objects"][0]["trials"][number]["report"].clone();
        assert_eq!(trial(&first), trial(&again));
    }
}

#[test]
fn experience_is_compared_with_geometry() {
    let case = OneImage::new();
    let path = case.path();
    let folder = path.display();
    let words = format!(
        "learn --experiences {folder}/e.db --object {folder}/part.ply --unit mm --attempts 3 --tries 3 --near 9 --weights {NETWORK} --out {folder}/learn"
    );
    learn(&Learn::parse_from(words.split_whitespace()).arguments).unwrap();
    let compare = &format!(
        "grasp compare --experiences e.db --object part.ply --unit mm --trials 2 --weights {NETWORK} --out compare --json"
    );
    let table = sixfold(path, compare);
    assert!(table.code <= 1, "{}", table.stderr);
    let table = table.json();
    assert_eq!(table["classes"][0]["trials"], 2);
    assert!(
        path.join("compare/part-0-both.png").exists() || path.join("compare/part-ply-0-both.png").exists()
    );
    assert_eq!(sixfold(path, compare).json()["classes"], table["classes"]);
}
