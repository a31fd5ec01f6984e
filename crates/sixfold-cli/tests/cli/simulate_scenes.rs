//! `sixfold simulate-scenes`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use sixfold_bop::{BopDataset, Estimate, MaskKind, Models, write_results};

use crate::support::*;

/// Two scenes of two small images with synthetic objects.
const SMALL: &str = "simulate-scenes --families can,box --toys 2 --scenes 2 --views 2 --objects-per-scene 3,5 --camera camera.json";

/// All files below a folder except its overview images.
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
fn photographs_are_shown_wherever_no_object_is() {
    let one = OneImage::new();
    let dir = one.path();
    std::fs::create_dir(dir.join("photographs")).unwrap();
    // Of one colour, so that every crop is known.
    let green = sixfold_geometry::RgbImage::from_fn(60, 40, |_, _| [10, 200, 30]);
    sixfold_io::write_rgb(&dir.join("photographs/green.png"), &green).unwrap();
    let made = |options: &str| {
        sixfold(dir, &format!("{SMALL} {options}")).expect(0);
        let name = options.split_whitespace().last().unwrap();
        BopDataset::open(&dir.join(name), "test").unwrap()
    };
    let [plain, green] = [made("--out plain"), made("--backgrounds photographs --out green")];
    let mut behind = 0;
    for scene_id in [0, 1] {
        let (plain, green) = (plain.scene(scene_id).unwrap(), green.scene(scene_id).unwrap());
        for im_id in [0, 1] {
            let objects = plain.image(im_id).unwrap().ground_truth.len();
            let mask = |i| plain.mask(im_id, i, MaskKind::Visible).unwrap().unwrap();
            let masks: Vec<sixfold_geometry::Mask> = (0..objects).map(mask).collect();
            let (before, after) = (plain.rgb(im_id).unwrap().unwrap(), green.rgb(im_id).unwrap().unwrap());
            for (i, (before, after)) in before.as_slice().iter().zip(after.as_slice()).enumerate() {
                let object = masks.iter().any(|mask| mask.as_slice()[i]);
                behind += usize::from(!object);
                assert_eq!(*after, if object { *before } else { [10, 200, 30] });
            }
            assert_eq!(plain.depth(im_id).unwrap(), green.depth(im_id).unwrap());
        }
    }
    assert!(behind > 1000);
    // Other photographs are another data set; without any there is an error.
    std::fs::create_dir(dir.join("none")).unwrap();
    let error = sixfold(dir, &format!("{SMALL} --backgrounds none --out none-out")).expect(2).stderr;
    assert!(error.contains("none"), "{error}");
    sixfold(dir, &format!("{SMALL} --backgrounds photographs --no-rgb --out other")).expect(2);
}

