//! `sixfold synthesize`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use sixfold_bop::BopDataset;
use sixfold_geometry::Mask;
use sixfold_io::{read_mask, read_rgb, write_depth, write_mask};
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

use crate::support::*;

/// A few views of both objects of the tiny dataset.
fn few(out: &str) -> String {
    format!("synthesize --dataset tiny --step 60 --elevation 30,30 --size 96 --weighting average --out {out}")
}

/// All files below a folder.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut open = vec![folder.to_path_buf()];
    while let Some(dir) = open.pop() {
        for entry in std::fs::read_dir(&dir).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                all.insert(path.strip_prefix(folder).unwrap().to_path_buf(), std::fs::read(&path).unwrap());
            }
        }
    }
    all
}

#[test]
fn a_training_set_of_new_views() {
    let tiny = Tiny::coloured();
    let run = sixfold(tiny.path(), &format!("{} --with-photographs --json", few("new"))).expect(0);
    let json = run.json();
    assert_eq!(json["objects"].as_array().unwrap().len(), 2);
    for object in json["objects"].as_array().unwrap() {
        assert_eq!((&object["photographs"], &object["images"]), (&3.into(), &9.into()), "{object}");
        let unseen = object["surface_unseen"].as_f64().unwrap();
        assert!((0.05..0.8).contains(&unseen), "{unseen}");
    }
    let dataset = BopDataset::open(&tiny.path().join("new"), "train_nol").unwrap();
    let scene = dataset.scene(1).unwrap();
    let image = scene.rgb(2).unwrap().unwrap();
    assert_eq!(image.size(), (96, 96));
    // The part has one colour: its visible pixels have that colour, in light and shadow.
    let mask = read_mask(&tiny.path().join("new/train_nol/000001/mask_visib/000002_000000.png")).unwrap();
    let photograph = read_rgb(&tiny.path().join("new/train_nol/000001/rgb/000006.png")).unwrap();
    let photographed =
        read_mask(&tiny.path().join("new/train_nol/000001/mask_visib/000006_000000.png")).unwrap();
    let mean = |image: &sixfold_geometry::RgbImage, mask: &Mask| -> [f64; 3] {
        let inside = image.as_slice().iter().zip(mask.as_slice()).filter(|(_, m)| **m);
        let count = inside.clone().count() as f64;
        assert!(count > 300.0);
        std::array::from_fn(|c| inside.clone().map(|(p, _)| f64::from(p[c])).sum::<f64>() / count)
    };
    let (new, old) = (mean(&image, &mask), mean(&photograph, &photographed));
    assert!((0..3).all(|c| (new[c] - old[c]).abs() < 40.0), "{new:?} {old:?}");
    assert!(image::open(tiny.path().join("new/preview.png")).is_ok());
    assert!(image::open(tiny.path().join("new/poses.png")).is_ok());
    let coordinates = image::open(tiny.path().join("new/train_nol/000001/coordinates/000002.png")).unwrap();
    let coordinates = coordinates.as_rgb16().unwrap();
    let covered = coordinates.pixels().filter(|p| p.0 != [0; 3]).count();
    assert_eq!(covered, mask.as_slice().iter().filter(|v| **v).count());

    // Deleted files are made again with the same bytes, on one thread or many.
    let before = files(&tiny.path().join("new"));
    for lost in ["coordinates/000001.png", "coordinates/000004.png", "rgb/000004.png"] {
        std::fs::remove_file(tiny.path().join("new/train_nol/000002").join(lost)).unwrap();
    }
    sixfold(tiny.path(), &format!("{} --with-photographs --threads 1", few("new"))).expect(0);
    let after = files(&tiny.path().join("new"));
    let differing: Vec<&PathBuf> = before.keys().filter(|k| before.get(*k) != after.get(*k)).collect();
    assert!(differing.is_empty() && before.len() == after.len(), "{differing:?}");
    fails(tiny.path(), &format!("{} --seed 4 --with-photographs", few("new")), &["another seed", "--out"]);

    // A training can use it directly.
    let train = "train pix2pose --dataset new --split train_nol --render-fraction 0 --size 64 --steps 2 --out trained --json";
    let trained = sixfold(tiny.path(), train).expect(0).json();
    assert_eq!(trained["photographs"], 18);
}

