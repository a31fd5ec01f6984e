//! Poses in real depth images of four sensors, by point pair features alone and without being told where to look.
//!
//! The images are third-party data that is not part of the repository: the folder is `SIXFOLD_DATA`, or
//! `../shared/data` beside the repository. Without it every test says that it was skipped.

use std::path::{Path, PathBuf};

use sixfold_align::{DepthOptions, DepthRegion};
use sixfold_bop::{BopDataset, Models};
use sixfold_geometry::{Camera, KdTree, Pose, Vec3};
use sixfold_io::read_depth;
use sixfold_mesh::{Mesh, Unit, read_mesh};
use sixfold_ppf::{ModelOptions, ObjectModel, PpfEstimate, PpfOptions, estimate};

fn data() -> Option<PathBuf> {
    let folder = std::env::var_os("SIXFOLD_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"), PathBuf::from);
    if folder.is_dir() {
        return Some(folder);
    }
    println!("skipped: no shared data at {}", folder.display());
    None
}

/// Mean distance of corresponding points.
fn add(points: &[Vec3], a: &Pose, b: &Pose) -> f64 {
    points.iter().map(|p| (a.transform_point(p) - b.transform_point(p)).norm()).sum::<f64>()
        / points.len() as f64
}

/// Mean distance to the nearest point, for objects that look alike from several sides.
fn adi(points: &[Vec3], estimated: &Pose, truth: &Pose) -> f64 {
    let tree = KdTree::new(&points.iter().map(|p| estimated.transform_point(p)).collect::<Vec<_>>());
    points.iter().filter_map(|p| tree.nearest(&truth.transform_point(p))).map(|n| n.distance).sum::<f64>()
        / points.len() as f64
}

fn find(
    scene: &DepthRegion,
    mesh: &Mesh,
    instances: usize,
    symmetries: &[Pose],
) -> (Vec<PpfEstimate>, ObjectModel) {
    let model = ObjectModel::new(mesh, symmetries, &ModelOptions::default()).unwrap();
    let options = PpfOptions { max_instances: instances, ..PpfOptions::default() };
    (estimate(scene, &model, &options), model)
}

#[test]
fn five_of_the_six_well_visible_objects_of_lmo_frame_3() {
    let Some(data) = data() else { return };
    let dataset = BopDataset::open(&data.join("lmo"), "test").unwrap();
    let frame = dataset.scene(2).unwrap();
    let camera = frame.camera(3).unwrap();
    let depth = frame.depth(3).unwrap().unwrap();
    let scene = DepthRegion::from_depth(&depth, &camera, None, &DepthOptions::default()).unwrap();
    let infos = dataset.models_info(Models::Rendering).unwrap().unwrap();
    let mut correct = 0;
    // The ape (1) is 9 % and the egg box (10) 40 % visible: not counted, but told.
    for id in [5, 6, 8, 9, 11, 12, 1, 10] {
        let mesh = dataset.model(id, Models::Rendering).unwrap();
        let info = &infos.0[&id];
        let (found, model) = find(&scene, &mesh, 1, &info.symmetry_poses(0.05));
        let truth =
            frame.image(3).unwrap().ground_truth.iter().find(|g| g.obj_id == id).unwrap().camera_from_object;
        let error = found.first().map_or(f64::INFINITY, |e| {
            if info.is_symmetric() {
                adi(mesh.vertices(), &e.camera_from_object, &truth)
            } else {
                add(mesh.vertices(), &e.camera_from_object, &truth)
            }
        });
        println!(
            "LM-O frame 3, object {id}: ADD(-S) {:.1} mm, {:.3} of the diameter",
            1e3 * error,
            error / model.diameter()
        );
        correct += usize::from(![1, 10].contains(&id) && error < 0.1 * model.diameter());
    }
    assert!(correct >= 5, "{correct} of 6");
}

