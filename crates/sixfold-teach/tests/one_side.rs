//! Objects taught from a single photograph with depth: the table, the mask and the hidden side are found or assumed.

use std::sync::Arc;

use sixfold_board::{Board, Paper};
use sixfold_geometry::{Camera, DepthImage, Image, KdTree, Mask, Plane, Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::DepthSensor;
use sixfold_teach::simulation::{SimulatedCapture, SimulationOptions};
use sixfold_teach::{
    Capture, PosedPhotograph, SalientSegmenter, ShapeOptions, TeachError, TeachOptions, Teaching, World,
    reconstruct, segment,
};

use support::{cuboid, painted, png};

mod support;

/// A box with a ledge on one side, which has no counterpart on the other.
fn carton() -> Mesh {
    let parts =
        [cuboid([-0.03, -0.05, 0.0], [0.03, 0.05, 0.12]), cuboid([-0.01, -0.07, 0.05], [0.01, -0.05, 0.07])];
    painted(&parts, &[[200, 60, 40], [40, 110, 170]])
}

fn options() -> SimulationOptions {
    let camera =
        Camera { fx: 620.0, fy: 618.0, cx: 322.0, cy: 238.0, width: 640, height: 480, distortion: None };
    SimulationOptions { photographs: 1, camera, ..SimulationOptions::default() }
}

fn depth_png(depth: &DepthImage) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("depth.png");
    sixfold_io::write_depth(&path, depth, 1e-4).unwrap();
    std::fs::read(&path).unwrap()
}

/// A teaching with one photograph and its depth, without a board, up to the poses.
fn opened(folder: &std::path::Path, image: &RgbImage, depth: &DepthImage) -> Result<Teaching, TeachError> {
    opened_in(World::Features, Some(options().camera), folder, image, depth)
}

fn opened_in(
    world: World,
    camera: Option<Camera>,
    folder: &std::path::Path,
    image: &RgbImage,
    depth: &DepthImage,
) -> Result<Teaching, TeachError> {
    let options = TeachOptions { camera, world, ..TeachOptions::default() };
    let mut teaching = Teaching::open(folder, &options)?;
    teaching.add_photograph("view.png", &png(image))?;
    teaching.add_depth(0, &depth_png(depth), 1e-4)?;
    teaching.locate(&())?;
    Ok(teaching)
}

fn shape() -> ShapeOptions {
    ShapeOptions { fine_cells: 90, faces: 6000, ..ShapeOptions::default() }
}

fn taught(
    folder: &std::path::Path,
    capture: &SimulatedCapture<'_>,
    depth: &DepthImage,
) -> Result<Teaching, TeachError> {
    let mut teaching = opened(folder, &capture.photograph(0).unwrap(), depth)?;
    teaching.find_masks(&SalientSegmenter::shipped().unwrap(), &shape(), &())?;
    teaching.reconstruct(&shape(), &())?;
    Ok(teaching)
}

#[test]
fn the_hidden_side_of_a_carton_is_assumed_and_its_ledge_kept() {
    let (mesh, ground, options) = (carton(), Image::filled(64, 64, [90, 85, 70]), options());
    let capture = SimulatedCapture::new(&mesh, &Board::new(Paper::A4), &ground, &options, 6);
    let folder = tempfile::tempdir().unwrap();
    let depth = capture.measured_depth(0, &DepthSensor::realsense()).unwrap();
    let teaching = taught(folder.path(), &capture, &depth).unwrap();
    let facts = *teaching.shape().unwrap();
    assert!(facts.one_side && facts.unseen > 0.4, "{facts:?}");
    // The world: z up from the table.
    let [x, y, z] = [0, 1, 2].map(|k| facts.board_from_object[k][3]);
    let in_world = teaching.mesh().unwrap().transformed(&Pose::from_translation(Vec3::new(x, y, z)));
    let (low, high) = in_world.bounding_box();
    assert!(low.z.abs() < 0.004 && (high.z - 0.12).abs() < 0.006, "{low} {high}");
    // Against the truth, in the camera's frame.
    let found = in_world.transformed(&teaching.camera_from_board(0).unwrap());
    let camera_from_true = capture.camera_from_board[0] * capture.board_from_object;
    let there = mesh.transformed(&camera_from_true);
    let points = |mesh: &Mesh| mesh.sample_surface(20_000, 1).points;
    let mean = |from: &[Vec3], to: &[Vec3]| {
        let tree = KdTree::new(to);
        from.iter().filter_map(|p| tree.nearest(p)).map(|n| n.distance).sum::<f64>() / from.len() as f64
    };
    let (a, b) = (points(&found), points(&there));
    let errors = [mean(&a, &b), mean(&b, &a)];
    assert!(errors[0] < 0.004 && errors[1] < 0.006, "{errors:?}");
    // The end of the ledge, which is in sight.
    let end = camera_from_true.transform_point(&Vec3::new(0.0, -0.07, 0.07));
    let shown = KdTree::new(&a).nearest(&end).unwrap().distance;
    assert!(shown < 0.008, "{shown}");
}

