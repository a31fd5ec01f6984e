//! The simulated hand against what physics says by hand.

use sixfold_geometry::{Pose, Vec3};
use sixfold_grasp::{Gripper, gripper_pose};
use sixfold_simulation::{ConvexParts, Outcome, PartsOptions, TrialOptions, try_grasp};
use sixfold_synth::primitives as shapes;

fn hand() -> Gripper {
    Gripper::built_in("jaws-85").unwrap()
}

fn from_above(tip: Vec3) -> Pose {
    gripper_pose(&tip, &-Vec3::z(), &Vec3::x()).unwrap()
}

fn cube() -> (ConvexParts, Pose) {
    let parts = ConvexParts::of_convex(&shapes::cuboid(Vec3::repeat(0.05)).unwrap()).unwrap();
    (parts, Pose::from_translation(Vec3::new(0.0, 0.0, 0.025)))
}

#[test]
fn a_cube_is_held_by_friction_and_slips_without() {
    let (parts, pose) = cube();
    let grasp = from_above(Vec3::new(0.0, 0.0, 0.008));
    let held = try_grasp(&parts, &pose, &hand(), &grasp, 0.07, &TrialOptions::default()).unwrap();
    assert_eq!(held.outcome, Outcome::Held);
    assert!(held.slip < 0.002 && held.turn < 0.02, "{held:?}");
    assert!((held.gap - 0.05).abs() < 0.001 && (held.raised - 0.1).abs() < 0.002, "{held:?}");
    let slippery = Gripper { friction: 0.0, ..hand() };
    let lost = try_grasp(&parts, &pose, &slippery, &grasp, 0.07, &TrialOptions::default()).unwrap();
    assert_eq!(lost.outcome, Outcome::LostInLift);
    assert!(lost.raised < 0.01, "{lost:?}");
}

#[test]
fn the_force_that_holds_is_that_of_coulombs_law() {
    // 2 mu F >= m (g + a): with mu 0.5 and 0.2 kg, 1.96 N hold the weight; the shake adds 0.02 m (4 pi / s)^2 = 3.2 m/s^2.
    let (parts, pose) = cube();
    let grasp = from_above(Vec3::new(0.0, 0.0, 0.008));
    let with = |force: f64| {
        let gripper = Gripper { force, ..hand() };
        try_grasp(&parts, &pose, &gripper, &grasp, 0.07, &TrialOptions::default()).unwrap()
    };
    assert_eq!(with(1.7).outcome, Outcome::LostInLift);
    assert_eq!(with(3.2).outcome, Outcome::Held);
}

#[test]
fn a_cylinder_off_its_centre_is_squeezed_out_and_inside_the_cone_it_is_held() {
    let parts = ConvexParts::of_convex(&shapes::cylinder(0.03, 0.1).unwrap()).unwrap();
    let pose = Pose::identity();
    // mu 0.5: the normals may be 26 degrees off the closing axis, 0.44 radii off the centre; y is across the fingers.
    let narrow = Gripper { finger_width: 0.004, ..hand() };
    let at = |y: f64| {
        let grasp = from_above(Vec3::new(0.0, y, 0.06));
        try_grasp(&parts, &pose, &narrow, &grasp, 0.08, &TrialOptions::default()).unwrap()
    };
    assert_eq!(at(0.0).outcome, Outcome::Held);
    assert_eq!(at(0.006).outcome, Outcome::Held);
    assert_ne!(at(0.024).outcome, Outcome::Held, "{:?}", at(0.024));
}

#[test]
fn a_gripper_beside_the_object_misses_and_one_under_the_table_is_blocked() {
    let (parts, pose) = cube();
    let options = TrialOptions::default();
    let beside = from_above(Vec3::new(0.0, 0.2, 0.008));
    assert_eq!(try_grasp(&parts, &pose, &hand(), &beside, 0.07, &options).unwrap().outcome, Outcome::Missed);
    let under = from_above(Vec3::new(0.0, 0.0, -0.01));
    assert_eq!(try_grasp(&parts, &pose, &hand(), &under, 0.07, &options).unwrap().outcome, Outcome::Blocked);
    let wide = try_grasp(&parts, &pose, &hand(), &beside, 0.2, &options).unwrap_err().to_string();
    assert!(wide.contains("opening") && wide.contains("0.2"), "{wide}");
    let heavy = TrialOptions { mass: 200.0, ..options };
    let heavy = try_grasp(&parts, &pose, &hand(), &beside, 0.07, &heavy).unwrap_err().to_string();
    assert!(heavy.contains("mass") && heavy.contains("0.001 to 20 kg"), "{heavy}");
}

#[test]
fn a_cup_is_lifted_by_its_wall() {
    let cup = shapes::cup(0.04, 0.09, 0.004).unwrap();
    let parts = ConvexParts::of_mesh(&cup, &PartsOptions::default()).unwrap();
    let grasp = from_above(Vec3::new(0.038, 0.0, 0.06));
    let report =
        try_grasp(&parts, &Pose::identity(), &hand(), &grasp, 0.03, &TrialOptions::default()).unwrap();
    assert_eq!(report.outcome, Outcome::Held, "{report:?}");
    assert!(report.gap > 0.003 && report.gap < 0.008, "{report:?}");
}

#[test]
fn the_same_trial_gives_the_same_numbers() {
    let bowl = shapes::bowl(0.06, 0.05, 0.004).unwrap();
    let parts = ConvexParts::of_mesh(&bowl, &PartsOptions::default()).unwrap();
    assert_eq!(parts, ConvexParts::of_mesh(&bowl, &PartsOptions::default()).unwrap());
    let grasp = from_above(Vec3::new(0.056, 0.0, 0.03));
    let run =
        || try_grasp(&parts, &Pose::identity(), &hand(), &grasp, 0.03, &TrialOptions::default()).unwrap();
    let first = run();
    assert_eq!(first, run());
    assert_eq!(first, std::thread::spawn(run_again(parts.clone(), grasp)).join().unwrap());
}

fn run_again(parts: ConvexParts, grasp: Pose) -> impl FnOnce() -> sixfold_simulation::TrialReport {
    move || try_grasp(&parts, &Pose::identity(), &hand(), &grasp, 0.03, &TrialOptions::default()).unwrap()
}
