//! `sixfold grasp`.

use std::fs;

use sixfold_geometry::Mask;
use sixfold_io::write_mask;
use sixfold_render::render_depth;

use crate::support::*;

const VIEW: &str = "grasp propose --depth depth.png --camera camera.json";

/// An object on a table, with its mask and an empty one.
fn folder() -> OneImage {
    let case = OneImage::new();
    let alone = render_depth(&part(), &case.truth, &camera());
    write_mask(&case.path().join("mask.png"), &alone.map(|&z| z > 0.0)).unwrap();
    write_mask(&case.path().join("nothing.png"), &Mask::filled(WIDTH, HEIGHT, false)).unwrap();
    case
}

#[test]
fn grasps_are_proposed_with_and_without_a_mask_and_drawn() {
    let case = folder();
    for mask in ["", " --mask mask.png"] {
        let run = sixfold(case.path(), &format!("{VIEW}{mask} --out out --json")).expect(0);
        let found = run.json();
        let grasps = found["grasps"].as_array().unwrap();
        assert!(!grasps.is_empty() && grasps.len() <= 5);
        assert!(grasps[0]["quality"].as_f64().unwrap() > 0.1);
        assert!(grasps[0]["opening"].as_f64().unwrap() <= 0.14);
        assert!(found["table"]["offset"].is_number());
        assert!(fs::metadata(case.path().join("out/overlay.png")).unwrap().len() > 1000);
        assert!(case.path().join("out/grasps.json").exists());
    }
}

#[test]
fn planners_that_learned_propose_as_well() {
    let case = folder();
    let planners: &[&str] = if cfg!(feature = "networks") { &["haf", "gpd"] } else { &["haf"] };
    for planner in planners {
        let view = format!("{VIEW} --mask mask.png --planner {planner} --json");
        let found = sixfold(case.path(), &view).expect(0).json();
        assert_eq!(found["method"], *planner);
        let qualities: Vec<f64> =
            found["grasps"].as_array().unwrap().iter().map(|g| g["quality"].as_f64().unwrap()).collect();
        assert!(!qualities.is_empty() && qualities.iter().all(|q| (0.0..=1.0).contains(q)), "{qualities:?}");
        assert!(*planner == "gpd" || qualities.is_sorted_by(|a, b| a >= b), "{qualities:?}");
        assert!(found["grasps"][0].get("parts").is_none(), "contacts are not judged");
        let again = sixfold(case.path(), &view).expect(0).json();
        assert_eq!(again["grasps"], found["grasps"]);
        fs::write(case.path().join("wrong.json"), "{}").unwrap();
        fails(
            case.path(),
            &format!("{view} --planner-weights wrong.json"),
            &["--planner-weights", "wrong.json"],
        );
    }
    fs::write(case.path().join("w.json"), "{}").unwrap();
    fails(case.path(), &format!("{VIEW} --planner-weights w.json"), &["--planner-weights", "gpd or haf"]);
}

#[test]
fn an_object_too_large_for_the_gripper_gives_exit_status_1() {
    let case = folder();
    let tiny = r#"{"kind": "parallel-jaws", "name": "tiny", "max_opening": 0.006, "finger_length": 0.02,
        "finger_width": 0.01, "finger_thickness": 0.005, "palm_width": 0.03, "palm_depth": 0.03, "palm_height": 0.05,
        "force": 5, "friction": 0.5}"#;
    fs::write(case.path().join("tiny.json"), tiny).unwrap();
    let run = sixfold(case.path(), &format!("{VIEW} --gripper tiny.json")).expect(1);
    assert!(run.stdout.contains("no grasp found for gripper tiny"), "{}", run.stdout);
}

#[test]
fn what_is_wrong_is_named() {
    let case = folder();
    fails(case.path(), &format!("{VIEW} --mask nothing.png"), &["nothing.png", "mask is empty"]);
    fails(case.path(), &format!("{VIEW} --gripper claw"), &["claw", "jaws-140"]);
    fs::write(case.path().join("bad.json"), r#"{"kind": "parallel-jaws", "name": "a", "max_opening": 140}"#)
        .unwrap();
    fails(case.path(), &format!("{VIEW} --gripper bad.json"), &["bad.json", "finger_length"]);
    fails(case.path(), &format!("{VIEW} --depth-scale 100"), &["scale wrong by a factor of 1000"]);
    fails(case.path(), "grasp try --object part.ply --unit mm --tip 0,0", &["--tip", "three finite numbers"]);
    fails(
        case.path(),
        "grasp try --object part.ply --unit mm --tip 0,0,0.05 --mass 200",
        &["mass", "0.001 to 20 kg"],
    );
}

#[test]
fn a_grasp_is_tried() {
    let case = folder();
    let run = sixfold(
        case.path(),
        "grasp try --object part.ply --unit mm --tip 0.0,0.0,0.01 --closing 0,1,0 --json",
    );
    assert!(run.code == 0 || run.code == 1, "{}", run.stderr);
    assert_eq!(run.json()["report"]["outcome"] == "held", run.code == 0);
    let beside = "grasp try --object part.ply --unit mm --tip 0.3,0,0.05";
    assert!(sixfold(case.path(), beside).expect(1).stdout.contains("closed on nothing"));
}
