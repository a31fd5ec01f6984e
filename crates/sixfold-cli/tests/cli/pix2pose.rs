//! Pix2Pose from the command line: training, weights, poses from colour; on images that the tests render.

use std::path::Path;

use serde_json::Value;
use sixfold_bop::read_results;
use sixfold_mesh::ModelsInfo;
use sixfold_pix2pose::model::Pix2PoseModel;

use crate::support::*;

/// Trains a small network on object 1 for a number of steps, on the three images of the tiny dataset.
fn train(steps: usize) -> String {
    format!(
        "train pix2pose --dataset tiny --ids 1 --size 64 --per-object 4 --rotation 0 --render-fraction 0 --steps {steps} --out trained"
    )
}

const WEIGHTS: &str = "trained/model.safetensors";

/// The image, camera, mesh and box of object 1 in image 4.
fn one_image(tiny: &Tiny) -> String {
    let truth = tiny.truth_of(4, 1);
    let corners: Vec<_> =
        part().vertices().iter().filter_map(|v| camera().project(&truth.transform_point(v))).collect();
    let minimum = |f: fn(&sixfold_geometry::Vec2) -> f64| corners.iter().map(f).fold(f64::INFINITY, f64::min);
    let most =
        |f: fn(&sixfold_geometry::Vec2) -> f64| corners.iter().map(f).fold(f64::NEG_INFINITY, f64::max);
    let (x, y) = (minimum(|c| c.x), minimum(|c| c.y));
    format!("{} --box {x},{y},{},{}", without_box(), most(|c| c.x) - x, most(|c| c.y) - y)
}

fn without_box() -> String {
    format!(
        "estimate --method pix2pose --weights {WEIGHTS} --rgb tiny/test/000007/rgb/000004.png --camera tiny/camera.json \
         --object tiny/models/obj_000001.ply --unit mm"
    )
}

fn json_of(file: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap()
}

