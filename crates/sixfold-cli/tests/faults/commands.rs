//! The table: every command that writes, on the smallest inputs it accepts. Each row becomes five tests.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use sixfold_io::write_mask;
use sixfold_render::render_depth;

use crate::driver::{Row, copy, kept, reference, run};
use crate::support::{OneImage, Tiny, camera, part, sixfold, write_posed_photographs};

/// One image with depth, the object's mask and mesh.
fn image(folder: &Path) {
    static CASE: LazyLock<PathBuf> = LazyLock::new(|| {
        let case = OneImage::new();
        let alone = render_depth(&part(), &case.truth, &camera());
        write_mask(&case.path().join("mask.png"), &alone.map(|&z| z > 0.0)).unwrap();
        let folder = kept("image");
        copy(case.path(), &folder);
        folder
    });
    copy(&CASE, folder);
}

/// A dataset `tiny` of three images and two objects, ground truth as results and as targets of object 1.
fn dataset(folder: &Path) {
    static CASE: LazyLock<PathBuf> = LazyLock::new(|| {
        let tiny = Tiny::coloured();
        tiny.write_truth_as_results("truth.csv");
        let targets =
            [0, 4].map(|im| serde_json::json!({"scene_id": 7, "im_id": im, "obj_id": 1, "inst_count": 1}));
        fs::write(tiny.path().join("targets.json"), serde_json::json!(targets).to_string()).unwrap();
        let folder = kept("dataset");
        copy(tiny.path(), &folder);
        folder
    });
    copy(&CASE, folder);
}

/// The dataset with one target.
fn one_target(folder: &Path) {
    dataset(folder);
    fs::copy(folder.join("targets.json"), folder.join("tiny/test_targets_bop19.json")).unwrap();
}

/// A file that another row's command wrote.
fn of(row: &Row, file: &str) -> PathBuf {
    reference(row).folder().join(file)
}

/// The dataset with the networks made by the trainings of this table.
fn dataset_and_networks(folder: &Path) {
    dataset(folder);
    fs::copy(of(&train_pix2pose::ROW, "out/model.safetensors"), folder.join("pix2pose.safetensors")).unwrap();
    fs::copy(of(&train_detector::ROW, "out/model.safetensors"), folder.join("detector.safetensors")).unwrap();
}

/// The dataset with detections of all objects.
fn detections(folder: &Path) {
    dataset(folder);
    fs::copy(of(&detect_dataset::ROW, "found.json"), folder.join("found.json")).unwrap();
}

/// The image with a network for grasps, and a grasp.
fn grasp(folder: &Path) {
    image(folder);
    fs::copy(of(&train_dgcm::ROW, "out/model.safetensors"), folder.join("w.safetensors")).unwrap();
    fs::copy(of(&grasp_propose::ROW, "out/grasps.json"), folder.join("grasps.json")).unwrap();
}

/// Stores of experiences, `a.db` with two and `b.db` with one more.
fn stores(folder: &Path) {
    static CASE: LazyLock<PathBuf> = LazyLock::new(|| {
        let folder = kept("stores");
        grasp(&folder);
        for (file, number) in [("a.db", 1), ("a.db", 2), ("b.db", 3)] {
            let add = grasp_store_add::ROW.arguments.replace("a.db", file);
            sixfold(&folder, &format!("{add} --number {number}")).expect(0);
        }
        folder
    });
    copy(&CASE, folder);
}

/// An object that was taught from the images of the dataset.
fn taught(folder: &Path) {
    static CASE: LazyLock<PathBuf> = LazyLock::new(|| {
        let tiny = Tiny::coloured();
        write_posed_photographs(&tiny);
        sixfold(tiny.path(), "teach part --photographs photographs.json --hull-only").expect(0);
        let folder = kept("taught");
        copy(&tiny.path().join("sixfold-objects"), &folder.join("sixfold-objects"));
        folder
    });
    copy(&CASE, folder);
}

/// The image, and an object that is stored already.
fn object(folder: &Path) {
    image(folder);
    run(&Row { arguments: "object add part part.ply --unit cm", ..object_add::ROW }, folder).expect(0);
}