#[test]
fn scenes_are_a_dataset_of_their_own() {
    let one = OneImage::new();
    let dir = one.path();
    let json =
        sixfold(dir, &format!("{SMALL} --object part.ply --unit mm --out new --json")).expect(0).json();
    assert_eq!((&json["objects"], &json["scenes"], &json["images"]), (&5.into(), &2.into(), &4.into()));
    let shown = json["mean_visible"].as_f64().unwrap();
    assert!((0.4..=1.0).contains(&shown), "{json}");

    let dataset = BopDataset::open(&dir.join("new"), "test").unwrap();
    let infos = dataset.models_info(Models::Evaluation).unwrap().unwrap();
    // The part from the file, a can, a box, two toys.
    assert_eq!(infos.0.len(), 5);
    assert!(infos.0[&2].is_symmetric() && infos.0[&3].is_symmetric() && !infos.0[&4].is_symmetric());
    let mut truth = vec![];
    for scene_id in [0, 1] {
        let scene = dataset.scene(scene_id).unwrap();
        let mut depths = vec![];
        for im_id in [0, 1] {
            let image = scene.image(im_id).unwrap();
            let objects = image.ground_truth.len();
            assert!((1..=5).contains(&objects));
            let world = image.camera.camera_from_world.unwrap().inverse();
            assert!(world.translation().z > 0.15, "{:?}", world.translation());
            let info = image.info.as_ref().unwrap();
            for (index, (g, info)) in image.ground_truth.iter().zip(info).enumerate() {
                assert!((0.0..=1.0).contains(&info.visib_fract));
                let whole = scene.mask(im_id, index, MaskKind::Full).unwrap().unwrap();
                let visible = scene.mask(im_id, index, MaskKind::Visible).unwrap().unwrap();
                let pixels = |m: &sixfold_geometry::Mask| m.as_slice().iter().filter(|v| **v).count() as u64;
                assert_eq!(pixels(&visible), info.px_count_visib.unwrap());
                assert!(pixels(&whole) >= pixels(&visible));
                // On the table, not under it.
                let mesh = dataset.model(g.obj_id, Models::Rendering).unwrap();
                let pose = world * g.camera_from_object;
                let lowest =
                    mesh.vertices().iter().map(|v| pose.transform_point(v).z).fold(f64::INFINITY, f64::min);
                assert!(lowest > -0.004, "{scene_id} {im_id} {index}: {lowest}");
                truth.push(Estimate::new(scene_id, im_id, g.obj_id, 0.9, g.camera_from_object));
            }
            let depth = scene.depth(im_id).unwrap().unwrap();
            assert!(depth.as_slice().iter().filter(|z| **z > 0.0).count() > WIDTH * HEIGHT / 4);
            assert!(scene.rgb(im_id).unwrap().is_some());
            depths.push(depth);
        }
        assert_ne!(depths[0], depths[1]);
    }
    write_results(&dir.join("truth.csv"), &truth).unwrap();
    let score = sixfold(dir, "eval --dataset new --results truth.csv --no-vsd --json").expect(0).json();
    assert!(score["ar_mssd"].as_f64().unwrap() > 0.999, "{score}");
    assert!(image::open(dir.join("new/preview.png")).is_ok());

    // `estimate` accepts its camera file.
    let found = sixfold(
        dir,
        "estimate --depth new/test/000000/depth/000000.png --camera new/camera.json --object part.ply --unit mm",
    );
    assert!([0, 1].contains(&found.code), "{found:?}");

    // An unfinished scene is made again with the same bytes, on one thread or many.
    let before = files(&dir.join("new"));
    std::fs::remove_file(dir.join("new/test/000001/scene_gt_info.json")).unwrap();
    std::fs::remove_file(dir.join("new/test/000001/depth/000001.png")).unwrap();
    let again = format!("{SMALL} --object part.ply --unit mm --out new --threads 1 --json");
    assert_eq!(sixfold(dir, &again).expect(0).json()["new_scenes"], 1);
    assert!(before == files(&dir.join("new")));
    let other = format!("{SMALL} --object part.ply --unit mm --out new --seed 4");
    fails(dir, &other, &["another seed", "--out"]);
}

#[test]
fn models_of_a_dataset_keep_their_ids() {
    let tiny = Tiny::new(false);
    let run = "simulate-scenes --dataset tiny --ids 2 --scenes 1 --views 1 --objects-per-scene 3,3 --camera tiny/camera.json --sensor none --no-rgb --no-masks --out new --json";
    sixfold(tiny.path(), run).expect(0);
    let dataset = BopDataset::open(&tiny.path().join("new"), "test").unwrap();
    let image = dataset.scene(0).unwrap();
    let image = image.image(0).unwrap();
    assert!(!image.ground_truth.is_empty() && image.ground_truth.iter().all(|g| g.obj_id == 2));
    assert!(!tiny.path().join("new/preview.png").exists());
    assert!(!tiny.path().join("new/test/000000/mask").exists());
    fails(tiny.path(), "simulate-scenes --dataset tiny --ids 7 --out other", &["--ids", "found 7", "1, 2"]);
    // Another dataset is not overwritten.
    fails(tiny.path(), "simulate-scenes --dataset tiny --out tiny", &["tiny", "another dataset", "--out"]);
}

#[test]
fn bad_options_say_so() {
    let dir = tempfile::tempdir().unwrap();
    let bad = |arguments: &str, words: &[&str]| {
        fails(dir.path(), &format!("simulate-scenes --out new {arguments}"), words);
        assert!(!dir.path().join("new").exists(), "{arguments}");
    };
    bad("", &["no objects", "--toys"]);
    bad("--toys 1 --elevation 30,95", &["--elevation", "30,95", "1 to 90"]);
    bad("--toys 1 --elevation 60,30", &["--elevation", "lower one first"]);
    bad("--toys 1 --distance 0.5", &["--distance", "1 numbers", "two"]);
    bad("--toys 1 --objects-per-scene 0,3", &["--objects-per-scene", "0,3"]);
    bad("--toys 1 --upright 1.5", &["upright", "1.5"]);
    bad("--toys 1 --split ../test", &["--split", "letters"]);
    bad("--toys 1 --scenes 0", &["--scenes", "found 0"]);
    bad("--families can,teapot", &["--families", "teapot", "bottle"]);
    bad("--object gone.ply", &["gone.ply", "--unit"]);
    bad("--dataset gone", &["gone", "models_info.json"]);
    bad("--toys 1 --camera gone.json", &["gone.json"]);
}
