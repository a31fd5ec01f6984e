//! Templates on real depth images of five sensors, without being told where to look: objects from meshes, and from one masked
//! view each.
//!
//! The images are third-party data that is not part of the repository: the folder is `SIXFOLD_DATA`, or
//! `../shared/data` beside the repository. Without it every test says that it was skipped.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use sixfold_align::{DepthOptions, DepthRegion, verification_mesh};
use sixfold_bop::{BopDataset, Models};
use sixfold_geometry::{Camera, KdTree, Pose, Vec3};
use sixfold_io::{read_depth, read_mask};
use sixfold_mesh::{Mesh, Unit, read_mesh};
use sixfold_mttm::model::MttmModel;
use sixfold_mttm::{
    DepthView, KnownObject, MatchedBy, MttmOptions, ObjectTemplates, Search, TemplateOptions, ViewCoverage,
};

fn data() -> Option<PathBuf> {
    let folder = std::env::var_os("SIXFOLD_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"), PathBuf::from);
    if folder.is_dir() {
        return Some(folder);
    }
    println!("skipped: no shared data at {}", folder.display());
    None
}

/// Mean distance of corresponding points, or to the nearest one for what looks alike from several sides.
fn error(points: &[Vec3], estimated: &Pose, truth: &Pose, symmetric: bool) -> f64 {
    let points: Vec<Vec3> = points.iter().step_by(points.len() / 1000 + 1).copied().collect();
    let there: Vec<Vec3> = points.iter().map(|p| estimated.transform_point(p)).collect();
    let tree = KdTree::new(&there);
    let one = |(i, p): (usize, &Vec3)| {
        let p = truth.transform_point(p);
        if symmetric { tree.nearest(&p).map_or(f64::INFINITY, |n| n.distance) } else { (there[i] - p).norm() }
    };
    points.iter().enumerate().map(one).sum::<f64>() / points.len() as f64
}

fn known(mesh: &Mesh, coverage: ViewCoverage, network: &Arc<MttmModel>) -> KnownObject {
    let options = TemplateOptions { coverage, ..TemplateOptions::default() };
    let templates = ObjectTemplates::from_mesh(mesh, &options).unwrap();
    let model = verification_mesh(mesh).unwrap();
    KnownObject::new(templates, Some(model)).with_network(network.clone())
}

fn network() -> Arc<MttmModel> {
    Arc::new(MttmModel::shipped().unwrap())
}

#[test]
fn objects_of_lmo_frame_3_in_clutter() {
    let Some(data) = data() else { return };
    let dataset = BopDataset::open(&data.join("lmo"), "test").unwrap();
    let frame = dataset.scene(2).unwrap();
    let depth = frame.depth(3).unwrap().unwrap();
    let scene =
        DepthRegion::from_depth(&depth, &frame.camera(3).unwrap(), None, &DepthOptions::default()).unwrap();
    let infos = dataset.models_info(Models::Rendering).unwrap().unwrap();
    let network = network();
    let ways = [MatchedBy::Points, MatchedBy::Network, MatchedBy::Both];
    let searches = ways.map(|_| Search::new(&scene));
    let mut right = [0; 3];
    // The ape (1) is 9 % and the egg box (10) 40 % visible.
    for id in [5, 6, 8, 9, 11, 12, 1, 10] {
        let mesh = dataset.model(id, Models::Rendering).unwrap();
        let info = &infos.0[&id];
        let object = known(&mesh, ViewCoverage::Above, &network);
        let truth =
            frame.image(3).unwrap().ground_truth.iter().find(|g| g.obj_id == id).unwrap().camera_from_object;
        for (k, matched_by) in ways.into_iter().enumerate() {
            let options = MttmOptions { matched_by, min_score: 0.0, ..MttmOptions::default() };
            let (found, _) = searches[k].estimate(&object, &options);
            let off = found.first().map_or(f64::INFINITY, |e| {
                error(mesh.vertices(), &e.camera_from_object, &truth, info.is_symmetric()) / info.diameter
            });
            right[k] += usize::from(off < 0.1);
            println!(
                "LM-O frame 3, object {id}, {matched_by:?}: ADD(-S) {off:.3} of the diameter, confidence {:.2}",
                found.first().map_or(0.0, |e| e.confidence)
            );
        }
    }
    println!("LM-O frame 3: by points {}, by the network {}, by both {} of 8", right[0], right[1], right[2]);
    assert!(right[1] >= 5 && right[2] >= 5 && right[2] > right[0], "{right:?}");
}

#[test]
fn objects_of_two_ycbv_frames() {
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
    let network = network();
    let mut right = 0;
    for im_id in frames.image_ids() {
        let depth = frames.depth(im_id).unwrap().unwrap();
        let scene =
            DepthRegion::from_depth(&depth, &frames.camera(im_id).unwrap(), None, &DepthOptions::default())
                .unwrap();
        let search = Search::new(&scene);
        for g in &frames.image(im_id).unwrap().ground_truth {
            let name = names.iter().find(|n| n.0 == g.obj_id).unwrap().1;
            let points =
                read_mesh(data.join(format!("ycbv_keyframe_poses/points/{name}/points.xyz")), Unit::Metre)
                    .unwrap();
            let object = known(&points.surfels().unwrap(), ViewCoverage::Around, &network);
            let (found, _) = search.estimate(&object, &MttmOptions::default());
            let off = found.first().map_or(f64::INFINITY, |e| {
                error(points.vertices(), &e.camera_from_object, &g.camera_from_object, true)
                    / points.diameter()
            });
            println!(
                "YCB-V frame {im_id}, {name}: ADD-S {off:.3} of the diameter, confidence {:.2}",
                found.first().map_or(0.0, |e| e.confidence)
            );
            right += usize::from(off < 0.1);
        }
    }
    println!("YCB-V: {right} of 7 by ADD-S");
    assert!(right >= 5, "{right} of 7");
}

