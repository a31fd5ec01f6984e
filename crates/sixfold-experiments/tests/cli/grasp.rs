//! `sixfold grasp measure` and `sixfold grasp compare`.

use crate::made::{NETWORK, experiences};
use crate::support::*;

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
    experiences(path);
    let compare = &format!(
        "grasp compare --experiences e.db --object part.ply --unit mm --trials 2 --weights {NETWORK} --out compare --json"
    );
    let table = sixfold(path, compare);
    assert!(table.code <= 1, "{}", table.stderr);
    let table = table.json();
    assert_eq!(table["classes"][0]["trials"], 2);
    assert_eq!(table["classes"][0]["rates"].as_array().unwrap().len(), 11, "GPD and HAF, alone and combined");
    assert!(
        path.join("compare/part-0-both.png").exists() || path.join("compare/part-ply-0-both.png").exists()
    );
    assert_eq!(sixfold(path, compare).json()["classes"], table["classes"]);
    // The published form with one of its rules at a time replaced by ours, ours among them as in the other table.
    let rules = compare.replace("--out compare", "--published-rules --out rules");
    let rules = sixfold(path, &rules).json();
    let rate = |table: &serde_json::Value, method: &str| {
        let place = table["methods"].as_array().unwrap().iter().position(|m| m == method).unwrap();
        table["classes"][0]["rates"][place].clone()
    };
    assert_eq!(rules["methods"].as_array().unwrap().len(), 11);
    assert_eq!(rules["classes"][0]["rates"].as_array().unwrap().len(), 11);
    for method in ["network", "experience"] {
        assert_eq!(rate(&rules, method), rate(&table, method), "{method}");
    }
    let mixed = compare.replace("--json", "--published-rules --json");
    fails(path, &mixed, &["other options"]);
    fails(path, &format!("{mixed} --gpd gpd.safetensors"), &["--gpd", "--published-rules"]);
}

#[test]
fn objects_of_a_list_have_units_of_their_own() {
    let dir = tempfile::tempdir().unwrap();
    for command in ["measure --list l.json", "compare --list l.json --experiences e.db --out out"] {
        let refused = |option: &str| {
            fails(dir.path(), &format!("grasp {command} {option}"), &[option.split(' ').next().unwrap()]);
        };
        refused("--unit mm");
        refused("--store objects");
    }
    // A synthetic object, the same each time; an incomplete entry is refused.
    let list = |text: &str| std::fs::write(dir.path().join("l.json"), text).unwrap();
    list(r#"[{"class": "cup", "synthetic": {"family": "cup", "number": 1}}]"#);
    let measure = "grasp measure --list l.json --trials 1 --json";
    let first = sixfold(dir.path(), measure).json();
    assert_eq!(first["objects"][0]["name"], "synthetic cup 1");
    assert_eq!(first["objects"][0]["parts"], sixfold(dir.path(), measure).json()["objects"][0]["parts"]);
    list(r#"[{"class": "cup", "mesh": "cup.ply", "synthetic": {"family": "cup", "number": 1}}]"#);
    fails(dir.path(), measure, &["l.json", "class cup", "mesh and unit, or synthetic alone"]);
}
