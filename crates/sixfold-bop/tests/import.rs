//! Datasets of other formats, from files as their authors' scripts write them (`fixtures/import/make.py`), converted and read again
//! as BOP datasets.

use std::path::{Path, PathBuf};

use sixfold_bop::import::{
    Ho3dOptions, NolOptions, SmotOptions, import_ho3d, import_nol, import_smot, parsers,
};
use sixfold_bop::{BopDataset, MaskKind, Models};
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Camera, DepthImage, Image, Pose, RgbImage, Vec3};
use sixfold_io::{write_depth, write_rgb};
use sixfold_mesh::{Mesh, PlyFormat, Unit, write_ply};
use sixfold_render::render_depth;
use tempfile::TempDir;

/// Metres per unit of HO-3D's depth.
const HO3D_UNIT: f64 = 0.000_124_986_647_279_001_77;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/import").join(name)
}

/// A box of 10x8x6 cm with a corner at the origin.
fn cuboid() -> Mesh {
    let corner = |i: u32| {
        Vec3::new(0.1 * f64::from(i >> 2 & 1), 0.08 * f64::from(i >> 1 & 1), 0.06 * f64::from(i & 1))
    };
    let sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
    let faces = sides.iter().flat_map(|s| [[s[0], s[1], s[2]], [s[0], s[2], s[3]]]).collect();
    Mesh::new((0..8).map(corner).collect(), faces).unwrap()
}

fn camera() -> Camera {
    Camera::new(60.0, 62.0, 31.5, 23.5, 64, 48).unwrap()
}

/// The pose in the meta files: a rotation by 90 degrees about z in OpenGL's frame, whose y and z are the negative of ours.
fn ho3d_pose() -> Pose {
    let rotation = UnitQuaternion::from_euler_angles(std::f64::consts::PI, 0.0, 0.0)
        * UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2);
    Pose::new(rotation, Vec3::new(0.01, -0.02, 0.5))
}

/// HO-3D with one sequence: the meta files `metas`, one image each.
fn ho3d(metas: &[&str], edit: impl Fn(Vec<u8>) -> Vec<u8>) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let sequence = dir.path().join("train/ABF10");
    for folder in ["rgb", "depth", "meta"] {
        std::fs::create_dir_all(sequence.join(folder)).unwrap();
    }
    let depth = render_depth(&cuboid(), &ho3d_pose(), &camera());
    // A hand over the left part, at a distance of 0.3 m.
    let depth = DepthImage::from_fn(64, 48, |x, y| if x < 28 { 0.3 } else { depth[(x, y)] });
    let spread = |x: usize, y: usize| {
        let units = (f64::from(depth[(x, y)]) / HO3D_UNIT).round() as u32;
        [(units & 255) as u8, (units >> 8) as u8, 0]
    };
    for (i, meta) in metas.iter().enumerate() {
        write_rgb(&sequence.join(format!("rgb/{i:04}.png")), &RgbImage::filled(64, 48, [i as u8; 3]))
            .unwrap();
        write_rgb(&sequence.join(format!("depth/{i:04}.png")), &Image::from_fn(64, 48, spread)).unwrap();
        let bytes = edit(std::fs::read(fixture(meta)).unwrap());
        std::fs::write(sequence.join(format!("meta/{i:04}.pkl")), bytes).unwrap();
    }
    let model = dir.path().join("ycb/003_cracker_box");
    std::fs::create_dir_all(&model).unwrap();
    let mut obj = String::new();
    for v in cuboid().vertices() {
        obj += &format!("v {} {} {}\n", v.x, v.y, v.z);
    }
    for f in cuboid().faces() {
        obj += &format!("f {} {} {}\n", f[0] + 1, f[1] + 1, f[2] + 1);
    }
    std::fs::write(model.join("textured_simple.obj"), obj).unwrap();
    dir
}

fn ho3d_options(dir: &Path) -> Ho3dOptions {
    Ho3dOptions { split: "train".into(), models: dir.join("ycb"), sequences: vec![], every: 1 }
}

