//! Detection from the command line: training, one image, a dataset, poses from the image alone, broken input.

use std::path::Path;

use serde_json::Value;

use crate::support::*;

/// A few steps on small images: the detector learns almost nothing, but is complete.
const TRAIN: &str = "train detector --dataset tiny --ids 1 --size 96 --batch 2 --out detector";
const WEIGHTS: &str = "detector/model.safetensors";

fn detect(rest: &str) -> String {
    format!("detect --weights {WEIGHTS} {rest}")
}

fn json_of(file: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap()
}

#[test]
fn a_detector_is_trained_and_used() {
    let tiny = Tiny::coloured();
    let trained = sixfold(tiny.path(), &format!("{TRAIN} --steps 120 --json")).expect(0).json();
    assert_eq!((&trained["steps"], &trained["photographs"]), (&120.into(), &3.into()));
    assert!(image::open(tiny.path().join("detector/training/curves.png")).is_ok());
    let card = std::fs::read_to_string(tiny.path().join("detector/model.md")).unwrap();
    assert!(card.contains("7/0 7/4 7/11"), "{card}");
    // Nothing is left to do: the same again; other options need another folder.
    let model = std::fs::read(tiny.path().join(WEIGHTS)).unwrap();
    sixfold(tiny.path(), &format!("{TRAIN} --steps 120 --export --json")).expect(0);
    assert!(std::fs::read(tiny.path().join(WEIGHTS)).unwrap() == model);
    fails(tiny.path(), &format!("{TRAIN} --steps 121"), &["steps was 120, is 121", "another folder"]);

    // Continuing from weights; the card states their origin.
    let further = TRAIN.replace("--out detector", &format!("--out further --init {WEIGHTS} --steps 1"));
    sixfold(tiny.path(), &further).expect(0);
    let card = std::fs::read_to_string(tiny.path().join("further/model.md")).unwrap();
    assert!(
        card.contains("continued_from") && card.contains(&format!("sixfold {TRAIN} --steps 120")),
        "{card}"
    );

    // One image: the object, its box, its mask, an image.
    let rgb = "--rgb tiny/test/000007/rgb/000004.png";
    let json =
        sixfold(tiny.path(), &detect(&format!("{rgb} --threshold 0.05 --per-object 1 --out one --json")));
    let json = json.expect(0).json();
    let found = &json["detections"][0];
    assert_eq!(found["object_id"], 1);
    assert!(found["mask_pixels"].as_u64().unwrap() > 0, "{json}");
    let overlay = image::open(tiny.path().join("one/overlay.png")).unwrap().to_rgb8();
    assert_eq!(overlay.dimensions(), (WIDTH as u32, HEIGHT as u32));
    let coco = json_of(&tiny.path().join("one/detections.json"));
    assert_eq!(coco[0]["segmentation"]["size"], serde_json::json!([HEIGHT, WIDTH]));
    assert_eq!(coco[0]["bbox"], found["bbox"]);
    // No detection has this score.
    sixfold(tiny.path(), &detect(&format!("{rgb} --threshold 1"))).expect(1);

    // Several files.
    let several = "--rgb tiny/test/000007/rgb/000000.png tiny/test/000007/rgb/000011.png";
    let options = "--threshold 0.05 --per-object 1 --out several --json";
    let json = sixfold(tiny.path(), &detect(&format!("{several} {options}"))).expect(0).json();
    assert_eq!((&json["images"][1]["image"], &json["detections"]), (&2.into(), &2.into()));
    assert_eq!(json_of(&tiny.path().join("several/detections.json"))[1]["image_id"], 2);
    assert!(image::open(tiny.path().join("several/overlays/000002_000011.png")).is_ok());
    let run = sixfold(tiny.path(), &detect(&format!("{several} nothing.png {options}")));
    assert!(run.expect(2).stderr.contains("skipped nothing.png"));

    // All images, and their scores.
    let all = detect("--dataset tiny --out found.json --overlays pictures --json");
    let json = sixfold(tiny.path(), &all).expect(0).json();
    assert_eq!(json["images"], 3);
    assert!(image::open(tiny.path().join("pictures/000007_000004.png")).is_ok());
    let eval = "eval --dataset tiny --detections found.json --min-score 0.05 --write-truth truth.json --json";
    let scores = sixfold(tiny.path(), eval).expect(0).json();
    assert_eq!(scores["images"], 3);
    assert!(scores["box"]["ap50"].is_number() && scores["mask"]["ap50"].is_number(), "{scores}");
    assert!(scores["found_at_half"][1]["recall_of"]["1"].is_number(), "{scores}");
    let truth = json_of(&tiny.path().join("truth.json"));
    assert_eq!(truth["images"].as_array().unwrap().len(), 3);
    let except = r#"[{"scene_id": 7, "im_id": 4}]"#;
    std::fs::write(tiny.path().join("except.json"), except).unwrap();
    let json = sixfold(tiny.path(), &format!("{all} --except except.json")).expect(0).json();
    assert_eq!(json["images"], 2);

    // Uses its masks for ICP and for new views.
    let pose = format!(
        "estimate --dataset tiny --targets targets.json --out masked.csv --detector {WEIGHTS} --json"
    );
    let target = r#"[{"scene_id": 7, "im_id": 4, "obj_id": 1, "inst_count": 1}]"#;
    std::fs::write(tiny.path().join("targets.json"), target).unwrap();
    assert!(sixfold(tiny.path(), &pose).code < 2);
    let views = "synthesize --dataset tiny --ids 1 --step 90 --elevation 30,30 --size 48 --weighting average";
    let run = sixfold(tiny.path(), &format!("{views} --detector {WEIGHTS} --out views")).expect(0);
    let note = run.stderr.lines().find(|l| l.contains("by the detector")).unwrap();
    assert!(note.contains("of 3 objects"), "{note}");
    let other = views.replace("--ids 1", "--ids 1,2");
    fails(tiny.path(), &format!("{other} --detector {WEIGHTS} --out more"), &["detector", "not on object 2"]);

    // Objects that it was not trained on.
    fails(
        tiny.path(),
        &detect(&format!("{rgb} --ids 2")),
        &["--ids", "trained on objects 1", "not on object 2"],
    );
    let estimate = "estimate --dataset tiny --out r.csv --detector detector/model.safetensors";
    fails(tiny.path(), estimate, &["detector", "not on object 2"]);
    fails(tiny.path(), "estimate --dataset tiny --out r.csv --boxes detect", &["--detector"]);
}

