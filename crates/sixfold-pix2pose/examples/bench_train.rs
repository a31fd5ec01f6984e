//! Time of one training step of the compact network on random data.
use burn::module::Module;
use burn::optim::{AdamWConfig, GradientsParams};
use burn::tensor::{Device, Tensor, TensorData};
use sixfold_pix2pose::networks::CompactConfig;
use std::time::Instant;

fn main() {
    let device = Device::flex().autodiff();
    let mut net = CompactConfig { objects: 8 }.init_random(1, &device).freeze(2);
    println!("{} parameters", net.num_params());
    let mut optimiser = AdamWConfig::new().init();
    let per = 4;
    let x: Vec<f32> = (0..8 * per * 3 * 128 * 128).map(|i| (i % 255) as f32 / 128.0 - 1.0).collect();
    let x = Tensor::<4>::from_data(TensorData::new(x, [8 * per, 3, 128, 128]), &device);
    let objects: Vec<(usize, usize)> = (0..8).map(|o| (o, per)).collect();
    for _ in 0..6 {
        let t = Instant::now();
        let maps = net.encoder.forward(x.clone());
        let te = t.elapsed();
        drop(maps);
        let t = Instant::now();
        let out = net.forward(x.clone(), &objects);
        let tf = t.elapsed();
        let t = Instant::now();
        let loss = out.into_iter().map(|o| o.abs().mean()).reduce(|a, b| a + b).unwrap();
        let tl = t.elapsed();
        let t = Instant::now();
        let grads = loss.backward();
        let tb = t.elapsed();
        let t = Instant::now();
        let grads = GradientsParams::from_grads(grads, &net);
        net = optimiser.step(1e-3, net, grads);
        println!(
            "encoder {te:.1?} forward {tf:.1?} loss {tl:.1?} backward {tb:.1?} optimiser {:.1?}",
            t.elapsed()
        );
    }
}
