//! Time of the compact detector: on a whole image, and of a training step on a crop.
//!
//!     cargo run --release -p sixfold-detect --example bench_detect

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use sixfold_detect::network::DetectorConfig;
use std::time::Instant;

/// Seconds of processor time of all threads so far (Linux; 0 elsewhere).
fn processor_seconds() -> f64 {
    let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<f64> = text.split(' ').skip(13).take(2).filter_map(|v| v.parse().ok()).collect();
    fields.iter().sum::<f64>() / 100.0
}

/// Milliseconds of wall clock and of processor time of one call.
fn time(calls: u32, mut call: impl FnMut()) -> (f64, f64) {
    call();
    let (start, before) = (Instant::now(), processor_seconds());
    (0..calls).for_each(|_| call());
    let each = 1000.0 / f64::from(calls);
    (start.elapsed().as_secs_f64() * each, (processor_seconds() - before) * each)
}

fn main() {
    let config = DetectorConfig::compact(8);
    let image = |height: usize, width: usize, device: &Device| {
        let values: Vec<f32> = (0..3 * height * width).map(|i| (i % 255) as f32 / 128.0 - 1.0).collect();
        Tensor::<4>::from_data(TensorData::new(values, [1, 3, height, width]), device)
    };
    let device = Device::flex();
    let network = config.init(1, &device);
    println!("{} parameters; milliseconds of wall clock and of processor time", network.num_params());
    let x = image(480, 640, &device);
    let (wall, processor) = time(10, || drop(network.forward(x.clone())));
    println!("640x480: {wall:.0}, {processor:.0}");
    let (wall, processor) = time(10, || drop(network.encoder.maps(x.clone())));
    println!("640x480, encoder alone: {wall:.0}, {processor:.0}");
    for side in [256, 320] {
        for frozen in [2, 3] {
            let device = Device::flex().autodiff();
            let network = config.init(1, &device).freeze(frozen);
            let x = image(side, side, &device);
            let (wall, processor) = time(10, || {
                let out = network.forward(x.clone());
                let sums = out.scores.into_iter().chain(out.boxes).chain([out.prototypes]).map(|t| t.sum());
                drop(sums.reduce(|a, b| a + b).map(|loss| loss.backward()));
            });
            println!(
                "{side}x{side}, {frozen} stages frozen, forward and backward: {wall:.0}, {processor:.0}"
            );
        }
    }
}
