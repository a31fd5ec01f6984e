//! Checks of each reader's result for any bytes: finite, within bounds, consistent. All imports of readers are here.

use std::path::{Path, PathBuf};

use sixfold_align::VerificationMesh;
use sixfold_bop::import::parsers;
use sixfold_bop::{
    CocoGroundTruth, IouType, ReadDetections, Rle, evaluate_coco, parse_detections, parse_results,
    parse_scene_camera, parse_scene_gt, parse_scene_gt_info, parse_targets,
};
use sixfold_estimator::{Object, ObjectStore};
#[cfg(feature = "networks")]
use sixfold_experience::{ExperienceStore, Position, SqliteStore};
use sixfold_geometry::{Pose, Vec2};
use sixfold_grasp::learned::{HeightGrid, parse_haf, write_haf};
use sixfold_grasp::parse_gripper;
use sixfold_io::{CameraFile, ImageFile, max_pixels};
use sixfold_mesh::{
    Mesh, ModelInfo, ModelsInfo, Unit, no_resources, parse_gltf, parse_obj, parse_ply, parse_stl, parse_xyz,
};
#[cfg(feature = "networks")]
use sixfold_mttm::ObjectTemplates;
#[cfg(feature = "networks")]
use sixfold_nn::pretrained::PretrainedFile;
#[cfg(feature = "networks")]
use sixfold_nn::training_log::read_training_log;
#[cfg(feature = "networks")]
use sixfold_nn::weights::read_card;
use sixfold_ppf::ObjectModel;

use crate::mutate::with_png_checksums;
use crate::seeds;

/// Runs a reader of paths on bytes, in a separate file with this name.
fn with_file<T>(name: &str, bytes: &[u8], read: impl FnOnce(&Path) -> T) -> T {
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    let path: PathBuf = folder.path().join(name);
    std::fs::write(&path, bytes).expect("a temporary file can be written");
    read(&path)
}

fn finite(pose: &Pose) -> bool {
    pose.to_matrix().iter().all(|v| v.is_finite())
        && (pose.rotation_matrix().determinant() - 1.0).abs() < 1e-6
}

fn mesh(mesh: &Mesh) {
    let count = mesh.vertices().len();
    assert!(mesh.vertices().iter().all(|v| v.iter().all(|c| c.is_finite())), "vertices are finite");
    assert!(mesh.faces().iter().flatten().all(|&i| (i as usize) < count), "faces name vertices");
    let diameter = mesh.diameter();
    assert!(diameter >= 0.0, "a diameter is no negative number and not NaN");
    let from_first = mesh.vertices().iter().map(|v| (v - mesh.vertices()[0]).norm()).fold(0.0, f64::max);
    assert!(diameter * (1.0 + 1e-9) >= from_first, "no two vertices are further apart than the diameter");
    let (low, high) = mesh.bounding_box();
    assert!(diameter <= (high - low).norm() * (1.0 + 1e-9), "the diameter is within the box");
    let normals = mesh.vertex_normals();
    assert_eq!(normals.len(), count, "a normal for each vertex");
    let unit = |n: &sixfold_geometry::Vec3| (n.norm() - 1.0).abs() < 1e-6 || n.norm() == 0.0;
    assert!(normals.iter().all(unit), "a normal is a direction, or zero where it is not known");
    let once = mesh.without_repeated_faces();
    assert!(once.faces().len() <= mesh.faces().len() && once.vertices() == mesh.vertices());
    if let Ok(surface) = mesh.surfels() {
        assert!(surface.faces().len() <= 4 * count, "four faces for each point");
    }
    assert!(mesh.colors().is_none_or(|c| c.len() == count), "a colour for each vertex");
    assert!(mesh.texcoords().is_none_or(|t| t.len() == count), "texture coordinates for each vertex");
    assert!(mesh.sample_surface(3, 0).points.len() <= 3, "no more samples than asked for");
}

