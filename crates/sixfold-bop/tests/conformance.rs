//! Published numbers on real data: LM-O scores of the official toolkit, YCB-V areas of the PoseCNN paper.

mod support;

use std::collections::BTreeMap;
use std::path::Path;

use sixfold_bop::{
    BopDataset, Estimate, EvalOptions, ModelPoints, Target, add, adi, area_under_accuracy, evaluate,
    evaluate_detection, read_results,
};
use sixfold_geometry::nalgebra::{Quaternion, UnitQuaternion};
use sixfold_geometry::{Pose, Vec3};

#[test]
fn lmo_published_results_score_as_with_the_official_toolkit() {
    let Some(dir) = support::data("lmo") else { return };
    let dataset = BopDataset::open(&dir, "test").unwrap();
    let estimates = read_results(&dir.join("published/cnos-fastsam-megapose_lmo-test.csv")).unwrap();
    let targets = dataset.targets(None).unwrap();
    let found = evaluate(&dataset, &estimates, &targets, &EvalOptions::default(), &()).unwrap();
    let text = std::fs::read_to_string(dir.join("published/expected_scores.json")).unwrap();
    let expected: serde_json::Value = serde_json::from_str(&text).unwrap();
    let close = |name: &str, found: Option<f64>, expected: &serde_json::Value| {
        let (found, expected) = (found.unwrap(), expected.as_f64().unwrap());
        assert!((found - expected).abs() < 1e-4, "{name}: {found}, expected {expected}");
    };
    close("AR_MSSD", found.ar_mssd, &expected["AR_MSSD"]);
    close("AR_MSPD", found.ar_mspd, &expected["AR_MSPD"]);
    close("mean", found.add_s_recall["mean"], &expected["mean_over_targets"]);
    let per_object = expected["recall_adds_0p1d"].as_object().unwrap();
    assert_eq!(per_object.len(), 8);
    for (id, expected) in per_object {
        close(id, found.add_s_recall[id], expected);
    }
    assert_eq!(found.targets as u64, expected["targets"].as_u64().unwrap());

    // One of the hundred frames has depth: no VSD, no AR, and the reasons state this.
    assert_eq!((found.ar, found.ar_vsd), (None, None));
    assert!(found.reasons["ar_vsd"].contains("99 of 100 images"), "{}", found.reasons["ar_vsd"]);
    assert!(found.reasons["ar"].contains("ar_vsd"));
    let json = serde_json::to_value(&found).unwrap();
    assert!(json["ar"].is_null() && json["ar_mssd"].is_f64() && json["add_s_recall"]["mean"].is_f64());
}

#[test]
fn lmo_ground_truth_scores_exactly_one() {
    let Some(dir) = support::data("lmo") else { return };
    let dataset = BopDataset::open(&dir, "test").unwrap();
    let scene = dataset.scene(2).unwrap();
    let mut estimates = Vec::new();
    for im_id in scene.image_ids() {
        for gt in &scene.image(im_id).unwrap().ground_truth {
            let (obj_id, camera_from_object) = (gt.obj_id, gt.camera_from_object);
            let estimate = Estimate::new(2, im_id, obj_id, 1.0, camera_from_object);
            let rotation_as_written = gt.rotation_as_written;
            estimates.push(Estimate { time: Some(0.5), rotation_as_written, ..estimate });
        }
    }
    // Written to a file and read again, without any loss.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("gt_lmo-test.csv");
    sixfold_bop::write_results(&path, &estimates).unwrap();
    let estimates = read_results(&path).unwrap();
    let targets = dataset.targets(None).unwrap();
    let options = EvalOptions::default();
    let found = evaluate(&dataset, &estimates, &targets, &options, &()).unwrap();
    assert_eq!((found.ar_mssd, found.ar_mspd), (Some(1.0), Some(1.0)));
    // The published matrices are not exactly rotations, but the estimates are read back from the same numbers: no error
    // at all.
    assert_eq!((found.add_auc, found.add_s_auc), (Some(1.0), Some(1.0)));
    assert!(found.add_s_recall.values().all(|v| *v == Some(1.0)), "{:?}", found.add_s_recall);
    assert_eq!(found.average_time_per_image, Some(0.5));
    let found = evaluate_detection(&dataset, &estimates, &targets, &options).unwrap();
    assert_eq!(found.ap, Some(1.0));

    // The one frame with depth: VSD and AR exist and are one as well, despite occlusion.
    let frame: Vec<Target> = targets.iter().copied().filter(|t| t.im_id == 3).collect();
    let found = evaluate(&dataset, &estimates, &frame, &options, &()).unwrap();
    assert_eq!((found.ar, found.ar_vsd), (Some(1.0), Some(1.0)), "{:?}", found.reasons);

    // An estimate with an error of five centimetres gets lower scores in every respect.
    let mut off = estimates.clone();
    for estimate in &mut off {
        let t = estimate.camera_from_object.translation() + Vec3::new(0.05, 0.0, 0.0);
        estimate.camera_from_object = estimate.camera_from_object.with_translation(t);
    }
    let worse = evaluate(&dataset, &off, &frame, &options, &()).unwrap();
    assert!(worse.ar_vsd < Some(0.6) && worse.ar_mssd < Some(0.5) && worse.ar_mspd < Some(0.6), "{worse:?}");
    assert_eq!(worse.add_s_recall["mean"], Some(0.0));
}

