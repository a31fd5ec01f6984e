//! Photographs without a board: poses, scale and floor compared with a simulation's ground truth, and the errors for unusable
//! photographs.

use sixfold_geometry::{Camera, DepthImage, Pose, RgbImage, Vec3, stats::median};
use sixfold_mesh::Mesh;
use sixfold_nn::keypoints::KeypointFinder;
use sixfold_teach::simulation::{SimulatedCapture, SimulationOptions, patterned};
use sixfold_teach::{
    KnownLength, PutTogether, SeenFeatures, TeachError, TeachOptions, Teaching, World, features_of,
    put_together,
};

const PHOTOGRAPHS: usize = 12;
/// Two corners of a rectangle on the cloth.
const ENDS: [[f64; 3]; 2] = [[-0.12, -0.08, 0.0], [0.12, 0.08, 0.0]];

fn camera() -> Camera {
    Camera { fx: 620.0, fy: 620.0, cx: 322.0, cy: 238.0, width: 640, height: 480, distortion: None }
}

fn brick() -> Mesh {
    let corner = |i: usize| {
        let side = |bit: usize, half: f64| if i >> bit & 1 == 0 { -half } else { half };
        Vec3::new(side(0, 0.04), side(1, 0.025), side(2, 0.03))
    };
    let faces = [
        [0, 2, 3],
        [0, 3, 1],
        [4, 5, 7],
        [4, 7, 6],
        [0, 1, 5],
        [0, 5, 4],
        [2, 6, 7],
        [2, 7, 3],
        [0, 4, 6],
        [0, 6, 2],
        [1, 3, 7],
        [1, 7, 5],
    ];
    let mesh = Mesh::new((0..8).map(corner).collect(), faces.to_vec()).unwrap();
    mesh.with_colors((0..8).map(|i| [60 + 20 * i, 200 - 15 * i, 90]).collect()).unwrap()
}

struct Taken {
    truth: Vec<Pose>,
    seen: Vec<SeenFeatures>,
}

fn few_pixels() -> SimulationOptions {
    SimulationOptions {
        photographs: PHOTOGRAPHS,
        camera: camera(),
        distance: [0.4, 0.48],
        motion: 0.5,
        blur: 0.5,
        ..SimulationOptions::default()
    }
}

/// The length between two corners, marked in three photographs.
fn length(truth: &[Pose], photographs: [usize; 3]) -> KnownLength {
    let ends = ENDS.map(Vec3::from);
    let pixel = |i: usize, p: &Vec3| camera().project(&truth[i].transform_point(p)).map(<[f64; 2]>::from);
    let ends_in = |i: usize| (i, [pixel(i, &ends[0]), pixel(i, &ends[1])]);
    KnownLength { metres: (ends[0] - ends[1]).norm(), ends: photographs.map(ends_in).to_vec() }
}

fn taken() -> Taken {
    let options = few_pixels();
    let (mesh, cloth, table) = (brick(), patterned(1024, 2), RgbImage::filled(8, 8, [110, 105, 95]));
    let capture = SimulatedCapture::without_board(&mesh, (&cloth, 0.5), &table, &options, 5);
    let finder = KeypointFinder::shipped().unwrap();
    let seen = (0..PHOTOGRAPHS).map(|i| {
        let image = capture.photograph(i).unwrap();
        let features = features_of(&finder, &image).unwrap();
        SeenFeatures { name: format!("{i:02}.jpg"), size: image.size(), features, focal_length: None }
    });
    Taken { truth: capture.camera_from_board.clone(), seen: seen.collect() }
}

fn without_depth(_: usize) -> Result<Option<DepthImage>, TeachError> {
    Ok(None)
}

impl Taken {
    fn put(&self, length: Option<&KnownLength>) -> Result<PutTogether, TeachError> {
        put_together(&self.seen, None, length, &without_depth, &())
    }

    /// Median errors of the motion from each photograph to the next, which need no common frame: metres and degrees.
    fn errors(&self, found: &PutTogether) -> [f64; 2] {
        let (mut shifts, mut rotations) = (vec![], vec![]);
        for i in 1..PHOTOGRAPHS {
            let (Ok(a), Ok(b)) = (&found.camera_from_world[i - 1], &found.camera_from_world[i]) else {
                continue;
            };
            let (found, truth) = (b * &a.inverse(), self.truth[i] * self.truth[i - 1].inverse());
            shifts.push((found.translation() - truth.translation()).norm());
            rotations.push(found.rotation_angle_to(&truth).to_degrees());
        }
        [median(&mut shifts).unwrap(), median(&mut rotations).unwrap()]
    }
}