pub(crate) fn ply(bytes: &[u8]) {
    if let Ok(read) = parse_ply(bytes, "fuzz.ply", Unit::Millimetre, &no_resources) {
        mesh(&read);
    }
}

pub(crate) fn obj(bytes: &[u8]) {
    // The same bytes serve as the material file and as the texture.
    let resources = |_: &str| Ok(bytes.to_vec());
    if let Ok(read) = parse_obj(bytes, "fuzz.obj", Unit::Millimetre, &resources) {
        mesh(&read);
    }
}

pub(crate) fn stl(bytes: &[u8]) {
    if let Ok(read) = parse_stl(bytes, "fuzz.stl", Unit::Millimetre, &no_resources) {
        mesh(&read);
    }
}

pub(crate) fn gltf(bytes: &[u8]) {
    if let Ok(read) = parse_gltf(bytes, "fuzz.gltf", Unit::Millimetre, &no_resources) {
        mesh(&read);
    }
}

pub(crate) fn xyz(bytes: &[u8]) {
    if let Ok(read) = parse_xyz(bytes, "fuzz.xyz", Unit::Millimetre, &no_resources) {
        assert!(read.faces().is_empty(), "points have no faces");
        mesh(&read);
    }
}

pub(crate) fn models_info(bytes: &[u8]) {
    if let Ok(infos) = ModelsInfo::parse(bytes, "fuzz.json") {
        for info in infos.0.values() {
            assert!(info.diameter.is_finite() && info.diameter > 0.0, "a diameter is a length");
            let symmetries = info.symmetry_poses(1.0);
            assert!(!symmetries.is_empty(), "the identity at least");
            assert!(symmetries.iter().all(finite), "symmetries are rigid");
            let scored = info.symmetry_poses(ModelInfo::BOP_MAX_STEP).len();
            assert!(scored <= 16_384, "{scored} symmetries are more than anyone can wait for");
        }
    }
}

pub(crate) fn scene_files(bytes: &[u8]) {
    let path = Path::new("fuzz.json");
    for camera in parse_scene_camera(bytes, path).unwrap_or_default().values() {
        assert!(camera.fx > 0.0 && camera.fy > 0.0, "focal lengths are positive");
        assert!((0.5..=2.0).contains(&(camera.fx / camera.fy)), "{camera:?}");
        assert!([camera.fx, camera.fy, camera.cx, camera.cy].iter().all(|v| v.is_finite()), "{camera:?}");
        assert!(camera.depth_scale.is_none_or(|s| s.is_finite() && s > 0.0), "{camera:?}");
        assert!(camera.camera_from_world.iter().all(finite), "{camera:?}");
    }
    for truth in parse_scene_gt(bytes, path).unwrap_or_default().values().flatten() {
        assert!(finite(&truth.camera_from_object), "{truth:?}");
    }
    for info in parse_scene_gt_info(bytes, path).unwrap_or_default().values().flatten() {
        assert!((0.0..=1.0).contains(&info.visib_fract), "{info:?}");
        for b in [info.bbox_obj, info.bbox_visib].into_iter().flatten() {
            assert!(b.width >= 0.0 && b.height >= 0.0, "{info:?}");
        }
    }
    let _ = parse_targets(bytes, path);
}

pub(crate) fn coco(bytes: &[u8]) {
    let path = Path::new("fuzz.json");
    let (width, height) = (640, 480);
    let options = ReadDetections { lenient: true, image_size: Some((width, height)) };
    let found = parse_detections(bytes, path, &options).unwrap_or_default();
    for d in &found.detections {
        assert!(d.score.is_finite(), "{d:?}");
        if let Some(b) = d.bbox {
            assert!(b.width > 0.0 && b.height > 0.0, "{d:?}");
            assert!(b.x >= 0.0 && b.x + b.width <= width as f64 + 1e-6, "{d:?}");
            assert!(b.y >= 0.0 && b.y + b.height <= height as f64 + 1e-6, "{d:?}");
        }
    }
    let mut truth = CocoGroundTruth::default();
    let _ = truth.add_scene(0, bytes, path);
    for kind in [IouType::Box, IouType::Mask] {
        let scores = evaluate_coco(&truth, &found.detections, kind);
        for score in [scores.ap, scores.ap50, scores.ap75, scores.ar100].into_iter().flatten() {
            assert!((0.0..=1.0).contains(&score), "{scores:?}");
        }
    }
}

