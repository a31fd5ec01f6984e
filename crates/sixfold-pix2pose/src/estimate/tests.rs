//! Tests both passes and PnP on constructed predictions instead of a network's: a ball with known coordinates at every pixel.

use super::*;
use sixfold_geometry::Vec2;
use sixfold_geometry::nalgebra::UnitQuaternion;

const RADIUS: f64 = 0.05;
const SIDE: usize = 64;

fn camera() -> Camera {
    Camera::new(600.0, 600.0, 319.5, 239.5, 640, 480).unwrap()
}

fn truth() -> Pose {
    Pose::new(UnitQuaternion::from_euler_angles(0.4, -0.7, 1.1), Vec3::new(0.03, -0.02, 0.7))
}

fn entry() -> ObjectEntry {
    ObjectEntry {
        id: 3,
        diameter: 2.0 * RADIUS,
        centre: [0.0; 3],
        half_size: [RADIUS; 3],
        thresholds: vec![0.2],
        correction: crate::object::Correction::default(),
    }
}

/// The window around the ball.
fn window() -> Window {
    Window { centre: camera().project(&truth().translation()).unwrap(), side: 128.0 }
}

/// The prediction in the window, with the object at `pose`.
fn prediction(pose: &Pose) -> Prediction {
    let (camera, window) = (camera(), window());
    let step = window.side / SIDE as f64;
    let mut p = Prediction {
        side: SIDE,
        coordinates: vec![[0.0; 3]; SIDE * SIDE],
        error: vec![0.05; SIDE * SIDE],
        visible: vec![0.0; SIDE * SIDE],
    };
    for i in 0..SIDE * SIDE {
        let pixel = Vec2::new((i % SIDE) as f64 + 0.5, (i / SIDE) as f64 + 0.5) * step;
        let pixel = window.centre - Vec2::repeat(0.5 * window.side) + pixel;
        let ray = Vec3::new((pixel.x - camera.cx) / camera.fx, (pixel.y - camera.cy) / camera.fy, 1.0);
        let (a, b) = (ray.norm_squared(), ray.dot(&pose.translation()));
        let root = b * b - a * (pose.translation().norm_squared() - RADIUS * RADIUS);
        if root > 0.0 {
            let point = pose.inverse().transform_point(&(ray * ((b - root.sqrt()) / a)));
            p.coordinates[i] = (point / RADIUS).map(|v| v as f32).into();
            p.visible[i] = 1.0;
        }
    }
    p
}

fn crop() -> Crop {
    Crop { window: window(), side: SIDE, pixels: vec![0.2; 3 * SIDE * SIDE] }
}

/// The candidate of a prediction.
fn candidate(p: &Prediction, threshold: f32, options: &Pix2PoseOptions) -> Candidate {
    let (camera, object) = (camera(), entry());
    let visible = object_mask(p, f32::INFINITY).iter().filter(|m| **m).count();
    Context { camera: &camera, object: &object, options, visible }.pose(threshold, &crop(), p).unwrap()
}

/// The pixels of the ball, in order.
fn ball(p: &Prediction) -> Vec<usize> {
    (0..p.visible.len()).filter(|i| p.visible[*i] > 0.5).collect()
}

#[test]
fn the_pose_of_exact_coordinates_is_the_truth() {
    let p = prediction(&truth());
    for options in [Pix2PoseOptions::default(), Pix2PoseOptions::published()] {
        let c = candidate(&p, 0.2, &options);
        let found = c.hypothesis.camera_from_object;
        assert!(found.distance_to(&truth()) < 1e-4, "{}", found.distance_to(&truth()));
        assert!(found.rotation_angle_to(&truth()) < 1e-3);
        assert_eq!((c.hypothesis.inliers, c.hypothesis.score), (ball(&p).len(), 1.0));
    }
}