#[test]
fn the_object_of_the_tyol_frame() {
    let Some(data) = data() else { return };
    let dataset = BopDataset::open(&data.join("tyol_frame"), "test").unwrap();
    let frames = dataset.scene(dataset.scene_ids()[0]).unwrap();
    let depth = frames.depth(10).unwrap().unwrap();
    let scene =
        DepthRegion::from_depth(&depth, &frames.camera(10).unwrap(), None, &DepthOptions::default()).unwrap();
    let mesh = read_mesh(data.join("tyol_frame/obj.ply"), Unit::Millimetre).unwrap();
    let object = known(&mesh, ViewCoverage::Around, &network());
    let options = MttmOptions { max_instances: 5, ..MttmOptions::default() };
    let (found, _) = Search::new(&scene).estimate(&object, &options);
    let truth = frames.image(10).unwrap().ground_truth[0].camera_from_object;
    let off: Vec<f64> = found
        .iter()
        .map(|e| error(mesh.vertices(), &e.camera_from_object, &truth, false) / mesh.diameter())
        .collect();
    let sure: Vec<f64> = found.iter().map(|e| e.confidence).collect();
    println!("TYO-L: ADD {off:.3?} of the diameter, confidence {sure:.2?}");
    // Not the first: a quarter of the basket's true pose disagrees with what the sensor saw of it, and the wall behind it is
    // flat.
    assert!(off.iter().any(|off| *off < 0.1), "{off:?}");
}

#[test]
fn cups_in_bins() {
    let Some(data) = data() else { return };
    let camera = Camera::new(550.0, 540.0, 316.0, 244.0, 640, 480).unwrap();
    let folder = data.join("icbin_frames");
    let mesh = read_mesh(folder.join("2/model.ply"), Unit::Millimetre).unwrap();
    let object = known(&mesh, ViewCoverage::Around, &network());
    let mut best = [0f64; 3];
    for bin in 1..=3 {
        let depth = read_depth(&folder.join(format!("{bin}/depth/0000.png")), 1e-3).unwrap();
        let scene = DepthRegion::from_depth(&depth, &camera, None, &DepthOptions::default()).unwrap();
        let options = MttmOptions { max_instances: 8, ..MttmOptions::default() };
        let (found, _) = Search::new(&scene).estimate(&object, &options);
        let each: Vec<String> = found.iter().map(|e| format!("{:.2}", e.confidence)).collect();
        println!("bin {bin}: {}", each.join(", "));
        best[bin - 1] = found.first().map_or(0.0, |e| e.confidence);
    }
    // Bin 1 holds juice cartons and no cup.
    assert!(best[1] > best[0] && best[2] > best[0], "{best:?}");
}

#[test]
fn objects_seen_once_and_tables_without_them() {
    let Some(data) = data() else { return };
    let network = network();
    let views: Vec<PathBuf> = folders(&data.join("tabletop_objects"));
    let camera_of = |folder: &Path| {
        let text = std::fs::read_to_string(folder.join("camera.json")).unwrap();
        let value: serde_json::Value = serde_json::from_str(&text).unwrap();
        let k = |i: usize| value["cam_K"][i].as_f64().unwrap();
        Camera::new(k(0), k(4), k(2), k(5), 640, 480).unwrap()
    };
    let mut objects = vec![];
    let mut scenes = vec![];
    for folder in &views {
        let (camera, depth) = (camera_of(folder), read_depth(&folder.join("depth.png"), 1e-4).unwrap());
        let mask = read_mask(&folder.join("mask.png")).unwrap();
        let view = DepthView { depth: &depth, camera: &camera, mask: &mask, camera_from_object: None };
        let templates = ObjectTemplates::from_depth(&[view], &TemplateOptions::default()).unwrap();
        objects.push(KnownObject::new(templates, None).with_network(network.clone()));
        scenes.push(DepthRegion::from_depth(&depth, &camera, None, &DepthOptions::default()).unwrap());
    }
    let options = MttmOptions { min_score: 0.0, ..MttmOptions::default() };
    let sure = |search: &Search<'_>, object: &KnownObject| {
        search.estimate(object, &options).0.first().map_or(0.0, |e| e.confidence)
    };
    let mut own_first = 0;
    for (i, scene) in scenes.iter().enumerate() {
        let search = Search::new(scene);
        let all: Vec<f64> = objects.iter().map(|o| sure(&search, o)).collect();
        println!("{}: {all:.2?}", views[i].file_name().unwrap_or_default().display());
        own_first += usize::from(all.iter().all(|c| *c <= all[i]));
    }
    // Tables with other boxes, cans and mugs, seen by a Kinect.
    let kinect = Camera::new(525.0, 525.0, 319.5, 239.5, 640, 480).unwrap();
    let tables = folders(&data.join("osd"));
    let mut highest = vec![];
    for folder in tables.iter().step_by(4) {
        let depth = read_depth(&folder.join("depth.png"), 1e-3).unwrap();
        let scene = DepthRegion::from_depth(&depth, &kinect, None, &DepthOptions::default()).unwrap();
        let search = Search::new(&scene);
        let best = objects.iter().map(|o| sure(&search, o)).fold(0.0, f64::max);
        highest.push(best);
    }
    println!("tables without them, highest confidence: {highest:.2?}");
    assert!(own_first >= 5, "{own_first} of 6 in their own view");
}

fn folders(of: &Path) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = std::fs::read_dir(of)
        .unwrap()
        .filter_map(|e| e.ok().map(|e| e.path()))
        .filter(|p| p.join("depth.png").is_file())
        .collect();
    found.sort();
    found
}
