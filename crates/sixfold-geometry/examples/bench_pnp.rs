//! Solves the PnP cases of `benches/pnp_vs_poselib.py` and times the solver alone:
//! `cargo run --release -p sixfold-geometry --example bench_pnp -- CASES [ap3p|epnp] [--min N] [--noise-window X] ...`.
//!
//! CASES, little-endian: `fx fy cx cy` (f64), number of cases and of correspondences in each (u64), then per case object points
//! (n x 3 f64, metres) and image points (n x 2 f64, pixels). Prints one line per case: milliseconds (median of three), samples,
//! rotation (row by row), translation in metres.

use std::time::Instant;

use sixfold_geometry::{Camera, PnpOptions, PnpSolver, Vec2, Vec3, pnp_ransac};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let bytes = std::fs::read(arguments.first().ok_or("which file of cases?")?)?;
    let mut options = PnpOptions::default();
    for pair in arguments[1..].windows(2) {
        match pair[0].as_str() {
            "--threshold" => options.threshold_px = pair[1].parse()?,
            "--min" => options.min_iterations = pair[1].parse()?,
            "--noise-window" => options.noise_window = pair[1].parse()?,
            "--local" => options.local_iterations = pair[1].parse()?,
            "--confidence" => options.confidence = pair[1].parse()?,
            _ => {}
        }
    }
    if arguments.iter().any(|a| a == "epnp") {
        options.solver = PnpSolver::Epnp;
    }
    let mut words = bytes.chunks_exact(8).map(|c| <[u8; 8]>::try_from(c).expect("eight bytes"));
    let mut word = || words.next().ok_or("the file ends too early");
    let [fx, fy, cx, cy] = [
        f64::from_le_bytes(word()?),
        f64::from_le_bytes(word()?),
        f64::from_le_bytes(word()?),
        f64::from_le_bytes(word()?),
    ];
    let camera = Camera::new(fx, fy, cx, cy, 640, 480)?;
    let (cases, n) = (u64::from_le_bytes(word()?), u64::from_le_bytes(word()?));
    for _ in 0..cases {
        let mut number = || word().map(f64::from_le_bytes);
        let mut points = vec![];
        for _ in 0..n {
            points.push(Vec3::new(number()?, number()?, number()?));
        }
        let mut pixels = vec![];
        for _ in 0..n {
            pixels.push(Vec2::new(number()?, number()?));
        }
        let mut times = vec![];
        let mut found = pnp_ransac(&points, &pixels, &camera, &options)?;
        for _ in 0..3 {
            let start = Instant::now();
            found = pnp_ransac(&points, &pixels, &camera, &options)?;
            times.push(start.elapsed().as_secs_f64() * 1e3);
        }
        times.sort_by(f64::total_cmp);
        print!("{} {}", times[1], found.iterations);
        for v in found.camera_from_object.rotation_matrix().transpose().iter() {
            print!(" {v:.17e}");
        }
        for v in found.camera_from_object.translation().iter() {
            print!(" {v:.17e}");
        }
        println!();
    }
    Ok(())
}
