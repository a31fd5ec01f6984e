use nalgebra::Vector6;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::BrownConrady;

fn camera() -> Camera {
    Camera::new(572.4, 573.6, 325.3, 242.0, 640, 480).unwrap()
}

struct Case {
    truth: Pose,
    points: Vec<Vec3>,
    pixels: Vec<Vec2>,
}

/// A 5 cm object 0.6 to 1.4 m away; `noise` metres on the object points, a fraction of them replaced at random.
fn case(seed: u64, n: usize, noise: f64, outliers: f64, flat: bool) -> Case {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut uniform = |a: f64, b: f64| random.random_range(a..b);
    let axis = Vec3::new(uniform(-1.0, 1.0), uniform(-1.0, 1.0), uniform(-1.0, 1.0)).normalize();
    let mut turn = axis * uniform(0.0, 3.1);
    if flat {
        turn *= 0.3;
    }
    let truth = Pose::exp(&Vector6::new(0.0, 0.0, 0.0, turn.x, turn.y, turn.z)).with_translation(Vec3::new(
        uniform(-0.2, 0.2),
        uniform(-0.15, 0.15),
        uniform(0.6, 1.4),
    ));
    let (mut points, mut pixels) = (vec![], vec![]);
    for i in 0..n {
        let mut random_point = || {
            let z = uniform(-0.025, 0.025);
            Vec3::new(uniform(-0.025, 0.025), uniform(-0.025, 0.025), if flat { 0.0 } else { z })
        };
        let exact = random_point();
        let other = random_point();
        pixels.push(camera().project(&truth.transform_point(&exact)).unwrap());
        // The sum of twelve uniform numbers is near enough to a normal one.
        let mut normal = || (0..12).map(|_| uniform(-0.5, 0.5)).sum::<f64>() * noise;
        let disturbed = exact + Vec3::new(normal(), normal(), normal());
        points.push(if (i as f64) < outliers * n as f64 { other } else { disturbed });
    }
    Case { truth, points, pixels }
}

fn solve(case: &Case, options: &PnpOptions) -> PnpReport {
    pnp_ransac(&case.points, &case.pixels, &camera(), options).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn exact_correspondences_give_the_exact_pose(seed in any::<u64>(), n in 6usize..60, flat in any::<bool>()) {
        let case = case(seed, n, 0.0, 0.0, flat);
        let found = solve(&case, &PnpOptions { seed, ..PnpOptions::default() });
        prop_assert!(found.camera_from_object.rotation_angle_to(&case.truth) < 1e-6, "{found:?}");
        prop_assert!(found.camera_from_object.distance_to(&case.truth) < 1e-6, "{found:?}");
        prop_assert_eq!(found.inlier_count, n);
        prop_assert!(found.score > 0.999_999 && found.rms_px < 1e-4);
    }
}

