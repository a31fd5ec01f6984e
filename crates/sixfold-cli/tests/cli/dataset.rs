//! `sixfold estimate` on a whole dataset.

use std::path::Path;

use serde_json::Value;
use sixfold_bop::{
    Detection, Rle, VISIBILITY_DELTA, ground_truth_visibility, read_results, write_detections,
};
use sixfold_geometry::{Mask, Rect};

use crate::support::*;

const ARGUMENTS: &str = "estimate --dataset tiny --split test --out results.csv --json";

/// Rows without the time, in the order of the file.
fn rows(file: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(file).unwrap();
    assert!(text.ends_with('\n'), "the last line is cut off: {text}");
    text.lines().map(|l| l.rsplit_once(',').unwrap().0.to_owned()).collect()
}

fn assert_all_found(tiny: &Tiny, file: &str) {
    let results = read_results(&tiny.path().join(file)).unwrap();
    assert_eq!(results.len(), 6, "{results:?}");
    for r in &results {
        assert_eq!(r.scene_id, 7);
        assert!(r.time.unwrap() > 0.0);
        assert_near(&r.camera_from_object, &tiny.truth_of(r.im_id, r.obj_id));
    }
}

#[test]
fn all_targets_are_estimated_and_score_well() {
    let tiny = Tiny::new(true);
    let run = sixfold(tiny.path(), &format!("{ARGUMENTS} --overlays pictures")).expect(0);
    let json = run.json();
    assert_eq!((&json["images"], &json["targets"], &json["poses"]), (&3.into(), &6.into(), &6.into()));
    assert_eq!(json["skipped"].as_array().unwrap().len(), 0);
    assert_all_found(&tiny, "results.csv");
    for name in ["000007_000000.png", "000007_000004.png", "000007_000011.png"] {
        let picture = image::open(tiny.path().join("pictures").join(name)).unwrap().to_rgb8();
        assert!(picture.pixels().any(|p| p.0[0] != p.0[1]), "{name} shows depth only");
    }
    let scores = sixfold(tiny.path(), "eval --dataset tiny --results results.csv --json").expect(0).json();
    for key in ["ar", "ar_vsd", "ar_mssd", "ar_mspd"] {
        assert!(scores[key].as_f64().unwrap() > 0.85, "{key}: {scores}");
    }
}

#[test]
fn an_interrupted_run_resumes_to_the_same_result() {
    let tiny = Tiny::new(true);
    let csv = tiny.path().join("results.csv");
    sixfold(tiny.path(), ARGUMENTS).expect(0);
    let whole = rows(&csv);
    assert_eq!(whole.len(), 7);
    let record = tiny.path().join("results.csv.run.json");
    let text = std::fs::read_to_string(&csv).unwrap();
    let lines: Vec<&str> = text.split_inclusive('\n').collect();

    // Stopped after the first image, in the middle of writing the second one's first row.
    let mut value: Value = serde_json::from_slice(&std::fs::read(&record).unwrap()).unwrap();
    value["done"] = serde_json::json!([]);
    std::fs::write(&record, value.to_string()).unwrap();
    std::fs::write(&csv, lines[..3].concat() + &lines[3][..lines[3].len() / 2]).unwrap();
    let run = sixfold(tiny.path(), ARGUMENTS).expect(0);
    assert!(run.stderr.contains("cut off"), "{}", run.stderr);
    assert_eq!(rows(&csv), whole);

    // Nothing is left to do: the file does not change by a byte.
    let before = std::fs::read(&csv).unwrap();
    sixfold(tiny.path(), ARGUMENTS).expect(0);
    assert_eq!(std::fs::read(&csv).unwrap(), before);

    // A run with another seed is not mixed with this one.
    fails(tiny.path(), &format!("{ARGUMENTS} --seed 5"), &["results.csv", "other options"]);
    std::fs::remove_file(&record).unwrap();
    fails(tiny.path(), ARGUMENTS, &["results.csv", "results.csv.run.json"]);
    assert_eq!(std::fs::read(&csv).unwrap(), before);
}

