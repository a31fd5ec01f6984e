//! Times the rasteriser: `cargo run --release -p sixfold-render --example bench_render [-- FOLDER]`. With a folder the mesh and the
//! last depth image are written there for `benches/render_vs_open3d.py`: vertices in the camera frame (f64), faces (u32), depth (f32).
//!
//! A closed mesh of 20,000 triangles covering about 70,000 of 640x480 pixels; depth and object
//! coordinates, one thread; median of 200 frames. The images are reused ([`Canvas`]), as in a renderer of training images or of
//! pose hypotheses; new images for each frame are timed as well.

use std::time::Instant;

use sixfold_geometry::{Camera, Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{Canvas, RenderOptions, SceneObject, VisibilityBuffer};

fn bumpy_sphere(rows: u32, columns: u32) -> Mesh {
    let mut vertices = vec![];
    for i in 0..=rows {
        let theta = std::f64::consts::PI * f64::from(i) / f64::from(rows);
        for j in 0..columns {
            let phi = std::f64::consts::TAU * f64::from(j) / f64::from(columns);
            let n = Vec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
            vertices.push(n * (0.1 + 0.004 * (7.0 * phi).sin() * (5.0 * theta).sin()));
        }
    }
    let mut faces = vec![];
    for i in 0..rows {
        for j in 0..columns {
            let k = (j + 1) % columns;
            let (a, b, c, d) =
                (i * columns + j, i * columns + k, (i + 1) * columns + j, (i + 1) * columns + k);
            faces.push([a, c, b]);
            faces.push([b, c, d]);
        }
    }
    Mesh::new(vertices, faces).expect("a valid sphere")
}

fn main() {
    let camera = Camera::new(572.4, 573.6, 325.3, 242.0, 640, 480).expect("a valid camera");
    let mesh = bumpy_sphere(100, 100);
    let mut frame = VisibilityBuffer::new(&camera);
    let mut depth_ms = vec![];
    let mut both_ms = vec![];
    let mut fresh_ms = vec![];
    let mut depth = Canvas::new(640, 480, 0.0);
    let mut coordinates = Canvas::new(640, 480, [f32::NAN; 3]);
    let mut pixels = 0;
    let mut last_pose = Pose::identity();
    for i in 0..200 {
        let turn = Pose::exp(&[0.0, 0.0, 0.0, 0.3, 0.03 * f64::from(i), 0.1].into());
        let pose = Pose::from_translation(Vec3::new(0.0, 0.0, 0.4)) * turn;
        last_pose = pose;
        let objects = [SceneObject { mesh: &mesh, camera_from_object: pose }];
        let start = Instant::now();
        frame.render(&objects, &RenderOptions::default());
        frame.depth_into(&mut depth);
        depth_ms.push(start.elapsed().as_secs_f64() * 1e3);
        frame.object_coordinates_into(&objects, &mut coordinates);
        both_ms.push(start.elapsed().as_secs_f64() * 1e3);
        pixels = depth.image().as_slice().iter().filter(|&&z| z > 0.0).count();
        assert!(coordinates.image().as_slice().iter().filter(|c| c[0].is_finite()).count() == pixels);
        let start = Instant::now();
        frame.render(&objects, &RenderOptions::default());
        let fresh = (frame.depth(), frame.object_coordinates(&objects));
        fresh_ms.push(start.elapsed().as_secs_f64() * 1e3);
        assert!(&fresh.0 == depth.image());
    }
    if let Some(folder) = std::env::args().nth(1) {
        let folder = std::path::Path::new(&folder);
        let write = |name: &str, bytes: Vec<u8>| {
            std::fs::write(folder.join(name), bytes).unwrap_or_else(|e| panic!("{name}: {e}"));
        };
        let vertices = mesh.vertices().iter().map(|v| last_pose.transform_point(v));
        write("vertices.bin", vertices.flat_map(|v| [v.x, v.y, v.z]).flat_map(f64::to_le_bytes).collect());
        write("faces.bin", mesh.faces().iter().flatten().flat_map(|i| i.to_le_bytes()).collect());
        write("depth.bin", depth.image().as_slice().iter().flat_map(|z| z.to_le_bytes()).collect());
    }
    depth_ms.sort_by(f64::total_cmp);
    both_ms.sort_by(f64::total_cmp);
    fresh_ms.sort_by(f64::total_cmp);
    println!("{} triangles, {pixels} pixels, 640x480, one thread", mesh.faces().len());
    println!("depth               median {:.2} ms, fastest {:.2} ms", depth_ms[100], depth_ms[0]);
    println!("depth + coordinates median {:.2} ms, fastest {:.2} ms", both_ms[100], both_ms[0]);
    println!("the same, fresh images median {:.2} ms, fastest {:.2} ms", fresh_ms[100], fresh_ms[0]);
}
