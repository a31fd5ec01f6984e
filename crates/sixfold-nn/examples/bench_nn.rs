//! Times a training step of ResNet-50 up to its third layer on random numbers, for `benches/nn_vs_pytorch.py`.
//!
//! `bench_nn BATCH SIDE REPEATS`: prints a JSON object with the median and all times in seconds. A step is forward, the mean of
//! the squared last map, and backward.

use std::error::Error;
use std::time::Instant;

use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use sixfold_nn::resnet::ResNet50Config;

fn main() -> Result<(), Box<dyn Error>> {
    let numbers: Vec<usize> = std::env::args().skip(1).map(|a| a.parse()).collect::<Result<_, _>>()?;
    let [batch, side, repeats] = numbers[..] else { return Err("expected BATCH SIDE REPEATS".into()) };
    let device = Device::default().autodiff();
    let network = ResNet50Config::features(3).init(0, &device);
    let values: Vec<f32> = (0..batch * 3 * side * side).map(|i| ((i * i) as f32 * 1e-3).sin()).collect();
    let x = Tensor::<4>::from_data(TensorData::new(values, [batch, 3, side, side]), &device);
    let mut times: Vec<f64> = (0..repeats.max(1) + 2)
        .map(|_| {
            let start = Instant::now();
            let maps = network.features(x.clone());
            let loss = maps[3].clone().square().mean();
            drop(maps);
            let gradients = GradientsParams::from_grads(loss.backward(), &network);
            assert!(!gradients.is_empty());
            start.elapsed().as_secs_f64()
        })
        .skip(2)
        .collect();
    times.sort_by(f64::total_cmp);
    println!("{}", serde_json::json!({ "median": times[times.len() / 2], "times": times }));
    Ok(())
}