#[test]
fn an_image_torn_between_its_rows_is_done_again() {
    let tiny = Tiny::new(true);
    let csv = tiny.path().join("results.csv");
    sixfold(tiny.path(), ARGUMENTS).expect(0);
    let whole = rows(&csv);
    // The first of two rows of the second image is on disk, the image is not in the record yet.
    let record = tiny.path().join("results.csv.run.json");
    let mut value: Value = serde_json::from_slice(&std::fs::read(&record).unwrap()).unwrap();
    value["done"] = serde_json::json!([]);
    std::fs::write(&record, value.to_string()).unwrap();
    let text = std::fs::read_to_string(&csv).unwrap();
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    std::fs::write(&csv, lines[..4].concat() + &lines[4][..20]).unwrap();
    sixfold(tiny.path(), ARGUMENTS).expect(0);
    assert_eq!(rows(&csv), whole);
}

#[test]
fn boxes_of_the_ground_truth_or_of_a_file() {
    let tiny = Tiny::new(true);
    let run = sixfold(tiny.path(), &format!("{ARGUMENTS} --boxes gt")).expect(0);
    assert_eq!(run.json()["poses"], 6);
    assert_all_found(&tiny, "results.csv");

    // Boxes for one of the objects in one image only.
    let tiny = Tiny::new(true);
    let centre = camera().project(&tiny.truth_of(4, 2).translation()).unwrap();
    let detections = serde_json::json!([{
        "scene_id": 7, "image_id": 4, "category_id": 2, "score": 0.8,
        "bbox": [centre.x - 45.0, centre.y - 55.0, 90.0, 90.0],
    }]);
    std::fs::write(tiny.path().join("boxes.json"), detections.to_string()).unwrap();
    sixfold(tiny.path(), &format!("{ARGUMENTS} --boxes boxes.json")).expect(0);
    let results = read_results(&tiny.path().join("results.csv")).unwrap();
    assert_eq!(results.len(), 1);
    assert_eq!((results[0].im_id, results[0].obj_id), (4, 2));
    assert_near(&results[0].camera_from_object, &tiny.truth_of(4, 2));
}

#[test]
fn masks_of_detections_say_more_than_their_boxes() {
    let tiny = Tiny::new(true);
    let (meshes, posed) = ([part(), other_part()], [1, 2].map(|id| tiny.truth_of(4, id)));
    let posed: Vec<_> = meshes.iter().zip(posed).collect();
    let masks = ground_truth_visibility(&posed, &camera(), None, VISIBILITY_DELTA);
    // The box is the whole image; only the mask gives the position.
    let found = |mask: Option<&Mask>| {
        let detection = Detection {
            scene_id: 7,
            image_id: 4,
            category_id: 2,
            score: 0.8,
            bbox: Some(Rect { x: 0.0, y: 0.0, width: WIDTH as f64, height: HEIGHT as f64 }),
            segmentation: mask.map(|m| Rle::encode(m).unwrap()),
            time: None,
        };
        write_detections(&tiny.path().join("boxes.json"), &[detection]).unwrap();
        for file in ["results.csv", "results.csv.run.json"] {
            let _ = std::fs::remove_file(tiny.path().join(file));
        }
        let run = sixfold(tiny.path(), &format!("{ARGUMENTS} --boxes boxes.json"));
        let results = read_results(&tiny.path().join("results.csv")).unwrap_or_default();
        (run, results.first().map(|r| r.camera_from_object.distance_to(&tiny.truth_of(4, 2))))
    };
    assert!(found(None).1.unwrap() < 0.005);
    assert!(found(Some(&masks[1].mask_visible)).1.unwrap() < 0.005);
    // This object cannot be at the place of the other one.
    assert!(found(Some(&masks[0].mask_visible)).1.is_none_or(|off| off > 0.05));
    let (run, none) = found(Some(&Mask::filled(7, 5, true)));
    assert!(none.is_none());
    for words in ["boxes.json", "segmentation.size", "found [5, 7]"] {
        assert!(run.stderr.contains(words), "{}", run.stderr);
    }
    run.expect(2);
}

