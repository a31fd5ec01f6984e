//! The weights in `weights/` on real frames: scores that a change must not lower unnoticed. They are compared with those that
//! `benches/results.sh` measured and stored in `results/`, minus two standard errors. Needs the folder that `SIXFOLD_DATA` names,
//! or `../shared/data` beside the repository; without it the tests are skipped.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use sixfold_bop::BopDataset;
use sixfold_nn::weights::read_card;

use crate::support::*;

/// The repository.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// The folder of LM-O, if it is available.
fn lmo() -> Option<PathBuf> {
    let folder =
        std::env::var_os("SIXFOLD_DATA").map_or_else(|| root().join("../shared/data"), PathBuf::from);
    let lmo = folder.join("lmo");
    if lmo.join("test").is_dir() {
        return Some(lmo.canonicalize().unwrap());
    }
    println!("skipped: no LM-O at {}", lmo.display());
    None
}

/// Writes every eighth of the frames that were not used for training as a file of targets; returns the number of targets.
fn every_eighth(lmo: &Path, weights: &Path, file: &Path) -> usize {
    let card = read_card(weights).unwrap();
    let trained = card.training_frames.iter().flatten().map(|f| (f.scene_id, f.im_id)).collect();
    every(8, lmo, &trained, file)
}

/// Writes every so many of the frames that are not left out as a file of targets; returns the number of targets.
fn every(step: usize, lmo: &Path, left_out: &BTreeSet<(u32, u32)>, file: &Path) -> usize {
    let targets = BopDataset::open(lmo, "test").unwrap().targets(None).unwrap();
    let frames: BTreeSet<(u32, u32)> = targets.iter().map(|t| (t.scene_id, t.im_id)).collect();
    let chosen: Vec<(u32, u32)> = frames.difference(left_out).copied().step_by(step).collect();
    let rows: Vec<Value> = targets
        .iter()
        .filter(|t| chosen.contains(&(t.scene_id, t.im_id)))
        .filter_map(|t| t.object.map(|o| (t, o)))
        .map(|(t, o)| {
            let (scene_id, im_id, inst_count) = (t.scene_id, t.im_id, o.inst_count);
            json!({"scene_id": scene_id, "im_id": im_id, "obj_id": o.obj_id, "inst_count": inst_count})
        })
        .collect();
    std::fs::write(file, Value::from(rows.clone()).to_string()).unwrap();
    rows.len()
}

/// The stored result of a run of `benches/results.sh`.
fn kept(name: &str) -> Value {
    let text = std::fs::read_to_string(root().join("results").join(format!("{name}.json"))).unwrap();
    serde_json::from_str::<Value>(&text).unwrap()["values"]["scores"].clone()
}

/// Each score is at least the measured one minus two standard errors of a fraction of `count`.
fn assert_kept(found: &Value, measured: &Value, scores: &[&str], count: usize) {
    for score in scores {
        let (found, measured) = [found, measured].map(|v| v.pointer(score).unwrap().as_f64().unwrap()).into();
        let error = (measured * (1.0 - measured) / count as f64).sqrt();
        println!("{score}: {found:.3}, measured {measured:.3}, standard error {error:.3}");
        assert!(found > measured - 2.0 * error, "{score}: {found}, measured {measured} +- {error}");
    }
}

#[test]
fn the_shipped_pix2pose_on_real_frames() {
    let Some(lmo) = lmo() else { return };
    let dir = tempfile::tempdir().unwrap();
    let weights = root().join("weights/pix2pose-lmo.safetensors");
    let count = every_eighth(&lmo, &weights, &dir.path().join("targets.json"));
    let data = format!("--dataset {} --targets targets.json", lmo.display());
    let model = format!("--method pix2pose --weights {}", weights.display());
    sixfold(dir.path(), &format!("estimate {model} {data} --boxes gt --out r.csv")).expect(0);
    let eval = format!("eval {data} --results r.csv --no-vsd --json");
    let (scores, kept) = (sixfold(dir.path(), &eval).expect(0).json(), kept("pix2pose"));
    assert_eq!((&scores["targets"], &kept["targets"]), (&count.into(), &count.into()));
    assert_kept(&scores, &kept, &["/ar_mssd", "/ar_mspd", "/add_s_recall/mean"], count);
}

/// Nothing is trained for these objects; a tenth of the images, so that the standard error is larger.
#[test]
fn views_in_boxes_on_real_frames() {
    let Some(lmo) = lmo() else { return };
    let dir = tempfile::tempdir().unwrap();
    let count = every(20, &lmo, &BTreeSet::new(), &dir.path().join("targets.json"));
    let data = format!("--dataset {} --targets targets.json", lmo.display());
    sixfold(dir.path(), &format!("estimate --method views {data} --boxes gt --out r.csv")).expect(0);
    let scores =
        sixfold(dir.path(), &format!("eval {data} --results r.csv --no-vsd --json")).expect(0).json();
    assert_kept(&scores, &kept("views"), &["/ar_mssd", "/ar_mspd", "/add_s_recall/mean"], count);
}

#[test]
fn more_starts_agree_better_with_the_image() {
    let dir = tempfile::tempdir().unwrap();
    let demo = |path: &str| root().join("data/demo").join(path).display().to_string();
    let weights = root().join("weights/pix2pose-lmo.safetensors");
    let image = format!("--rgb {} --camera {}", demo("test/000002/rgb/000003.png"), demo("camera.json"));
    // A box that is too small for the object and not centred on it.
    let object =
        format!("--object {} --unit mm --object-id 9 --box 370,310,60,45", demo("models/obj_000009.ply"));
    let pose = |starts: usize| {
        let estimate = format!("estimate --method pix2pose --weights {} {image} {object}", weights.display());
        let answer =
            sixfold(dir.path(), &format!("{estimate} --starts {starts} --out o --json")).expect(0).json();
        answer["poses"][0].clone()
    };
    let (one, three) = (pose(1), pose(3));
    let agreement = |pose: &Value| pose["agreement"].as_f64().unwrap();
    assert!(agreement(&three) > agreement(&one) + 0.005, "{} and {}", agreement(&one), agreement(&three));
    // The duck is at a distance of 0.984 m.
    let off = |pose: &Value| (pose["camera_from_object"][2][3].as_f64().unwrap() - 0.984).abs();
    assert!(off(&three) < off(&one), "{} and {}", off(&one), off(&three));
    fails(
        dir.path(),
        &format!("estimate --method pix2pose --weights w {image} {object} --starts 6"),
        &["--starts", "5"],
    );
}

#[test]
fn the_shipped_detector_on_real_frames() {
    let Some(lmo) = lmo() else { return };
    let dir = tempfile::tempdir().unwrap();
    let weights = root().join("weights/detector-lmo.safetensors");
    let count = every_eighth(&lmo, &weights, &dir.path().join("targets.json"));
    let data = format!("--dataset {} --targets targets.json", lmo.display());
    let detect = format!("detect --weights {} {data} --out d.json", weights.display());
    sixfold(dir.path(), &detect).expect(0);
    let scores = sixfold(dir.path(), &format!("eval {data} --detections d.json --json")).expect(0).json();
    assert_kept(&scores, &kept("detector"), &["/box/ap", "/box/ap50"], count);
}