fn median_rotation_error(noise: f64, outliers: f64, options: &PnpOptions) -> f64 {
    let mut errors: Vec<f64> = (0..21)
        .map(|seed| {
            let case = case(seed, 800, noise, outliers, false);
            solve(&case, options).camera_from_object.rotation_angle_to(&case.truth).to_degrees()
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    errors[10]
}

#[test]
fn noise_and_outliers() {
    let options = PnpOptions::default();
    for (outliers, most) in [(0.0, 1.0), (0.6, 1.5), (0.8, 2.5)] {
        let error = median_rotation_error(0.003, outliers, &options);
        assert!(error < most, "{outliers}: {error}");
    }
    let exact = median_rotation_error(0.0, 0.8, &options);
    assert!(exact < 0.05, "{exact}");
}

#[test]
fn epnp_in_ransac() {
    let options = PnpOptions { solver: PnpSolver::Epnp, ..PnpOptions::default() };
    let error = median_rotation_error(0.003, 0.3, &options);
    assert!(error < 1.3, "{error}");
}

#[test]
fn epnp_with_noise() {
    let mut errors: Vec<f64> = (0..21)
        .map(|seed| {
            let case = case(seed, 200, 0.001, 0.0, false);
            let found = epnp(&case.points, &case.pixels, &camera()).unwrap();
            found.rotation_angle_to(&case.truth).to_degrees()
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    assert!(errors[10] < 1.5, "{errors:?}");
}

#[test]
fn a_refinement_weights_correspondences_by_their_trust() {
    let case = case(5, 200, 0.0, 0.4, false);
    let start = case.truth * Pose::exp(&Vector6::new(0.002, -0.001, 0.01, 0.05, -0.08, 0.04));
    let refined = |of_wrong: Trust| {
        let right = Trust { spread_px: 0.5, weight: 1.0 };
        let trust: Vec<Trust> = (0..200).map(|i| if i < 80 { of_wrong } else { right }).collect();
        let found = refine_trusted(&case.points, &case.pixels, &trust, &camera(), &start).unwrap();
        found.rotation_angle_to(&case.truth)
    };
    // Forty per cent are wrong: with weight 0 they have no influence, with a large spread hardly any, and with the same
    // trust as the others some.
    let none = refined(Trust { spread_px: 0.5, weight: 0.0 });
    let rough = refined(Trust { spread_px: 20.0, weight: 1.0 });
    let all = refined(Trust { spread_px: 0.5, weight: 1.0 });
    assert!(none < 1e-6 && rough < 0.01 && rough < all, "{none} {rough} {all}");
    let lost = vec![Trust { spread_px: 1.0, weight: 0.0 }; 200];
    let found = refine_trusted(&case.points, &case.pixels, &lost, &camera(), &start);
    assert_eq!(found, Err(PnpError::NoModel));
    let found = refine_trusted(&case.points, &case.pixels, &lost[1..], &camera(), &start);
    assert_eq!(found, Err(PnpError::Lengths { object_points: 199, image_points: 200 }));
}

#[test]
fn refinement_ignores_outliers_beyond_the_threshold() {
    let case = case(5, 200, 0.0, 0.4, false);
    let start = case.truth * Pose::exp(&Vector6::new(0.0005, -0.0003, 0.003, 0.01, -0.02, 0.01));
    let options = RefineOptions::default();
    let found = refine_pose(&case.points, &case.pixels, &camera(), &start, &options).unwrap();
    assert!(found.camera_from_object.rotation_angle_to(&case.truth) < 0.02, "{found:?}");
    let away = Pose::from_translation(Vec3::new(5.0, 0.0, 1.0));
    assert_eq!(refine_pose(&case.points, &case.pixels, &camera(), &away, &options), Err(PnpError::NoModel));
}

#[test]
fn same_seed_same_bytes() {
    let case = case(9, 500, 0.003, 0.6, false);
    for solver in [PnpSolver::Ap3p, PnpSolver::Epnp] {
        let options = PnpOptions { seed: 4, solver, ..PnpOptions::default() };
        let bytes = |r: &PnpReport| {
            r.camera_from_object.to_matrix().iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()
        };
        let (a, b) = (solve(&case, &options), solve(&case, &options));
        assert_eq!(bytes(&a), bytes(&b));
        assert_eq!(a, b);
    }
}

#[test]
fn distortion_is_undone_at_the_edge() {
    let case = case(11, 100, 0.0, 0.2, false);
    let distortion = Some(BrownConrady { k1: -0.2, k2: 0.05, p1: 1e-3, p2: -5e-4, k3: 0.0 });
    let camera = Camera { distortion, ..camera() };
    let raw: Vec<Vec2> = case.pixels.iter().map(|p| camera.distort_point(p)).collect();
    let found = pnp_ransac(&case.points, &raw, &camera, &PnpOptions::default()).unwrap();
    assert!(found.camera_from_object.rotation_angle_to(&case.truth) < 1e-5, "{found:?}");
}

#[test]
fn failures_are_reported() {
    let Case { points, pixels, .. } = case(1, 20, 0.0, 0.0, false);
    let options = PnpOptions::default();
    let solve = |points: &[Vec3], pixels: &[Vec2]| pnp_ransac(points, pixels, &camera(), &options);
    assert_eq!(solve(&points[..5], &pixels), Err(PnpError::Lengths { object_points: 5, image_points: 20 }));
    assert_eq!(solve(&points[..3], &pixels[..3]), Err(PnpError::TooFew { found: 3 }));
    let mut bad = points.clone();
    bad[7].y = f64::NAN;
    assert_eq!(solve(&bad, &pixels), Err(PnpError::NotFinite { what: "object point", index: 7 }));
    let mut bad = pixels.clone();
    bad[2].x = f64::INFINITY;
    assert_eq!(solve(&points, &bad), Err(PnpError::NotFinite { what: "image point", index: 2 }));
    let line: Vec<Vec3> = (0..20).map(|i| Vec3::new(1.0, 2.0, 3.0) * f64::from(i)).collect();
    assert_eq!(solve(&line, &pixels), Err(PnpError::Degenerate { what: "object points" }));
    assert_eq!(solve(&[Vec3::x(); 20], &pixels), Err(PnpError::Degenerate { what: "object points" }));
    assert_eq!(solve(&points, &[Vec2::zeros(); 20]), Err(PnpError::Degenerate { what: "image points" }));
    // Points that fit no pose.
    let noise = case(3, 12, 0.0, 1.0, false);
    let strict = PnpOptions { threshold_px: 0.01, max_iterations: 300, ..options };
    assert_eq!(pnp_ransac(&noise.points, &noise.pixels, &camera(), &strict), Err(PnpError::NoModel));
    let folded = Camera { distortion: Some(BrownConrady { k1: -5.0, ..Default::default() }), ..camera() };
    assert!(matches!(
        pnp_ransac(&points, &vec![Vec2::new(0.0, 0.0); 20], &folded, &options),
        Err(PnpError::Undistortable { index: 0 })
    ));
    let no_camera = Camera { fx: 0.0, ..camera() };
    assert!(matches!(pnp_ransac(&points, &pixels, &no_camera, &options), Err(PnpError::Camera(_))));
    for (bad, name) in [
        (PnpOptions { threshold_px: f64::NAN, ..options }, "threshold_px"),
        (PnpOptions { confidence: 1.0, ..options }, "confidence"),
        (PnpOptions { noise_window: -1.0, ..options }, "noise_window"),
        (PnpOptions { max_iterations: 0, min_iterations: 0, ..options }, "max_iterations"),
        (PnpOptions { min_iterations: 20_000, ..options }, "min_iterations"),
    ] {
        let result = pnp_ransac(&points, &pixels, &camera(), &bad);
        assert!(matches!(result, Err(PnpError::Option { option, .. }) if option == name), "{result:?}");
    }
}