#[test]
fn the_camera_file_is_one_that_estimate_takes() {
    let tiny = Tiny::coloured();
    let dir = tiny.path();
    sixfold(dir, &few("new")).expect(0);
    let dataset = BopDataset::open(&dir.join("new"), "train_nol").unwrap();
    let scene = dataset.scene(1).unwrap();
    let first = scene.image_ids()[0];
    let file = sixfold_io::CameraFile::read(&dir.join("new/camera.json")).unwrap();
    let (written, of_image) = (file.camera, scene.camera(first).unwrap());
    assert!(file.sized && written == of_image, "{written:?} {of_image:?}");
    // The view of that camera at the first image's pose; the part's own sides are the only planes.
    let pose = scene.image(first).unwrap().ground_truth[0].camera_from_object;
    let part = part();
    let part = SceneObject { mesh: &part, camera_from_object: pose };
    let mut frame = VisibilityBuffer::new(&written);
    frame.render(&[part], &RenderOptions::default());
    write_depth(&dir.join("depth.png"), &frame.depth(), 1e-4).unwrap();
    let found = sixfold(
        dir,
        "estimate --depth depth.png --depth-scale 0.1 --camera new/camera.json --object tiny/models/obj_000001.ply --unit mm --keep-plane --json",
    );
    let poses = found.expect(0).json();
    assert_near(&pose_of(&poses["poses"][0]["camera_from_object"]), &pose);
}

#[test]
fn disturbed_poses_come_back() {
    let tiny = Tiny::coloured();
    let run = format!("{} --ids 1 --disturb 6,2 --json", few("new"));
    sixfold(tiny.path(), &run).expect(0);
    let poses: Value =
        serde_json::from_slice(&std::fs::read(tiny.path().join("new/poses.json")).unwrap()).unwrap();
    let list = poses["photographs"].as_array().unwrap();
    assert_eq!(list.len(), 3);
    let (mut before, mut after) = (vec![], vec![]);
    for entry in list {
        let given = pose_of(&entry["given"]);
        let truth = tiny.truth_of(entry["frame"][1].as_u64().unwrap() as u32, 1);
        assert!(given.distance_to(&truth) > 1e-4);
        assert!(pose_of(&entry["undisturbed"]).distance_to(&truth) < 1e-6);
        assert!(entry["moved_mm"].as_f64().unwrap() > 0.0);
        // Perpendicular to the optical axis, where an image is most informative.
        let across = |pose: &sixfold_geometry::Pose| {
            let off = pose.translation() - truth.translation();
            off.x.hypot(off.y)
        };
        before.push(across(&given));
        after.push(across(&pose_of(&entry["camera_from_object"])));
    }
    let mean = |all: &[f64]| all.iter().sum::<f64>() / all.len() as f64;
    println!("{before:.5?} {after:.5?}");
    assert!(mean(&after) < 0.5 * mean(&before), "{before:.5?} {after:.5?}");
    let same = sixfold(tiny.path(), &format!("{} --ids 1 --no-refine --json", few("as-they-are"))).expect(0);
    assert_eq!(same.json()["refined"], false);
}

/// A file of photographs of object 1.
fn photographs(tiny: &Tiny, change: impl Fn(usize, &mut Value)) -> String {
    let entries: Vec<Value> = [0, 4, 11]
        .into_iter()
        .enumerate()
        .map(|(k, im_id)| {
            let pose = tiny.truth_of(im_id, 1);
            let r = pose.rotation_matrix();
            let rows: Vec<f64> = (0..3).flat_map(|i| (0..3).map(move |j| (i, j))).map(|at| r[at]).collect();
            let t = pose.translation() * 1000.0;
            let mut entry = json!({
                "image": format!("tiny/test/000007/rgb/{im_id:06}.png"), "camera": "tiny/camera.json",
                "cam_R_m2c": rows, "cam_t_m2c": [t.x, t.y, t.z],
            });
            change(k, &mut entry);
            entry
        })
        .collect();
    let file = json!({ "mesh": "tiny/models/obj_000001.ply", "unit": "mm", "photographs": entries });
    std::fs::write(tiny.path().join("photographs.json"), file.to_string()).unwrap();
    "synthesize --photographs photographs.json --step 90 --elevation 30,30 --size 64 --weighting best"
        .to_owned()
}