#[test]
fn lmo_published_results_as_detections() {
    // Computed with the official toolkit's matching and scoring; see checks/detection_ap_vs_bop_toolkit.py.
    let Some(dir) = support::data("lmo") else { return };
    let dataset = BopDataset::open(&dir, "test").unwrap();
    let estimates = read_results(&dir.join("published/cnos-fastsam-megapose_lmo-test.csv")).unwrap();
    let mut targets = dataset.targets(None).unwrap();
    for target in &mut targets {
        target.object = None;
    }
    let found = evaluate_detection(&dataset, &estimates, &targets, &EvalOptions::default()).unwrap();
    let (mssd, mspd) = (found.ap_mssd.unwrap(), found.ap_mspd.unwrap());
    println!("ap_mssd {mssd:.6} ap_mspd {mspd:.6} ap_mssd_mm {:.6}", found.ap_mssd_mm.unwrap());
    assert!((mssd - EXPECTED_AP_MSSD).abs() < 1e-6, "{mssd}");
    assert!((mspd - EXPECTED_AP_MSPD).abs() < 1e-6, "{mspd}");
    let mm = found.ap_mssd_mm.unwrap();
    assert!((mm - EXPECTED_AP_MSSD_MM).abs() < 1e-6, "{mm}");
}

const EXPECTED_AP_MSSD: f64 = 0.418_384_545_6;
const EXPECTED_AP_MSSD_MM: f64 = 0.102_767_943_6;
const EXPECTED_AP_MSPD: f64 = 0.530_951_948_1;