#[test]
fn a_broken_image_is_skipped_and_the_rest_finished() {
    let tiny = Tiny::new(true);
    truncate(&tiny.file("test/000007/depth/000004.png"), 0.5);
    let run = sixfold(tiny.path(), ARGUMENTS).expect(2);
    let line = run.stderr.lines().find(|l| l.starts_with("skipped")).unwrap();
    assert!(line.contains("7/4") && line.contains("000004.png"), "{line}");
    assert_eq!(run.json()["skipped"].as_array().unwrap().len(), 1);
    let done =
        |file| read_results(&tiny.path().join(file)).unwrap().iter().map(|r| r.im_id).collect::<Vec<_>>();
    assert_eq!(done("results.csv"), [0, 0, 11, 11]);

    // Once the image is repaired, the same command finishes the run.
    let whole = Tiny::new(true);
    let name = "test/000007/depth/000004.png";
    std::fs::copy(whole.file(name), tiny.file(name)).unwrap();
    sixfold(tiny.path(), ARGUMENTS).expect(0);
    assert_eq!(done("results.csv"), [0, 0, 11, 11, 4, 4]);
}

#[test]
fn images_without_depth_are_skipped_with_advice() {
    let tiny = Tiny::new(false);
    let run = sixfold(tiny.path(), ARGUMENTS).expect(2);
    assert_eq!(run.stderr.lines().filter(|l| l.contains("simulate-depth")).count(), 3, "{}", run.stderr);
}

#[test]
fn stale_rows_of_changed_inputs_are_refused_by_name() {
    let tiny = Tiny::new(true);
    let csv = tiny.path().join("results.csv");
    sixfold(tiny.path(), ARGUMENTS).expect(0);
    let before = std::fs::read(&csv).unwrap();
    let refused = |file: &str, change: &dyn Fn(&Path), words: [&str; 2]| {
        let path = tiny.file(file);
        let whole = std::fs::read(&path).unwrap();
        change(&path);
        fails(
            tiny.path(),
            ARGUMENTS,
            &["results.csv was made with another", words[0], words[1], "choose another --out"],
        );
        assert!(std::fs::read(&csv).unwrap() == before, "{file}: rows were written");
        std::fs::write(&path, whole).unwrap();
    };
    let copy = |from: &'static str| {
        let from = tiny.file(from);
        move |to: &Path| std::fs::write(to, std::fs::read(&from).unwrap()).unwrap()
    };
    let camera = "test/000007/scene_camera.json";
    refused(camera, &|path| replace(path, "300", "303"), ["camera of image 7/0", "scene_camera.json"]);
    let depth = "test/000007/depth/000004.png";
    refused(depth, &copy("test/000007/depth/000011.png"), ["depth image of image 7/4", "000004.png"]);
    let mesh = "models/obj_000002.ply";
    refused(mesh, &copy("models/obj_000001.ply"), ["mesh of object 2", "obj_000002.ply"]);
    let longer = |path: &Path| {
        let mut infos: Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
        let diameter = infos["1"]["diameter"].as_f64().unwrap();
        infos["1"]["diameter"] = (1.0001 * diameter).into();
        std::fs::write(path, infos.to_string()).unwrap();
    };
    refused("models/models_info.json", &longer, ["models_info of object 1", "models_info.json"]);
    let targets = "test_targets_bop19.json";
    let fewer = |path: &Path| {
        let mut targets: Vec<Value> = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
        targets.truncate(4);
        std::fs::write(path, serde_json::json!(targets).to_string()).unwrap();
    };
    refused(targets, &fewer, ["list of targets of image 7/11", "tiny"]);

    // Unchanged inputs: nothing is left to do.
    sixfold(tiny.path(), ARGUMENTS).expect(0);
    assert!(std::fs::read(&csv).unwrap() == before);

    // Boxes of the ground truth are an input too, as is the content of a file of boxes.
    sixfold(tiny.path(), &format!("{} --boxes gt", ARGUMENTS.replace("results", "gt"))).expect(0);
    let truth = tiny.file("test/000007/scene_gt.json");
    let whole = std::fs::read(&truth).unwrap();
    let mut poses: Value = serde_json::from_slice(&whole).unwrap();
    poses["4"][0]["cam_t_m2c"][0] = 1.0.into();
    std::fs::write(&truth, poses.to_string()).unwrap();
    let gt = format!("{} --boxes gt", ARGUMENTS.replace("results", "gt"));
    fails(tiny.path(), &gt, &["gt.csv", "ground truth of image 7/4", "scene_gt.json"]);
}

