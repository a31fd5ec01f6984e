//! Reconstructions from simulated photographs of points with known ground truth.

use rand::RngExt;
use sixfold_geometry::random::{Random, normal, stream};
use sixfold_geometry::{BrownConrady, Camera, Mat3, Pose, Vec2, Vec3, umeyama};
use sixfold_sfm::{LeftOut, PairMatches, Reconstruction, SfmError, SfmOptions, reconstruct};

struct Scene {
    poses: Vec<Pose>,
    camera: Camera,
    pixels: Vec<Vec<Vec2>>,
    matches: Vec<PairMatches>,
}

fn looking_at(eye: Vec3, target: Vec3) -> Pose {
    let forward = (target - eye).normalize();
    let right = forward.cross(&Vec3::z()).normalize();
    let rows = Mat3::from_rows(&[right.transpose(), forward.cross(&right).transpose(), forward.transpose()]);
    let rotation = Pose::from_parts(&rows, Vec3::zeros()).unwrap();
    rotation.with_translation(-rotation.transform_point(&eye))
}

fn around(count: usize) -> Vec<Pose> {
    (0..count)
        .map(|i| {
            let angle = std::f64::consts::TAU * i as f64 / count as f64;
            let height = if i % 3 == 2 { 0.42 } else { 0.28 };
            looking_at(Vec3::new(0.4 * angle.cos(), 0.4 * angle.sin(), height), Vec3::new(0.0, 0.0, 0.03))
        })
        .collect()
}

fn camera() -> Camera {
    Camera::new(980.0, 980.0, 511.5, 383.5, 1024, 768).unwrap()
}

/// Points of a table with objects on it, or without objects if `flat`.
fn points(count: usize, flat: bool, random: &mut Random) -> Vec<Vec3> {
    (0..count)
        .map(|i| {
            let (x, y) = (random.random_range(-0.2..0.2), random.random_range(-0.2..0.2));
            let z = if flat || i % 2 == 0 { 0.0 } else { random.random_range(0.0..0.12) };
            Vec3::new(x, y, z)
        })
        .collect()
}

impl Scene {
    /// Every photograph shows all points; `noise` in pixels, `wrong` is the fraction of wrong matches.
    fn new(poses: Vec<Pose>, camera: Camera, flat: bool, noise: f64, wrong: f64) -> Scene {
        let mut random = stream(3, 0);
        let points = points(300, flat, &mut random);
        let mut pixels = vec![];
        for pose in &poses {
            let of = |p: &Vec3| {
                let pixel = camera.distort_point(&camera.project(&pose.transform_point(p)).unwrap());
                pixel + Vec2::new(f64::from(normal(&mut random)), f64::from(normal(&mut random))) * noise
            };
            pixels.push(points.iter().map(of).collect());
        }
        let mut matches = vec![];
        for b in 0..poses.len() {
            for a in 0..b {
                // Points are matched between viewpoints that are not too far apart.
                let side = |p: &Pose| p.inverse().translation().normalize();
                if side(&poses[a]).dot(&side(&poses[b])) < 0.3 {
                    continue;
                }
                let mut partner =
                    |i: u32| if random.random_bool(wrong) { random.random_range(0..300) } else { i };
                matches
                    .push(PairMatches { pair: (a, b), matches: (0..300).map(|i| (i, partner(i))).collect() });
            }
        }
        Scene { poses, camera, pixels, matches }
    }

    fn found(&self, camera: &Camera, options: &SfmOptions) -> Result<Reconstruction, SfmError> {
        reconstruct(&self.pixels, &self.matches, camera, options, &())
    }

    /// Largest errors of positions (metres) and rotations (radians), after the best similarity.
    fn errors(&self, found: &Reconstruction) -> [f64; 2] {
        let known: Vec<(usize, Pose)> = found
            .camera_from_world
            .iter()
            .enumerate()
            .filter_map(|(i, p)| Some((i, p.clone().ok()?)))
            .collect();
        let eyes: Vec<Vec3> = known.iter().map(|(_, p)| p.inverse().translation()).collect();
        let truth: Vec<Vec3> = known.iter().map(|(i, _)| self.poses[*i].inverse().translation()).collect();
        let fit = umeyama(&eyes, &truth, None).unwrap();
        let mut errors = [0.0f64; 2];
        for ((eye, truth), (i, pose)) in eyes.iter().zip(&truth).zip(&known) {
            errors[0] = errors[0].max((fit.transform_point(eye) - truth).norm());
            let rotation = pose.rotation() * fit.target_from_source.rotation().inverse();
            errors[1] = errors[1].max(rotation.angle_to(&self.poses[*i].rotation()));
        }
        errors
    }
}

