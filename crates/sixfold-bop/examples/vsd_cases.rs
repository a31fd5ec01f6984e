//! Writes depth images and the VSD that this crate computes for them, for `checks/vsd_independent.py`.
//!
//!     cargo run -p sixfold-bop --example vsd_cases -- FOLDER
//!
//! For each case three raw little-endian f32 images (estimate, ground truth, test; metres, row by row) and, in
//! `cases.json`, the camera, diameter, delta, taus and the errors.

use std::error::Error;
use std::path::Path;

use serde_json::json;
use sixfold_bop::{VsdOptions, vsd};
use sixfold_geometry::nalgebra::Vector6;
use sixfold_geometry::{Camera, DepthImage, Image, Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::render_depth;

/// A wavy ball with a size of about 0.1 m.
fn ball() -> Result<Mesh, Box<dyn Error>> {
    let (rings, steps) = (24u32, 48u32);
    let at = |i: u32, j: u32| {
        let (a, b) = (f64::from(i) / f64::from(rings), f64::from(j) / f64::from(steps));
        let (polar, around) = (std::f64::consts::PI * a, std::f64::consts::TAU * b);
        let radius = 0.05 * (1.0 + 0.2 * (3.0 * around).sin() * polar.sin());
        radius * Vec3::new(polar.sin() * around.cos(), polar.sin() * around.sin(), polar.cos())
    };
    let vertices = (0..=rings).flat_map(|i| (0..steps).map(move |j| at(i, j))).collect();
    let quad = |i: u32, j: u32| {
        let (a, b) = (i * steps + j, i * steps + (j + 1) % steps);
        [[a, b, a + steps], [b, b + steps, a + steps]]
    };
    let faces = (0..rings).flat_map(|i| (0..steps).flat_map(move |j| quad(i, j))).collect();
    Ok(Mesh::new(vertices, faces)?)
}

fn main() -> Result<(), Box<dyn Error>> {
    let folder = std::env::args().nth(1).ok_or("usage: vsd_cases FOLDER")?;
    let folder = Path::new(&folder);
    std::fs::create_dir_all(folder)?;
    let mesh = ball()?;
    let diameter = mesh.diameter();
    let camera = Camera::new(280.0, 300.0, 85.0, 55.0, 160, 120)?;
    let options = VsdOptions::default();
    let write = |name: String, image: &DepthImage| {
        let bytes: Vec<u8> = image.as_slice().iter().flat_map(|z| z.to_le_bytes()).collect();
        std::fs::write(folder.join(name), bytes)
    };
    let mut cases = Vec::new();
    for case in 0..20u32 {
        // Poses and noise from a small counter hash: the same in every run.
        let random = |n: u32| {
            let mixed = (case * 1000 + n).wrapping_mul(2_654_435_761) ^ 0x9e37_79b9;
            f64::from((mixed ^ (mixed >> 15)).wrapping_mul(2_246_822_519) >> 8) / f64::from(1u32 << 24) - 0.5
        };
        let truth =
            Pose::from_translation(Vec3::new(0.1 * random(1), 0.08 * random(2), 0.4 + 0.1 * random(3)));
        let far = 0.2 + f64::from(case % 5) * 0.3;
        let twist: [f64; 6] =
            std::array::from_fn(|i| far * random(10 + i as u32) * if i < 3 { 0.08 } else { 1.0 });
        let estimate = truth * Pose::exp(&Vector6::from(twist));
        let (e, g) = (render_depth(&mesh, &estimate, &camera), render_depth(&mesh, &truth, &camera));
        // The sensor sees the object with noise, holes, an occluder over a third and a table behind it.
        let test = Image::from_fn(camera.width, camera.height, |x, y| {
            let noise = random(100 + (y * camera.width + x) as u32);
            let occluded = x as f64 > 95.0 + 30.0 * random(50);
            let seen = if g[(x, y)] > 0.0 { f64::from(g[(x, y)]) } else { 0.6 };
            let z = if occluded && case % 2 == 0 { 0.3 } else { seen + 0.04 * noise };
            if noise > 0.42 { 0.0 } else { z as f32 }
        });
        let errors = vsd(&e, &g, &test, &camera, diameter, &options)?;
        for (name, image) in [("estimate", &e), ("truth", &g), ("test", &test)] {
            write(format!("{case:02}_{name}.f32"), image)?;
        }
        cases.push(json!({
            "case": format!("{case:02}"), "width": camera.width, "height": camera.height, "fx": camera.fx,
            "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "diameter": diameter, "delta": options.delta,
            "taus": options.taus.values(), "errors": errors,
        }));
    }
    std::fs::write(folder.join("cases.json"), serde_json::to_string_pretty(&cases)?)?;
    Ok(())
}