#[test]
fn a_network_trained_on_three_images_finds_the_object_in_them() {
    let tiny = Tiny::coloured();
    let trained = sixfold(tiny.path(), &format!("{} --json", train(160))).expect(0).json();
    assert_eq!((&trained["steps"], &trained["photographs"]), (&160.into(), &3.into()));
    assert!(trained["losses"]["coordinates"].as_f64().unwrap() < 0.5, "{trained}");
    assert!(image::open(tiny.path().join("trained/training/curves.png")).is_ok());
    let card = std::fs::read_to_string(tiny.path().join("trained/model.md")).unwrap();
    assert!(card.contains("7/0 7/4 7/11"), "{card}");

    // Without further steps: the same weights, and the alignment measured again with the same result.
    let again = train(0).replace("--out trained", &format!("--init {WEIGHTS} --out again"));
    sixfold(tiny.path(), &again).expect(0);
    let both = [WEIGHTS, "again/model.safetensors"]
        .map(|file| Pix2PoseModel::load(&tiny.path().join(file)).unwrap());
    assert_eq!(both[0].objects(), both[1].objects());
    assert!(both[1].card().extra["corrections"]["command"].as_str().unwrap().contains("--steps 0"));
    let grey = vec![0.5; 3 * 64 * 64];
    assert_eq!(both[0].predict(0, &grey), both[1].predict(0, &grey));

    // One image: pose, all hypotheses, both images.
    let run = sixfold(tiny.path(), &format!("{} --out one --json", one_image(&tiny))).expect(0);
    let json = run.json();
    assert_eq!(json, json_of(&tiny.path().join("one/poses.json")));
    let pose = &json["poses"][0];
    assert_eq!((&pose["object"], &pose["object_id"]), (&"obj_000001".into(), &1.into()));
    let (found, truth) = (pose_of(&pose["camera_from_object"]), tiny.truth_of(4, 1));
    let (metres, degrees) = (found.distance_to(&truth), found.rotation_angle_to(&truth).to_degrees());
    assert!(metres < 0.06 && degrees < 25.0, "{metres} m, {degrees} degrees off");
    assert!(pose["agreement"].as_f64().is_some_and(|a| a > 0.0 && a <= 1.0), "refined: {pose}");
    let inliers: Vec<u64> =
        pose["hypotheses"].as_array().unwrap().iter().map(|h| h["inliers"].as_u64().unwrap()).collect();
    assert!(!inliers.is_empty() && inliers.is_sorted_by(|a, b| a >= b), "{inliers:?}");
    let overlay = image::open(tiny.path().join("one/overlay.png")).unwrap().to_rgb8();
    assert_eq!(overlay.dimensions(), (WIDTH as u32, HEIGHT as u32));
    assert!(overlay.pixels().any(|p| p.0[0].abs_diff(p.0[2]) > 60), "nothing is rendered");
    let seen = image::open(tiny.path().join("one/coordinates.png")).unwrap().to_rgb8();
    assert_eq!(seen.height(), 256);
    // The second of the four is coloured where the object is.
    let colours = (280..500).filter(|x| {
        let p = seen.get_pixel(*x, 128).0;
        p[0].abs_diff(p[1]).max(p[1].abs_diff(p[2])) > 40
    });
    assert!(colours.count() > 20);

    // With depth, ICP brings it near.
    let icp = format!("{} --depth tiny/test/000007/depth/000004.png --icp --json", one_image(&tiny));
    let json = sixfold(tiny.path(), &icp).expect(0).json();
    let aligned = pose_of(&json["poses"][0]["camera_from_object"]);
    assert!(
        aligned.distance_to(&truth) < 0.01,
        "{} m after ICP, {metres} m before",
        aligned.distance_to(&truth)
    );
    assert!(json["poses"][0]["icp"]["inliers"].as_u64().unwrap() > 20);
    assert!(json["poses"][0]["agreement"].is_null(), "not refined by colour");

    // A pose is found without the mesh too.
    let bare = one_image(&tiny).replace("--object tiny/models/obj_000001.ply --unit mm", "");
    let run = sixfold(tiny.path(), &format!("{bare} --out bare --json")).expect(0);
    assert!(run.stderr.contains("without --object"), "{}", run.stderr);
    assert_eq!(run.json()["poses"][0]["refined"], false);
    assert!(run.json()["poses"][0]["agreement"].is_null());

    // A score that no pose reaches: nothing found.
    let run = sixfold(tiny.path(), &format!("{} --min-score 1.01 --json", one_image(&tiny))).expect(1);
    assert_eq!(run.json()["not_found"][0], "obj_000001");

    // The whole dataset, for the model's object.
    let targets = serde_json::json!(
        [0, 4, 11].map(|im| serde_json::json!({"scene_id": 7, "im_id": im, "obj_id": 1, "inst_count": 1}))
    );
    std::fs::write(tiny.path().join("targets.json"), targets.to_string()).unwrap();
    let dataset = format!(
        "estimate --method pix2pose --weights {WEIGHTS} --dataset tiny --targets targets.json --out results.csv --json"
    );
    fails(tiny.path(), &dataset, &["boxes", "--boxes gt"]);
    let json = sixfold(tiny.path(), &format!("{dataset} --boxes gt")).expect(0).json();
    assert_eq!(json["targets"], 3);
    let results = read_results(&tiny.path().join("results.csv")).unwrap();
    assert!(results.iter().any(|r| r.camera_from_object.distance_to(&tiny.truth_of(r.im_id, 1)) < 0.06));
    // A run with other options is not mixed with this one.
    fails(tiny.path(), &format!("{dataset} --boxes gt --no-refine"), &["results.csv", "other options"]);
}

#[test]
fn a_training_resumes_and_is_not_mixed_with_another() {
    let tiny = Tiny::coloured();
    fails(tiny.path(), &format!("{} --export", train(3)), &["trained", "no checkpoint"]);
    sixfold(tiny.path(), &train(3)).expect(0);
    let model = std::fs::read(tiny.path().join(WEIGHTS)).unwrap();
    // Nothing is left to do: the same model again, to the byte.
    std::fs::remove_file(tiny.path().join(WEIGHTS)).unwrap();
    sixfold(tiny.path(), &train(3)).expect(0);
    assert!(
        std::fs::read(tiny.path().join(WEIGHTS)).unwrap() == model,
        "the same training gave another model"
    );
    // And in another folder.
    let elsewhere = train(3).replace("--out trained", "--out elsewhere");
    sixfold(tiny.path(), &format!("--threads 1 {elsewhere}")).expect(0);
    let weights = |folder: &str| {
        let bytes = std::fs::read(tiny.path().join(folder).join("model.safetensors")).unwrap();
        let header = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        bytes[8 + header..].to_vec()
    };
    assert!(weights("trained") == weights("elsewhere"), "one thread gave other weights than two");
    // Other options need another folder, and do not change the existing one.
    fails(tiny.path(), &train(6), &["trained", "steps was 3, is 6", "another folder"]);
    fails(tiny.path(), &format!("{} --seed 1", train(3)), &["trained", "seed was 0, is 1"]);
    assert!(std::fs::read(tiny.path().join(WEIGHTS)).unwrap() == model);
    let json = sixfold(tiny.path(), &format!("{} --export --json", train(3))).expect(0).json();
    assert_eq!((&json["steps"], &json["seconds"]), (&3.into(), &Value::Null));
    // The card states that the network was trained without the exact mesh.
    sixfold(tiny.path(), &train(1).replace("--out trained", "--out hull --convex-hull")).expect(0);
    let card = std::fs::read_to_string(tiny.path().join("hull/model.md")).unwrap();
    assert!(card.contains("convex hulls"), "{card}");
    // Another seed is another network.
    let other = train(3).replace("--out trained", "--out other --seed 1");
    sixfold(tiny.path(), &other).expect(0);
    assert!(weights("trained") != weights("other"));
}

