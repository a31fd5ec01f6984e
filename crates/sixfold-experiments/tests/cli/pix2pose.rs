//! `sixfold reproduce pix2pose`, on images that the test renders.

use crate::made::pix2pose;
use crate::support::*;

const WEIGHTS: &str = "trained/model.safetensors";

#[test]
fn the_table_is_made_row_by_row() {
    let tiny = Tiny::coloured();
    pix2pose(tiny.path());
    tiny.write_truth_as_results("perfect.csv");
    let command = format!(
        "reproduce pix2pose --dataset tiny --frames frames.json --weights {WEIGHTS} --published perfect.csv --out table"
    );
    let run = sixfold(tiny.path(), &format!("{command} --json"));
    assert!(run.code == 0 || run.code == 1, "{}", run.stderr);
    let json = run.json();
    // Object 1 in the only frame that was not used for training; the model was not trained on object 2.
    assert_eq!((&json["frames"], &json["targets"]), (&1.into(), &1.into()));
    let rows = json["rows"].as_array().unwrap();
    let keys: Vec<&str> = rows.iter().map(|r| r["key"].as_str().unwrap()).collect();
    for key in [
        "default",
        "no-refinement",
        "as-published",
        "one-stage",
        "bug-recentring",
        "bugs-all",
        "noise-20",
        "published",
    ] {
        assert!(keys.contains(&key), "{key} is not in {keys:?}");
        assert!(tiny.path().join(format!("table/rows/{key}.json")).is_file());
    }
    let published = &rows[keys.iter().position(|k| *k == "published").unwrap()]["scores"];
    for score in ["ar_mssd", "ar_mspd", "add_s"] {
        assert!((published[score].as_f64().unwrap() - 1.0).abs() < 1e-9, "{score}: {published}");
    }
    let table = std::fs::read_to_string(tiny.path().join("table/table.md")).unwrap();
    assert!(table.contains("| 1.000 | 1.000 | 1.000 |") && table.contains("0.320"), "{table}");

    // Existing rows are not made again; missing ones are.
    let edited = tiny.path().join("table/rows/one-stage.json");
    replace(&edited, "\"one stage, PnP\"", "\"kept from before\"");
    std::fs::remove_file(tiny.path().join("table/rows/noise-20.json")).unwrap();
    let run = sixfold(tiny.path(), &command);
    assert!(run.stdout.contains("kept from before"), "{}", run.stdout);
    assert!(run.stderr.contains("row noise-20") && !run.stderr.contains("row default"), "{}", run.stderr);

    fails(tiny.path(), &format!("{command} --quick"), &["table", "quick was false, is true"]);
    // Training frames cannot be used as tests.
    std::fs::write(tiny.path().join("wrong.json"), "[{\"scene_id\": 7, \"im_id\": 0}]").unwrap();
    let wrong = command.replace("frames.json", "wrong.json").replace("--out table", "--out other");
    fails(tiny.path(), &wrong, &["7/11", "wrong.json"]);
    let all = serde_json::json!([0, 4, 11].map(|im| serde_json::json!({"scene_id": 7, "im_id": im})));
    std::fs::write(tiny.path().join("all.json"), all.to_string()).unwrap();
    fails(
        tiny.path(),
        &command.replace("frames.json", "all.json").replace("--out table", "--out other"),
        &["no target"],
    );
}

#[test]
fn the_trainings_of_the_ablations_are_made_scored_and_kept() {
    let tiny = Tiny::coloured();
    pix2pose(tiny.path());
    let command = format!(
        "reproduce pix2pose --dataset tiny --frames frames.json --weights {WEIGHTS} --quick --train --steps 2 --size 64 --out table"
    );
    let run = sixfold(tiny.path(), &format!("{command} --json"));
    assert!(run.code == 0 || run.code == 1, "{}", run.stderr);
    let json = run.json();
    let rows = json["rows"].as_array().unwrap();
    let row = |key: &str| rows.iter().find(|r| r["key"] == format!("{key}-2"));
    // The part has no symmetry: nothing is trained for those, and the reason is reported.
    assert!(row("trained-transformer-loss").is_none());
    assert!(run.stderr.contains("trained-plain-l1-2: the model has no such object"), "{}", run.stderr);
    // Each with its own network and row, on the frame that was not used for training.
    for key in ["trained-mesh", "trained-discriminator", "trained-convex-hull", "fourfold-plain-l1"] {
        let row = row(key).unwrap_or_else(|| panic!("{key} is not in {rows:?}"));
        assert!((0.0..=1.0).contains(&row["scores"]["ar_mspd"].as_f64().unwrap()), "{row}");
        assert!(tiny.path().join(format!("table/trainings/{key}-2/model.safetensors")).is_file());
    }
    let weights = |key: &str| {
        std::fs::read(tiny.path().join(format!("table/trainings/{key}-2/model.safetensors"))).unwrap()
    };
    assert_ne!(weights("trained-mesh"), weights("trained-discriminator"));
    assert_ne!(weights("trained-mesh"), weights("trained-convex-hull"));
    assert_ne!(weights("fourfold-plain-l1"), weights("fourfold-transformer-loss"));
    assert!(rows.iter().any(|r| r["key"] == "trained-mesh-2-half-black"), "{rows:?}");
}

/// Figure 3.3, on the eggbox of the sample data.
#[test]
fn the_loss_of_a_symmetric_object_is_plotted_against_its_rotation() {
    let dir = tempfile::tempdir().unwrap();
    let demo = concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/demo");
    let command = |more: &str| format!("reproduce loss-curve --dataset {demo} --out curves {more}");
    let json = sixfold(dir.path(), &command("--json")).expect(0).json();
    let curve = &json["objects"]["10"];
    let value = |loss: &str, step: usize| curve[loss][step].as_f64().unwrap();
    assert_eq!(curve["degrees"][90], 180.0);
    // After half a rotation the eggbox appears nearly the same: only L1 is large.
    assert!(value("l1", 90) > 5.0 * value("transformer", 90), "{curve}");
    assert!(value("transformer", 45) > 5.0 * value("transformer", 90), "{curve}");
    let plot = sixfold_io::read_rgb(&dir.path().join("curves/obj_000010.png")).unwrap();
    assert!(plot.as_slice().iter().any(|p| *p != [255; 3]));
    let none = sixfold(dir.path(), &command("--ids 1")).expect(1);
    assert!(none.stderr.contains("object 1 has no curve"), "{}", none.stderr);
    let unknown = sixfold(dir.path(), &command("--ids 999")).expect(2);
    assert!(unknown.stderr.contains("--ids 999") && unknown.stderr.contains("12"), "{}", unknown.stderr);
}