#[test]
fn images_of_all_kinds() {
    let tiny = Tiny::coloured();
    sixfold(tiny.path(), &format!("{TRAIN} --steps 1")).expect(0);
    let path = |name: &str| tiny.path().join(name);
    image::GrayImage::from_pixel(33, 70, image::Luma([90])).save(path("grey.png")).unwrap();
    image::RgbaImage::from_pixel(800, 20, image::Rgba([9, 90, 200, 30])).save(path("alpha.png")).unwrap();
    image::RgbImage::from_pixel(1, 1, image::Rgb([9, 90, 200])).save(path("dot.png")).unwrap();
    std::fs::write(path("empty.png"), b"").unwrap();
    std::fs::write(path("broken.png"), b"\x89PNG\r\n\x1a\nnothing else").unwrap();
    for name in ["grey.png", "alpha.png", "dot.png"] {
        let run = sixfold(tiny.path(), &detect(&format!("--rgb {name} --json")));
        assert!(run.code < 2, "{name}: {}", run.stderr);
    }
    for name in ["empty.png", "broken.png", "nowhere.png"] {
        fails(tiny.path(), &detect(&format!("--rgb {name}")), &[name]);
    }
    fails(tiny.path(), &detect("--rgb grey.png --threshold 2"), &["threshold", "found 2"]);
    fails(tiny.path(), "detect --weights grey.png --rgb grey.png", &["grey.png"]);
    // A network of another kind.
    let encoder =
        concat!(env!("CARGO_MANIFEST_DIR"), "/../sixfold-nn/weights/efficientnet-lite0-encoder.safetensors");
    fails(
        tiny.path(),
        &format!("detect --weights {encoder} --rgb grey.png"),
        &["architecture", "detect-compact"],
    );
    // An unreadable image of a dataset affects only itself.
    std::fs::write(path("tiny/test/000007/rgb/000004.png"), b"no image").unwrap();
    let run = sixfold(tiny.path(), &detect("--dataset tiny --threshold 0 --out found.json")).expect(2);
    assert!(run.stderr.contains("skipped image 7/4"), "{}", run.stderr);
    assert!(path("found.json.part").exists());
}

