//! Broken, missing and contradictory input: exit status 2, a message that names file and field, never a panic
//! (`sixfold` in `support` checks this after every run).

use std::path::Path;

use crate::support::*;

/// `estimate` on the one image fails with these words after `spoil` has changed the folder.
fn estimate_fails(spoil: impl FnOnce(&Path), more: &str, words: &[&str]) {
    let case = OneImage::new();
    spoil(case.path());
    fails(case.path(), &format!("{} {more}", OneImage::ARGUMENTS), words);
}

fn ascii_ply(vertices: &[&str], said: usize) -> String {
    format!(
        "ply\nformat ascii 1.0\nelement vertex {said}\nproperty float x\nproperty float y\nproperty float z\n\
         element face 0\nproperty list uchar int vertex_indices\nend_header\n{}\n",
        vertices.join("\n")
    )
}

#[test]
fn truncated_mesh() {
    estimate_fails(|dir| truncate(&dir.join("part.ply"), 0.7), "", &["part.ply", "face"]);
    estimate_fails(|dir| truncate(&dir.join("part.ply"), 0.02), "", &["part.ply"]);
    estimate_fails(|dir| truncate(&dir.join("part.ply"), 0.0), "", &["part.ply"]);
}

#[test]
fn mesh_with_a_wrong_length() {
    let text = ascii_ply(&["0 0 0", "10 0 0"], 4_000_000_000);
    estimate_fails(|dir| std::fs::write(dir.join("part.ply"), text).unwrap(), "", &["part.ply", "vertex"]);
}

#[test]
fn mesh_with_nan() {
    let text = ascii_ply(&["0 0 0", "10 nan 0", "0 50 0"], 3);
    estimate_fails(
        |dir| std::fs::write(dir.join("part.ply"), text).unwrap(),
        "",
        &["part.ply", "vertex", "row 1", "property y", "NaN"],
    );
}

#[test]
fn empty_mesh() {
    let text = ascii_ply(&[], 0);
    estimate_fails(
        |dir| std::fs::write(dir.join("part.ply"), text).unwrap(),
        "",
        &["part.ply", "vertex", "at least one"],
    );
}

#[test]
fn wrong_unit() {
    let case = OneImage::new();
    let arguments = OneImage::ARGUMENTS.replace("--unit mm", "--unit m");
    fails(case.path(), &arguments, &["part.ply", "--unit mm"]);
    fails(case.path(), OneImage::ARGUMENTS.trim_end_matches(" --unit mm"), &["part.ply", "--unit"]);
    let run = sixfold(case.path(), &OneImage::ARGUMENTS.replace("--unit mm", "--unit parsec")).expect(2);
    assert!(run.stderr.contains("parsec"), "{}", run.stderr);
}

#[test]
fn missing_files() {
    for name in ["depth.png", "rgb.png", "camera.json", "part.ply"] {
        estimate_fails(|dir| std::fs::remove_file(dir.join(name)).unwrap(), "", &[name, "No such file"]);
    }
    estimate_fails(|_| {}, "--mask none.png", &["none.png"]);
    let case = OneImage::new();
    fails(case.path(), "estimate --camera camera.json --object part.ply", &["--depth"]);
    fails(case.path(), "estimate --depth depth.png --camera camera.json", &["--object"]);
    fails(case.path(), "render --object no-such-thing", &["no-such-thing", "object add"]);
    fails(case.path(), "eval --dataset none --results r.csv", &["none"]);
    fails(case.path(), "estimate --dataset none --out r.csv", &["none"]);
    fails(case.path(), "simulate-depth --dataset none --out new", &["none"]);
    fails(case.path(), "demo --data none", &["none"]);
    fails(case.path(), "object add a none.ply --unit mm", &["none.ply"]);
}

#[test]
fn truncated_images() {
    for name in ["depth.png", "rgb.png"] {
        estimate_fails(|dir| truncate(&dir.join(name), 0.5), "", &[name]);
        estimate_fails(|dir| truncate(&dir.join(name), 0.0), "", &[name]);
        estimate_fails(|dir| std::fs::write(dir.join(name), "no image").unwrap(), "", &[name]);
    }
}

#[test]
fn image_whose_header_claims_too_much() {
    // The width in the PNG header becomes two billion; its checksum is left wrong.
    let widen = |dir: &Path| {
        let mut bytes = std::fs::read(dir.join("depth.png")).unwrap();
        bytes[16..20].copy_from_slice(&0x7fff_ffffu32.to_be_bytes());
        std::fs::write(dir.join("depth.png"), bytes).unwrap();
    };
    estimate_fails(widen, "", &["depth.png"]);
}

