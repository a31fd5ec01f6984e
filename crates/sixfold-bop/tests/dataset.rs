//! A dataset written by this crate, read back, scored with VSD, and broken in the ways in which a user can break it.

use std::path::{Path, PathBuf};

use sixfold_bop::{
    BopDataset, Estimate, EvalOptions, GroundTruth, GroundTruthInfo, MaskKind, Models, NewImage, SceneWriter,
    Target, TargetObject, VISIBILITY_DELTA, evaluate, evaluate_detection, ground_truth_visibility,
    write_camera, write_targets,
};
use sixfold_geometry::nalgebra::Vector6;
use sixfold_geometry::{Camera, Image, Mask, Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

/// A box of 0.10 x 0.06 x 0.04 m, as vertices and triangles.
fn brick() -> Mesh {
    let corner = |i: usize| {
        let side = |bit: usize, half: f64| if i >> bit & 1 == 1 { half } else { -half };
        Vec3::new(side(0, 0.05), side(1, 0.03), side(2, 0.02))
    };
    let quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
    let faces = quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
    Mesh::new((0..8).map(corner).collect(), faces).unwrap()
}

fn ply_mm(mesh: &Mesh) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        mesh.vertices().len(),
        mesh.faces().len()
    );
    for v in mesh.vertices() {
        text.push_str(&format!("{} {} {}\n", v.x * 1000.0, v.y * 1000.0, v.z * 1000.0));
    }
    for f in mesh.faces() {
        text.push_str(&format!("3 {} {} {}\n", f[0], f[1], f[2]));
    }
    text
}

fn camera() -> Camera {
    Camera::new(300.0, 310.0, 79.5, 59.5, 160, 120).unwrap()
}

fn pose(x: f64, z: f64, turn: f64) -> Pose {
    Pose::from_translation(Vec3::new(x, 0.0, z))
        * Pose::exp(&Vector6::new(0.0, 0.0, 0.0, turn, 0.5 * turn, 0.3))
}

/// Two images of two bricks each, one brick partly in front of the other, with depth, masks and infos.
fn write_dataset(root: &Path) -> Vec<Target> {
    let (mesh, camera) = (brick(), camera());
    std::fs::create_dir_all(root.join("models")).unwrap();
    std::fs::write(root.join("models/obj_000001.ply"), ply_mm(&mesh)).unwrap();
    std::fs::write(root.join("models/obj_000002.ply"), ply_mm(&mesh)).unwrap();
    let d = 1000.0 * mesh.diameter();
    let info = format!(
        r#"{{"1": {{"diameter": {d}, "min_x": -50, "min_y": -30, "min_z": -20, "size_x": 100, "size_y": 60, "size_z": 40}},
            "2": {{"diameter": {d}, "min_x": -50, "min_y": -30, "min_z": -20, "size_x": 100, "size_y": 60, "size_z": 40,
                  "symmetries_discrete": [[-1,0,0,0, 0,-1,0,0, 0,0,1,0, 0,0,0,1]]}}}}"#
    );
    std::fs::write(root.join("models/models_info.json"), info).unwrap();
    write_camera(root, &camera, 1e-4).unwrap();
    let mut writer = SceneWriter::new(root, "test", 2);
    let mut targets = Vec::new();
    for im_id in [3, 11] {
        let turn = f64::from(im_id) * 0.1;
        let truth =
            [GroundTruth::new(1, pose(-0.02, 0.5, turn)), GroundTruth::new(2, pose(0.03, 0.4, -turn))];
        let objects: Vec<SceneObject<'_>> = truth
            .iter()
            .map(|gt| SceneObject { mesh: &mesh, camera_from_object: gt.camera_from_object })
            .collect();
        let mut frame = VisibilityBuffer::new(&camera);
        frame.render(&objects, &RenderOptions::default());
        let depth = frame.depth().map(|z| if *z > 0.0 { *z } else { 1.0 });
        let pairs: Vec<(&Mesh, Pose)> = truth.iter().map(|gt| (&mesh, gt.camera_from_object)).collect();
        let visibility = ground_truth_visibility(&pairs, &camera, Some(&depth), VISIBILITY_DELTA);
        let infos: Vec<GroundTruthInfo> = visibility.iter().map(|v| v.info).collect();
        let masks: Vec<Mask> = visibility.iter().map(|v| v.mask.clone()).collect();
        let visible: Vec<Mask> = visibility.iter().map(|v| v.mask_visible.clone()).collect();
        let rgb = Image::from_fn(160, 120, |x, y| [x as u8, y as u8, im_id as u8]);
        writer
            .add(&NewImage {
                depth_scale: 1e-4,
                camera_from_world: Some(pose(0.1, 0.2, 0.3)),
                rgb: Some(&rgb),
                depth: Some(&depth),
                ground_truth: &truth,
                info: Some(&infos),
                masks: Some(&masks),
                masks_visible: Some(&visible),
                ..NewImage::new(im_id, &camera)
            })
            .unwrap();
        for obj_id in [1, 2] {
            let object = Some(TargetObject { obj_id, inst_count: 1 });
            targets.push(Target { scene_id: 2, im_id, object });
        }
    }
    writer.finish().unwrap();
    write_targets(&root.join("test_targets_bop19.json"), &targets).unwrap();
    targets
}