#[test]
fn a_dataset_with_an_image_left_out_is_completed_by_the_same_command() {
    let tiny = Tiny::coloured();
    sixfold(tiny.path(), &format!("{TRAIN} --steps 1")).expect(0);
    let all = |out: &str| detect(&format!("--dataset tiny --threshold 0 --out {out} --json"));
    let whole = sixfold(tiny.path(), &all("whole.json")).expect(0).json();
    let other = format!("{TRAIN} --steps 1 --seed 3").replace("--out detector", "--out other");
    sixfold(tiny.path(), &other).expect(0);
    let image = tiny.file("test/000007/rgb/000004.png");
    let before = std::fs::read(&image).unwrap();
    std::fs::write(&image, b"no image").unwrap();
    let part = sixfold(tiny.path(), &all("found.json")).expect(2).json();
    assert!(part["detections"].as_u64().unwrap() < whole["detections"].as_u64().unwrap(), "{part}");
    // Not resumed with another threshold, nor with other weights.
    let other = all("found.json").replace("--threshold 0", "--threshold 0.1");
    fails(tiny.path(), &other, &["found.json.part", "threshold", "remove both"]);
    let other = all("found.json").replace("detector/model", "other/model");
    fails(tiny.path(), &other, &["found.json.part", "weights", "remove both"]);

    std::fs::write(&image, before).unwrap();
    let again = sixfold(tiny.path(), &all("found.json")).expect(0).json();
    assert_eq!((&again["images"], &again["detections"]), (&whole["images"], &whole["detections"]));
    for name in ["found.json.part", "found.json.part.run.json"] {
        assert!(!tiny.path().join(name).exists(), "{name}");
    }
    let timeless = |name: &str| {
        let mut all = json_of(&tiny.path().join(name));
        all.as_array_mut().unwrap().iter_mut().for_each(|d| d["time"] = 0.into());
        all
    };
    assert_eq!(timeless("found.json"), timeless("whole.json"));
}

#[test]
fn overlays_that_cannot_be_written_cost_no_detections() {
    let tiny = Tiny::coloured();
    sixfold(tiny.path(), &format!("{TRAIN} --steps 1")).expect(0);
    // A file in the place of the folder: reported before anything is computed.
    std::fs::write(tiny.path().join("taken"), b"").unwrap();
    let all = "--dataset tiny --threshold 0 --out found.json --json";
    fails(tiny.path(), &detect(&format!("{all} --overlays taken/pictures")), &["taken"]);
    // Images that only fail when they are written.
    std::fs::create_dir_all(tiny.path().join("pictures/000007_000004.png")).unwrap();
    let run = sixfold(tiny.path(), &detect(&format!("{all} --overlays pictures"))).expect(2);
    let json = run.json();
    assert_eq!(json["skipped"].as_array().unwrap().len(), 1, "{json}");
    assert!(run.stderr.contains("skipped pictures/000007_000004.png"), "{}", run.stderr);
    assert!(json["detections"].as_u64().unwrap() > 0, "{json}");
    let found = json_of(&tiny.path().join("found.json"));
    assert_eq!(found.as_array().unwrap().len() as u64, json["detections"].as_u64().unwrap());

    let one = "--rgb tiny/test/000007/rgb/000004.png --threshold 0 --out one --json";
    std::fs::create_dir_all(tiny.path().join("one/overlay.png")).unwrap();
    fails(tiny.path(), &detect(one), &["one/overlay.png", "is there already"]);
    assert!(!tiny.path().join("one/detections.json").exists());
}