const METAS: [&str; 5] = [
    "meta_python2_protocol0.pkl",
    "meta_python2_protocol2.pkl",
    "meta_python3_protocol2.pkl",
    "meta_python3_protocol4.pkl",
    "meta_python3_protocol5.pkl",
];

#[test]
fn ho3d_reads_the_same_from_every_protocol_of_pickle() {
    let all = [&METAS[..], &["meta_without_pose.pkl"]].concat();
    let dir = ho3d(&all, |bytes| bytes);
    let out = dir.path().join("out");
    let summary = import_ho3d(dir.path(), &out, &ho3d_options(dir.path()), &()).unwrap();
    assert_eq!((summary.scenes, summary.images, summary.without_poses), (1, 5, 1));
    let dataset = BopDataset::open(&out, "train").unwrap();
    let scene = dataset.scene(1).unwrap();
    assert_eq!(scene.image_ids(), [0, 1, 2, 3, 4]);
    for im_id in scene.image_ids() {
        let image = scene.image(im_id).unwrap();
        let [truth] = &image.ground_truth[..] else { panic!("{image:?}") };
        assert_eq!(truth.obj_id, 3);
        // The rotation has 32 bits in the file.
        assert!(truth.camera_from_object.rotation_angle_to(&ho3d_pose()) < 1e-7, "{im_id}");
        assert!(truth.camera_from_object.distance_to(&ho3d_pose()) < 1e-12, "{im_id}");
        let c = scene.camera(im_id).unwrap();
        assert_eq!((c.fx, c.fy, c.cx, c.cy, c.width, c.height), (60.0, 62.0, 31.5, 23.5, 64, 48));
        assert_eq!(scene.rgb(im_id).unwrap().unwrap()[(5, 5)], [im_id as u8; 3]);
        // Depth is accurate to half a unit, and the part covered by the hand is not visible.
        let depth = scene.depth(im_id).unwrap().unwrap();
        assert!((f64::from(depth[(3, 3)]) - 0.3).abs() < HO3D_UNIT, "{}", depth[(3, 3)]);
        let visible = scene.mask(im_id, 0, MaskKind::Visible).unwrap().unwrap();
        let full = scene.mask(im_id, 0, MaskKind::Full).unwrap().unwrap();
        let count = |x0: usize, mask: &sixfold_geometry::Mask| {
            (0..48).flat_map(|y| (x0..64).map(move |x| (x, y))).filter(|&p| mask[p]).count()
        };
        assert!(count(0, &full) > count(28, &full) && count(28, &full) > 10);
        assert_eq!(count(0, &visible), count(28, &full));
        let fraction = image.info.as_ref().unwrap()[0].visib_fract;
        assert!((fraction - count(28, &full) as f64 / count(0, &full) as f64).abs() < 1e-12, "{fraction}");
    }
    let model = dataset.model(3, Models::Rendering).unwrap();
    assert!((model.diameter() - cuboid().diameter()).abs() < 1e-7);
}

#[test]
fn ho3d_takes_every_nth_image_of_chosen_sequences() {
    let dir = ho3d(&METAS, |bytes| bytes);
    let options = Ho3dOptions { every: 2, ..ho3d_options(dir.path()) };
    assert_eq!(import_ho3d(dir.path(), &dir.path().join("out"), &options, &()).unwrap().images, 3);
    let options = Ho3dOptions { sequences: vec!["MC1".into()], ..options };
    let error = import_ho3d(dir.path(), &dir.path().join("two"), &options, &()).unwrap_err().to_string();
    assert!(error.contains("MC1") && error.contains("ABF10"), "{error}");
}