fn written() -> (tempfile::TempDir, BopDataset) {
    let dir = tempfile::tempdir().unwrap();
    write_dataset(dir.path());
    let dataset = BopDataset::open(dir.path(), "test").unwrap();
    (dir, dataset)
}

fn truth_as_estimates(dataset: &BopDataset) -> Vec<Estimate> {
    let scene = dataset.scene(2).unwrap();
    let of = |im_id: u32| {
        let truth = scene.image(im_id).unwrap().ground_truth.clone();
        truth.into_iter().map(move |gt| Estimate::new(2, im_id, gt.obj_id, 0.5, gt.camera_from_object))
    };
    scene.image_ids().into_iter().flat_map(of).collect()
}

fn score(dataset: &BopDataset, estimates: &[Estimate]) -> sixfold_bop::Evaluation {
    let targets = dataset.targets(None).unwrap();
    evaluate(dataset, estimates, &targets, &EvalOptions::default(), &()).unwrap()
}

#[test]
fn what_was_written_is_read_back() {
    let dir = tempfile::tempdir().unwrap();
    let targets = write_dataset(dir.path());
    let dataset = BopDataset::open(dir.path(), "test").unwrap();
    assert_eq!(dataset.targets(None).unwrap(), targets);
    assert_eq!((dataset.scene_ids(), dataset.image_size()), (vec![2], Some((160, 120))));
    let scene = dataset.scene(2).unwrap();
    assert_eq!(scene.image_ids(), [3, 11]);
    assert_eq!(scene.camera(3).unwrap(), camera());
    let image = scene.image(3).unwrap();
    let back = image.ground_truth[0].camera_from_object.inverse() * pose(-0.02, 0.5, 0.3);
    assert!(back.log().amax() < 1e-9);
    let world = image.camera.camera_from_world.unwrap().inverse() * pose(0.1, 0.2, 0.3);
    assert!(world.log().amax() < 1e-9);
    assert_eq!(scene.rgb(3).unwrap().unwrap()[(5, 7)], [5, 7, 3]);
    let depth = scene.depth(3).unwrap().unwrap();
    assert_eq!(depth[(0, 0)], 1.0);
    let info = image.info.as_ref().unwrap();
    let visible = scene.mask(3, 0, MaskKind::Visible).unwrap().unwrap();
    let full = scene.mask(3, 0, MaskKind::Full).unwrap().unwrap();
    let count = |m: &Mask| m.as_slice().iter().filter(|p| **p).count() as u64;
    assert_eq!(info[0].px_count_visib, Some(count(&visible)));
    assert!(count(&visible) < count(&full), "the near brick hides part of the far one");
    assert!(scene.mask(3, 7, MaskKind::Full).unwrap().is_none());
    assert!(dataset.model(1, Models::Evaluation).unwrap().vertices().len() == 8);
    let text = std::fs::read_to_string(dir.path().join("test/000002/scene_camera.json")).unwrap();
    assert!(text.contains("\"depth_scale\":0.1"), "{text}");
}

