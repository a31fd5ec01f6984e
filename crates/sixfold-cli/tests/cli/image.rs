//! `sixfold estimate` on one image.

use serde_json::Value;

use crate::support::*;

/// JSON without measured times.
fn without_times(mut value: Value) -> Value {
    for pose in value["poses"].as_array_mut().unwrap() {
        assert!(pose.as_object_mut().unwrap().remove("seconds").is_some());
    }
    value
}

#[test]
fn finds_the_pose_and_draws_it() {
    let case = OneImage::new();
    let run = sixfold(case.path(), &format!("{} --out out --json", OneImage::ARGUMENTS)).expect(0);
    let json = run.json();
    let poses = json["poses"].as_array().unwrap();
    assert_eq!(poses.len(), 1);
    assert_eq!(poses[0]["object"], "part");
    assert_near(&pose_of(&poses[0]["camera_from_object"]), &case.truth);
    assert!((0.0..=1.0).contains(&poses[0]["confidence"].as_f64().unwrap()));
    assert_eq!(json["not_found"].as_array().unwrap().len(), 0);

    let kept: Value =
        serde_json::from_slice(&std::fs::read(case.path().join("out/poses.json")).unwrap()).unwrap();
    assert_eq!(kept, json);

    // The overlay colours the object's pixels and leaves the rest of the image unchanged.
    let overlay = image::open(case.path().join("out/overlay.png")).unwrap().to_rgb8();
    assert_eq!(overlay.dimensions(), (WIDTH as u32, HEIGHT as u32));
    let centre = camera().project(&case.truth.transform_point(&part().vertices()[0])).unwrap();
    let changed: Vec<(f64, f64)> = overlay
        .enumerate_pixels()
        .filter(|(_, _, p)| p.0 != [90; 3])
        .map(|(x, y, _)| (f64::from(x), f64::from(y)))
        .collect();
    assert!(changed.len() > 1000, "{} pixels drawn", changed.len());
    assert!(changed.iter().all(|(x, y)| (x - centre.x).hypot(y - centre.y) < 120.0));
    // The description was stored in the cache, and nothing beside the mesh.
    assert!(cached(case.path(), "ppf.bin").is_file());
    let mut beside: Vec<_> = std::fs::read_dir(case.path())
        .unwrap()
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .collect();
    beside.sort();
    assert_eq!(beside, ["cache-of-tests", "camera.json", "depth.png", "out", "part.ply", "rgb.png"]);
}

#[test]
fn same_bytes_on_one_thread_and_on_two() {
    let case = OneImage::new();
    let at = |more: &str| {
        let run = sixfold(case.path(), &format!("{} --json {more}", OneImage::ARGUMENTS)).expect(0);
        serde_json::to_string(&without_times(run.json())).unwrap()
    };
    // The first run computes the description, the others read it.
    let first = at("--threads 1");
    assert_eq!(first, at("--threads 2"));
    assert_eq!(first, at("--threads 2 --seed 0"));
    let kept = cached(case.path(), "ppf.bin");
    std::fs::remove_file(&kept).unwrap();
    assert_eq!(first, at("--threads 2 --no-cache"));
    assert!(!kept.exists());
    assert_eq!(first, at("--threads 2"));
}

#[test]
fn any_seed_finds_the_pose() {
    let case = OneImage::new();
    for seed in [1, 77] {
        let run = sixfold(case.path(), &format!("{} --json --seed {seed}", OneImage::ARGUMENTS)).expect(0);
        assert_near(&pose_of(&run.json()["poses"][0]["camera_from_object"]), &case.truth);
    }
}

#[test]
fn a_table_is_printed_without_json() {
    let case = OneImage::new();
    let run = sixfold(case.path(), &format!("{} --json poses.json", OneImage::ARGUMENTS)).expect(0);
    assert!(run.stdout.lines().any(|l| l.starts_with("part ")), "{}", run.stdout);
    let json: Value =
        serde_json::from_slice(&std::fs::read(case.path().join("poses.json")).unwrap()).unwrap();
    assert_near(&pose_of(&json["poses"][0]["camera_from_object"]), &case.truth);
}

#[test]
fn nothing_found_is_exit_status_1() {
    let case = OneImage::new();
    sixfold_io::write_depth(&case.path().join("depth.png"), &depth_of(&[]), DEPTH_SCALE).unwrap();
    let run = sixfold(case.path(), &format!("{} --json", OneImage::ARGUMENTS)).expect(1);
    let json = run.json();
    assert_eq!(json["poses"].as_array().unwrap().len(), 0, "{json}");
    assert_eq!(json["not_found"][0], "part");
}

#[test]
fn min_score_leaves_poses_out() {
    let case = OneImage::new();
    sixfold(case.path(), &format!("{} --min-score 1.1", OneImage::ARGUMENTS)).expect(1);
}

#[test]
fn a_min_score_that_is_no_number_is_refused() {
    let case = OneImage::new();
    for value in ["nan", "=-0.5", "much"] {
        let option = if value.starts_with('=') { "--min-score" } else { "--min-score " };
        fails(case.path(), &format!("{} {option}{value}", OneImage::ARGUMENTS), &["--min-score"]);
    }
}

#[test]
fn two_instances_and_boxes() {
    let case = OneImage::new();
    let part = part();
    let poses = [on_table(-0.09, 0.0, 0.4), on_table(0.09, 0.02, 2.5)];
    let depth = depth_of(&[(&part, poses[0]), (&part, poses[1])]);
    sixfold_io::write_depth(&case.path().join("depth.png"), &depth, DEPTH_SCALE).unwrap();
    let found = |more: &str| -> Vec<_> {
        let run = sixfold(case.path(), &format!("{} --json {more}", OneImage::ARGUMENTS)).expect(0);
        let json = run.json();
        let poses = json["poses"].as_array().unwrap();
        poses.iter().map(|p| pose_of(&p["camera_from_object"])).collect()
    };
    let mut both = found("--instances 2");
    assert_eq!(both.len(), 2);
    both.sort_by(|a, b| a.translation().x.total_cmp(&b.translation().x));
    assert_near(&both[0], &poses[0]);
    assert_near(&both[1], &poses[1]);
    // A box or a mask selects one of the two.
    let left = found("--box -10,40,160,150");
    assert_eq!(left.len(), 1);
    assert_near(&left[0], &poses[0]);
    let mask = sixfold_geometry::Mask::from_fn(WIDTH, HEIGHT, |x, _| x >= WIDTH / 2);
    sixfold_io::write_mask(&case.path().join("mask.png"), &mask).unwrap();
    let right = found("--mask mask.png");
    assert_eq!(right.len(), 1);
    assert_near(&right[0], &poses[1]);
}

#[test]
fn a_model_of_points_is_enough() {
    let case = OneImage::new();
    let samples = part().sample_surface(4000, 1);
    let points = sixfold_mesh::Mesh::new(samples.points, vec![]).unwrap();
    let file = case.path().join("part.ply");
    sixfold_mesh::write_ply(file, &points, sixfold_mesh::Unit::Millimetre, sixfold_mesh::PlyFormat::Ascii)
        .unwrap();
    let run = sixfold(case.path(), &format!("{} --json", OneImage::ARGUMENTS)).expect(0);
    assert!(run.stderr.contains("part.ply has points and no faces"), "{}", run.stderr);
    assert_near(&pose_of(&run.json()["poses"][0]["camera_from_object"]), &case.truth);
}