#[test]
fn colour_image_in_place_of_depth() {
    let swap = |dir: &Path| {
        std::fs::copy(dir.join("rgb.png"), dir.join("depth.png")).unwrap();
    };
    estimate_fails(swap, "", &["depth.png", "16"]);
}

#[test]
fn depth_of_zeros() {
    let empty = sixfold_geometry::DepthImage::filled(WIDTH, HEIGHT, 0.0);
    let write = |dir: &Path| sixfold_io::write_depth(&dir.join("depth.png"), &empty, 1e-3).unwrap();
    estimate_fails(write, "", &["depth.png", "no valid pixel"]);
}

#[test]
fn depth_scale_off_by_a_thousand() {
    estimate_fails(
        |dir| replace(&dir.join("camera.json"), "\"depth_scale\": 0.1", "\"depth_scale\": 0.0001"),
        "",
        &["depth.png", "1000"],
    );
    estimate_fails(|_| {}, "--depth-scale 0", &["--depth-scale"]);
    estimate_fails(|_| {}, "--depth-scale nan", &["--depth-scale"]);
}

#[test]
fn broken_camera() {
    let camera = |text: &str| {
        let text = text.to_owned();
        move |dir: &Path| std::fs::write(dir.join("camera.json"), text).unwrap()
    };
    let cases: [(&str, &[&str]); 9] = [
        ("{\"fx\": 300, \"fy\": 300, \"cx\":", &["camera.json", "JSON"]),
        ("[1, 2]", &["camera.json", "object"]),
        (r#"{"fx": 300, "fy": 300, "cx": 159.5, "depth_scale": 1}"#, &["camera.json", "field cy"]),
        (
            r#"{"fx": "wide", "fy": 300, "cx": 159.5, "cy": 119.5, "depth_scale": 1}"#,
            &["camera.json", "field fx"],
        ),
        (r#"{"fx": -300, "fy": 300, "cx": 159.5, "cy": 119.5, "depth_scale": 1}"#, &["camera.json", "fx"]),
        (r#"{"cam_K": [300, 0, 159.5], "depth_scale": 1}"#, &["camera.json", "cam_K"]),
        (r#"{"fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5}"#, &["camera.json", "depth_scale"]),
        (
            r#"{"fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5, "depth_scale": -1}"#,
            &["camera.json", "depth_scale"],
        ),
        (
            r#"{"0": {"cam_K": [300, 0, 159.5, 0, 300, 119.5, 0, 0, 1]}, "1": {}}"#,
            &["camera.json", "images", "dataset"],
        ),
    ];
    for (text, words) in cases {
        estimate_fails(camera(text), "", words);
    }
}

#[test]
fn intrinsics_of_another_resolution() {
    let sized = r#"{"width": 640, "height": 480, "fx": 600, "fy": 600, "cx": 319.5, "cy": 239.5, "depth_scale": 0.1}"#;
    estimate_fails(
        |dir| std::fs::write(dir.join("camera.json"), sized).unwrap(),
        "",
        &["camera.json", "640x480", "320x240"],
    );
    let unsized_one = r#"{"fx": 600, "fy": 600, "cx": 319.5, "cy": 239.5, "depth_scale": 0.1}"#;
    estimate_fails(
        |dir| std::fs::write(dir.join("camera.json"), unsized_one).unwrap(),
        "",
        &["camera.json", "cx", "320x240", "resolution"],
    );
    let small = sixfold_geometry::RgbImage::filled(160, 120, [1; 3]);
    estimate_fails(
        |dir| sixfold_io::write_rgb(&dir.join("rgb.png"), &small).unwrap(),
        "",
        &["rgb.png", "160x120", "320x240"],
    );
    let mask = sixfold_geometry::Mask::filled(160, 120, true);
    estimate_fails(
        |dir| sixfold_io::write_mask(&dir.join("mask.png"), &mask).unwrap(),
        "--mask mask.png",
        &["mask.png", "160x120", "320x240"],
    );
}

/// A focal length of half a pixel once gave a pose 597 m behind the camera, one of 1e-5 pixels a panic.
#[test]
fn impossible_cameras() {
    for (numbers, words) in [
        (r#""fx": 0.5, "fy": 0.5, "cx": 159.5, "cy": 119.5"#, "millimetres"),
        (r#""fx": 1e-5, "fy": 1e-5, "cx": 159.5, "cy": 119.5"#, "millimetres"),
        (r#""fx": 0.94, "fy": 1.25, "cx": 0.5, "cy": 0.5"#, "normalised"),
        (r#""fx": 300, "fy": 30, "cx": 159.5, "cy": 119.5"#, "factor of 2"),
        (r#""fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5, "width": 320"#, "height"),
        (r#""fx": 300, "fy": 300, "cx": 159.5, "cy": 119.5, "focus": 3"#, "focus"),
    ] {
        let text = format!("{{{numbers}, \"depth_scale\": 0.1}}");
        estimate_fails(
            |dir| std::fs::write(dir.join("camera.json"), text).unwrap(),
            "",
            &["camera.json", "field", words],
        );
    }
}

#[test]
fn images_above_the_limit() {
    estimate_fails(|_| {}, "--max-pixels 76799", &["camera.json", "320x240", "--max-pixels"]);
    let without_size = |dir: &Path| {
        let camera = dir.join("camera.json");
        let text = std::fs::read_to_string(&camera).unwrap();
        let mut value: serde_json::Value = serde_json::from_str(&text).unwrap();
        value.as_object_mut().unwrap().retain(|key, _| key != "width" && key != "height");
        std::fs::write(&camera, value.to_string()).unwrap();
    };
    estimate_fails(without_size, "--max-pixels 76799", &["depth.png", "320x240", "--max-pixels"]);
    let case = OneImage::new();
    sixfold(case.path(), &format!("{} --max-pixels 76800", OneImage::ARGUMENTS)).expect(0);
}

#[test]
fn boxes_and_masks_that_leave_nothing() {
    estimate_fails(|_| {}, "--box 400,10,50,50", &["--box", "320x240"]);
    estimate_fails(|_| {}, "--box 10,10,0,50", &["--box"]);
    estimate_fails(|_| {}, "--box 10,10,nan,50", &["--box"]);
    let run = {
        let case = OneImage::new();
        sixfold(case.path(), &format!("{} --box 10,10,50", OneImage::ARGUMENTS)).expect(2)
    };
    assert!(run.stderr.contains("--box"), "{}", run.stderr);
    let mask = sixfold_geometry::Mask::filled(WIDTH, HEIGHT, false);
    estimate_fails(
        |dir| sixfold_io::write_mask(&dir.join("mask.png"), &mask).unwrap(),
        "--mask mask.png",
        &["mask.png", "empty"],
    );
}

#[test]
fn broken_object_in_the_store() {
    let case = OneImage::new();
    let dir = case.path();
    sixfold(dir, "object add part part.ply --unit mm").expect(0);
    let record = dir.join("sixfold-objects/part/object.json");
    let good = std::fs::read_to_string(&record).unwrap();
    truncate(&record, 0.5);
    fails(dir, "object show part", &["object.json"]);
    std::fs::write(&record, good.replace("\"version\": 1", "\"version\": 9")).unwrap();
    fails(dir, "object show part", &["object.json", "version", "9"]);
    std::fs::write(&record, good).unwrap();
    truncate(&dir.join("sixfold-objects/part/mesh.ply"), 0.5);
    fails(dir, "render --object part", &["mesh.ply"]);

    // A broken description can be computed again, with a note.
    sixfold(dir, "object add part part.ply --unit mm --replace").expect(0);
    truncate(&dir.join("sixfold-objects/part/ppf.bin"), 0.5);
    let run = sixfold(dir, "estimate --depth depth.png --camera camera.json --object part").expect(0);
    assert!(run.stderr.contains("description of part"), "{}", run.stderr);
}

/// `command` on the dataset fails with these words after `spoil` has changed it.
fn dataset_fails(spoil: impl FnOnce(&Tiny), command: &str, words: &[&str]) {
    let tiny = Tiny::new(true);
    tiny.write_truth_as_results("results.csv");
    spoil(&tiny);
    fails(tiny.path(), command, words);
}

const EVAL: &str = "eval --dataset tiny --results results.csv";
const ESTIMATE: &str = "estimate --dataset tiny --out new.csv";

#[test]
fn pose_that_is_no_rotation() {
    let spoil = |tiny: &Tiny| {
        let file = tiny.file("test/000007/scene_gt.json");
        let mut json: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        json["4"][1]["cam_R_m2c"] = serde_json::json!([2, 0, 0, 0, 1, 0, 0, 0, 1]);
        std::fs::write(file, json.to_string()).unwrap();
    };
    for command in [EVAL, "simulate-depth --dataset tiny --out new"] {
        dataset_fails(spoil, command, &["scene_gt.json", "im_id 4", "cam_R_m2c"]);
    }
}

#[test]
fn broken_dataset_files() {
    let cut = |name: &'static str| move |tiny: &Tiny| truncate(&tiny.file(name), 0.6);
    for name in ["test/000007/scene_gt.json", "test/000007/scene_camera.json"] {
        let short = name.rsplit_once('/').unwrap().1;
        dataset_fails(cut(name), EVAL, &[short]);
        dataset_fails(cut(name), ESTIMATE, &[short]);
    }
    dataset_fails(cut("test_targets_bop19.json"), ESTIMATE, &["test_targets_bop19.json"]);
    dataset_fails(cut("models/models_info.json"), ESTIMATE, &["models_info.json"]);
    dataset_fails(cut("models/obj_000002.ply"), ESTIMATE, &["obj_000002.ply"]);
    dataset_fails(cut("models/obj_000002.ply"), EVAL, &["obj_000002.ply"]);
    let remove = |tiny: &Tiny| std::fs::remove_file(tiny.file("models/obj_000001.ply")).unwrap();
    dataset_fails(remove, ESTIMATE, &["obj_000001.ply"]);
    dataset_fails(|_| {}, "eval --dataset tiny --results results.csv --split train", &["train"]);
    dataset_fails(|_| {}, "estimate --dataset tiny --out folder", &["--out", ".csv"]);
    dataset_fails(|_| {}, "estimate --dataset tiny --out new.csv --boxes detect", &["--boxes detect"]);
    dataset_fails(|_| {}, "estimate --dataset tiny --out new.csv --targets t.json", &["t.json"]);
}

#[test]
fn broken_results() {
    let spoil = |from: &'static str, to: &'static str| {
        move |tiny: &Tiny| replace(&tiny.path().join("results.csv"), from, to)
    };
    dataset_fails(spoil("7,0,1,0.9,", "7,0,1,"), EVAL, &["results.csv", "line 2", "columns"]);
    dataset_fails(spoil("7,0,1,0.9,", "7,0,1,nan,"), EVAL, &["results.csv", "line 2", "score", "nan"]);
    dataset_fails(spoil("7,0,1,", "7,0,cup,"), EVAL, &["results.csv", "line 2", "obj_id", "cup"]);
    dataset_fails(spoil("7,0,1,0.9,", "7,0,1,0.9,NaN "), EVAL, &["results.csv", "line 2", "R"]);
    dataset_fails(
        |tiny| std::fs::write(tiny.path().join("results.csv"), [0xff, 0xfe, 0x00]).unwrap(),
        EVAL,
        &["results.csv"],
    );
    dataset_fails(
        |tiny| std::fs::remove_file(tiny.path().join("results.csv")).unwrap(),
        EVAL,
        &["results.csv"],
    );
}

#[test]
fn detections_off_the_image_or_broken() {
    let write =
        |text: &'static str| move |tiny: &Tiny| std::fs::write(tiny.path().join("d.json"), text).unwrap();
    let command = format!("{ESTIMATE} --boxes d.json");
    let off = r#"[{"scene_id": 7, "image_id": 0, "category_id": 1, "score": 1, "bbox": [900, 10, 20, 20]}]"#;
    dataset_fails(write(off), &command, &["skipped", "d.json", "entry 0", "box", "900"]);
    let negative =
        r#"[{"scene_id": 7, "image_id": 0, "category_id": 1, "score": 1, "bbox": [9, 10, -20, 20]}]"#;
    dataset_fails(write(negative), &command, &["d.json", "bbox", "-20"]);
    dataset_fails(write(r#"[{"image_id": 0, "#), &command, &["d.json"]);
    dataset_fails(
        write(r#"[{"scene_id": 7, "image_id": 0}]"#),
        &command,
        &["d.json", "entry 0", "field bbox"],
    );
}

#[cfg(all(feature = "experience", feature = "physics"))]
#[test]
fn options_that_would_be_ignored_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let one = "--depth d.png --camera c.json";
    let found = "--object part.ply --unit mm";
    for (arguments, option, reason) in [
        ("estimate --dataset lmo --out r.csv --unit mm", "--unit", "with --dataset"),
        ("estimate --dataset lmo --out r.csv --store objects", "--store", "with --dataset"),
        ("estimate --dataset lmo --out r.csv --instances 3", "--instances", "with --dataset"),
        ("estimate ONE FOUND --split train", "--split", "without --dataset"),
        (
            "estimate --method pix2pose --weights w --rgb c.png --camera c.json FOUND --depth-scale 1",
            "--depth-scale",
            "without --depth",
        ),
        (
            "estimate ONE FOUND --object-id 3",
            "--object-id",
            "with --method auto without --weights without --detector",
        ),
        (
            "estimate --method ppf ONE FOUND --object-id 3",
            "--object-id",
            "with --method ppf without --detector",
        ),
        (
            "estimate --method mttm ONE FOUND --object-id 3",
            "--object-id",
            "with --method mttm without --detector",
        ),
        ("estimate --dataset lmo --out r.csv --boxes gt --detector d", "--detector", "with --boxes gt"),
        (
            "estimate --dataset lmo --out r.csv --boxes b.json --detector d",
            "--detector",
            "with --boxes b.json",
        ),
        (
            "estimate --method mttm --matcher points --weights w ONE FOUND",
            "--weights",
            "with --matcher points",
        ),
        (
            "estimate --method mttm --masks network --matcher both ONE FOUND",
            "--matcher",
            "with --masks network with --matcher both",
        ),
        ("estimate ONE FOUND --cache folder --no-cache", "--cache", "with --no-cache"),
        ("detect --weights w --rgb c.png --split train", "--split", "without --dataset"),
        ("eval --dataset lmo --results r.csv --min-score 0.5", "--min-score", "without --detections"),
        ("eval --dataset lmo --detections d.json --detection-ap", "--detection-ap", "with --detections"),
        ("eval --dataset lmo --detections d.json --no-vsd", "--no-vsd", "with --detections"),
        ("eval --dataset lmo --detections d.json --curves c.png", "--curves", "with --detections"),
        ("object add mug mug.ply --unit mm --model-id 3", "--model-id", "without --models-info"),
        ("object add mug ONE --mask m.png --unit mm", "--unit", "with --depth"),
        ("object add mug ONE --mask m.png --models-info i --model-id 3", "--models-info", "with --depth"),
        ("object add mug ONE --mask m.png --symmetric-about z", "--symmetric-about", "with --depth"),
        ("synthesize --photographs p.json --out out --split train", "--split", "without --dataset"),
        ("synthesize --dataset lmo --out out --no-refine --rough 3,1", "--rough", "with --no-refine"),
        ("synthesize --dataset lmo --out out --no-refine --scene still", "--scene", "with --no-refine"),
        ("simulate-scenes --toys 1 --out out --unit mm", "--unit", "without --object"),
        ("simulate-scenes --toys 1 --out out --store objects", "--store", "without --object"),
        ("train pix2pose FOUND --out out --split train", "--split", "without --dataset"),
        ("train pix2pose --dataset lmo --out out --unit mm", "--unit", "without --object"),
        (
            "train pix2pose --dataset lmo --out out --no-adversarial --network compact",
            "--no-adversarial",
            "with --network compact",
        ),
        (
            "train pix2pose --dataset lmo --out out --no-adversarial",
            "--no-adversarial",
            "without --network without --preset",
        ),
        ("train detector FOUND --out out --split train", "--split", "without --dataset"),
        ("train detector --dataset lmo --out out --store objects", "--store", "without --object"),
        ("grasp propose ONE --weights w", "--weights", "without --experiences"),
        ("grasp propose ONE --rgb c.png", "--rgb", "without --out"),
        ("grasp try FOUND --grasp g.json --approach 0,0,1", "--approach", "with --grasp"),
        ("grasp try FOUND --grasp g.json --closing 0,1,0", "--closing", "with --grasp"),
        ("grasp learn --experiences e.db --families can --out out --unit mm", "--unit", "without --object"),
        (
            "grasp learn --experiences e.db --families can --out out --store objects",
            "--store",
            "without --object",
        ),
    ] {
        let arguments = arguments.replace("ONE", one).replace("FOUND", found);
        fails(dir.path(), &arguments, &[&format!("{option} has no effect"), reason]);
    }
    // The option does not exist for commands without colour.
    fails(dir.path(), "grasp store add e.db --rgb c.png", &["unexpected argument", "--rgb"]);
    // Options from the environment may be meant for other commands.
    let mut command = std::process::Command::new(crate::PROGRAM);
    command.args(["grasp", "propose", "--depth", "d.png", "--camera", "c.json"]).current_dir(dir.path());
    let output = command.env("SIXFOLD_DGCM", "w.safetensors").output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(stderr.contains("c.json") && !stderr.contains("no effect"), "{stderr}");
}