#[test]
fn trainings_that_cannot_be() {
    let tiny = Tiny::new(true);
    fails(tiny.path(), &train(3), &["tiny", "split test", "no colour images", "--renders-only"]);
    assert!(!tiny.path().join(WEIGHTS).exists());
    let tiny = Tiny::coloured();
    fails(tiny.path(), "train pix2pose --out trained", &["--dataset", "--object"]);
    fails(tiny.path(), "train pix2pose --dataset none --out trained", &["none"]);
    fails(
        tiny.path(),
        &format!("{} --size 50", train(3).replace("--size 64", "")),
        &["--size", "50", "multiple of 32"],
    );
    fails(tiny.path(), &format!("{} --frames none.json", train(3)), &["none.json"]);
    std::fs::write(tiny.path().join("frames.json"), "[{\"scene_id\": 7, \"im_id\": 99}]").unwrap();
    fails(tiny.path(), &format!("{} --frames frames.json", train(3)), &["99"]);
    std::fs::write(tiny.path().join("empty.json"), "[]").unwrap();
    fails(tiny.path(), &format!("{} --frames empty.json", train(3)), &["frames", "--renders-only"]);
    fails(tiny.path(), &format!("{} --init none.safetensors", train(3)), &["none.safetensors"]);
    fails(tiny.path(), &train(0), &["steps", "found 0", "1 or more"]);
    let other = train(3).replace("--ids 1", "--ids 2");
    fails(tiny.path(), &format!("{other} --preset lmo"), &["preset", "object 2", "1, 5, 6, 8 to 12"]);
    assert!(!tiny.path().join(WEIGHTS).exists());
}

#[test]
fn a_preset_brings_its_thresholds_and_symmetries() {
    let tiny = Tiny::coloured();
    let model = |preset: &str| {
        let out = format!("--out {preset} --preset {preset}");
        let run = sixfold(tiny.path(), &train(1).replace("--out trained", &out)).expect(0);
        let model = Pix2PoseModel::load(&tiny.path().join(preset).join("model.safetensors")).unwrap();
        (model, run.stderr)
    };
    let (lmo, quiet) = model("lmo");
    assert_eq!(lmo.objects()[0].thresholds, [0.2]);
    assert!(lmo.card().data.contains("parameters for lmo"), "{}", lmo.card().data);
    assert!(!quiet.contains("appendix A"), "{quiet}");
    // Object 1 of T-LESS is symmetric about z; this one, which is not a cylinder, is not.
    let (tless, output) = model("tless");
    assert_eq!(tless.objects()[0].thresholds, [0.1]);
    assert!(
        output.contains(
            "0 discrete and 1 continuous symmetries of appendix A in place of the dataset's 0 and 0"
        )
    );
    assert!(output.contains("warning: object 1: under a declared symmetry"), "{output}");
    assert_eq!(model("bop").0.objects()[0].thresholds, [0.15, 0.25, 0.35]);
}

#[test]
fn a_symmetry_that_the_mesh_does_not_have_is_reported() {
    let tiny = Tiny::coloured();
    let quiet = sixfold(tiny.path(), &train(1)).expect(0);
    assert!(!quiet.stderr.contains("warning"), "{}", quiet.stderr);
    let file = tiny.file("models/models_info.json");
    let mut infos = ModelsInfo::read(&file).unwrap();
    let half_turn = sixfold_geometry::Pose::exp(&[0.0, 0.0, 0.0, std::f64::consts::PI, 0.0, 0.0].into());
    infos.0.get_mut(&1).unwrap().symmetries_discrete.push(half_turn);
    infos.write(&file).unwrap();
    let run = sixfold(tiny.path(), &train(1).replace("--out trained", "--out other")).expect(0);
    let line = run.stderr.lines().find(|l| l.starts_with("warning")).unwrap();
    // Lying instead of standing, the part of 11 cm differs from itself by several centimetres.
    let millimetres: f64 = line
        .split_whitespace()
        .zip(line.split_whitespace().skip(1))
        .find(|(_, u)| *u == "mm")
        .unwrap()
        .0
        .parse()
        .unwrap();
    assert!(line.contains("object 1") && (15.0..110.0).contains(&millimetres), "{line}");
}

