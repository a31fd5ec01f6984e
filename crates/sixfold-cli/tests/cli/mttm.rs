//! `sixfold estimate --method mttm`, `sixfold object add --templates` and `--depth`.

use sixfold_geometry::{Mask, Pose};
use sixfold_io::{read_mask, write_depth, write_mask};

use crate::support::*;

const DEPTH: &str = "estimate --method mttm --depth depth.png --camera camera.json";

/// Writes the mask of the part in its image.
fn write_part_mask(case: &OneImage) {
    let alone = depth_of(&[(&part(), case.truth)]);
    let table = depth_of(&[]);
    let mask = Mask::from_fn(WIDTH, HEIGHT, |x, y| (alone[(x, y)] - table[(x, y)]).abs() > 1e-4);
    write_mask(&case.path().join("mask.png"), &mask).unwrap();
}

#[test]
fn finds_the_pose_by_templates_with_and_without_the_mesh() {
    let case = OneImage::new();
    let dir = case.path();
    let run = sixfold(dir, &format!("{DEPTH} --object part.ply --unit mm --json --out out")).expect(0).json();
    assert_near(&pose_of(&run["poses"][0]["camera_from_object"]), &case.truth);
    assert_eq!(run["poses"][0]["verified_by"], "mesh");
    assert!(dir.join("out/overlay.png").is_file() && dir.join("out/poses.json").is_file());
    assert!(dir.join("out/masks/1-part-1.png").is_file());
    // The templates are kept in the cache and used the next time.
    let kept = cached(dir, "templates.bin");
    let before = std::fs::read(&kept).unwrap();
    let alone =
        sixfold(dir, &format!("{DEPTH} --object part.ply --unit mm --json --templates-only")).expect(0);
    assert_eq!(alone.json()["poses"][0]["verified_by"], "template");
    assert_near(&pose_of(&alone.json()["poses"][0]["camera_from_object"]), &case.truth);
    assert_eq!(std::fs::read(&kept).unwrap(), before);
    // A damaged file is made again, with a note.
    std::fs::write(&kept, &before[..1000]).unwrap();
    let again = sixfold(dir, &format!("{DEPTH} --object part.ply --unit mm --json")).expect(0);
    assert!(again.stderr.contains("cut off"), "{}", again.stderr);
    assert_eq!(std::fs::read(&kept).unwrap(), before);
}

/// The mask is the network's, not that of the pose.
#[test]
fn masks_of_the_network_come_before_any_alignment() {
    let case = OneImage::new();
    let dir = case.path();
    write_part_mask(&case);
    let truth = read_mask(&dir.join("mask.png")).unwrap();
    let overlap = |options: &str, out: &str| {
        let command = format!("{DEPTH} --object part.ply --unit mm --json --out {out} {options}");
        let run = sixfold(dir, &command).expect(0).json();
        assert_near(&pose_of(&run["poses"][0]["camera_from_object"]), &case.truth);
        let mask = read_mask(&dir.join(out).join("masks/1-part-1.png")).unwrap();
        let pairs = mask.as_slice().iter().zip(truth.as_slice());
        let count = |of: fn(bool, bool) -> bool| pairs.clone().filter(|(a, b)| of(**a, **b)).count();
        (mask.clone(), count(|a, b| a && b) as f64 / count(|a, b| a || b) as f64)
    };
    let (aligned, _) = overlap("--masks aligned", "aligned");
    for options in ["--masks network", "--masks network --matcher network"] {
        let (mask, iou) = overlap(options, "network");
        assert!(iou > 0.5 && mask != aligned, "{options}: {iou}");
    }
}

#[test]
fn an_object_is_stored_with_templates_and_found() {
    let case = OneImage::new();
    let dir = case.path();
    let run = sixfold(dir, "object add thing part.ply --unit mm --templates").expect(0);
    assert!(run.stdout.contains("305 views with 7 rotations"), "{}", run.stdout);
    let file = dir.join("sixfold-objects/thing/templates.bin");
    let bytes = std::fs::read(&file).unwrap();
    let one = sixfold(dir, &format!("--threads 1 {DEPTH} --object thing --json")).expect(0).json();
    let two = sixfold(dir, &format!("--threads 2 {DEPTH} --object thing --json")).expect(0).json();
    assert_near(&pose_of(&one["poses"][0]["camera_from_object"]), &case.truth);
    for field in ["camera_from_object", "confidence", "template", "mask_pixels"] {
        assert_eq!(one["poses"][0][field], two["poses"][0][field], "{field}");
    }
    // The same mesh, the same bytes.
    sixfold(dir, "object add twin part.ply --unit mm --templates above").expect(0);
    assert_eq!(std::fs::read(dir.join("sixfold-objects/twin/templates.bin")).unwrap(), bytes);
    fails(dir, "object add thing part.ply --unit mm --templates", &["thing", "--replace"]);
    assert_eq!(std::fs::read(&file).unwrap(), bytes);
    // Templates from other directions for one search are stored separately and leave the object's own
    // templates unchanged.
    let around = format!("{DEPTH} --matcher points --object thing --templates around --json");
    let found = sixfold(dir, &around).expect(0).json();
    assert_near(&pose_of(&found["poses"][0]["camera_from_object"]), &case.truth);
    let beside = std::fs::metadata(dir.join("sixfold-objects/thing/templates-around.bin")).unwrap();
    assert!(beside.len() > 2 * bytes.len() as u64);
    assert_eq!(std::fs::read(&file).unwrap(), bytes);
}

