//! `sixfold estimate --method auto`.

use serde_json::Value;
use sixfold_geometry::RgbImage;
use sixfold_io::write_rgb;
use sixfold_mesh::{PlyFormat, Unit, write_ply};

use crate::support::*;

const DEPTH: &str = "estimate --method auto --depth depth.png --camera camera.json --unit mm";

#[test]
fn it_prints_probabilities_and_absent_objects() {
    let case = OneImage::new();
    let dir = case.path();
    write_other_part(dir);
    let run = sixfold(dir, &format!("{DEPTH} --object part.ply other.ply --json --out out")).expect(0).json();
    let poses = run["poses"].as_array().unwrap();
    assert!(poses.iter().all(|pose| pose["alternatives"].is_array()), "{poses:?}");
    assert_eq!(poses.len(), 1, "{poses:?}");
    assert_near(&pose_of(&poses[0]["camera_from_object"]), &case.truth);
    let probability = poses[0]["probability"].as_f64().unwrap();
    assert!((0.5..=1.0).contains(&probability), "{probability}");
    assert_eq!(poses[0]["confidence"].as_f64(), Some(probability));
    assert!(poses[0]["evidence"]["visible"].as_f64().unwrap() > 0.5, "{}", poses[0]);
    assert!(!poses[0]["found_by"].as_array().unwrap().is_empty());
    assert_eq!(run["not_found"], serde_json::json!(["other"]));
    assert!(dir.join("out/overlay.png").is_file());

    let table = sixfold(dir, &format!("{DEPTH} --object part.ply")).expect(0).stdout;
    assert!(table.starts_with("object") && table.contains(" probability "), "{table}");
    // Methods without probabilities report none.
    let table = sixfold(dir, &format!("{} --method ppf", OneImage::ARGUMENTS)).expect(0).stdout;
    assert!(table.contains(" confidence ") && !table.contains("probability"), "{table}");
    // An absent object gives "nothing found".
    sixfold(dir, &format!("{DEPTH} --object other.ply")).expect(1);
}

fn write_other_part(dir: &std::path::Path) {
    write_ply(dir.join("other.ply"), &other_part(), Unit::Millimetre, PlyFormat::BinaryLittleEndian).unwrap();
}

#[test]
fn the_same_on_any_number_of_threads() {
    let case = OneImage::new();
    let args = format!("{DEPTH} --rgb rgb.png --object part.ply --json");
    // A uniform colour image carries no information.
    let flat = sixfold(case.path(), &args).expect(0);
    assert!(
        flat.stderr.contains("the colour image has one colour everywhere: colours are not used"),
        "{}",
        flat.stderr
    );
    assert!(flat.json()["poses"][0]["evidence"]["edges"].is_null());
    // An image of something else is evidence against the object, even if depth agrees.
    let squares =
        RgbImage::from_fn(WIDTH, HEIGHT, |x, y| [if (x / 16 + y / 16) % 2 == 0 { 30 } else { 220 }; 3]);
    write_rgb(&case.path().join("rgb.png"), &squares).unwrap();
    sixfold(case.path(), &args).expect(1);
    write_rgb(&case.path().join("rgb.png"), &picture_of(&[(&part(), case.truth)])).unwrap();
    let at = |more: &str| -> Value {
        let run = sixfold(case.path(), &format!("{args} {more}")).expect(0);
        let mut json = run.json();
        assert!(json["poses"][0].as_object_mut().unwrap().remove("seconds").is_some());
        json
    };
    assert_eq!(at("--threads 1"), at("--threads 2"));
}

#[test]
fn wrong_options_are_named() {
    let case = OneImage::new();
    let dir = case.path();
    fails(dir, &format!("{DEPTH} --object part.ply --budget 0s"), &["--budget", "found 0s", "500ms"]);
    fails(dir, &format!("{DEPTH} --object part.ply --budget soon"), &["--budget", "soon"]);
    fails(dir, &format!("{DEPTH} --object part.ply --icp"), &["--icp", "--method auto", "--method pix2pose"]);
    fails(dir, &format!("{DEPTH} --object part.ply --weights none.safetensors"), &["none.safetensors"]);
    fails(
        dir,
        "estimate --method auto --camera camera.json --object part.ply --unit mm",
        &["--depth", "--rgb"],
    );
    sixfold(dir, &format!("{DEPTH} --object part.ply --budget 1ms")).expect(0);
}
