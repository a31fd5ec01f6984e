//! Example 3: a pose from points of an object and their pixels, a quarter of them wrong:
//! `cargo run -p sixfold --example 03_pnp`.

use sixfold::geometry::{PnpOptions, Vec2, pnp_ransac};
use sixfold::prelude::*;
use sixfold::synth::primitives::mug;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let camera = Camera::new(572.4, 573.6, 325.3, 242.0, 640, 480)?;
    let truth =
        Pose::exp(&[0.0, 0.0, 0.0, 1.9, 0.3, 0.4].into()).with_translation(Vec3::new(0.05, -0.02, 0.7));

    // Correspondences: 100 points of the surface and their pixels, with half a pixel of noise.
    let points = mug(0.04, 0.10, 0.004, 0.03)?.sample_surface(100, 0).points;
    let mut pixels: Vec<Vec2> = vec![];
    for (k, point) in points.iter().enumerate() {
        let pixel = camera.project(&truth.transform_point(point)).ok_or("behind the camera")?;
        let noise = Vec2::new((7.0 * k as f64).sin(), (11.0 * k as f64).cos()) * 0.5;
        pixels.push(if k % 4 == 0 { Vec2::new(40.0 + 5.0 * k as f64, 30.0) } else { pixel + noise });
    }

    let found = pnp_ransac(&points, &pixels, &camera, &PnpOptions::default())?;
    println!("{} of {} correspondences agree, {:.2} px", found.inlier_count, points.len(), found.rms_px);
    println!(
        "error: {:.2} mm, {:.3} degrees",
        1000.0 * found.camera_from_object.distance_to(&truth),
        found.camera_from_object.rotation_angle_to(&truth).to_degrees()
    );
    Ok(())
}