#[test]
fn poses_scale_and_floor_are_found_without_the_camera_or_an_error_explains() {
    let mut taken = taken();
    // A photograph of another camera is left out, and the others are registered.
    taken.seen[4].size = (480, 640);
    let length = length(&taken.truth, [0, 3, 6]);
    let found = taken.put(Some(&length)).unwrap();
    let reason = found.camera_from_world[4].as_ref().unwrap_err();
    assert!(reason.contains("480x640 pixels, most photographs have 640x480"), "{reason}");
    assert_eq!(found.camera_from_world.iter().flatten().count(), PHOTOGRAPHS - 1);
    let [shift, rotation] = taken.errors(&found);
    assert!(shift < 0.004 && rotation < 0.5, "{shift} m, {rotation} degrees");
    assert!((found.camera.fx / camera().fx - 1.0).abs() < 0.02, "{:?}", found.camera);
    // The world's origin is on the cloth below the object, z up.
    assert_eq!(found.floor, Some(0.0));
    for (pose, truth) in found.camera_from_world.iter().zip(&taken.truth) {
        let Ok(pose) = pose else { continue };
        let (eye, there) = (pose.inverse().translation(), truth.inverse().translation());
        assert!((eye.z - there.z).abs() < 0.005, "height {} of {}", eye.z, there.z);
        assert!((eye.xy().norm() - there.xy().norm()).abs() < 0.03, "{eye} {there}");
    }
    assert_refused(taken, &length);
}

fn assert_refused(taken: Taken, length: &KnownLength) {
    let refused = |taken: &Taken, length: Option<&KnownLength>, parts: &[&str]| {
        let error = taken.put(length).unwrap_err().to_string();
        assert!(parts.iter().all(|part| error.contains(part)), "{error}");
    };
    refused(&taken, None, &["--length", "--ends", "depth images"]);
    let stopped =
        put_together(&taken.seen, None, Some(length), &without_depth, &|done: usize, _: usize| done < 5);
    assert!(matches!(stopped, Err(TeachError::Stopped)));
    // All from one viewpoint.
    let one = Taken { seen: vec![taken.seen[0].clone(); 5], ..taken };
    let two = KnownLength { ends: vec![length.ends[0], (3, length.ends[1].1)], ..length.clone() };
    refused(&one, Some(&two), &["one place", "walk around"]);
    // No texture.
    let bare = SeenFeatures {
        name: "bare.jpg".to_owned(),
        size: (640, 480),
        features: Default::default(),
        focal_length: None,
    };
    let bare = Taken { seen: vec![bare; 5], ..one };
    refused(&bare, Some(&two), &["0 photographs", "texture", "bare.jpg: 0 features"]);
}

#[test]
fn a_teaching_keeps_its_poses_until_the_length_changes() {
    let folder = tempfile::tempdir().unwrap();
    let options = SimulationOptions { photographs: 6, around: 120.0, ..few_pixels() };
    let (mesh, cloth, table) = (brick(), patterned(1024, 2), RgbImage::filled(8, 8, [110, 105, 95]));
    let capture = SimulatedCapture::without_board(&mesh, (&cloth, 0.5), &table, &options, 5);
    let teach = TeachOptions { world: World::Features, camera: Some(camera()), ruler: None };
    let mut teaching = Teaching::open(folder.path().join("t"), &teach).unwrap();
    for i in 0..6 {
        let file = folder.path().join(format!("{i}.png"));
        sixfold_io::write_rgb(&file, &capture.photograph(i).unwrap()).unwrap();
        teaching.add_photograph(&format!("{i}.png"), &std::fs::read(&file).unwrap()).unwrap();
    }
    assert!(matches!(teaching.locate(&()), Err(TeachError::NoScale)));
    let length = length(&capture.camera_from_board, [0, 2, 4]);
    teaching.set_length(Some(length.clone())).unwrap();
    let stop_at = |last: usize| move |done: usize, _: usize| done < last;
    assert!(matches!(teaching.locate(&stop_at(3)), Err(TeachError::Stopped)));
    assert!(matches!(teaching.locate(&stop_at(7)), Err(TeachError::Stopped)));
    teaching.locate(&()).unwrap();
    let height = |teaching: &Teaching| teaching.camera_from_board(5).unwrap().inverse().translation().z;
    let (there, before) = (capture.camera_from_board[5].inverse().translation().z, height(&teaching));
    assert!((before - there).abs() < 0.01, "{before} {there}");
    assert!(teaching.floor().is_some_and(|floor| floor.normal == Vec3::z()) && teaching.board().is_none());
    drop(teaching);
    // Nothing is computed again, so nothing can be stopped.
    let mut teaching = Teaching::open(folder.path().join("t"), &teach).unwrap();
    teaching.set_length(Some(length.clone())).unwrap();
    teaching.locate(&stop_at(0)).unwrap();
    let twice = KnownLength { metres: 2.0 * length.metres, ..length };
    teaching.set_length(Some(twice)).unwrap();
    assert!(teaching.camera_from_board(5).is_none());
    teaching.locate(&()).unwrap();
    assert!((height(&teaching) / before - 2.0).abs() < 1e-6, "{} {before}", height(&teaching));
}