#[test]
fn bad_boxes_weights_and_objects() {
    let tiny = Tiny::coloured();
    sixfold(tiny.path(), &train(1)).expect(0);
    let base = without_box();
    fails(tiny.path(), &base, &["--box", "--mask"]);
    fails(tiny.path(), &format!("{base} --box 100,100,0,50"), &["--box", "size above 0"]);
    fails(tiny.path(), &format!("{base} --box 100,100,-5,50"), &["--box", "size above 0"]);
    fails(tiny.path(), &format!("{base} --box 100,100,1,1"), &["box", "at least 2 pixels"]);
    fails(tiny.path(), &format!("{base} --box 100,100,50"), &["--box", "3 numbers"]);
    fails(tiny.path(), &format!("{base} --box 400,100,50,50"), &["--box", "outside the 320x240"]);
    fails(tiny.path(), &format!("{base} --box 100,100,NaN,50"), &["--box", "size above 0"]);

    let boxed = format!("{base} --box 60,60,80,80");
    fails(tiny.path(), &boxed.replace(&format!("--weights {WEIGHTS}"), ""), &["--weights", "train pix2pose"]);
    fails(tiny.path(), &boxed.replace(WEIGHTS, "none.safetensors"), &["none.safetensors"]);
    std::fs::write(tiny.path().join("text.safetensors"), "no weights").unwrap();
    fails(tiny.path(), &boxed.replace(WEIGHTS, "text.safetensors"), &["text.safetensors"]);
    std::fs::copy(tiny.path().join(WEIGHTS), tiny.path().join("cut.safetensors")).unwrap();
    truncate(&tiny.path().join("cut.safetensors"), 0.6);
    fails(tiny.path(), &boxed.replace(WEIGHTS, "cut.safetensors"), &["cut.safetensors"]);
    // The name of another network in the card, as long as the right one.
    let mut bytes = std::fs::read(tiny.path().join(WEIGHTS)).unwrap();
    let name = b"pix2pose-compact";
    let at = bytes.windows(name.len()).position(|w| w == name).unwrap();
    bytes[at..at + name.len()].copy_from_slice(b"pix2pose-another");
    std::fs::write(tiny.path().join("other.safetensors"), bytes).unwrap();
    fails(
        tiny.path(),
        &boxed.replace(WEIGHTS, "other.safetensors"),
        &["other.safetensors", "pix2pose-another"],
    );

    fails(tiny.path(), &format!("{boxed} --object-id 2"), &["trained on objects 1", "object 2"]);
    fails(
        tiny.path(),
        &boxed.replace("obj_000001.ply", "obj_000002.ply"),
        &["obj_000002.ply", "object 1", "mm"],
    );
    fails(tiny.path(), &boxed.replace("--unit mm", "--unit cm"), &["obj_000001.ply", "mm"]);
    fails(tiny.path(), &boxed.replace("--rgb tiny/test/000007/rgb/000004.png", ""), &["--rgb"]);
    fails(tiny.path(), &boxed.replace("--method pix2pose", "--method ppf"), &["--method ppf", "pix2pose"]);
    fails(tiny.path(), &format!("{boxed} --icp"), &["--icp", "--depth"]);

    // An image of another size than the camera file says.
    let camera_file = tiny.path().join("tiny/camera.json");
    let camera: Value = json_of(&camera_file);
    let small = sixfold_geometry::RgbImage::filled(160, 120, [90; 3]);
    sixfold_io::write_rgb(&tiny.path().join("small.png"), &small).unwrap();
    fails(tiny.path(), &boxed.replace("tiny/test/000007/rgb/000004.png", "small.png"), &["160", "120"]);
    assert!(camera["fx"].is_number());
    // A target of the dataset that the model was not trained on.
    let all =
        format!("estimate --method pix2pose --weights {WEIGHTS} --dataset tiny --boxes gt --out results.csv");
    fails(tiny.path(), &all, &["trained on objects 1", "object 2"]);
}