#[test]
fn six_of_the_seven_objects_of_two_ycbv_frames() {
    let Some(data) = data() else { return };
    let dataset = BopDataset::open(&data.join("ycbv_frame"), "test").unwrap();
    let frames = dataset.scene(dataset.scene_ids()[0]).unwrap();
    let names = [
        (1, "002_master_chef_can"),
        (3, "004_sugar_box"),
        (8, "009_gelatin_box"),
        (9, "010_potted_meat_can"),
        (11, "019_pitcher_base"),
        (14, "025_mug"),
        (21, "061_foam_brick"),
    ];
    let (mut correct, mut exact) = (0, 0);
    for im_id in frames.image_ids() {
        let camera = frames.camera(im_id).unwrap();
        let depth = frames.depth(im_id).unwrap().unwrap();
        let scene = DepthRegion::from_depth(&depth, &camera, None, &DepthOptions::default()).unwrap();
        for g in &frames.image(im_id).unwrap().ground_truth {
            let name = names.iter().find(|n| n.0 == g.obj_id).unwrap().1;
            let points =
                read_mesh(data.join(format!("ycbv_keyframe_poses/points/{name}/points.xyz")), Unit::Metre)
                    .unwrap();
            let surface = points.surfels().unwrap();
            let (found, model) = find(&scene, &surface, 1, &[]);
            let pose = found.first().map(|e| e.camera_from_object);
            let error = |f: &dyn Fn(&Pose) -> f64| pose.as_ref().map_or(f64::INFINITY, f);
            let s = error(&|p| adi(points.vertices(), p, &g.camera_from_object));
            let a = error(&|p| add(points.vertices(), p, &g.camera_from_object));
            println!(
                "YCB-V frame {im_id}, {name}: ADD-S {:.1} mm, ADD {:.1} mm, ADD-S {:.3} of the diameter, confidence {:.2}",
                1e3 * s,
                1e3 * a,
                s / model.diameter(),
                found.first().map_or(0.0, |e| e.confidence)
            );
            correct += usize::from(s < 0.1 * model.diameter());
            exact += usize::from(a < 0.1 * model.diameter());
        }
    }
    println!("YCB-V: {correct} of 7 by ADD-S, {exact} of 7 by ADD");
    assert!(correct >= 6, "{correct} of 7");
}

#[test]
fn the_object_of_the_tyol_frame() {
    let Some(data) = data() else { return };
    let dataset = BopDataset::open(&data.join("tyol_frame"), "test").unwrap();
    let frames = dataset.scene(dataset.scene_ids()[0]).unwrap();
    let camera = frames.camera(10).unwrap();
    let scene =
        DepthRegion::from_depth(&frames.depth(10).unwrap().unwrap(), &camera, None, &DepthOptions::default())
            .unwrap();
    let mesh = read_mesh(data.join("tyol_frame/obj.ply"), Unit::Millimetre).unwrap();
    let (found, model) = find(&scene, &mesh, 1, &[]);
    let truth = frames.image(10).unwrap().ground_truth[0].camera_from_object;
    let e = found.first().expect("a pose");
    let (a, s) = (
        add(mesh.vertices(), &e.camera_from_object, &truth),
        adi(mesh.vertices(), &e.camera_from_object, &truth),
    );
    println!(
        "TYO-L: ADD {:.1} mm, ADD-S {:.1} mm, diameter {:.0} mm",
        1e3 * a,
        1e3 * s,
        1e3 * model.diameter()
    );
    assert!(a < 0.1 * model.diameter());
}

#[test]
fn four_cups_in_each_bin_that_holds_cups() {
    let Some(data) = data() else { return };
    let camera = Camera::new(550.0, 540.0, 316.0, 244.0, 640, 480).unwrap();
    let folder = data.join("icbin_frames");
    let mesh = read_mesh(folder.join("2/model.ply"), Unit::Millimetre).unwrap();
    // There is no ground truth. The overlays of bins 2 and 3 were inspected: their best eight poses all lie on cups.
    // Bin 1 holds juice cartons and no cup; agreement in depth alone would accept some there, so the confidence counts.
    const SURE: f64 = 0.4;
    for bin in 1..=3 {
        for frame in 0..3 {
            let depth = read_depth(&folder.join(format!("{bin}/depth/{frame:04}.png")), 1e-3).unwrap();
            let scene = DepthRegion::from_depth(&depth, &camera, None, &DepthOptions::default()).unwrap();
            let (found, _) = find(&scene, &mesh, 8, &[]);
            let sure: Vec<_> = found.iter().filter(|e| e.confidence > SURE).collect();
            let each: Vec<_> = found
                .iter()
                .map(|e| {
                    format!(
                        "{:.2} (S_D {:.2}, seen {:.2})",
                        e.confidence,
                        e.score.depth,
                        e.score.visible_fraction()
                    )
                })
                .collect();
            println!("bin {bin}, frame {frame}: {} sure: {}", sure.len(), each.join(", "));
            if bin == 1 {
                assert!(sure.len() <= 1, "bin 1, frame {frame}: {} false cups", sure.len());
            } else {
                assert!(sure.len() >= 4, "bin {bin}, frame {frame}: {}", sure.len());
                assert!(sure.iter().all(|e| e.score.depth > 0.7), "bin {bin}, frame {frame}");
            }
        }
    }
}