/// The first two bytes are the mask's size.
pub(crate) fn rle(bytes: &[u8]) {
    let [width, height, text @ ..] = bytes else { return };
    let Ok(text) = std::str::from_utf8(text) else { return };
    if let Ok(rle) = Rle::from_compressed((*width).into(), (*height).into(), text) {
        let again = Rle::from_compressed((*width).into(), (*height).into(), &rle.to_compressed());
        assert_eq!(again.as_ref(), Ok(&rle), "what decodes encodes to itself");
        let mask = rle.decode();
        let area = mask.as_slice().iter().filter(|p| **p).count();
        assert_eq!(area as u64, rle.area());
        assert_eq!(rle.intersection(&rle), Some(rle.area()));
    }
}

pub(crate) fn results(bytes: &[u8]) {
    let (estimates, bad) = parse_results(&String::from_utf8_lossy(bytes));
    for e in &estimates {
        assert!(e.score.is_finite() && finite(&e.camera_from_object), "{e:?}");
        assert!(e.time.is_none_or(f64::is_finite), "{e:?}");
    }
    let lines = bytes.iter().filter(|b| matches!(b, b'\n' | b'\r')).count() + 1;
    assert!(estimates.len() + bad.len() <= lines, "no more rows than lines");
}

/// Meta files of HO-3D: only data, whatever functions they would call.
pub(crate) fn pickle(bytes: &[u8]) {
    parsers::pickle(bytes);
}

/// Source images of NOL: no more numbers than the file has bytes for.
pub(crate) fn hdf5(bytes: &[u8]) {
    let count = parsers::hdf5(bytes, &["faces"]).unwrap_or(0);
    assert!(count <= bytes.len(), "every number takes a byte");
}

pub(crate) fn camera(bytes: &[u8]) {
    with_file("camera.json", bytes, |path| {
        let Ok(file) = CameraFile::read(path) else { return };
        assert!(file.depth_scale.is_none_or(|s| s.is_finite() && s > 0.0), "{file:?}");
        file.camera.check().expect("a camera that was read is a camera");
        if file.sized {
            file.camera
                .check_whole_image()
                .expect("a camera that states its image's size is one of a whole image");
            assert!((file.camera.width * file.camera.height) as u64 <= max_pixels(), "{file:?}");
        }
        if let Ok(camera) = file.for_image(640, 480, path) {
            camera.check_whole_image().expect("a camera of an image is one of a whole image");
            assert_eq!((camera.width, camera.height), (640, 480));
            for (x, y) in [(0.0, 0.0), (639.0, 0.0), (0.0, 479.0), (639.0, 479.0)] {
                let (pixel, raw) = (Vec2::new(x, y), camera.distort_point(&Vec2::new(x, y)));
                let point = camera.unproject(&pixel, 1.0);
                assert!(point.norm() < 20.0 && raw.iter().all(|v| v.is_finite()), "{camera:?}");
                let back = camera.project(&point).expect("a point before the camera");
                assert!((back - pixel).norm() < 1e-6, "{camera:?}");
            }
        }
    });
}

/// Largest image that is decoded under test, pixels.
const PIXELS: u64 = 1 << 16;

/// The bytes as they are, and with the checksums of a PNG.
pub(crate) fn images(bytes: &[u8]) {
    for bytes in [bytes.to_vec(), with_png_checksums(bytes.to_vec())] {
        image(&bytes);
    }
}