#[test]
fn ground_truth_and_its_symmetric_pose_score_one_with_vsd() {
    let (_dir, dataset) = written();
    let mut estimates = truth_as_estimates(&dataset);
    let found = score(&dataset, &estimates);
    assert_eq!((found.ar, found.ar_vsd), (Some(1.0), Some(1.0)), "{:?}", found.reasons);
    assert_eq!(found.reasons.keys().collect::<Vec<_>>(), ["average_time_per_image"]);
    // Object 2 is symmetric: a half turn is right for MSSD, MSPD and ADI. Object 1 is not.
    let half_turn = Pose::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::PI));
    for estimate in &mut estimates {
        estimate.camera_from_object = estimate.camera_from_object * half_turn;
    }
    let found = score(&dataset, &estimates);
    assert_eq!((found.objects["2"].ar_mssd, found.objects["2"].ar_mspd), (Some(1.0), Some(1.0)));
    assert_eq!((found.add_s_recall["2"], found.add_s_recall["1"]), (Some(1.0), Some(0.0)));
    assert_eq!((found.add_s_recall["mean"], found.objects["1"].ar_mssd), (Some(0.5), Some(0.0)));
}

#[test]
fn only_the_surest_estimates_count_and_the_others_are_counted_as_left_out() {
    let (_dir, dataset) = written();
    let mut estimates = truth_as_estimates(&dataset);
    let wrong: Vec<Estimate> = estimates
        .iter()
        .map(|e| Estimate { score: 0.9, camera_from_object: pose(0.3, 0.9, 0.0), ..*e })
        .collect();
    estimates.extend(wrong);
    estimates.push(Estimate { im_id: 99, ..estimates[0] });
    let found = score(&dataset, &estimates);
    assert_eq!((found.ar_mssd, found.estimates, found.estimates_left_out), (Some(0.0), 4, 5));
    // As detections, the wrong ones lower the precision and the right ones are still found: precision 1/2 at every
    // recall.
    let targets = dataset.targets(None).unwrap();
    let found = evaluate_detection(&dataset, &estimates, &targets, &EvalOptions::default()).unwrap();
    assert!((found.ap.unwrap() - 0.5).abs() < 1e-12, "{found:?}");
}

#[test]
fn vsd_of_a_shift_along_the_axis_is_between_the_taus() {
    // 26 mm towards the camera at a diameter of 123 mm is 0.21 diameters: wrong for the taus up to .2, and right for
    // those above, except for the pixels at the silhouette, which a wide threshold tolerates.
    let (_dir, dataset) = written();
    let mut estimates = truth_as_estimates(&dataset);
    for e in &mut estimates {
        let t = e.camera_from_object.translation() - Vec3::new(0.0, 0.0, 0.026);
        e.camera_from_object = e.camera_from_object.with_translation(t);
    }
    let found = score(&dataset, &estimates);
    let curve = found.curves.vsd.unwrap();
    let at = |threshold: f64| curve.mean[curve.thresholds.iter().position(|t| *t >= threshold).unwrap()];
    assert!((at(0.5) - 0.6).abs() < 1e-9, "six of ten taus: {}", at(0.5));
    assert_eq!(at(0.04), 0.0);
}

