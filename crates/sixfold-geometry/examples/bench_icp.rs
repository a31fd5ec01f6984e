//! Aligns the clouds of `benches/icp_vs_open3d_small_gicp.py`:
//! `cargo run --release -p sixfold-geometry --example bench_icp -- CLOUDS`.
//!
//! CLOUDS, little-endian: number of cases (u64); per case the numbers of target and source points (u64), target points and
//! normals, source points and normals (n x 3 f64 each, metres), the initial pose (12 f64, rows of `[R t]`). Prints one line per
//! case: milliseconds to build the index, milliseconds to align (median of three), rotation (row by row), translation.

use std::time::Instant;

use sixfold_geometry::{IcpOptions, IndexedCloud, Mat3, PointCloud, Pose, Vec3, icp};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let bytes = std::fs::read(std::env::args().nth(1).ok_or("which file of clouds?")?)?;
    let mut words = bytes.chunks_exact(8).map(|c| <[u8; 8]>::try_from(c).expect("eight bytes"));
    let mut word = || words.next().ok_or("the file ends too early");
    let options = IcpOptions::coarse_to_fine(0.02);
    for _ in 0..u64::from_le_bytes(word()?) {
        let counts = [u64::from_le_bytes(word()?), u64::from_le_bytes(word()?)];
        let mut number = || word().map(f64::from_le_bytes);
        let mut vectors = |n: u64| -> Result<Vec<Vec3>, &str> {
            (0..n).map(|_| Ok(Vec3::new(number()?, number()?, number()?))).collect()
        };
        let target = PointCloud { points: vectors(counts[0])?, normals: vectors(counts[0])? };
        let source = PointCloud { points: vectors(counts[1])?, normals: vectors(counts[1])? };
        let rows: Vec<f64> = (0..12).map(|_| number()).collect::<Result<_, _>>()?;
        let rotation = Mat3::from_fn(|i, j| rows[4 * i + j]);
        let initial = Pose::from_parts(&rotation, Vec3::new(rows[3], rows[7], rows[11]))?;
        let (mut build, mut align, mut pose) = (vec![], vec![], initial);
        for _ in 0..3 {
            let cloud = target.clone();
            let start = Instant::now();
            let indexed = IndexedCloud::new(cloud)?;
            build.push(start.elapsed().as_secs_f64() * 1e3);
            let start = Instant::now();
            if let Ok(found) = icp(&source, &indexed, &initial, &options) {
                pose = found.target_from_source;
            }
            align.push(start.elapsed().as_secs_f64() * 1e3);
        }
        build.sort_by(f64::total_cmp);
        align.sort_by(f64::total_cmp);
        print!("{} {}", build[1], align[1]);
        for v in pose.rotation_matrix().transpose().iter().chain(pose.translation().iter()) {
            print!(" {v:.17e}");
        }
        println!();
    }
    Ok(())
}
