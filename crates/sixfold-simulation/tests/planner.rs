//! The planner on simulated depth views: what it proposes is held, and what it cannot use is refused with a reason.

use sixfold_geometry::{DepthImage, Mask, Pose, Vec3};
use sixfold_grasp::{
    AntipodalOptions, CompletionOptions, GraspView, Gripper, ViewError, ViewOptions, antipodal_grasps,
    complete_by_mirrors, find_objects,
};
use sixfold_mesh::Mesh;
use sixfold_render::DepthSensor;
use sixfold_simulation::{
    AttemptOptions, ConvexParts, PartsOptions, SimulatedView, ViewPoint, attempt, simulate_view,
};
use sixfold_synth::primitives as shapes;

fn hand() -> Gripper {
    Gripper::built_in("jaws-140").unwrap()
}

fn simulated(mesh: &Mesh, pose: &Pose) -> SimulatedView {
    let point = ViewPoint { azimuth: 0.3, elevation: 0.8, distance: 0.85, target: Vec3::new(0.0, 0.0, 0.05) };
    simulate_view(mesh, pose, &point, Some(&DepthSensor::kinect()), 3).unwrap()
}

fn view_of(seen: &SimulatedView) -> GraspView {
    let options = ViewOptions::default();
    let masks = find_objects(&seen.depth, &seen.camera, &options).unwrap();
    GraspView::new(&seen.depth, &seen.camera, &masks[0], &options).unwrap()
}

#[test]
fn most_first_proposals_on_simple_shapes_hold() {
    let shapes = [
        shapes::cuboid(Vec3::new(0.06, 0.1, 0.12)).unwrap(),
        shapes::cylinder(0.035, 0.1).unwrap(),
        shapes::cup(0.04, 0.1, 0.004).unwrap(),
        shapes::bowl(0.08, 0.055, 0.005).unwrap(),
        shapes::cuboid(Vec3::new(0.18, 0.025, 0.025)).unwrap(),
    ];
    let mut held = 0;
    for mesh in &shapes {
        let parts = ConvexParts::of_mesh(mesh, &PartsOptions::default()).unwrap();
        for number in 0..3 {
            let result = attempt(mesh, &parts, &hand(), &AttemptOptions::default(), 5, number).unwrap();
            held += usize::from(result.ending.is_success());
        }
    }
    assert!(held >= 13, "{held} of 15");
}

#[test]
fn the_far_side_of_a_can_is_completed_at_its_place() {
    let seen = simulated(&shapes::cylinder(0.035, 0.1).unwrap(), &Pose::identity());
    let view = view_of(&seen);
    let whole = complete_by_mirrors(&view, &CompletionOptions::default());
    assert_eq!(whole.planes.len(), 2);
    let assumed: Vec<f64> = whole.cloud.points[whole.observed..]
        .iter()
        .map(|p| seen.world_from_camera.transform_point(p))
        .filter(|p| p.z > 0.02 && p.z < 0.08)
        .map(|p| p.xy().norm())
        .collect();
    assert!(assumed.len() > 200, "{}", assumed.len());
    let mean = assumed.iter().sum::<f64>() / assumed.len() as f64;
    assert!((mean - 0.035).abs() < 0.006, "{mean}");
}

#[test]
fn every_grasp_fits_the_gripper_and_is_clear_of_the_table() {
    let seen = simulated(&shapes::cup(0.04, 0.1, 0.004).unwrap(), &Pose::identity());
    let view = view_of(&seen);
    let gripper = hand();
    let grasps = antipodal_grasps(&view, &gripper, &AntipodalOptions::default()).unwrap();
    assert!(grasps.len() > 20, "{}", grasps.len());
    for grasp in &grasps {
        assert!(grasp.opening <= gripper.max_opening && grasp.width < grasp.opening, "{grasp:?}");
        assert!((0.0..=1.0).contains(&grasp.quality.total()), "{grasp:?}");
        let world_from_gripper = seen.world_from_camera * grasp.camera_from_gripper;
        for part in gripper.boxes(grasp.opening) {
            for corner in part.corners() {
                assert!(world_from_gripper.transform_point(&corner).z > 0.0, "{grasp:?}");
            }
        }
    }
    // The same seed gives the same grasps, at one thread as at many.
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let again = one.install(|| antipodal_grasps(&view, &gripper, &AntipodalOptions::default())).unwrap();
    assert_eq!(grasps, again);
    let other =
        antipodal_grasps(&view, &gripper, &AntipodalOptions { seed: 1, ..AntipodalOptions::default() });
    assert_ne!(grasps, other.unwrap());
}

