//! Commands do not replace files of others, and the files in a folder belong together.

use std::path::Path;

use sixfold_io::WriteLock;
#[cfg(feature = "physics")]
use sixfold_mesh::{PlyFormat, Unit, write_ply};

use crate::support::*;

#[cfg(feature = "physics")]
const SCENES: &str = "simulate-scenes --object part.ply --unit mm --scenes 2 --views 1 --objects-per-scene 1,2 --camera \
    camera.json --no-rgb --no-masks --out new";

fn read(dir: &Path, name: &str) -> Vec<u8> {
    std::fs::read(dir.join(name)).unwrap()
}

/// Once, images stayed while models were replaced by those of the changed mesh, and all ground truth was wrong.
#[test]
#[cfg(feature = "physics")]
fn simulate_scenes_does_not_resume_with_a_changed_mesh_at_the_same_path() {
    let one = OneImage::new();
    let dir = one.path();
    sixfold(dir, SCENES).expect(0);
    let mesh = read(dir, "part.ply");
    let models = || [read(dir, "new/models/obj_000001.ply"), read(dir, "new/models/models_info.json")];
    let before = models();
    write_ply(dir.join("part.ply"), &other_part(), Unit::Millimetre, PlyFormat::BinaryLittleEndian).unwrap();
    std::fs::remove_file(dir.join("new/test/000001/scene_gt_info.json")).unwrap();
    fails(dir, SCENES, &["options.json", "other contents of object 1", "--out"]);
    assert!(models() == before);
    // The same with another camera, and with a model that was changed.
    std::fs::write(dir.join("part.ply"), mesh).unwrap();
    let camera = std::fs::read_to_string(dir.join("camera.json")).unwrap();
    replace(&dir.join("camera.json"), "300.0", "310.0");
    fails(dir, SCENES, &["other contents of camera"]);
    std::fs::write(dir.join("camera.json"), camera).unwrap();
    truncate(&dir.join("new/models/obj_000001.ply"), 0.9);
    fails(dir, SCENES, &["obj_000001.ply", "changed"]);
    std::fs::write(dir.join("new/models/obj_000001.ply"), &before[0]).unwrap();
    // With its original inputs it is resumed.
    assert_eq!(sixfold(dir, &format!("{SCENES} --json")).expect(0).json()["new_scenes"], 1);
    assert!(models() == before);
}

/// `--dataset own --out own` once reduced models_info.json from 8 objects to 1.
#[test]
#[cfg(feature = "networks")]
fn synthesize_does_not_write_over_its_input_or_another_dataset() {
    let tiny = Tiny::coloured();
    let dir = tiny.path();
    let before = read(dir, "tiny/models/models_info.json");
    let run = "synthesize --dataset tiny --ids 1 --step 90 --elevation 30,30 --size 48 --weighting average";
    fails(dir, &format!("{run} --out tiny"), &["--out tiny", "is the input"]);
    fails(dir, &format!("{run} --out other/../tiny/"), &["is the input tiny"]);
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(dir.join("tiny"), dir.join("link")).unwrap();
        fails(dir, &format!("{run} --out link"), &["--out link", "is the input tiny"]);
    }
    std::fs::create_dir_all(dir.join("there/models")).unwrap();
    std::fs::write(dir.join("there/models/models_info.json"), "{}").unwrap();
    fails(dir, &format!("{run} --out there"), &["--out there", "another dataset", "models"]);
    assert_eq!(read(dir, "there/models/models_info.json"), b"{}");
    assert_eq!(read(dir, "tiny/models/models_info.json"), before);

    // Its own folder is resumed, but not if a photograph was replaced at the same path.
    sixfold(dir, &format!("{run} --out new")).expect(0);
    sixfold(dir, &format!("{run} --out new")).expect(0);
    let images = tiny.file("test/000007/rgb");
    std::fs::copy(images.join("000004.png"), images.join("000011.png")).unwrap();
    fails(dir, &format!("{run} --out new"), &["options.json", "other contents of photographs"]);
}

#[test]
fn the_second_of_two_at_once_is_refused_at_once() {
    let tiny = Tiny::coloured();
    let dir = tiny.path();
    let _lock = WriteLock::take(&dir.canonicalize().unwrap().join("new")).unwrap();
    let mut runs = vec!["simulate-depth --dataset tiny --out new"];
    #[cfg(feature = "networks")]
    runs.push("synthesize --dataset tiny --weighting average --out new");
    #[cfg(feature = "physics")]
    runs.push("simulate-scenes --toys 1 --out new");
    for run in runs {
        fails(dir, run, &["new", "another process", "is writing"]);
    }
    assert!(!dir.join("new").exists());
}