#[test]
fn weights_of_torchvision_are_a_detector() {
    let tiny = Tiny::coloured();
    let path = |name: &str| tiny.path().join(name);
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("../sixfold-detect/tests/anchored");
    for (from, to) in [("mask-rcnn.safetensors", "mask.safetensors"), ("faster-rcnn.pth", "faster.pth")] {
        std::fs::copy(fixtures.join(from), path(to)).unwrap();
    }
    // Miniature networks need small images.
    let sides = r#""min_side": 96, "max_side": 160, "norm_epsilon": 1e-5"#;
    std::fs::write(path("mask.objects.json"), format!(r#"{{"objects": {{"1": 1, "3": 30}}, {sides}}}"#))
        .unwrap();
    std::fs::write(path("faster.objects.json"), format!("{{{sides}}}")).unwrap();
    let rgb = "--rgb tiny/test/000007/rgb/000004.png --threshold 0.05";

    let run = sixfold(tiny.path(), &format!("detect --weights mask.safetensors {rgb} --out one --json"));
    let found = run.expect(0).json()["detections"].as_array().unwrap().clone();
    assert!(found.iter().all(|d| d["object_id"] == 1 || d["object_id"] == 30), "{found:?}");
    assert!(found.iter().any(|d| d["mask_pixels"].as_u64() > Some(0)), "{found:?}");
    let coco = json_of(&path("one/detections.json"));
    assert_eq!((&coco[0]["bbox"], &coco[0]["category_id"]), (&found[0]["bbox"], &found[0]["object_id"]));
    assert_eq!(coco[0]["segmentation"]["size"], serde_json::json!([HEIGHT, WIDTH]));
    let run = sixfold(tiny.path(), &format!("detect --weights faster.pth {rgb} --ids 2 --json"));
    let found = run.expect(0).json()["detections"].as_array().unwrap().clone();
    assert!(found.iter().all(|d| d["object_id"] == 2 && d["mask_pixels"].is_null()), "{found:?}");
    fails(
        tiny.path(),
        &format!("detect --weights faster.pth {rgb} --ids 9"),
        &["--ids", "trained on objects 1, 2, 3"],
    );

    // A dataset, with other objects of the labels.
    let all = "detect --weights mask.safetensors --dataset tiny --out found.json --threshold 0.05 --json";
    assert_eq!(sixfold(tiny.path(), all).expect(0).json()["images"], 3);
    std::fs::write(path("mask.objects.json"), format!(r#"{{"objects": {{"2": 1}}, {sides}}}"#)).unwrap();
    sixfold(tiny.path(), all).expect(0);
    let found = json_of(&path("found.json")).as_array().unwrap().clone();
    assert!(!found.is_empty() && found.iter().all(|d| d["category_id"] == 1), "{found:?}");

    // Boxes for a pose.
    std::fs::write(path("targets.json"), r#"[{"scene_id": 7, "im_id": 4, "obj_id": 1, "inst_count": 1}]"#)
        .unwrap();
    let pose =
        "estimate --dataset tiny --targets targets.json --out poses.csv --detector mask.safetensors --json";
    let run = sixfold(tiny.path(), pose);
    assert!(run.code < 2, "{}", run.stderr);

    // An invalid file.
    std::fs::write(path("mask.objects.json"), r#"{"objects": {"9": 1}}"#).unwrap();
    fails(
        tiny.path(),
        &format!("detect --weights mask.safetensors {rgb}"),
        &["mask.objects.json", "label 9"],
    );
    std::fs::write(path("other.pth"), b"nothing").unwrap();
    fails(tiny.path(), &format!("detect --weights other.pth {rgb}"), &["other.pth", "PyTorch weight file"]);
    fails(tiny.path(), &format!("detect --weights none.pth {rgb}"), &["none.pth", "cannot be read"]);
}

#[test]
fn detectors_with_anchors_are_trained_and_used() {
    let tiny = Tiny::coloured();
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("../sixfold-detect/tests/anchored");
    let train =
        "train detector --dataset tiny --ids 1 --size 96 --batch 1 --frozen-stages 0 --longest-side 96";
    for network in ["faster-rcnn", "mask-rcnn", "retinanet-anchors"] {
        let start = format!("{network}.safetensors");
        std::fs::copy(fixtures.join(&start), tiny.path().join(&start)).unwrap();
        let of = format!("{train} --network {network} --out {network} --json");
        fails(tiny.path(), &format!("{of} --steps 2"), &["--encoder", "ResNet-50"]);
        let trained = sixfold(tiny.path(), &format!("{of} --encoder {start} --steps 2")).expect(0).json();
        assert!(trained["losses"]["boxes"].as_f64().is_some_and(f64::is_finite), "{trained}");
        let card = std::fs::read_to_string(tiny.path().join(network).join("model.md")).unwrap();
        assert!(card.contains(&format!("detect-{network}")) && card.contains("7/0 7/4 7/11"), "{card}");
        let rgb = "--rgb tiny/test/000007/rgb/000004.png --threshold 0.0001";
        let run = sixfold(tiny.path(), &format!("detect --weights {network}/model.safetensors {rgb} --json"));
        let found = run.expect(0).json()["detections"].as_array().unwrap().clone();
        assert!(found.iter().all(|d| d["object_id"] == 1), "{found:?}");
        assert!(network != "mask-rcnn" || found.iter().any(|d| d["mask_pixels"].is_u64()), "{found:?}");
        // Continuing from its own weights.
        let further =
            of.replace("--out ", &format!("--init {network}/model.safetensors --steps 1 --out more-"));
        sixfold(tiny.path(), &further).expect(0);
        let other = further.replace(&format!("--network {network}"), "--network compact");
        fails(tiny.path(), &other.replace("--out more-", "--out other-"), &["architecture"]);
    }
    let wrong =
        format!("{train} --network mask-rcnn --encoder faster-rcnn.safetensors --steps 1 --out wrong");
    fails(tiny.path(), &wrong, &["--encoder", "weights of another network"]);
}

#[test]
fn detectors_with_anchors_are_trained_on_lite0() {
    let tiny = Tiny::coloured();
    let train = "train detector --dataset tiny --ids 1 --size 96 --batch 1 --longest-side 96 --json";
    for network in ["faster-rcnn", "mask-rcnn", "retinanet-anchors"] {
        let of = format!("{train} --network {network} --backbone lite0 --out {network}");
        let trained = sixfold(tiny.path(), &format!("{of} --steps 2")).expect(0).json();
        assert!(trained["losses"]["boxes"].as_f64().is_some_and(f64::is_finite), "{trained}");
        let card = std::fs::read_to_string(tiny.path().join(network).join("model.md")).unwrap();
        assert!(card.contains(&format!("detect-{network}")) && card.contains("\"lite0\""), "{card}");
        let rgb = "--rgb tiny/test/000007/rgb/000004.png --threshold 0.0001";
        let run = sixfold(tiny.path(), &format!("detect --weights {network}/model.safetensors {rgb} --json"));
        assert!(run.expect(0).json()["detections"].as_array().is_some_and(|found| !found.is_empty()));
        let other = format!("{train} --network {network} --steps 1 --init {network}/model.safetensors");
        fails(
            tiny.path(),
            &format!("{other} --backbone resnet50 --out other"),
            &["--backbone", "resnet50 for weights on lite0"],
        );
        sixfold(tiny.path(), &format!("{other} --out more-{network}")).expect(0);
        fails(tiny.path(), &format!("{of} --steps 2 --encoder a.pth"), &["--encoder", "lite0"]);
    }
    fails(
        tiny.path(),
        &format!("{train} --network compact --backbone resnet50 --out no"),
        &["--backbone", "resnet50 with network compact"],
    );
}

#[test]
fn objects_are_detected_by_their_views() {
    let tiny = Tiny::coloured();
    let views = |rest: &str| format!("detect --method views {rest} --cache kept");
    // The whole dataset: its models are the objects.
    let all = views("--dataset tiny --out found.json --overlays pictures --json");
    let run = sixfold(tiny.path(), &all).expect(0).json();
    assert_eq!(run["images"], 3);
    let scores = sixfold(tiny.path(), "eval --dataset tiny --detections found.json --json").expect(0).json();
    for kind in ["box", "mask"] {
        assert!(scores[kind]["ap50"].as_f64().unwrap() > 0.5, "{kind}: {scores}");
    }
    assert!(image::open(tiny.path().join("pictures/000007_000004.png")).is_ok());

    // One image without its camera: the object has a name, and the table shows it.
    let one =
        "--object tiny/models/obj_000001.ply --unit mm --rgb tiny/test/000007/rgb/000004.png --threshold 0";
    let run = sixfold(tiny.path(), &views(&format!("{one} --out one --json"))).expect(0);
    assert!(!run.stderr.contains("rendered again"), "{}", run.stderr);
    let found = &run.json()["detections"][0];
    assert_eq!((&found["object_id"], &found["object"]), (&1.into(), &"obj_000001".into()));
    assert!(found["mask_pixels"].as_u64().unwrap() > 0);
    assert!(image::open(tiny.path().join("one/overlay.png")).is_ok());
    let quick =
        sixfold(tiny.path(), &views(&format!("{one} --quick --no-masks --max-detections 2"))).expect(0);
    assert_eq!(quick.stdout.matches("obj_000001").count(), 2, "{}", quick.stdout);
    // No detection has this score.
    sixfold(tiny.path(), &views(&format!("{} --quick", one.replace("threshold 0", "threshold 1")))).expect(1);

    // A changed model is another run.
    let model = tiny.file("models/obj_000001.ply");
    let image = tiny.file("test/000007/rgb/000004.png");
    let before = std::fs::read(&image).unwrap();
    std::fs::write(&image, b"no image").unwrap();
    let part = views("--quick --dataset tiny --ids 1 --out part.json");
    sixfold(tiny.path(), &part).expect(2);
    std::fs::write(&image, before).unwrap();
    let text = std::fs::read(&model).unwrap();
    std::fs::write(&model, [b"ply\ncomment changed".as_slice(), &text[3..]].concat()).unwrap();
    fails(tiny.path(), &part, &["part.json.part", "object 1", "remove both"]);
}

#[test]
fn detection_by_views_says_what_is_missing() {
    let tiny = Tiny::coloured();
    let rgb = "--rgb tiny/test/000007/rgb/000004.png";
    let cases: [(&str, &[&str]); 7] = [
        ("detect --method views", &["--method views needs --object"]),
        ("detect --method views --weights a.safetensors", &["--weights is no option of --method views"]),
        ("detect --method views --scales 2", &["--scales is no option of --method views"]),
        ("detect --quick", &["--quick is no option of --method network"]),
        ("detect --object tiny/models/obj_000001.ply", &["--object is no option of --method network"]),
        ("detect --method views --object tiny/models/obj_000001.ply", &["--unit"]),
        ("detect --method views --object nowhere.ply --unit mm", &["nowhere.ply"]),
    ];
    let missing = "detect --method views --object nowhere.ply --unit mm --rgb missing.png";
    fails(tiny.path(), missing, &["missing.png"]);
    for (command, words) in cases {
        fails(tiny.path(), &format!("{command} {rgb}"), words);
    }
    let other = format!("detect --method views --object tiny/models/obj_000001.ply --unit mm --ids 2 {rgb}");
    fails(tiny.path(), &other, &["--ids", "found 2"]);
    fails(tiny.path(), "detect --method views --dataset tiny --ids 9 --out f.json", &["object 9"]);
    // Before anything is rendered, which would fail for object 9.
    fails(tiny.path(), "detect --method views --dataset tiny --ids 9 --out f.csv", &["f.csv", ".json"]);
    std::fs::remove_file(tiny.file("models/models_info.json")).unwrap();
    let words = ["models_info.json", "--ids"];
    fails(tiny.path(), "detect --method views --dataset tiny --out f.json", &words);
    let message = "detect --method views --object tiny/models/obj_000001.ply --unit mm --threshold 2";
    fails(tiny.path(), &format!("{message} {rgb}"), &["threshold", "found 2"]);
}