#[test]
fn an_object_known_from_one_depth_image_is_found_elsewhere() {
    let case = OneImage::new();
    let dir = case.path();
    write_part_mask(&case);
    let pose = case.truth.to_matrix();
    let rows: Vec<Vec<f64>> = (0..4).map(|i| (0..4).map(|j| pose[(i, j)]).collect()).collect();
    std::fs::write(dir.join("poses.json"), serde_json::to_string(&[rows]).unwrap()).unwrap();
    let add = "object add seen --depth depth.png --mask mask.png --camera camera.json";
    sixfold(dir, &format!("{add} --poses poses.json")).expect(0);
    sixfold(dir, "object add seen-too --depth depth.png --mask mask.png --camera camera.json").expect(0);
    let shown = sixfold(dir, "object show seen --json").expect(0).json();
    assert_eq!(shown["without_mesh"], true);
    // Moved by 4 cm along the table and rotated a little.
    let moved = case.truth * Pose::exp(&[0.03, 0.02, 0.0, 0.0, 0.0, 0.15].into());
    write_depth(&dir.join("moved.png"), &depth_of(&[(&part(), moved)]), DEPTH_SCALE).unwrap();
    let found = "estimate --method mttm --depth moved.png --camera camera.json --json --out out";
    let run = sixfold(dir, &format!("{found} --object seen")).expect(0).json();
    assert_eq!(run["poses"][0]["frame"], "object");
    assert_near(&pose_of(&run["poses"][0]["camera_from_object"]), &moved);
    // Without a pose, the result is the motion of the view's own frame.
    let run = sixfold(dir, &format!("{found} --object seen-too")).expect(0).json();
    assert_eq!(run["poses"][0]["frame"], "view");
    let still = sixfold(dir, &format!("{DEPTH} --json --object seen-too")).expect(0).json();
    let (there, here) =
        (pose_of(&run["poses"][0]["camera_from_object"]), pose_of(&still["poses"][0]["camera_from_object"]));
    assert_near(&(there * here.inverse() * case.truth), &moved);
    // auto uses only this method, and does not report its confidence as a probability.
    let auto = "estimate --method auto --depth moved.png --camera camera.json --json --object seen";
    let answer = sixfold(dir, auto).expect(0);
    let pose = &answer.json()["poses"][0];
    assert_near(&pose_of(&pose["camera_from_object"]), &moved);
    assert_eq!(pose["method"], "mttm");
    assert!(pose["probability"].is_null() && pose["confidence"].is_number(), "{pose}");
    assert!(
        answer.stderr.contains("no mesh") && answer.stderr.contains("no probability"),
        "{}",
        answer.stderr
    );
    // Other methods cannot search for it.
    let other = "estimate --method ppf --depth depth.png --camera camera.json --object seen";
    fails(dir, other, &["seen", "no mesh", "mttm"]);
}

#[test]
fn templates_from_around_find_objects_upside_down() {
    let case = OneImage::new();
    let dir = case.path();
    // Upside down, on its tower.
    let truth = on_table(0.02, 0.01, 0.5) * Pose::exp(&[0.0, 0.0, 0.11, 0.0, 0.0, 0.0].into());
    let truth = truth * Pose::exp(&[0.0, 0.0, 0.0, std::f64::consts::PI, 0.0, 0.0].into());
    write_depth(&dir.join("over.png"), &depth_of(&[(&part(), truth)]), DEPTH_SCALE).unwrap();
    let search =
        "estimate --method mttm --depth over.png --camera camera.json --object part.ply --unit mm --json";
    // With the cached data of each, and in either order of searches.
    for _ in 0..2 {
        let above = sixfold(dir, search);
        assert!(above.code < 2, "{}", above.stderr);
        let wrong =
            |pose: &serde_json::Value| pose_of(&pose["camera_from_object"]).rotation_angle_to(&truth) > 0.5;
        assert!(above.json()["poses"].as_array().unwrap().iter().all(wrong), "{}", above.stdout);
        let around = sixfold(dir, &format!("{search} --templates around")).expect(0).json();
        assert_near(&pose_of(&around["poses"][0]["camera_from_object"]), &truth);
    }
    fails(dir, &format!("{search} --templates below"), &["below", "--templates"]);
}