#[test]
fn two_runs_on_one_result_file_do_not_mix_their_rows() {
    let tiny = Tiny::new(true);
    let csv = tiny.path().join("results.csv");
    let other = sixfold_io::WriteLock::take(&csv).unwrap();
    fails(tiny.path(), ARGUMENTS, &["results.csv", "another process", "choose another place"]);
    assert!(!csv.exists());
    drop(other);

    // Both at once: one is refused, or runs after the other.
    let both = std::thread::scope(|scope| {
        let run = || sixfold(tiny.path(), ARGUMENTS);
        let other = scope.spawn(run);
        [run(), other.join().unwrap()]
    });
    assert!(both.iter().any(|run| run.code == 0), "{both:?}");
    assert!(both.iter().all(|run| run.code == 0 || run.stderr.contains("another process")), "{both:?}");
    assert_all_found(&tiny, "results.csv");
}

#[test]
fn detections_without_scene_id_are_of_the_only_scene_or_refused() {
    let tiny = Tiny::new(true);
    let centre = camera().project(&tiny.truth_of(4, 2).translation()).unwrap();
    let mut detection = serde_json::json!({
        "image_id": 4, "category_id": 2, "score": 0.8,
        "bbox": [centre.x - 45.0, centre.y - 55.0, 90.0, 90.0],
    });
    let write = |detection: &Value| {
        let text = serde_json::json!([detection]).to_string();
        std::fs::write(tiny.path().join("boxes.json"), text).unwrap();
    };
    write(&detection);
    let run = sixfold(tiny.path(), &format!("{ARGUMENTS} --boxes boxes.json")).expect(0);
    assert!(run.stderr.contains("name no scene_id and are taken for scene 7"), "{}", run.stderr);
    assert_eq!(run.json()["poses"], 1);

    // A detection of a scene that does not exist: the reason is stated.
    detection["scene_id"] = 3.into();
    write(&detection);
    let other = ARGUMENTS.replace("results.csv", "other.csv");
    let run = sixfold(tiny.path(), &format!("{other} --boxes boxes.json")).expect(1);
    assert!(run.stderr.contains("none of the 1 detections is of a target"), "{}", run.stderr);
    assert!(run.stderr.contains("scene_id 3, image_id 4, category_id 2"), "{}", run.stderr);

    // With two scenes it is unclear which one is meant.
    detection.as_object_mut().unwrap().remove("scene_id");
    write(&detection);
    std::fs::create_dir_all(tiny.file("test/000008")).unwrap();
    std::fs::copy(tiny.file("test/000007/scene_camera.json"), tiny.file("test/000008/scene_camera.json"))
        .unwrap();
    for command in [
        format!("{} --boxes boxes.json", ARGUMENTS.replace("results", "two")),
        "eval --dataset tiny --detections boxes.json".into(),
    ] {
        fails(tiny.path(), &command, &["boxes.json", "scene_id", "one of 7, 8"]);
    }
}

#[test]
fn the_demo_scores_and_draws_its_samples() {
    let tiny = Tiny::new(true);
    let run = sixfold(tiny.path(), "demo --data tiny --out out --json demo.json").expect(0);
    assert!(run.stdout.contains("6 of 6 poses within 10 %"), "{}", run.stdout);
    let json: Value = serde_json::from_slice(&std::fs::read(tiny.path().join("demo.json")).unwrap()).unwrap();
    assert_eq!((&json["correct"], &json["targets"]), (&6.into(), &6.into()));
    for row in json["poses"].as_array().unwrap() {
        assert!(row["add_s_mm"].as_f64().unwrap() < 5.0, "{row}");
    }
    let pictures = json["pictures"].as_array().unwrap();
    assert_eq!(pictures.len(), 4);
    for picture in pictures {
        assert!(image::open(tiny.path().join(picture.as_str().unwrap())).is_ok(), "{picture}");
    }
}

#[test]
fn rows_that_went_missing_are_computed_again() {
    let tiny = Tiny::new(true);
    let csv = tiny.path().join("results.csv");
    sixfold(tiny.path(), ARGUMENTS).expect(0);
    let whole = rows(&csv);
    let text = std::fs::read_to_string(&csv).unwrap();
    // One of the two rows of the second image, the last one of the third.
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    std::fs::write(&csv, [&lines[..3], &lines[4..6]].concat().concat()).unwrap();
    let run = sixfold(tiny.path(), ARGUMENTS).expect(0);
    assert!(run.stderr.contains("image 7/4"), "{}", run.stderr);
    assert_eq!(rows(&csv), whole);
}