#[test]
fn the_scores_do_not_depend_on_the_number_of_threads() {
    let Some(dir) = support::data("lmo") else { return };
    let dataset = BopDataset::open(&dir, "test").unwrap();
    let estimates = read_results(&dir.join("published/cnos-fastsam-megapose_lmo-test.csv")).unwrap();
    let mut targets = dataset.targets(None).unwrap();
    targets.truncate(60);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let run = || evaluate(&dataset, &estimates, &targets, &EvalOptions::default(), &()).unwrap();
        serde_json::to_string(&pool.install(run)).unwrap()
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn hope_as_a_bare_scene_folder_reports_missing_depth() {
    let Some(dir) = support::data("hope") else { return };
    let dataset = BopDataset::open(&dir, "test").unwrap();
    let targets = dataset.targets(None).unwrap();
    assert!(targets.len() >= 3 * 15);
    let camera = dataset.scene(0).unwrap().camera(0).unwrap();
    assert_eq!((camera.width, camera.height), (1920, 1080));
    let found = evaluate(&dataset, &[], &targets, &EvalOptions::default(), &()).unwrap();
    assert_eq!((found.ar, found.ar_mssd), (None, Some(0.0)));
    assert_eq!(found.add_s_recall["2"], Some(0.0));
    assert!(
        found.reasons["ar_vsd"].contains("3 of 3 images with targets have no depth"),
        "{:?}",
        found.reasons
    );
    assert!(found.reasons["average_time_per_image"].contains("no estimates"), "{:?}", found.reasons);
}

#[test]
fn ycbv_and_tyol_frames_are_read_with_their_depth() {
    let Some(dir) = support::data("ycbv_frame") else { return };
    let scene = BopDataset::open(&dir, "test").unwrap().scene(0).unwrap();
    assert_eq!(scene.image_ids(), [1, 2]);
    let depth = scene.depth(1).unwrap().unwrap();
    let measured: Vec<f32> = depth.as_slice().iter().copied().filter(|z| *z > 0.0).collect();
    let mean = measured.iter().sum::<f32>() / measured.len() as f32;
    assert!((0.5..2.0).contains(&mean), "a tabletop at {mean} m");
    assert_eq!(scene.rgb(1).unwrap().unwrap().size(), depth.size());
    let Some(dir) = support::data("tyol_frame") else { return };
    let scene = BopDataset::open(&dir, "test").unwrap().scene(0).unwrap();
    assert!(scene.depth(10).unwrap().is_some() && !scene.image(10).unwrap().ground_truth.is_empty());
}

fn read_keyframe_poses(path: &Path) -> Vec<Option<Pose>> {
    let text = std::fs::read_to_string(path).unwrap();
    let parse = |line: &str| {
        let v: Vec<f64> = line.split_whitespace().map(|n| n.parse().unwrap()).collect();
        let q = Quaternion::new(v[0], v[1], v[2], v[3]);
        // The networks' quaternions are not normalised; a failed estimate is a row of zeros.
        let rotation = UnitQuaternion::try_new(q, 1e-9)?;
        Some(Pose::new(rotation, Vec3::new(v[4], v[5], v[6])))
    };
    text.lines().map(parse).collect()
}

fn ycbv_areas(root: &Path, method: &str) -> (usize, f64, f64) {
    let mut points = BTreeMap::new();
    let mut files: Vec<_> =
        std::fs::read_dir(root.join("poses/ground_truth")).unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    let (mut add_errors, mut adi_errors) = (Vec::new(), Vec::new());
    for file in files {
        let name = file.file_name().unwrap().to_str().unwrap();
        let object = name[5..].trim_end_matches(".txt").to_owned();
        let model: &ModelPoints = points.entry(object.clone()).or_insert_with(|| {
            let text = std::fs::read_to_string(root.join("points").join(&object).join("points.xyz")).unwrap();
            let read = |line: &str| {
                Vec3::from_iterator(line.split_whitespace().take(3).map(|n| n.parse::<f64>().unwrap()))
            };
            ModelPoints::new(&text.lines().filter(|l| !l.trim().is_empty()).map(read).collect::<Vec<_>>())
                .unwrap()
        });
        let truth = read_keyframe_poses(&file);
        let estimates = read_keyframe_poses(&root.join("poses").join(method).join(name));
        assert_eq!(truth.len(), estimates.len(), "{name}");
        use rayon::prelude::*;
        let both = |(g, e): (&Option<Pose>, &Option<Pose>)| {
            let g = g.as_ref().unwrap();
            e.as_ref().map_or((f64::INFINITY, f64::INFINITY), |e| (add(model, e, g), adi(model, e, g)))
        };
        let errors: Vec<(f64, f64)> = truth.par_iter().zip(&estimates).map(both).collect();
        add_errors.extend(errors.iter().map(|e| e.0));
        adi_errors.extend(errors.iter().map(|e| e.1));
    }
    let area = |errors: &[f64]| 100.0 * area_under_accuracy(errors, 0.1).unwrap();
    (add_errors.len(), area(&add_errors), area(&adi_errors))
}

#[test]
fn ycbv_keyframes_give_the_areas_of_the_posecnn_paper() {
    let Some(root) = support::data("ycbv_keyframe_poses") else { return };
    // Mean over all instances of all objects, plain ADD for every object, failed estimates infinitely wrong.
    for (method, expected_add, expected_adi) in
        [("posecnn_rss2018", 53.71, 75.81), ("posecnn_icp_rss2018", 79.18, 92.95)]
    {
        let (count, add, adi) = ycbv_areas(&root, method);
        assert_eq!(count, 14_025);
        assert!((add - expected_add).abs() < 0.02, "{method}: ADD {add}");
        assert!((adi - expected_adi).abs() < 0.02, "{method}: ADD-S {adi}");
    }
}