#[test]
fn errors_of_a_meta_file_are_named() {
    let convert = |edit: &dyn Fn(Vec<u8>) -> Vec<u8>| {
        let dir = ho3d(&["meta_python3_protocol4.pkl"], edit);
        import_ho3d(dir.path(), &dir.path().join("out"), &ho3d_options(dir.path()), &())
            .unwrap_err()
            .to_string()
    };
    let swapped = |from: &'static [u8], to: &'static [u8]| {
        move |bytes: Vec<u8>| {
            let at = bytes.windows(from.len()).position(|w| w == from).unwrap();
            [&bytes[..at], to, &bytes[at + from.len()..]].concat()
        }
    };
    for (error, parts) in [
        (convert(&|bytes| bytes[..300].to_vec()), ["0000.pkl", "get the file again"]),
        (convert(&|_| b"I5\n.".to_vec()), ["found a number", "a dictionary"]),
        (convert(&|_| b"cposix\nsystem\n(S'true'\ntR.".to_vec()), ["unknown class", "a dictionary"]),
        (convert(&swapped(b"objTrans", b"objTranz")), ["field objTrans", "found nothing"]),
        (convert(&swapped(b"003_cracker_box", b"xxx_cracker_box")), ["field objName", "003_cracker_box"]),
        (convert(&swapped(b"003_cracker_box", b"../../../../../")), ["field objName", "YCB"]),
        (convert(&swapped(b"003_cracker_box", b"004_cracker_box")), ["004_cracker_box", "YCB-Video"]),
        // A matrix with one number fewer: the number of bytes has to match the shape.
        (convert(&swapped(b"K\x03K\x03\x86", b"K\x03K\x02\x86")), ["bytes for an array", "as many"]),
    ] {
        assert!(parts.iter().all(|part| error.contains(part)), "{error}: {parts:?}");
    }
}