fn image(bytes: &[u8]) {
    let file = ImageFile::of_bytes(Path::new("image.png"), bytes).with_limit(PIXELS);
    let size = file.size().ok();
    if let Some((width, height)) = size {
        assert!(width > 0 && height > 0 && (width * height) as u64 <= PIXELS, "{width}x{height}");
    }
    if let Ok(image) = file.rgb() {
        assert_eq!(Some(image.size()), size, "the header says the size");
    }
    if let Ok(Some(focal_length)) = file.focal_length() {
        assert!(focal_length.is_finite() && focal_length > 0.0, "{focal_length}");
    }
    let mask = file.mask();
    if let Ok(mask) = &mask {
        assert_eq!(mask.as_slice().len(), mask.width() * mask.height());
        assert_eq!(Some(mask.size()), size, "the header says the size");
    }
    if let (Ok(units), Ok(depth)) = (file.units(), file.depth(0.001)) {
        assert!(depth.as_slice().iter().all(|d| d.is_finite() && *d >= 0.0), "depth is a length");
        let mask = mask.expect("what is grey is a mask");
        let lost = units.as_slice().iter().zip(mask.as_slice()).filter(|(u, m)| (**u > 0) != **m).count();
        assert_eq!(lost, 0, "pixels are in the mask where they are not zero");
    }
}

#[cfg(feature = "networks")]
pub(crate) fn weights(bytes: &[u8]) {
    with_file("model.safetensors", bytes, |path| {
        let _ = read_card(path);
        if let Ok(file) = PretrainedFile::open(path) {
            for (name, shape) in file.tensors() {
                let size = shape.iter().try_fold(1usize, |product, side| product.checked_mul(*side));
                assert!(size.is_some_and(|s| s <= bytes.len()), "{name} {shape:?} fits into its file");
            }
        }
    });
}

/// A damaged description is made again, so the object is described in any case.
pub(crate) fn ppf(bytes: &[u8]) {
    with_file("object.sixfold-ppf", bytes, |path| {
        let described = ObjectModel::cached(path, &seeds::tetrahedron(), &[], &seeds::coarse());
        let (model, _) =
            described.expect("a file of any content does not keep an object from being described");
        let (samples, tetrahedron) = (model.samples(), seeds::tetrahedron());
        assert_eq!(model.diameter(), tetrahedron.diameter(), "the diameter is that of the mesh");
        assert_eq!(samples.points.len(), samples.normals.len());
        assert!((20..=16_000).contains(&samples.len()), "samples within bounds");
        let on_it = |p: &sixfold_geometry::Vec3| p.norm() < 0.2;
        assert!(samples.points.iter().all(on_it), "samples lie on the object");
        assert!(samples.normals.iter().all(|n| (n.norm() - 1.0).abs() < 1e-5), "normals are directions");
        assert!(!model.mesh().faces().is_empty(), "there is something to render");
        mesh(model.mesh());
    });
}

/// A damaged mesh for verification is simplified again.
pub(crate) fn verification_mesh(bytes: &[u8]) {
    with_file("verification-mesh.bin", bytes, |path| {
        let fine = seeds::fine();
        let kept = VerificationMesh::cached(Some(path), &fine);
        let kept = kept.expect("a file of any content does not keep a mesh from being verified").mesh;
        assert!(!kept.faces().is_empty() && kept.faces().len() <= fine.faces().len());
        assert!(kept.vertices().iter().all(|v| v.norm() < 1.0), "it lies where the mesh lies");
        mesh(&kept);
    });
}

/// An object of a store is loaded as a whole or not at all.
fn stored(record: &[u8], mesh_file: &[u8]) {
    let root = tempfile::tempdir().expect("a temporary folder can be made");
    let folder = root.path().join("part");
    std::fs::create_dir(&folder).expect("a folder can be made");
    for (name, bytes) in [("object.json", record), ("mesh.ply", mesh_file)] {
        std::fs::write(folder.join(name), bytes).expect("a temporary file can be written");
    }
    let store = ObjectStore::new(root.path());
    assert_eq!(store.names().expect("a store can be listed"), ["part"]);
    if let Ok(Object { mesh: Some(read), info: Some(info), .. }) = store.load("part") {
        mesh(&read);
        assert!((0.004..=20.0).contains(&info.diameter), "the diameter is that of an object");
        assert!((info.diameter - read.diameter()).abs() < 1e-9, "and of its mesh");
        let symmetries = info.symmetry_poses(1.0);
        assert!(symmetries.iter().all(finite), "symmetries are rigid");
        assert!(symmetries.len() <= 10_000, "symmetries within bounds");
    }
    store.remove("part").expect("an object of any content can be removed");
}

