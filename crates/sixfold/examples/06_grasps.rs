//! Example 6: grasps from one depth image of a mug on a table, and a trial of the best one in a physics engine:
//! `cargo run --release -p sixfold --example 06_grasps`.

use sixfold::grasp::{
    AntipodalOptions, ClusterOptions, GraspView, Gripper, ViewOptions, antipodal_grasps, cluster_grasps,
    find_objects,
};
use sixfold::prelude::*;
use sixfold::render::DepthSensor;
use sixfold::simulation::{ConvexParts, PartsOptions, TrialOptions, ViewPoint, simulate_view, try_grasp};
use sixfold::synth::primitives::mug;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    // The world: z up, the table at z = 0.
    let (mesh, world_from_object) = (mug(0.035, 0.09, 0.004, 0.03)?, Pose::identity());
    let eye = ViewPoint { azimuth: 0.3, elevation: 0.9, distance: 0.7, target: Vec3::new(0.0, 0.0, 0.04) };
    let seen = simulate_view(&mesh, &world_from_object, &eye, Some(&DepthSensor::realsense()), 0)?;

    // From here on only the depth image is used.
    let options = ViewOptions::default();
    let masks = find_objects(&seen.depth, &seen.camera, &options)?;
    let mask = masks.first().ok_or("no object found on the table")?;
    let view = GraspView::new(&seen.depth, &seen.camera, mask, &options)?;
    let gripper = Gripper::built_in("jaws-85").ok_or("no such gripper")?;
    let grasps = antipodal_grasps(&view, &gripper, &AntipodalOptions::default())?;
    let clusters = cluster_grasps(&grasps, &ClusterOptions::default());
    println!("{} grasps in {} clusters", grasps.len(), clusters.len());
    let best = clusters.first().ok_or("no grasp")?.best;
    println!("the best: pads {:.0} mm apart, quality {:.2}", 1000.0 * best.opening, best.quality.total());

    // The robot tries it: approach, close, lift, shake.
    let parts = ConvexParts::of_mesh(&mesh, &PartsOptions::default())?;
    let world_from_gripper = seen.world_from_camera * best.camera_from_gripper;
    let options = TrialOptions::default();
    let report =
        try_grasp(&parts, &world_from_object, &gripper, &world_from_gripper, best.opening, &options)?;
    println!("{:?}", report.outcome);
    Ok(())
}