/// `render --out .` once replaced a user's depth image.
#[test]
fn images_of_the_user_are_not_replaced() {
    let one = OneImage::new();
    let dir = one.path();
    let before = ["depth.png", "rgb.png"].map(|name| read(dir, name));
    let render = "render --object part.ply --unit mm --out";
    fails(dir, &format!("{render} ."), &["depth.png", "not written by this program"]);
    assert!(["depth.png", "rgb.png"].map(|name| read(dir, name)) == before && !dir.join("mask.png").exists());
    // Its own images are replaced.
    for _ in 0..2 {
        sixfold(dir, &format!("{render} out")).expect(0);
    }
    std::fs::write(dir.join("overlay.png"), "mine").unwrap();
    fails(dir, &format!("{} --out .", OneImage::ARGUMENTS), &["overlay.png", "not written by this program"]);
    let depth = "--depth depth.png --camera camera.json";
    fails(dir, &format!("grasp propose {depth} --out ."), &["overlay.png", "not written by this program"]);
    assert_eq!(read(dir, "overlay.png"), b"mine");
    let tiny = Tiny::new(false);
    std::fs::create_dir_all(tiny.path().join("there/train")).unwrap();
    fails(
        tiny.path(),
        "simulate-depth --dataset tiny --out there",
        &["--out there", "another dataset", "train"],
    );
}

#[test]
fn counts_out_of_range_and_ids_named_twice_are_refused() {
    let one = OneImage::new();
    let bad = |arguments: &str, words: &[&str]| fails(one.path(), arguments, words);
    bad("object list --threads 100000", &["--threads", "100000", "1 to 1024"]);
    bad("object list --threads 0", &["--threads", "1 to 1024"]);
    bad("object list --device tpu", &["--device", "tpu", "cpu or gpu"]);
    if !cfg!(feature = "gpu") {
        bad("object list --device gpu", &["--device gpu", "feature `gpu`", "cpu"]);
    }
    bad("eval --dataset tiny --results a.csv --min-score nan", &["--min-score", "NaN", "0 to 1"]);
    bad("eval --dataset tiny --results a.csv --min-score 2", &["--min-score", "2", "0 to 1"]);
    bad(&format!("{} --instances 100000", OneImage::ARGUMENTS), &["--instances", "100000", "1 to 1000"]);
    bad(&format!("{} --min-score nan", OneImage::ARGUMENTS), &["--min-score"]);
    bad("simulate-depth --dataset tiny --out new --images 4,4", &["--images", "4 twice"]);
    #[cfg(feature = "physics")]
    {
        bad("simulate-scenes --toys 1000000 --out new", &["--toys", "1000000", "0 to 10000"]);
        bad("simulate-scenes --families can --members 1000000 --out new", &["--members", "1 to 10000"]);
        bad("simulate-scenes --toys 1 --views 100000000 --out new", &["--views", "1 to 10000"]);
        bad("simulate-scenes --dataset tiny --ids 8,8 --out new", &["--ids", "8 twice"]);
    }
    #[cfg(feature = "networks")]
    {
        bad("synthesize --dataset tiny --ids 8,8 --out new", &["--ids", "8 twice"]);
        bad("synthesize --dataset tiny --per-view 0 --out new", &["--per-view", "found 0", "1 to 1000"]);
        bad(
            "synthesize --dataset tiny --step 1 --rotations 72 --out new",
            &["--step", "--rotations", "200000"],
        );
        bad("detect --weights none --rgb rgb.png --ids 8,8", &["--ids", "8 twice"]);
    }
}

/// Once, the diameter times 1000 gave recall 1.0 for a wrong pose, as did an axis of 1e308; 1000 x 200 symmetries never
/// ended.
#[test]
fn a_models_info_that_is_not_of_the_meshes_is_refused() {
    let axis = r#"{"axis": [0, 0, 1e308], "offset": [0, 0, 0]}"#;
    let aside = r#"{"axis": [0, 0, 1], "offset": [900, 0, 0]}"#;
    let one = "[1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]";
    let many = vec![one; 1000].join(",");
    for (change, words) in [
        ("\"diameter\":1".to_owned(), ["object 1, diameter", "mm, as the mesh has it"]),
        (
            format!("\"symmetries_continuous\":[{axis}],\"diameter\":"),
            ["object 1, symmetries_continuous[0].axis", "at most"],
        ),
        (
            format!("\"symmetries_continuous\":[{aside}],\"diameter\":"),
            ["object 1, symmetries_continuous[0]", "onto itself"],
        ),
        (
            format!("\"symmetries_discrete\":[{many}],\"diameter\":"),
            ["object 1, symmetries_discrete", "at most 512"],
        ),
    ] {
        let tiny = Tiny::new(true);
        tiny.write_truth_as_results("results.csv");
        replace(&tiny.file("models/models_info.json"), "\"diameter\":", &change);
        for command in ["eval --dataset tiny --results results.csv", "estimate --dataset tiny --out new.csv"]
        {
            fails(tiny.path(), command, &["models_info.json", words[0], words[1]]);
        }
    }
}