pub(crate) fn object_record(bytes: &[u8]) {
    stored(bytes, &seeds::object_mesh()[0]);
}

pub(crate) fn object_mesh(bytes: &[u8]) {
    stored(&seeds::object_record()[0], bytes);
}

#[cfg(feature = "networks")]
pub(crate) fn templates(bytes: &[u8]) {
    let path = Path::new("fuzz.sixfold-templates");
    if let Ok(read) = ObjectTemplates::parse(bytes, path) {
        let again = ObjectTemplates::parse(&read.to_bytes(), path);
        again.expect("what was read can be written and read again");
        assert!(read.diameter > 0.0 && read.diameter <= 1000.0, "a diameter is a length");
        assert!((1..=4096).contains(&read.templates.len()), "templates within bounds");
        let size = read.options.margin * read.diameter;
        assert!((read.size - size).abs() <= 1e-6 * size, "the patch is the margin times the diameter");
        for template in &read.templates {
            assert!(finite(&template.view_from_object) && template.distance.is_finite());
            assert!(template.depth.iter().any(|z| *z > 0), "a template shows something");
        }
        let (cloud, pixels) = read.templates[0].cloud(read.size);
        assert!(cloud.len() == pixels.len() && cloud.points.iter().all(|p| p.iter().all(|c| c.is_finite())));
    }
}

pub(crate) fn gripper(bytes: &[u8]) {
    if let Ok(g) = parse_gripper(&String::from_utf8_lossy(bytes), "fuzz.json") {
        let lengths = [g.max_opening, g.finger_length, g.finger_width, g.finger_thickness, g.palm_width];
        let others = [g.palm_depth, g.palm_height, g.force, g.friction];
        assert!(lengths.iter().chain(&others).all(|v| v.is_finite() && *v > 0.0), "{g:?}");
    }
}

pub(crate) fn haf(bytes: &[u8]) {
    if let Ok(planner) = parse_haf(&String::from_utf8_lossy(bytes), "fuzz.json") {
        let heights = |y: usize, x: usize| 0.01 * (x as f32 - y as f32);
        let grid = HeightGrid::from_heights(std::array::from_fn(|y| std::array::from_fn(|x| heights(y, x))));
        let score = planner.score(&grid);
        assert!(score.is_nan() || (0.0..=1.0).contains(&score), "{score}");
        assert_eq!(
            parse_haf(&write_haf(&planner).unwrap(), "again.json").unwrap().features,
            planner.features
        );
    }
}

#[cfg(feature = "networks")]
pub(crate) fn training_log(bytes: &[u8]) {
    with_file("log.jsonl", bytes, |path| {
        let lines = bytes.iter().filter(|b| **b == b'\n').count() + 1;
        assert!(read_training_log(path).unwrap_or_default().len() <= lines, "no more records than lines");
    });
}

/// A store is a database file: each experience is read or refused, whatever the file contains.
#[cfg(feature = "networks")]
pub(crate) fn experience(bytes: &[u8]) {
    with_file("experience.db", bytes, |path| {
        let Ok(store) = SqliteStore::open(path) else { return };
        let _ = store.check_integrity();
        let _ = store.changes(Position::default());
        let _ = store.attempts(0);
        for summary in store.list().unwrap_or_default() {
            if let Ok(Some(stored)) = store.get(summary.id) {
                stored.experience.check().expect("an experience that was read is one");
            }
        }
    });
}