#[test]
fn depth_of_what_stands_before_the_object_is_not_its_own() {
    let (mesh, ground, options) = (carton(), Image::filled(64, 64, [90, 85, 70]), options());
    let capture = SimulatedCapture::new(&mesh, &Board::new(Paper::A4), &ground, &options, 6);
    let (mask, mut depth) = (capture.mask(0).unwrap(), capture.depth(0).unwrap());
    let [x0, y0, width, height] = mask.bounding_box().unwrap();
    // A bar 10 cm before the lower third of the object.
    let hidden = Mask::from_fn(640, 480, |x, y| {
        (x0..x0 + width).contains(&x) && (y0 + 2 * height / 3..y0 + height).contains(&y)
    });
    for (z, hidden) in depth.as_mut_slice().iter_mut().zip(hidden.as_slice()) {
        *z -= if *hidden { 0.1 } else { 0.0 };
    }
    let photograph = PosedPhotograph {
        name: "view".to_owned(),
        image: Arc::new(capture.photograph(0).unwrap()),
        depth: Some(Arc::new(depth)),
        mask: Some(Arc::new(mask)),
        hidden: Some(Arc::new(hidden)),
        camera: options.camera,
        camera_from_world: capture.camera_from_board[0],
    };
    let floor = Plane { normal: Vec3::z(), offset: 0.0 };
    let capture = Capture::without_board(vec![photograph], Some(floor));
    let found = segment(&capture, &SalientSegmenter::shipped().unwrap(), &shape(), &()).unwrap();
    let made = reconstruct(&capture, &found, &shape(), &()).unwrap();
    let (low, high) = made.mesh.transformed(&made.world_from_object).bounding_box();
    assert!(made.one_side && low.z.abs() < 0.004 && (high.z - 0.12).abs() < 0.006, "{low} {high}");
    assert!((high - low).xy().max() < 0.16, "{low} {high}");
}

#[test]
fn one_photograph_with_depth_on_the_board_is_enough_if_the_camera_is_known() {
    let (mesh, ground, options) = (carton(), Image::filled(64, 64, [90, 85, 70]), options());
    let capture = SimulatedCapture::new(&mesh, &Board::new(Paper::A4), &ground, &options, 6);
    let folder = tempfile::tempdir().unwrap();
    let depth = capture.measured_depth(0, &DepthSensor::realsense()).unwrap();
    let image = capture.photograph(0).unwrap();
    let mut teaching =
        opened_in(World::Board, Some(options.camera), &folder.path().join("a"), &image, &depth).unwrap();
    teaching.find_masks(&SalientSegmenter::shipped().unwrap(), &shape(), &()).unwrap();
    teaching.reconstruct(&shape(), &()).unwrap();
    assert!(teaching.shape().unwrap().one_side);
    let (low, high) = teaching.mesh().unwrap().bounding_box();
    assert!((high.z - low.z - 0.12).abs() < 0.006 && (high - low).xy().max() < 0.15, "{low} {high}");
    let error = opened_in(World::Features, None, &folder.path().join("b"), &image, &depth).unwrap_err();
    assert!(error.to_string().contains("view.png") && error.to_string().contains("--camera"), "{error}");
}

#[test]
fn one_depth_image_that_shows_no_object_is_refused_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let grey = Image::filled(640, 480, [90; 3]);
    // Noise of 40 cm: no plane has enough points.
    let rough =
        Image::from_fn(640, 480, |x, y| 0.5 + 0.4 * ((x * 7919 + y * 104_729) % 1000) as f32 / 1000.0);
    let error = opened(&folder.path().join("a"), &grey, &rough).unwrap_err().to_string();
    assert!(error.contains("view.png") && error.contains("no table"), "{error}");
    let flat = Image::filled(640, 480, 0.6);
    let mut teaching = opened(&folder.path().join("b"), &grey, &flat).unwrap();
    let error =
        teaching.find_masks(&SalientSegmenter::shipped().unwrap(), &shape(), &()).unwrap_err().to_string();
    assert!(error.contains("nothing stands on the table"), "{error}");
    // Two boxes, and nothing that says which is meant.
    let two = Image::from_fn(640, 480, |x, y| {
        let inside = |low: usize| (low..low + 120).contains(&x) && (180..300).contains(&y);
        if inside(120) || inside(400) { 0.55 } else { 0.6 }
    });
    let mut teaching = opened(&folder.path().join("c"), &grey, &two).unwrap();
    let error =
        teaching.find_masks(&SalientSegmenter::shipped().unwrap(), &shape(), &()).unwrap_err().to_string();
    assert!(error.contains("2 objects") && error.contains("masks"), "{error}");
}
