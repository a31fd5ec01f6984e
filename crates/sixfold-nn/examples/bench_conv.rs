//! Times convolutions of the sizes in a JSON list of `[batch, inputs, outputs, side, kernel, stride]`, given as the only argument, and prints
//! the median of each in milliseconds, as a JSON list. Called by `benches/conv_vs_pytorch.py`.

use std::time::Instant;

use burn::tensor::{Device, Tensor};
use sixfold_geometry::random::stream;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{ConvConfig, Padding};

const RUNS: usize = 25;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let sizes = std::env::args().nth(1).ok_or("the sizes are missing")?;
    let sizes: Vec<[usize; 6]> = serde_json::from_str(&sizes)?;
    let device = Device::default();
    let mut random = stream(0, 0);
    let mut medians = Vec::new();
    for [batch, inputs, outputs, side, kernel, stride] in sizes {
        let config = ConvConfig {
            padding: Padding::Zeros(kernel / 2),
            ..ConvConfig::new([inputs, outputs], kernel, Activation::Relu).with_stride(stride)
        };
        let layer = config.init(2.0, &mut random, &device);
        let x = Tensor::<4>::ones([batch, inputs, side, side], &device);
        let mut times: Vec<f64> = (0..RUNS)
            .map(|_| {
                let start = Instant::now();
                std::hint::black_box(layer.forward(x.clone()));
                start.elapsed().as_secs_f64() * 1e3
            })
            .collect();
        times.sort_by(f64::total_cmp);
        medians.push(times[RUNS / 2]);
    }
    println!("{}", serde_json::to_string(&medians)?);
    Ok(())
}
