//! Example 4: a rough pose aligned with a noisy depth image by point-to-plane ICP:
//! `cargo run -p sixfold --example 04_icp`.

use sixfold::geometry::{DepthTarget, IcpOptions, NormalOptions, PointCloud, icp, normals_from_depth};
use sixfold::prelude::*;
use sixfold::render::{DepthSensor, render_depth, simulate_depth};
use sixfold::synth::primitives::mug;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let camera = Camera::new(572.4, 573.6, 325.3, 242.0, 640, 480)?;
    let mesh = mug(0.04, 0.10, 0.004, 0.03)?;
    let truth =
        Pose::exp(&[0.0, 0.0, 0.0, 1.9, 0.3, 0.4].into()).with_translation(Vec3::new(0.05, -0.02, 0.7));

    // What a depth camera would measure.
    let ideal = render_depth(&mesh, &truth, &camera);
    let of_ideal = normals_from_depth(&ideal, &camera, &NormalOptions::default());
    let depth = simulate_depth(&ideal, &of_ideal, &DepthSensor::realsense(), 0);
    let normals = normals_from_depth(&depth, &camera, &NormalOptions::default());
    let target = DepthTarget { depth: &depth, normals: &normals, camera: &camera };

    // The source is the visible surface of the mesh at the rough pose, in the object's frame.
    let start = truth * Pose::exp(&[0.006, -0.004, 0.005, 0.05, -0.04, 0.03].into());
    let rendered = render_depth(&mesh, &start, &camera);
    let source = PointCloud::from_depth(&rendered, None, &camera).transformed(&start.inverse());

    let report = icp(&source, &target, &start, &IcpOptions::coarse_to_fine(0.02))?;
    for (name, pose) in [("before", start), ("after", report.target_from_source)] {
        let (metres, angle) = (pose.distance_to(&truth), pose.rotation_angle_to(&truth));
        println!("{name}: {:.2} mm, {:.2} degrees", 1000.0 * metres, angle.to_degrees());
    }
    println!("{} correspondences, {:.2} mm", report.inliers, 1000.0 * report.rms);
    Ok(())
}