#[test]
fn photographs_of_a_file_and_their_errors() {
    let tiny = Tiny::coloured();
    let run = photographs(&tiny, |_, _| ());
    let json = sixfold(tiny.path(), &format!("{run} --out a --json")).expect(0).json();
    assert_eq!((&json["objects"][0]["photographs"], &json["objects"][0]["images"]), (&3.into(), &4.into()));

    // One photograph: most of the object is unseen, and this is reported.
    let file: Value =
        serde_json::from_slice(&std::fs::read(tiny.path().join("photographs.json")).unwrap()).unwrap();
    let mut one = file.clone();
    one["photographs"].as_array_mut().unwrap().truncate(1);
    std::fs::write(tiny.path().join("one.json"), one.to_string()).unwrap();
    let single = run.replace("photographs.json", "one.json");
    let json = sixfold(tiny.path(), &format!("{single} --out one --json")).expect(0).json();
    assert!(json["objects"][0]["surface_unseen"].as_f64().unwrap() > 0.3, "{json}");
    assert!(json["objects"][0]["pixels_unseen"].as_f64().unwrap() > 0.1, "{json}");

    // An empty mask leaves its photograph out, with a message; the others are used.
    write_mask(&tiny.path().join("empty.png"), &Mask::filled(WIDTH, HEIGHT, false)).unwrap();
    let run = photographs(&tiny, |k, entry| {
        if k == 1 {
            entry["mask"] = "empty.png".into();
        }
    });
    let masked = sixfold(tiny.path(), &format!("{run} --out masked --json")).expect(0);
    assert!(masked.stderr.contains("the mask covers 0 %"), "{}", masked.stderr);
    assert_eq!(masked.json()["objects"][0]["photographs"], 2);

    // A mask of another size, a pose outside the image, a camera of another image, missing fields.
    write_mask(&tiny.path().join("small.png"), &Mask::filled(32, 24, true)).unwrap();
    let run = photographs(&tiny, |_, entry| entry["mask"] = "small.png".into());
    fails(tiny.path(), &format!("{run} --out b"), &["mask is 32x24", "320x240"]);
    let run = photographs(&tiny, |_, entry| entry["cam_t_m2c"] = json!([0.0, 0.0, -0.6]));
    fails(tiny.path(), &format!("{run} --out b"), &["outside the image", "millimetres"]);
    let run = photographs(&tiny, |_, entry| entry["cam_R_m2c"] = json!([0, 0, 0, 0, 0, 0, 0, 0, 0]));
    fails(tiny.path(), &format!("{run} --out b"), &["cam_R_m2c"]);
    let run = photographs(&tiny, |_, entry| entry["camera"] = "nowhere.json".into());
    fails(tiny.path(), &format!("{run} --out b"), &["nowhere.json"]);
    std::fs::write(tiny.path().join("photographs.json"), "{\"mesh\": \"a.ply\"}").unwrap();
    fails(tiny.path(), &format!("{run} --out b"), &["photographs.json", "expected"]);
    for (option, words) in [
        ("--step 0", ["--step", "1 to 90"]),
        ("--elevation 50,20", ["--elevation", "lower one first"]),
        ("--elevation 50", ["--elevation", "two numbers"]),
        ("--size 4", ["--size", "32 to 1024"]),
        ("--weights a.safetensors", ["--weights", "--weighting network"]),
    ] {
        let run = "synthesize --dataset tiny --weighting best --out c".to_owned();
        fails(tiny.path(), &format!("{run} {option}"), &words);
    }
}