#[test]
fn an_object_wider_than_the_gripper_gives_no_grasp_across_it() {
    let seen = simulated(&shapes::cuboid(Vec3::new(0.12, 0.12, 0.1)).unwrap(), &lifted(0.05));
    let narrow = Gripper::built_in("jaws-85").unwrap();
    assert!(antipodal_grasps(&view_of(&seen), &narrow, &AntipodalOptions::default()).unwrap().is_empty());
    let none = AntipodalOptions { samples: 0, ..AntipodalOptions::default() };
    let error = antipodal_grasps(&view_of(&seen), &narrow, &none).unwrap_err().to_string();
    assert!(error.contains("samples") && error.contains("found 0"), "{error}");
}

fn lifted(height: f64) -> Pose {
    Pose::from_translation(Vec3::new(0.0, 0.0, height))
}

#[test]
fn views_without_an_object_are_refused_with_a_reason() {
    let seen = simulated(&shapes::cylinder(0.035, 0.1).unwrap(), &Pose::identity());
    let (depth, camera) = (&seen.depth, &seen.camera);
    let options = ViewOptions::default();
    let refused =
        |depth: &DepthImage, mask: &Mask| GraspView::new(depth, camera, mask, &options).unwrap_err();
    let (width, height) = depth.size();
    let full = |value| Mask::filled(width, height, value);
    assert_eq!(refused(depth, &full(false)), ViewError::EmptyMask);
    assert!(matches!(refused(depth, &Mask::filled(10, 10, true)), ViewError::MaskSize { .. }));
    assert!(matches!(
        refused(&DepthImage::filled(width, height, 0.0), &full(true)),
        ViewError::Depth(sixfold_geometry::DepthImageError::NoDepth { .. })
    ));
    let thousand = depth.map(|z| z * 1000.0);
    assert!(refused(&thousand, &full(true)).to_string().contains("factor of 1000"));
    // A mask of the bare table: nothing in it stands above it.
    let corner = Mask::from_fn(width, height, |x, y| x < 60 && y > height - 60);
    assert!(matches!(refused(depth, &corner), ViewError::NoDepthInMask { .. }));
    // Two cans, one mask.
    let two = Mesh::merged(&[
        shapes::cylinder(0.03, 0.1).unwrap(),
        shapes::cylinder(0.03, 0.1).unwrap().transformed(&Pose::from_translation(Vec3::new(0.0, 0.2, 0.0))),
    ]);
    let seen = simulated(&two.unwrap(), &Pose::identity());
    let error = GraspView::new(&seen.depth, &seen.camera, &full(true), &options).unwrap_err();
    assert!(matches!(error, ViewError::SeveralObjects { parts: 2, .. }), "{error}");
    assert_eq!(find_objects(&seen.depth, &seen.camera, &options).unwrap().len(), 2);
    // No table: a wall of noise-free steps is no plane.
    let stairs =
        DepthImage::from_fn(width, height, |x, y| 0.5 + 0.05 * ((x / 40 + 3 * (y / 40)) % 11) as f32);
    assert!(matches!(
        find_objects(
            &stairs,
            camera,
            &ViewOptions {
                plane: sixfold_geometry::PlaneOptions { min_fraction: 0.5, ..options.plane },
                ..options
            }
        ),
        Err(ViewError::NoTable { .. })
    ));
}

#[test]
fn an_object_at_the_edge_of_the_image_is_marked_as_cut() {
    let seen =
        simulated(&shapes::cylinder(0.035, 0.1).unwrap(), &Pose::from_translation(Vec3::new(0.0, 0.45, 0.0)));
    assert!(view_of(&seen).cut_by_edge);
    let seen = simulated(&shapes::cylinder(0.035, 0.1).unwrap(), &Pose::identity());
    assert!(!view_of(&seen).cut_by_edge);
}