rows! {
    estimate_image: image, ["out", "poses.json"], None,
        "estimate --depth depth.png --rgb rgb.png --camera camera.json --object part.ply --unit mm --out out --json poses.json";
    estimate_image_by_templates: image, ["out"], None,
        "estimate --method mttm --matcher points --depth depth.png --camera camera.json --object part.ply --unit mm --out out";
    estimate_image_by_colour: dataset_and_networks, ["out"], None,
        "estimate --method pix2pose --weights pix2pose.safetensors --rgb tiny/test/000007/rgb/000004.png --camera tiny/camera.json \
         --object tiny/models/obj_000001.ply --unit mm --box 60,60,120,120 --out out";
    estimate_dataset: dataset, ["results.csv", "pictures", "run.json"], None,
        "estimate --dataset tiny --targets targets.json --out results.csv --overlays pictures";
    estimate_dataset_by_templates: dataset, ["results.csv"], None,
        "estimate --method mttm --matcher points --dataset tiny --targets targets.json --out results.csv";
    estimate_dataset_by_colour: dataset_and_networks, ["results.csv"], None,
        "estimate --method pix2pose --weights pix2pose.safetensors --dataset tiny --targets targets.json --boxes gt --out results.csv";
    estimate_dataset_by_views: dataset, ["results.csv"], None,
        "estimate --method views --dataset tiny --targets targets.json --boxes gt --out results.csv";
    estimate_dataset_by_views_alone: dataset, ["results.csv"], None,
        "estimate --method views --dataset tiny --targets targets.json --out results.csv";
    detect_image: dataset_and_networks, ["out"], None,
        "detect --weights detector.safetensors --rgb tiny/test/000007/rgb/000004.png --threshold 0 --per-object 2 --out out";
    detect_dataset: dataset_and_networks, ["found.json", "pictures"], None,
        "detect --weights detector.safetensors --dataset tiny --threshold 0 --per-object 2 --out found.json --overlays pictures";
    train_pix2pose: dataset, ["out"], None,
        "train pix2pose --dataset tiny --ids 1 --size 64 --per-object 4 --rotation 0 --render-fraction 0 --steps 3 --out out";
    train_detector: dataset, ["out"], None,
        "train detector --dataset tiny --ids 1 --size 96 --batch 2 --steps 3 --out out";
    train_views: dataset, ["out"], None, "train views --steps 3 --batch 1 --out out";
    train_refiner: dataset, ["out"], None, "train refiner --steps 3 --batch 1 --out out";
    train_proposals: dataset, ["out"], None, "train proposals --steps 3 --batch 2 --objects 6 --size 96 --out out";
    train_nol: dataset, ["out"], None, "train nol --steps 2 --out out";
    train_mttm: dataset, ["out"], None, "train mttm --steps 2 --objects 16 --scenes 4 --anchors 4 --out out";
    train_dgcm: dataset, ["out"], None, "train dgcm --views 64 --steps 3 --pairs 2 --out out";
    simulate_depth: dataset, ["out"], Some((2, "exists already")),
        "simulate-depth --dataset tiny --rgb --pictures out/pictures --out out";
    simulate_scenes: image, ["out"], None,
        "simulate-scenes --families can,box --toys 1 --object part.ply --unit mm --scenes 2 --views 2 --objects-per-scene 2,3 \
         --camera camera.json --out out";
    synthesize: dataset, ["out"], None,
        "synthesize --dataset tiny --ids 1 --step 90 --elevation 30,30 --size 48 --weighting average --with-photographs --out out";
    teach_train: taught, ["out", "sixfold-objects"], None, "teach part --train --train-steps 2 --view-step 90 --out out";
    object_add: image, ["sixfold-objects"], Some((2, "--replace")),
        "object add part part.ply --unit mm --templates";
    object_add_views: image, ["sixfold-objects"], Some((2, "--replace")),
        "object add seen --depth depth.png --mask mask.png --camera camera.json";
    object_replace: object, ["sixfold-objects"], None,
        "object add part part.ply --unit mm --symmetric-about z --templates --replace";
    object_remove: object, ["sixfold-objects", "part"], Some((2, "none yet")), "object remove part";
    object_show: object, ["part.png"], None, "object show part --picture part.png";
    grasp_propose: image, ["out"], None,
        "grasp propose --depth depth.png --camera camera.json --mask mask.png --out out";
    grasp_learn: grasp, ["learn", "e.db"], None,
        "grasp learn --experiences e.db --object part.ply --unit mm --attempts 2 --tries 2 --explore 1 --near 9 --weights w.safetensors --out learn";
    grasp_store_add: grasp, ["a.db"], None,
        "grasp store add a.db --depth depth.png --camera camera.json --mask mask.png --grasp grasps.json --object part \
         --weights w.safetensors";
    grasp_store_show: stores, ["shown.png"], None, "grasp store show a.db 1 --picture shown.png";
    grasp_store_merge: stores, ["a.db"], Some((1, "0 experiences taken over")), "grasp store merge a.db b.db";
    grasp_store_export: stores, ["files"], None, "grasp store export a.db --out files";
    grasp_store_refresh: stores, ["c.db"], None, "grasp store refresh a.db --out c.db --weights w.safetensors";
    grasp_store_forget: stores, ["a.db"], Some((1, "0 experiences forgotten")), "grasp store forget a.db 1";
    eval_poses: dataset, ["scores.json", "curves.png"], None,
        "eval --dataset tiny --results truth.csv --curves curves.png --json scores.json";
    eval_detections: detections, ["scores.json", "coco.json"], None,
        "eval --dataset tiny --detections found.json --write-truth coco.json --json scores.json";
    render: image, ["out"], None, "render --object part.ply --unit mm --camera camera.json --out out";
    demo: one_target, ["out", "demo.json"], None, "demo --data tiny --out out --json demo.json";
}

/// Killed between its last checkpoint and the figure of its curves, a training only has to make the figure.
#[test]
fn a_training_without_its_curves_gets_them() {
    let folder = tempfile::tempdir().unwrap();
    copy(reference(&train_dgcm::ROW).folder(), folder.path());
    let curves = folder.path().join("out/training/curves.png");
    fs::remove_file(&curves).unwrap();
    run(&train_dgcm::ROW, folder.path()).expect(0);
    assert!(image::open(curves).is_ok());
}