#[test]
fn exact_points_give_exact_poses() {
    let scene = Scene::new(around(12), camera(), false, 0.0, 0.0);
    let found = scene.found(&scene.camera, &SfmOptions::default()).unwrap();
    assert!(found.camera_from_world.iter().all(Result::is_ok));
    assert!(found.points.len() == 300 && found.rms_px < 1e-5, "{} {}", found.points.len(), found.rms_px);
    let [shift, rotation] = scene.errors(&found);
    assert!(shift < 1e-6 && rotation < 1e-6, "{shift:e} {rotation:e}");
}

#[test]
fn a_plane_is_no_obstacle() {
    let scene = Scene::new(around(10), camera(), true, 0.3, 0.0);
    let found = scene.found(&scene.camera, &SfmOptions::default()).unwrap();
    assert!(found.camera_from_world.iter().all(Result::is_ok));
    let [shift, rotation] = scene.errors(&found);
    assert!(shift < 1e-3 && rotation < 2e-3, "{shift:e} {rotation:e}");
}

#[test]
fn thirty_percent_wrong_matches_change_little() {
    let scene = Scene::new(around(12), camera(), false, 0.5, 0.3);
    let found = scene.found(&scene.camera, &SfmOptions::default()).unwrap();
    assert!(found.camera_from_world.iter().all(Result::is_ok));
    let [shift, rotation] = scene.errors(&found);
    assert!(shift < 5e-4 && rotation < 1e-3, "{shift:e} {rotation:e}");
}

#[test]
fn a_camera_that_is_a_guess_is_found_too() {
    let distortion = Some(BrownConrady { k1: 0.08, k2: -0.15, p1: 0.0, p2: 0.0, k3: 0.0 });
    let truth = Camera { cx: 515.0, cy: 380.0, distortion, ..camera() };
    let scene = Scene::new(around(12), truth, false, 0.5, 0.2);
    let guess = Camera::new(1229.0, 1229.0, 511.5, 383.5, 1024, 768).unwrap();
    let found = scene.found(&guess, &SfmOptions { refine_camera: true, ..SfmOptions::default() }).unwrap();
    let [shift, rotation] = scene.errors(&found);
    assert!(shift < 1e-3 && rotation < 2e-3, "{shift:e} {rotation:e}");
    assert!((found.camera.fx - truth.fx).abs() < 5.0, "{:?}", found.camera);
    assert!((found.camera.cx - truth.cx).abs() < 2.0 && (found.camera.cy - truth.cy).abs() < 2.0);
}

#[test]
fn a_focal_length_in_the_file_helps_with_an_unusual_lens() {
    // The telephoto lens of a phone: 77 mm on 35 mm film.
    let truth = Camera::new(2278.0, 2278.0, 511.5, 383.5, 1024, 768).unwrap();
    let scene = Scene::new(around(12), truth, false, 0.5, 0.1);
    let error = |f: f64, focal_length_from_camera: bool| {
        let guess = Camera::new(f, f, 511.5, 383.5, 1024, 768).unwrap();
        let options = SfmOptions { refine_camera: true, focal_length_from_camera, ..SfmOptions::default() };
        let found = scene.found(&guess, &options).ok()?;
        Some((found.camera.fx / truth.fx - 1.0).abs())
    };
    // The value in the file is rounded, and the focal length changes with focus: an error of three per cent.
    let (named, guessed) = (error(1.03 * truth.fx, true), error(0.9 * 1024.0, false));
    assert!(named.is_some_and(|named| named < 0.01), "{named:?}");
    assert!(guessed.is_none_or(|guessed| guessed > 0.05), "{guessed:?}");
}

#[test]
fn the_same_bytes_at_one_and_two_threads() {
    let scene = Scene::new(around(8), camera(), false, 0.5, 0.3);
    let options = SfmOptions { refine_camera: true, ..SfmOptions::default() };
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| format!("{:?}", scene.found(&scene.camera, &options).unwrap()))
    };
    assert_eq!(with(1), with(2));
}