#[test]
fn missing_parts_leave_scores_empty_with_reasons() {
    let (dir, _) = written();
    std::fs::remove_file(dir.path().join("test/000002/depth/000011.png")).unwrap();
    std::fs::remove_file(dir.path().join("models/obj_000002.ply")).unwrap();
    let dataset = BopDataset::open(dir.path(), "test").unwrap();
    let found = score(&dataset, &truth_as_estimates(&dataset));
    assert_eq!((found.ar, found.ar_vsd, found.ar_mssd, found.add_s_recall["mean"]), (None, None, None, None));
    assert!(found.reasons["ar_vsd"].contains("1 of 2 images"), "{:?}", found.reasons);
    assert!(found.reasons["ar_mssd"].contains("no model of object 2"), "{:?}", found.reasons);
    assert_eq!((found.add_s_recall["1"], found.add_s_recall["2"]), (Some(1.0), None));
    // For frame 3 and object 1 alone everything can be computed.
    let object = Some(TargetObject { obj_id: 1, inst_count: 1 });
    let one = [Target { scene_id: 2, im_id: 3, object }];
    let found =
        evaluate(&dataset, &truth_as_estimates(&dataset), &one, &EvalOptions::default(), &()).unwrap();
    assert_eq!(found.ar, Some(1.0));
}

#[test]
fn poses_that_are_hardly_visible_are_no_targets_of_their_own_accord() {
    let (dir, _) = written();
    std::fs::remove_file(dir.path().join("test_targets_bop19.json")).unwrap();
    let path = dir.path().join("test/000002/scene_gt_info.json");
    let text = std::fs::read_to_string(&path).unwrap();
    let mut info: serde_json::Value = serde_json::from_str(&text).unwrap();
    info["3"][0]["visib_fract"] = serde_json::json!(0.05);
    std::fs::write(&path, info.to_string()).unwrap();
    let dataset = BopDataset::open(dir.path(), "test").unwrap();
    assert_eq!(dataset.targets(None).unwrap().len(), 3);
    // As a detection, the hardly visible one is ignored.
    let images: Vec<Target> = [3, 11].map(|im_id| Target { scene_id: 2, im_id, object: None }).to_vec();
    let mut estimates = truth_as_estimates(&dataset);
    let options = EvalOptions::default();
    assert_eq!(evaluate_detection(&dataset, &estimates, &images, &options).unwrap().ap, Some(1.0));
    estimates.remove(0);
    assert_eq!(evaluate_detection(&dataset, &estimates, &images, &options).unwrap().ap, Some(1.0));
    estimates.remove(0);
    assert!(evaluate_detection(&dataset, &estimates, &images, &options).unwrap().ap < Some(1.0));
}

fn message(result: Result<impl Sized, impl std::fmt::Display>) -> String {
    result.err().expect("an error").to_string()
}

