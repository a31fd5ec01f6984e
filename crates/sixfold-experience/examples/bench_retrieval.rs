//! Milliseconds to find the ten nearest of many experiences: `cargo run --release -p sixfold-experience --example bench_retrieval
//! [COUNT]` (default 100000 features).

use std::time::Instant;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_experience::{FEATURE, FeatureIndex};

fn main() {
    let count: usize = std::env::args().nth(1).and_then(|n| n.parse().ok()).unwrap_or(100_000);
    let mut random = ChaCha8Rng::seed_from_u64(0);
    // Clusters, as families of objects are.
    let centres: Vec<Vec<f32>> =
        (0..40).map(|_| (0..FEATURE).map(|_| random.random_range(-0.8f32..0.8)).collect()).collect();
    let mut draw = |i: usize| -> Vec<f32> {
        centres[i % 40].iter().map(|c| (c + random.random_range(-0.2f32..0.2)).clamp(-1.0, 1.0)).collect()
    };
    let mut index = FeatureIndex::new("bench");
    for i in 0..count {
        index.insert(i as i64, 0.0, &draw(i));
    }
    let queries: Vec<Vec<f32>> = (0..101).map(&mut draw).collect();
    let mut times: Vec<f64> = queries
        .iter()
        .map(|query| {
            let began = Instant::now();
            let found = index.nearest(query, 10, |_| true);
            assert_eq!(found.len(), 10.min(count));
            1000.0 * began.elapsed().as_secs_f64()
        })
        .collect();
    times.sort_by(f64::total_cmp);
    println!(
        "{count} features of {FEATURE} numbers, ten nearest, exact: median {:.2} ms, fastest {:.2} ms, slowest {:.2} ms",
        times[50], times[0], times[100]
    );
}