#[test]
fn photographs_from_one_place_are_refused() {
    let eye = Vec3::new(0.4, 0.0, 0.3);
    let poses = (0..6).map(|i| looking_at(eye, Vec3::new(0.0, 0.02 * f64::from(i), 0.03))).collect();
    let scene = Scene::new(poses, camera(), false, 0.3, 0.0);
    let error = scene.found(&scene.camera, &SfmOptions::default()).unwrap_err();
    assert!(matches!(error, SfmError::NoBaseline { degrees, .. } if degrees < 0.5), "{error}");
    assert!(error.to_string().contains("walk around the object"));
}

#[test]
fn the_larger_of_two_groups_is_kept_and_the_others_are_named() {
    let mut scene = Scene::new(around(10), camera(), false, 0.3, 0.0);
    scene.matches.retain(|m| (m.pair.0 < 6) == (m.pair.1 < 6));
    scene.pixels[9].truncate(20);
    scene.matches.retain(|m| m.pair.1 != 9);
    let found = scene.found(&scene.camera, &SfmOptions::default()).unwrap();
    assert!(found.camera_from_world[..6].iter().all(Result::is_ok));
    assert_eq!(found.camera_from_world[6], Err(LeftOut::OtherGroup { group: vec![7, 8] }));
    let reason = found.camera_from_world[6].clone().unwrap_err().reason(&|i| format!("{i}.jpg"));
    assert!(reason.contains("7.jpg, 8.jpg"), "{reason}");
    assert!(matches!(found.camera_from_world[9], Err(LeftOut::FewFeatures { found: 20, .. })));
}

#[test]
fn too_few_photographs_and_bad_matches_are_refused() {
    let scene = Scene::new(around(12)[..2].to_vec(), camera(), false, 0.3, 0.0);
    let error = scene.found(&scene.camera, &SfmOptions::default()).unwrap_err();
    assert!(matches!(error, SfmError::TooFew { found: 2, minimum: 3, .. }), "{error}");
    let mut scene = Scene::new(around(12)[..4].to_vec(), camera(), false, 0.3, 0.0);
    scene.matches[0].matches[3].1 = 300;
    let error = scene.found(&scene.camera, &SfmOptions::default()).unwrap_err();
    assert!(matches!(error, SfmError::Matches { .. }), "{error}");
    let stopped = reconstruct(
        &scene.pixels,
        &scene.matches[1..],
        &scene.camera,
        &SfmOptions::default(),
        &|_: usize, _: usize| false,
    );
    assert_eq!(stopped, Err(SfmError::Stopped));
}

#[test]
fn a_photograph_with_few_matches_is_named_with_their_number() {
    let mut scene = Scene::new(around(8), camera(), false, 0.0, 0.0);
    scene.matches.iter_mut().filter(|m| m.pair.1 == 7).for_each(|m| m.matches.truncate(20));
    let options = SfmOptions { min_matches: 20, ..SfmOptions::default() };
    assert!(scene.found(&scene.camera, &options).unwrap().camera_from_world[7].is_ok());
    // Wrong ones among as many as are asked for: fewer agree.
    for m in scene.matches.iter_mut().filter(|m| m.pair.1 == 7) {
        m.matches.extend((20..32).map(|i| (i, 299 - i)));
    }
    let found = scene.found(&scene.camera, &SfmOptions { min_matches: 28, ..options }).unwrap();
    let Err(LeftOut::FewMatches { found, minimum: 28 }) = found.camera_from_world[7] else {
        panic!("{:?}", found.camera_from_world[7]);
    };
    assert!((20..28).contains(&found), "{found}");
}

#[test]
fn unrelated_photographs_are_left_out() {
    let mut scene = Scene::new(around(10), camera(), false, 0.3, 0.0);
    let mut random = stream(8, 0);
    scene.pixels[4]
        .iter_mut()
        .for_each(|p| *p = Vec2::new(random.random_range(0.0..1024.0), random.random_range(0.0..768.0)));
    let found = scene.found(&scene.camera, &SfmOptions::default()).unwrap();
    assert!(found.camera_from_world[4].is_err());
    assert_eq!(found.camera_from_world.iter().filter(|p| p.is_ok()).count(), 9);
}
