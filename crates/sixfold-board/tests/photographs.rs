//! Simulated photographs of the board: tags, poses and calibrations compared with the ground truth.

use sixfold_board::simulation::{Conditions, photograph};
use sixfold_board::{
    Board, BoardError, CalibrationOptions, Corner, Paper, board_pose, calibrate, detect_tags,
};
use sixfold_geometry::nalgebra::{Unit, UnitQuaternion};
use sixfold_geometry::{BrownConrady, Camera, Image, Pose, RgbImage, Vec2, Vec3};

/// A camera as in many phones' video, with a lens that bends lines by several pixels.
fn camera() -> Camera {
    let distortion = BrownConrady { k1: -0.12, k2: 0.05, p1: 0.0008, p2: -0.0005, k3: 0.0 };
    Camera {
        fx: 905.0,
        fy: 902.0,
        cx: 486.0,
        cy: 352.0,
        width: 960,
        height: 720,
        distortion: Some(distortion),
    }
}

/// The board seen under `tilt` from the vertical, from the direction `azimuth`, at a distance.
fn pose(tilt: f64, azimuth: f64, distance: f64) -> Pose {
    let facing = UnitQuaternion::from_axis_angle(&Vec3::x_axis(), std::f64::consts::PI);
    let axis = Unit::new_normalize(Vec3::new(azimuth.cos(), azimuth.sin(), 0.0));
    let spin = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), 1.7 * azimuth);
    let rotation = UnitQuaternion::from_axis_angle(&axis, tilt) * facing * spin;
    Pose::new(rotation, Vec3::new(0.01 * azimuth.sin(), 0.015 * azimuth.cos(), distance))
}

fn poses() -> Vec<Pose> {
    (0..10)
        .map(|i| pose(0.25 + 0.06 * f64::from(i), 0.63 * f64::from(i), 0.38 + 0.02 * f64::from(i % 4)))
        .collect()
}

fn corners(image: &RgbImage) -> Vec<Corner> {
    Board::new(Paper::A4).corners(&detect_tags(image).tags)
}

/// Errors of the found corners, pixels, smallest first.
fn errors(corners: &[Corner], camera: &Camera, pose: &Pose) -> Vec<f64> {
    let error = |c: &Corner| {
        let p = camera.project(&pose.transform_point(&c.on_board)).unwrap();
        (camera.distort_point(&p) - c.pixel).norm()
    };
    let mut errors: Vec<f64> = corners.iter().map(error).collect();
    errors.sort_by(f64::total_cmp);
    errors
}

#[test]
fn tags_are_found_to_a_fraction_of_a_pixel_though_some_are_hidden() {
    let board = Board::new(Paper::A4);
    let hidden = (0.0, 0.0, 0.05);
    for (i, truth) in poses().iter().enumerate().take(4) {
        let conditions = Conditions { hidden, ..Conditions::default() };
        let found = corners(&photograph(&board, &camera(), truth, &conditions, i as u64));
        // The disc hides 9 or more of the 35, and the image's border may cut others off.
        assert!(found.len() >= 4 * 15, "photograph {i}: {} tags", found.len() / 4);
        assert!(found.len() <= 4 * 30);
        let errors = errors(&found, &camera(), truth);
        assert!(errors[errors.len() / 2] < 0.12, "photograph {i}: median {}", errors[errors.len() / 2]);
        assert!(errors[errors.len() * 95 / 100] < 0.5, "photograph {i}: {errors:?}");
    }
}

#[test]
fn a_camera_is_calibrated_and_poses_are_exact() {
    let board = Board::new(Paper::A4);
    let photographs: Vec<Vec<Corner>> = poses()
        .iter()
        .enumerate()
        .map(|(i, p)| corners(&photograph(&board, &camera(), p, &Conditions::default(), 50 + i as u64)))
        .collect();
    let found = calibrate(&photographs, (960, 720), &CalibrationOptions::default()).unwrap();
    let truth = camera();
    assert!((found.camera.fx / truth.fx - 1.0).abs() < 0.003, "{:?}", found.camera);
    assert!((found.camera.fy / truth.fy - 1.0).abs() < 0.003, "{:?}", found.camera);
    assert!(
        (found.camera.cx - truth.cx).abs() < 2.0 && (found.camera.cy - truth.cy).abs() < 2.0,
        "{:?}",
        found.camera
    );
    // Compare the distortion at the image's corners, not the coefficients, which can compensate each other.
    for pixel in [Vec2::new(30.0, 30.0), Vec2::new(930.0, 40.0), Vec2::new(900.0, 690.0)] {
        let ray = |camera: &Camera| {
            let p = camera.undistort_point(&pixel).unwrap();
            camera.unproject(&p, 1.0).normalize()
        };
        let angle = ray(&found.camera).angle(&ray(&truth)).to_degrees();
        assert!(angle < 0.15, "{pixel:?}: {angle} degrees");
    }
    assert!(found.rms < 0.2, "{}", found.rms);
    let mut away = vec![];
    let mut angles = vec![];
    for (view, truth) in found.views.iter().zip(poses()) {
        let pose = view.as_ref().unwrap().camera_from_board;
        away.push(pose.distance_to(&truth));
        angles.push(pose.rotation_angle_to(&truth).to_degrees());
    }
    away.sort_by(f64::total_cmp);
    angles.sort_by(f64::total_cmp);
    assert!(away[5] < 0.001 && angles[5] < 0.1, "{away:?} {angles:?}");
    // With the true camera.
    for (corners, truth) in photographs.iter().zip(poses()) {
        let pose = board_pose(corners, &camera()).unwrap().camera_from_board;
        assert!(pose.distance_to(&truth) < 5e-4 && pose.rotation_angle_to(&truth).to_degrees() < 0.1);
    }
}