#[test]
fn nol_sources_have_the_camera_of_their_part() {
    let dir = tempfile::tempdir().unwrap();
    let camera = dir.path().join("camera.json");
    // The author's camera of SMOT ends with zeros.
    std::fs::write(&camera, r#"{"width": 64, "height": 48, "cam_K": [60, 0, 31.5, 0, 62, 23.5, 0, 0, 0]}"#)
        .unwrap();
    let options = NolOptions { camera: camera.clone(), obj_id: None, split: "train".into() };
    let out = dir.path().join("out");
    let summary = import_nol(&fixture("nol_obj_07.hdf5"), &out, &options, &()).unwrap();
    assert_eq!((summary.images, summary.objects.iter().copied().collect::<Vec<_>>()), (2, vec![7]));
    let dataset = BopDataset::open(&out, "train").unwrap();
    let scene = dataset.scene(1).unwrap();
    // 24x24 pixels from (20, 12) on became 12x12: half the focal length; the centre of the first pixel is at (20.5, 12.5) of the whole.
    let c = scene.camera(0).unwrap();
    assert_eq!((c.fx, c.fy, c.width, c.height), (30.0, 31.0, 12, 12));
    assert!((c.cx - ((31.5 - 20.0 + 0.5) / 2.0 - 0.5)).abs() < 1e-12, "{c:?}");
    assert!((c.cy - ((23.5 - 12.0 + 0.5) / 2.0 - 0.5)).abs() < 1e-12, "{c:?}");
    // 36 columns and 24 rows: thirds and halves.
    let c = scene.camera(1).unwrap();
    assert!((c.fx - 20.0).abs() < 1e-12 && (c.fy - 31.0).abs() < 1e-12, "{c:?}");
    let rgb = scene.rgb(0).unwrap().unwrap();
    assert_eq!(rgb[(0, 0)], [0, 0, 51]);
    assert_eq!(rgb[(3, 6)], [128, 64, 51]);
    assert_eq!(scene.rgb(1).unwrap().unwrap()[(3, 6)], [106, 64, 51]);
    let mask = scene.mask(0, 0, MaskKind::Visible).unwrap().unwrap();
    let rows: Vec<usize> = (0..12).filter(|&y| mask[(4, y)]).collect();
    assert_eq!(rows, [3, 4, 5, 6, 7, 8, 9]);
    let pose = scene.image(1).unwrap().ground_truth[0].camera_from_object;
    assert!(pose.distance_to(&Pose::from_translation(Vec3::new(-0.05, -0.04, 0.7))) < 1e-12);
    assert!((dataset.model(7, Models::Rendering).unwrap().diameter() - cuboid().diameter()).abs() < 1e-7);

    let named = NolOptions { obj_id: Some(3), ..options.clone() };
    let summary = import_nol(&fixture("nol_obj_07.hdf5"), &dir.path().join("three"), &named, &()).unwrap();
    assert!(summary.objects.contains(&3));
    // Files that do not have this form.
    let fails = |file: &Path, parts: &[&str]| {
        let error = import_nol(file, &dir.path().join("none"), &options, &()).unwrap_err().to_string();
        assert!(parts.iter().all(|part| error.contains(part)), "{error}: {parts:?}");
    };
    fails(&fixture("chunked.hdf5"), &["chunked.hdf5", "vertices_3d", "without chunks"]);
    fails(&fixture("newest.hdf5"), &["newest.hdf5", "superblock", "libver"]);
    fails(&fixture("make.py"), &["make.py", "an HDF5 file"]);
    let cut = dir.path().join("cut.hdf5");
    let bytes = std::fs::read(fixture("nol_obj_07.hdf5")).unwrap();
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    fails(&cut, &["cut.hdf5", "cut off"]);
    std::fs::write(&camera, r#"{"width": 40, "height": 48, "cam_K": [60, 0, 31.5, 0, 62, 23.5, 0, 0, 1]}"#)
        .unwrap();
    fails(&fixture("nol_obj_07.hdf5"), &["bboxes", "40x48"]);
}

/// SMOT with one sequence of two annotated images and one that is not.
fn smot(truth: &str) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let sequence = dir.path().join("train/seq2");
    for folder in ["color", "depth"] {
        std::fs::create_dir_all(sequence.join(folder)).unwrap();
    }
    std::fs::create_dir_all(dir.path().join("models")).unwrap();
    write_ply(dir.path().join("models/obj_05.ply"), &cuboid(), Unit::Metre, PlyFormat::Ascii).unwrap();
    let intrinsics =
        r#"{"width": 64, "height": 48, "intrinsic_matrix": [60, 0, 0, 0, 62, 0, 31.5, 23.5, 1]}"#;
    std::fs::write(dir.path().join("camera_intrinsic.json"), intrinsics).unwrap();
    std::fs::write(sequence.join("scene_gt.json"), truth).unwrap();
    for i in 0..3 {
        let depth = render_depth(&cuboid(), &Pose::from_translation(Vec3::new(-0.05, -0.04, 0.6)), &camera());
        write_rgb(&sequence.join(format!("color/{i:06}.png")), &RgbImage::filled(64, 48, [9; 3])).unwrap();
        write_depth(&sequence.join(format!("depth/{i:06}.png")), &depth, 1e-3).unwrap();
    }
    dir
}

const SMOT_TRUTH: &str = r#"{"0": [{"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [-0.05, -0.04, 0.6], "obj_id": "5"}],
    "2": [{"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [-0.05, -0.04, 0.8], "obj_id": 5}]}"#;

#[test]
fn smot_is_in_metres_there_and_in_millimetres_here() {
    let dir = smot(SMOT_TRUTH);
    let out = dir.path().join("out");
    let options = SmotOptions { split: "train".into(), every: 1 };
    let summary = import_smot(dir.path(), &out, &options, &()).unwrap();
    assert_eq!((summary.scenes, summary.images, summary.without_poses), (1, 2, 1));
    let dataset = BopDataset::open(&out, "train").unwrap();
    let scene = dataset.scene(2).unwrap();
    assert_eq!(scene.image_ids(), [0, 2]);
    let of = |im_id| scene.image(im_id).unwrap();
    assert!(
        (of(0).ground_truth[0].camera_from_object.translation() - Vec3::new(-0.05, -0.04, 0.6)).norm()
            < 1e-12
    );
    assert_eq!(of(0).info.as_ref().unwrap()[0].visib_fract, 1.0);
    // The measured depth is 20 cm in front of the second pose everywhere.
    assert_eq!(of(2).info.as_ref().unwrap()[0].visib_fract, 0.0);
    let depth = scene.depth(0).unwrap().unwrap();
    assert!((depth[(32, 24)] - 0.6).abs() < 5e-4, "{}", depth[(32, 24)]);
    let model = dataset.model(5, Models::Rendering).unwrap();
    assert!((model.diameter() - cuboid().diameter()).abs() < 1e-7);
    let text = std::fs::read_to_string(out.join("train/000002/scene_gt.json")).unwrap();
    assert!(text.contains("600.0"), "{text}");
}

#[test]
fn errors_of_smot_are_named() {
    let options = SmotOptions { split: "train".into(), every: 1 };
    let convert = |from: &str, to: &str| {
        let dir = smot(&SMOT_TRUTH.replace(from, to));
        import_smot(dir.path(), &dir.path().join("out"), &options, &()).unwrap_err().to_string()
    };
    for (error, parts) in [
        (convert("0.6]", "600]"), ["cam_t_m2c", "millimetres"]),
        (convert("\"5\"", "\"five\""), ["obj_id", "five"]),
        (convert("\"obj_id\": 5", "\"obj_id\": 6"), ["obj_06.ply", "No such file"]),
        (convert("\"cam_t_m2c\": [-0.05, -0.04, 0.8], ", ""), ["im_id 2", "cam_t_m2c"]),
        (convert("\"2\": ", "\"2\" "), ["scene_gt.json", "not valid JSON"]),
    ] {
        assert!(parts.iter().all(|part| error.contains(part)), "{error}: {parts:?}");
    }
    let missing = SmotOptions { split: "test".into(), every: 1 };
    let dir = smot(SMOT_TRUTH);
    let error = import_smot(dir.path(), &dir.path().join("out"), &missing, &()).unwrap_err().to_string();
    assert!(error.contains("test") && error.contains("seq1"), "{error}");
}

#[test]
fn no_bytes_make_the_readers_panic() {
    // Every byte of the files is changed in three ways, and the files are truncated to every length.
    let names = ["vertices_3d", "faces", "images", "poses", "masks", "bboxes"];
    let mut read = 0;
    for name in METAS.iter().chain(&["nol_obj_07.hdf5", "chunked.hdf5", "newest.hdf5"]) {
        let bytes = std::fs::read(fixture(name)).unwrap();
        let check = |bytes: &[u8]| match name.ends_with("pkl") {
            true => usize::from(parsers::pickle(bytes)),
            false => parsers::hdf5(bytes, &names).map_or(0, |n| n.min(1)),
        };
        for at in 0..bytes.len() {
            check(&bytes[..at]);
            for change in [0x01, 0x80, 0xff] {
                let mut changed = bytes.clone();
                changed[at] ^= change;
                read += check(&changed);
            }
        }
        let foreign = matches!(*name, "chunked.hdf5" | "newest.hdf5");
        assert_eq!(check(&bytes), usize::from(!foreign), "{name}");
    }
    assert!(
        read > 1000,
        "only {read} changed files could be read: the changes reach nothing but the signatures"
    );
}

#[test]
fn a_pickle_that_uses_its_bytes_again_and_again_is_refused() {
    // An array of 60 kB, made again from the same bytes by every three of the following bytes.
    let mut bytes = b"\x80\x04}\x94cnumpy.core.numeric\n_frombuffer\n\x94".to_vec();
    bytes.extend(b"B");
    bytes.extend(60_000u32.to_le_bytes());
    bytes.extend(vec![0; 60_000]);
    bytes.extend(b"cnumpy\ndtype\nU\x02u1\x85R");
    bytes.extend(b"M\x60\xea\x85\x87\x94");
    for _ in 0..100_000 {
        bytes.extend(b"h\x01h\x02R0");
    }
    bytes.extend(b".");
    assert!(!parsers::pickle(&bytes));
}