#[test]
fn theta_i_decides_which_pixels_are_correspondences() {
    let mut p = prediction(&truth());
    let pixels = ball(&p);
    for i in pixels.iter().step_by(3) {
        p.error[*i] = 0.15;
    }
    let uncertain = pixels.len().div_ceil(3);
    let points = |options: &Pix2PoseOptions| candidate(&p, 0.2, options).object_points.len();
    assert_eq!(points(&Pix2PoseOptions::published()), pixels.len() - uncertain);
    let wider = Pix2PoseOptions { inlier_threshold: Some(0.2), ..Pix2PoseOptions::published() };
    assert_eq!(points(&wider), pixels.len());
    // Our default uses pixels below 0.3 or the outlier threshold, whichever is larger.
    pixels.iter().step_by(3).for_each(|i| p.error[*i] = 0.29);
    assert_eq!(candidate(&p, 0.1, &Pix2PoseOptions::default()).object_points.len(), pixels.len());
    pixels.iter().step_by(3).for_each(|i| p.error[*i] = 0.31);
    let points = |threshold| candidate(&p, threshold, &Pix2PoseOptions::default()).object_points.len();
    assert_eq!([points(0.1), points(0.35)], [pixels.len() - uncertain, pixels.len()]);
}

/// A prediction in which every fourth pixel has the coordinates of one some columns further, twice as many pixels of the image; the
/// number of all pixels, and of these.
fn partly_moved(columns: usize) -> (Prediction, usize, usize) {
    let exact = prediction(&truth());
    let mut p = exact.clone();
    let mut moved = 0;
    for i in ball(&exact).into_iter().step_by(4).filter(|i| exact.visible[i + columns] > 0.5) {
        p.coordinates[i] = exact.coordinates[i + columns];
        moved += 1;
    }
    let all = ball(&p).len();
    (p, all, moved)
}

#[test]
fn theta_re_is_in_pixels_of_the_image() {
    let (p, all, moved) = partly_moved(3);
    let inliers = |reprojection| {
        let options = Pix2PoseOptions { reprojection, ..Pix2PoseOptions::published() };
        candidate(&p, 0.2, &options).hypothesis.inliers
    };
    assert_eq!(inliers(Reprojection::ImagePixels(3.0)), all - moved);
    // The limit in pixels of the network, each of two image pixels, excludes only few of them.
    assert!(inliers(Reprojection::NetworkPixels(4.5)) > all - moved / 4);
}

/// The author's code allows 5 pixels.
#[test]
fn plain_pnp_counts_pixels_that_are_four_pixels_off() {
    let (p, all, moved) = partly_moved(2);
    let inliers = |plain_pnp| {
        let quirks = Quirks { plain_pnp, ..Quirks::default() };
        candidate(&p, 0.2, &Pix2PoseOptions { quirks, ..Pix2PoseOptions::published() }).hypothesis.inliers
    };
    assert_eq!(inliers(false), all - moved);
    assert!(inliers(true) > all - moved / 2, "{} of {all}, {moved} moved", inliers(true));
}

#[test]
fn the_candidate_with_most_inliers_wins() {
    let (camera, object) = (camera(), entry());
    let good = prediction(&truth());
    // Half of the mask: fewer inliers, and the pose's centre is away from the mask's.
    let mut half = good.clone();
    ball(&good).into_iter().filter(|i| i % SIDE < SIDE / 2).for_each(|i| half.visible[i] = 0.0);
    // The same number of pixels, of which a third are wrong.
    let mut worse = good.clone();
    ball(&good).into_iter().step_by(3).for_each(|i| worse.coordinates[i] = [0.9, -0.9, 0.9]);
    let views = vec![(0.1, crop(), half), (0.2, crop(), good), (0.3, crop(), worse)];
    let first_view = view(&crop(), &views[0].2);
    let order = |quirks: Quirks, views: Vec<(f32, Crop, Prediction)>| -> Vec<f32> {
        let options = Pix2PoseOptions { quirks, ..Pix2PoseOptions::default() };
        let context = Context { camera: &camera, object: &object, options: &options, visible: 1 };
        let found = context.best(views, first_view.clone(), first_view.clone()).unwrap();
        found.hypotheses.iter().map(|h| h.threshold).collect()
    };
    let threshold = order(Quirks::default(), views.clone());
    assert_eq!(threshold, [0.2, 0.3, 0.1]);
    let centre = Quirks { centre_choice: true, ..Quirks::default() };
    assert_eq!(order(centre, views), [0.2, 0.3, 0.1]);
    // With the choice by centres the smaller one wins if the larger one's mask is lopsided.
    let mut lopsided = prediction(&truth());
    ball(&lopsided).into_iter().filter(|i| i % SIDE < 28).for_each(|i| lopsided.visible[i] = 0.0);
    let mut small = prediction(&truth());
    let mid = SIDE as isize / 2;
    for i in ball(&small) {
        let (x, y) = ((i % SIDE) as isize - mid, (i / SIDE) as isize - mid);
        if x * x + y * y > 100 {
            small.visible[i] = 0.0;
        }
    }
    let views = vec![(0.1, crop(), lopsided), (0.2, crop(), small)];
    assert_eq!(order(Quirks::default(), views.clone()), [0.1, 0.2]);
    assert_eq!(order(centre, views), [0.2, 0.1]);
}