#[test]
fn unusable_photographs_are_refused_with_the_reason() {
    let board = Board::new(Paper::A4);
    let truth = pose(0.4, 0.3, 0.45);
    let good = photograph(&board, &camera(), &truth, &Conditions::default(), 3);
    let mirrored = Image::from_fn(960, 720, |x, y| good[(959 - x, y)]);
    let seen = detect_tags(&mirrored);
    assert!(seen.tags.is_empty() && seen.mirrored > 15, "{seen:?}");
    let blank = detect_tags(&Image::filled(64, 48, [200; 3]));
    assert!(blank.tags.is_empty() && blank.mirrored == 0);
    let few = &corners(&good)[..8];
    assert_eq!(board_pose(few, &camera()), Err(BoardError::TooFewTags { found: 2, minimum: 4 }));
    // The camera of another image.
    let other = Camera { fx: 2000.0, ..camera() };
    assert!(matches!(board_pose(&corners(&good), &other), Err(BoardError::DoesNotFit { .. })));
    // A blurred photograph has no readable tags, or is reported as blurred.
    let blurred =
        photograph(&board, &camera(), &truth, &Conditions { blur: 4.0, ..Conditions::default() }, 3);
    let refused = board_pose(&corners(&blurred), &camera());
    assert!(
        matches!(refused, Err(BoardError::Blurred { .. } | BoardError::TooFewTags { .. })),
        "{refused:?}"
    );
    // The same for a camera that moved by 13 pixels.
    let moved = RgbImage::from_fn(960, 720, |x, y| {
        let sum: usize = (0..13).map(|i| usize::from(good[((x + i).min(959), y)][0])).sum();
        [(sum / 13) as u8; 3]
    });
    let refused = board_pose(&corners(&moved), &camera());
    assert!(
        matches!(refused, Err(BoardError::Blurred { .. } | BoardError::TooFewTags { .. })),
        "{refused:?}"
    );
    // All from one direction: the focal length is not determined.
    let frontal: Vec<Vec<Corner>> = (0..5)
        .map(|i| {
            let truth = pose(0.002, f64::from(i), 0.45);
            corners(&photograph(&board, &camera(), &truth, &Conditions::default(), 70 + i as u64))
        })
        .collect();
    let refused = calibrate(&frontal, (960, 720), &CalibrationOptions::default());
    assert!(matches!(refused, Err(BoardError::Undetermined { .. } | BoardError::NoSolution)), "{refused:?}");
    let refused = calibrate(&frontal[..2], (960, 720), &CalibrationOptions::default());
    assert_eq!(refused, Err(BoardError::TooFewPhotographs { found: 2, minimum: 4 }));
}

#[test]
fn a_photograph_that_does_not_fit_is_left_out() {
    let board = Board::new(Paper::A4);
    let mut photographs: Vec<Vec<Corner>> = poses()
        .iter()
        .take(7)
        .enumerate()
        .map(|(i, p)| corners(&photograph(&board, &camera(), p, &Conditions::default(), 90 + i as u64)))
        .collect();
    // By another camera.
    for corner in &mut photographs[2] {
        corner.pixel.x = 480.0 + 0.5 * (corner.pixel.x - 480.0);
    }
    let found = calibrate(&photographs, (960, 720), &CalibrationOptions::default()).unwrap();
    let left_out: Vec<bool> = found.views.iter().map(Result::is_err).collect();
    assert_eq!(left_out, [false, false, true, false, false, false, false]);
    assert!((found.camera.fx / camera().fx - 1.0).abs() < 0.005, "{:?}", found.camera);
}
