//! Times the sensor simulation: `cargo run --release -p sixfold-render --example bench_sensor`. 640x480 pixels of a bumpy wall,
//! all of rayon's threads, median of 60 frames after warming up.

use std::time::Instant;

use sixfold_geometry::{DepthImage, Image};
use sixfold_render::{DepthSensor, simulate_depth};

fn main() {
    let depth = DepthImage::from_fn(640, 480, |x, y| {
        let wall = 0.9 + 0.0005 * y as f32;
        if (x / 80 + y / 80) % 3 == 0 { wall - 0.15 } else { wall }
    });
    let normals = Image::from_fn(640, 480, |x, _| {
        let angle = 0.5 * (x as f32 / 40.0).sin();
        [angle.sin(), 0.0, -angle.cos()]
    });
    println!("{} threads", rayon::current_num_threads());
    for (name, sensor) in [
        ("kinect", DepthSensor::kinect()),
        ("xtion", DepthSensor::xtion()),
        ("realsense", DepthSensor::realsense()),
    ] {
        let mut ms: Vec<f64> = (0..70)
            .map(|seed| {
                let start = Instant::now();
                let out = simulate_depth(&depth, &normals, &sensor, seed);
                assert!(out.as_slice().iter().any(|&z| z > 0.0));
                start.elapsed().as_secs_f64() * 1e3
            })
            .skip(10)
            .collect();
        ms.sort_by(f64::total_cmp);
        println!("{name:<10} {:.2} ms, {:.0} frames/s", ms[ms.len() / 2], 1000.0 / ms[ms.len() / 2]);
    }
}