#[test]
fn broken_datasets_are_named() {
    let (dir, dataset) = written();
    let root = dir.path();
    let file = |name: &str| -> PathBuf { root.join("test/000002").join(name) };
    let scene = dataset.scene(2).unwrap();
    assert!(message(dataset.scene(7)).contains("scene 7 is not there; the split has scenes 2"));
    assert!(message(scene.image(4)).contains("im_id 4"));
    assert!(message(dataset.model(9, Models::Evaluation)).contains("obj_000009.ply"));
    assert!(message(BopDataset::open(&root.join("gone"), "test")).contains("the dataset folder is missing"));
    assert!(message(BopDataset::open(root, "train")).contains("the folder of the split is missing"));
    assert!(message(BopDataset::open(root, "models")).contains("a scene folder is missing"));

    // An image of another resolution than the intrinsics.
    image::RgbImage::new(320, 240).save(file("rgb/000003.png")).unwrap();
    let error = message(scene.rgb(3));
    for part in ["000003.png", "im_id 3", "320x240", "160x120", "camera.json", "another resolution"] {
        assert!(error.contains(part), "{error} lacks {part}");
    }
    // A truncated depth image.
    let png = std::fs::read(file("depth/000003.png")).unwrap();
    std::fs::write(file("depth/000003.png"), &png[..png.len() / 2]).unwrap();
    assert!(message(scene.depth(3)).contains("depth/000003.png: im_id 3: not a readable image"));
    let targets = dataset.targets(None).unwrap();
    let result = evaluate(&dataset, &[], &targets, &EvalOptions::default(), &());
    assert!(message(result).contains("000003.png"));

    let gt = std::fs::read_to_string(file("scene_gt.json")).unwrap();
    std::fs::write(file("scene_gt.json"), gt.replace("\"11\":", "\"12\":")).unwrap();
    assert!(message(dataset.scene(2)).contains("im_id 12"));
    std::fs::write(file("scene_gt.json"), &gt[..gt.len() - 40]).unwrap();
    assert!(message(dataset.scene(2)).contains("not valid JSON"));
    std::fs::write(file("scene_gt.json"), &gt).unwrap();
    std::fs::write(file("scene_gt_info.json"), r#"{"3": []}"#).unwrap();
    assert!(message(dataset.scene(2)).contains("im_id 3, field (number of entries): found 0, expected 2"));
    std::fs::remove_file(file("scene_gt_info.json")).unwrap();
    std::fs::remove_file(file("scene_gt.json")).unwrap();
    assert!(!dataset.scene(2).unwrap().has_ground_truth());
    let result = evaluate(&dataset, &[], &targets, &EvalOptions::default(), &());
    assert!(message(result).contains("scene_gt.json: the ground truth is missing"));
    std::fs::write(root.join("camera.json"), r#"{"width": 0, "height": 480}"#).unwrap();
    assert!(message(BopDataset::open(root, "test")).contains("field width: found 0"));
    std::fs::write(root.join("camera.json"), r#"{"width": 640}"#).unwrap();
    assert!(message(BopDataset::open(root, "test")).contains("field height: found nothing"));
    std::fs::write(root.join("camera.json"), r#"{"width": 32768, "height": 32768}"#).unwrap();
    assert!(message(BopDataset::open(root, "test")).contains("megapixels"));

    // A focal length in millimetres, where pixels are expected.
    std::fs::write(root.join("camera.json"), r#"{"width": 160, "height": 120}"#).unwrap();
    let cameras = r#"{"3": {"cam_K": [1.88, 0, 79.5, 0, 1.88, 59.5, 0, 0, 1], "depth_scale": 1}}"#;
    std::fs::write(file("scene_camera.json"), cameras).unwrap();
    let error = message(BopDataset::open(root, "test").unwrap().scene(2).unwrap().camera(3));
    for part in ["scene_camera.json", "im_id 3", "cam_K", "1.88", "millimetres"] {
        assert!(error.contains(part), "{error} lacks {part}");
    }
}

#[test]
fn options_out_of_range_are_refused() {
    let (_dir, dataset) = written();
    let bad = EvalOptions { max_symmetry_step: 0.0, ..EvalOptions::default() };
    assert!(message(evaluate(&dataset, &[], &[], &bad, &())).contains("max_symmetry_step"));
    let found = evaluate(&dataset, &[], &[], &EvalOptions::default(), &()).unwrap();
    assert_eq!(found.ar_mssd, None);
    assert!(found.reasons["ar_mssd"].contains("no pose to be found"), "{:?}", found.reasons);
}

#[test]
fn a_writer_refuses_invalid_data() {
    let dir = tempfile::tempdir().unwrap();
    let camera = camera();
    let mut writer = SceneWriter::new(dir.path(), "test", 1);
    let small = Image::filled(10, 10, [0u8; 3]);
    let error = message(writer.add(&NewImage { rgb: Some(&small), ..NewImage::new(1, &camera) }));
    assert!(error.contains("im_id 1, field rgb: found 10x10, expected 160x120"), "{error}");
    let masks = [Image::filled(160, 120, true)];
    let error = message(writer.add(&NewImage { masks: Some(&masks), ..NewImage::new(1, &camera) }));
    assert!(error.contains("field masks: found 1 entries, expected 0"), "{error}");
}