#[test]
fn eight_bits_quantise_the_coordinates() {
    let p = prediction(&truth());
    let quirks = Quirks { eight_bits: true, ..Quirks::default() };
    let c = candidate(&p, 0.2, &Pix2PoseOptions { quirks, ..Pix2PoseOptions::default() });
    let whole = |v: f64| ((v / RADIUS + 1.0) * 127.5 - ((v / RADIUS + 1.0) * 127.5).round()).abs() < 1e-3;
    assert!(c.object_points.iter().flat_map(|p| p.iter()).all(|v| whole(*v)));
    let c = candidate(&p, 0.2, &Pix2PoseOptions::default());
    assert!(!c.object_points.iter().flat_map(|p| p.iter()).all(|v| whole(*v)));
}

#[test]
fn the_second_crop_is_centred_on_the_mask() {
    // An L of network pixels: columns 40..44 by rows 10..30, and columns 44..52 by rows 26..30; a window of 128 pixels.
    let inside = |x: usize, y: usize| {
        ((40..44).contains(&x) && (10..30).contains(&y)) || ((44..52).contains(&x) && (26..30).contains(&y))
    };
    let mask: Vec<bool> = (0..SIDE * SIDE).map(|i| inside(i % SIDE, i / SIDE)).collect();
    let window = Window { centre: Vec2::new(300.0, 200.0), side: 128.0 };
    let options = Pix2PoseOptions::default();
    let boxed = recentred(&window, &mask, SIDE, &options);
    // The box: columns 40 to 51, rows 10 to 29; the centre of the window is pixel 31.5; a network pixel is two of the image.
    assert_eq!(boxed.centre, Vec2::new(300.0 + 2.0 * (45.5 - 31.5), 200.0 + 2.0 * (19.5 - 31.5)));
    assert_eq!(boxed.side, 0.6 * 128.0);
    let centroid = on_centroid(&window, &mask, SIDE);
    let mean =
        Vec2::new((80.0 * 41.5 + 32.0 * 47.5) / 112.0 - 31.5, (80.0 * 19.5 + 32.0 * 27.5) / 112.0 - 31.5);
    assert!((centroid.centre - (window.centre + mean * 2.0)).norm() < 1e-9);
    assert_eq!(centroid.side, 128.0);
    // The author's code adds pixels of a network of side 128 to pixels of the image.
    let quirks = Quirks { unscaled_recentring: true, ..Quirks::default() };
    let large = Window { side: 256.0, ..window };
    let unscaled = recentred(&large, &mask, SIDE, &Pix2PoseOptions { quirks, ..options });
    assert_eq!((unscaled.centre, unscaled.side), (boxed.centre, 256.0));
}

#[test]
fn the_second_crop_has_no_background() {
    let crop = crop();
    let mask: Vec<bool> = (0..SIDE * SIDE).map(|i| i % SIDE >= 32).collect();
    let closed = crop.without_background(&crop.window, &mask, SIDE);
    let area = SIDE * SIDE;
    for (i, v) in closed.pixels.iter().enumerate() {
        assert_eq!(*v, if i % area % SIDE >= 32 { 0.2 } else { GREY }, "{i}");
    }
    let grown = grown(&mask, SIDE);
    assert!((0..area).all(|i| grown[i] == (i % SIDE >= 31)));
}

#[test]
fn the_published_form_keeps_the_dissertations_parameters() {
    let published = Pix2PoseOptions::published();
    assert_eq!(published.inlier_threshold, Some(0.1));
    assert_eq!(published.reprojection, Reprojection::ImagePixels(3.0));
    assert_eq!((published.recentring, published.solver), (Recentring::Centroid, PnpSolver::Epnp));
    assert!(!published.open_candidate && published.two_stages && published.crop_factor == 1.5);
    assert!(published.check().is_ok());
    let wrong = Pix2PoseOptions { inlier_threshold: Some(0.0), ..published };
    assert_eq!(wrong.check().unwrap_err().option, "inlier_threshold");
}