#[test]
fn a_mask_cut_too_large_is_trimmed_or_refused() {
    let case = OneImage::new();
    let dir = case.path();
    write_part_mask(&case);
    let mask = read_mask(&dir.join("mask.png")).unwrap();
    write_mask(&dir.join("large.png"), &mask.grown(3)).unwrap();
    write_mask(&dir.join("huge.png"), &mask.grown(20)).unwrap();
    let add = |name: &str, mask: &str| {
        let input = format!("--depth depth.png --mask {mask} --camera camera.json --json");
        sixfold(dir, &format!("object add {name} {input}"))
    };
    let diameter = |run: &Run| run.json()["diameter"].as_f64().unwrap();
    let right = add("right", "mask.png").expect(0);
    assert!(!right.stderr.contains("warning"), "{}", right.stderr);
    let trimmed = add("trimmed", "large.png").expect(0);
    assert!((diameter(&trimmed) / diameter(&right) - 1.0).abs() < 0.03, "{trimmed:?} {right:?}");
    for words in ["large.png", "left out", "% of the mask", "--mask-as-is"] {
        assert!(trimmed.stderr.contains(words), "{}", trimmed.stderr);
    }
    let out = &trimmed.json()["left_out"][0];
    assert!(out["mask"] == "large.png" && out["on_plane"].as_f64().unwrap() > 0.1, "{out}");
    // A refused object leaves no files, and the same name can be added again.
    let refused = add("refused", "huge.png").expect(2);
    for words in ["huge.png", "% of the mask", "plane", "cut it closer", "--mask-as-is"] {
        assert!(refused.stderr.contains(words), "{}", refused.stderr);
    }
    fails(dir, "object show refused", &["refused"]);
    let as_is = add("as-is", "huge.png --mask-as-is").expect(0);
    assert!(diameter(&as_is) > 1.2 * diameter(&right), "{as_is:?}");
    assert_eq!(as_is.json()["left_out"], serde_json::json!([]));
}

#[test]
fn bad_templates_and_bad_depth_are_explained() {
    let case = OneImage::new();
    let dir = case.path();
    write_part_mask(&case);
    fails(dir, "object add x --depth depth.png --camera camera.json", &["--mask"]);
    fails(
        dir,
        "object add x --depth depth.png depth.png --mask mask.png --camera camera.json",
        &["1 masks for 2 depth images"],
    );
    write_mask(&dir.join("none.png"), &Mask::filled(WIDTH, HEIGHT, false)).unwrap();
    fails(
        dir,
        "object add x --depth depth.png --mask none.png --camera camera.json",
        &["depth.png", "0 of the mask's 0 pixels"],
    );
    write_mask(&dir.join("small.png"), &Mask::filled(10, 10, true)).unwrap();
    fails(
        dir,
        "object add x --depth depth.png --mask small.png --camera camera.json",
        &["small.png", "10x10"],
    );
    fails(
        dir,
        "object add x --depth depth.png --mask mask.png --camera camera.json --depth-scale 100",
        &["depth.png", "m large", "depth scale"],
    );
    // No incomplete object is left.
    sixfold(dir, "object list").expect(1);
    fails(dir, &format!("{DEPTH} --object part.ply --unit mm --depth-scale 0.0001"), &["depth.png", "1000"]);
    fails(dir, &format!("{DEPTH} --object part.ply --unit mm --icp"), &["--icp", "pix2pose"]);
    fails(
        dir,
        "estimate --templates-only --depth depth.png --camera camera.json --object part.ply --unit mm",
        &["--templates-only", "mttm"],
    );
}

#[test]
fn a_store_of_another_version_is_refused_and_kept() {
    let case = OneImage::new();
    let dir = case.path();
    write_part_mask(&case);
    sixfold(dir, "object add seen --depth depth.png --mask mask.png --camera camera.json").expect(0);
    let file = dir.join("sixfold-objects/seen/templates.bin");
    let mut bytes = std::fs::read(&file).unwrap();
    bytes[8] = 2;
    std::fs::write(&file, &bytes).unwrap();
    fails(dir, &format!("{DEPTH} --object seen"), &["templates.bin", "another version", "format 2"]);
    assert_eq!(std::fs::read(&file).unwrap(), bytes);
}

#[test]
fn a_dataset_run_resumes() {
    let tiny = Tiny::new(true);
    let dir = tiny.path();
    let estimate = "estimate --method mttm --dataset tiny --out results.csv --json";
    let first = sixfold(dir, estimate).expect(0).json();
    assert!(first["poses"].as_u64().unwrap() >= 2, "{first}");
    let rows = std::fs::read(dir.join("results.csv")).unwrap();
    sixfold(dir, estimate).expect(0);
    assert_eq!(std::fs::read(dir.join("results.csv")).unwrap(), rows);
    fails(dir, &format!("{estimate} --templates-only"), &["results.csv", "other options"]);
}
